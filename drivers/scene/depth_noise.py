"""The noise of a simulated camera's depth.

The errors of a real camera's depth, added to exact depth:

**Stereo** (D400 series). Depth is z = f b / d, with the disparity d in pixels, so an error of d becomes one of z that
grows with its square: RMS = subpixel z^2 / (f b). That is the formula of Intel's white paper on tuning these cameras
("Tuning depth cameras for best performance"); 0.08 pixels is what one of its authors recommends to assume
(realsenseai/librealsense issue 3904; 0.032 at best). The matcher's finest step is 1/32 pixel (their white paper on
subpixel linearity). It compares patches, not pixels, so neighbours have similar errors, which is why planes look bumpy
(issue 1910); the size of the bumps is our choice. The left imager is the reference: what the right one does not see,
behind the left edge of a nearer object or left of its own picture, has no depth (data sheet, "Invalid Depth Band",
quoted in issue 12072).

**Lidar** (L515). Standard deviation 2.5 mm at 1 m and 15.5 mm at 9 m, off a target that reflects 95 % of the light
(issue 5808); linear in between, which is our choice.

Not modelled: calibration errors, errors that persist from frame to frame, untextured surfaces, glass, mirrors, the sun.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from hal.camera import frame_from_color
from hal.config.files import Problems, validate
from hal.config.schema import Flag, Strict, describe
from hal.errors import ConfigError, Problem
from hal.specs import CameraSpec, SensorSpec

Image = NDArray[np.float32]


# --- options ---------------------------------------------------------------------------------------------------------


class _CameraOptions(Strict):
    """The keys of ``simulated:`` in a camera's entry of the rig."""

    depth_noise: Any = False


class DepthNoiseOptions(Strict):
    """Options that every kind of depth sensor has."""

    seed: int = Field(default=0, ge=0, strict=True)
    """In lock-step the same seed gives the same noise, frame by frame."""


class StereoNoiseOptions(DepthNoiseOptions):
    """Noise of depth that is computed from two pictures. Pixels are those of the depth picture as captured."""

    subpixel: float = Field(default=0.08, gt=0.0, le=2.0, strict=True)
    """RMS error of the disparity, pixels."""
    step: float = Field(default=1 / 32, ge=0.0, le=1.0, strict=True)
    """Smallest difference between two disparities, pixels; 0 for none."""
    patch: float = Field(default=4.0, ge=1.0, le=64.0, strict=True)
    """Distance over which neighbours have similar errors, pixels; 1 for independent errors."""
    shadow: Flag = True
    """Whether depth is missing where only one of the two imagers sees."""


class LidarNoiseOptions(DepthNoiseOptions):
    """Noise of depth that is measured by time of flight: standard deviations, m, with a line through both."""

    sigma_1m: float = Field(default=0.0025, ge=0.0, le=1.0, strict=True)
    sigma_9m: float = Field(default=0.0155, ge=0.0, le=1.0, strict=True)


NoiseOptions = StereoNoiseOptions | LidarNoiseOptions
_OPTIONS: dict[str, type[StereoNoiseOptions] | type[LidarNoiseOptions]] = {
    "stereo": StereoNoiseOptions,
    "lidar": LidarNoiseOptions,
}


def check(spec: CameraSpec) -> Iterator[tuple[str, str, str]]:
    """Yield (key in the camera's entry of the rig, message, code) for each problem in a simulated camera's options."""
    try:
        noise_of(spec)
    except ConfigError as error:
        for problem in error.problems:
            yield problem.key, problem.message, problem.code


def noise_of(spec: CameraSpec) -> NoiseOptions | None:
    """Return the options of this camera's depth noise, None without noise; raises ConfigError, which lists problems."""
    problems = Problems()
    given = validate(_CameraOptions, spec.options, "", problems, "simulated").depth_noise
    problems.raise_any()
    if given is False:
        return None
    key = "simulated.depth_noise"
    if spec.depth_sensor is None:
        message = f"is not known for model {spec.model!r}, which has no depth_sensor"
        raise ConfigError([Problem("", key, message, "conflict")])
    kind = _OPTIONS[spec.depth_sensor.kind]
    if given is not True and not isinstance(given, Mapping):
        keys = ", ".join(kind.model_fields)
        message = f"must be true, false or keys and values, not {describe(given)}; keys: {keys}"
        raise ConfigError([Problem("", key, message, "wrong_type")])
    found = validate(kind, {} if given is True else given, "", problems, key)
    problems.raise_any()
    return found


# --- noise -----------------------------------------------------------------------------------------------------------


class DepthNoise:
    """Turns exact depth into measured depth: common part of all kinds of sensors. Raises ConfigError."""

    def __init__(self, spec: CameraSpec, noise: NoiseOptions) -> None:
        assert spec.depth_sensor is not None  # checked by noise_of
        self._range = spec.depth_min, spec.depth_max
        self._unit = np.float32(spec.depth_sensor.unit)
        self._seed = noise.seed, zlib.crc32(spec.name.encode())

    def __call__(self, depth: Image, number: int) -> Image:
        """Return the measured depth (H, W), m, of a frame by its number; 0 for none. ``depth`` may be changed."""
        raise NotImplementedError

    def _generator(self, number: int) -> np.random.Generator:
        return np.random.Generator(np.random.SFC64([*self._seed, number]))

    def _read_out(self, depth: Image, seen: NDArray[np.bool_]) -> Image:
        """Return depth in whole units where ``seen``, and only within the range."""
        np.rint(depth / self._unit, out=depth)
        depth *= self._unit
        seen &= (depth >= self._range[0]) & (depth <= self._range[1])
        depth[~seen] = 0
        return depth


def depth_noise(spec: CameraSpec) -> DepthNoise | None:
    """Return the noise of a camera's depth, None without noise; raises ConfigError."""
    noise = noise_of(spec)
    if noise is None or "depth" not in spec.sensors:
        return None
    return _StereoNoise(spec, noise) if isinstance(noise, StereoNoiseOptions) else _LidarNoise(spec, noise)


class _StereoNoise(DepthNoise):
    def __init__(self, spec: CameraSpec, noise: StereoNoiseOptions) -> None:
        super().__init__(spec, noise)
        sensor = spec.sensors["depth"]
        assert spec.depth_sensor is not None
        baseline = spec.depth_sensor.baseline
        self._noise = noise
        self._scale = np.float32(sensor.K[0][0] * baseline)
        """Depth x disparity, m x pixels of the captured depth picture."""
        self._bumps = _SmoothNoise(spec.height, spec.width, noise.patch * spec.K[0][0] / sensor.K[0][0])
        left = frame_from_color(spec).inverse().transform(sensor.position)
        self._imagers = [_Imager(spec, sensor, offset, baseline) for offset in (left, left + [baseline, 0.0, 0.0])]

    def __call__(self, depth: Image, number: int) -> Image:
        seen = depth > 0
        disparity = np.divide(self._scale, depth, out=np.zeros_like(depth), where=seen)
        if self._noise.shadow:
            for imager in self._imagers:
                imager.remove_unseen(disparity, seen)
        disparity += np.float32(self._noise.subpixel) * self._bumps(self._generator(number))
        if self._noise.step > 0.0:
            step = np.float32(self._noise.step)
            np.rint(disparity / step, out=disparity)
            disparity *= step
        seen &= disparity > 0
        return self._read_out(np.divide(self._scale, disparity, out=np.zeros_like(depth), where=seen), seen)


class _Imager:
    """One of the two imagers, ``baseline`` m apart, and what it sees of the picture that is handed out.

    ``offset`` (3,), m, is its position in the frame of that picture; their axes are parallel.
    """

    def __init__(self, spec: CameraSpec, sensor: SensorSpec, offset: NDArray[np.float64], baseline: float) -> None:
        K, own = np.array(spec.K), np.array(sensor.K)
        columns, rows = np.arange(spec.width), np.arange(spec.height)
        dx, dy, _ = offset / (sensor.K[0][0] * baseline)
        self._shift = np.float32(K[0, 0] * dx)
        """Parallax: columns by which an object is further left for this imager, per pixel of disparity."""
        self._columns = columns.astype(np.float32)
        self._x = (own[0, 0] * (columns - K[0, 2]) / K[0, 0] + own[0, 2]).astype(np.float32)
        self._y = (own[1, 1] * (rows - K[1, 2]) / K[1, 1] + own[1, 2]).astype(np.float32)[:, None]
        """Place of the pixels in its own picture, were they infinitely far away."""
        self._dx, self._dy = np.float32(own[0, 0] * dx), np.float32(own[1, 1] * dy)
        self._size = sensor.width - 0.5, sensor.height - 0.5
        self._is_view = bool(np.abs(offset).max() < 1e-6)

    def remove_unseen(self, disparity: Image, seen: NDArray[np.bool_]) -> None:
        """Clear in ``seen`` what lies outside its picture, or behind something nearer."""
        x = self._x - self._dx * disparity
        y = self._y - self._dy * disparity if self._dy else self._y
        seen &= (x >= -0.5) & (x <= self._size[0]) & (y >= -0.5) & (y <= self._size[1])
        if not self._is_view and self._shift:
            self._hide(disparity, seen)

    def _hide(self, disparity: Image, seen: NDArray[np.bool_]) -> None:
        """Clear in ``seen`` the pixels that fall into the same column of this imager as a nearer one."""
        parallax = abs(self._shift) * disparity
        jumps = np.abs(np.diff(parallax, axis=1)).max(axis=1) > 1.0
        if not jumps.any():  # no pixel hides its neighbour
            return
        parallax = parallax[jumps]
        height, width = parallax.shape
        margin = math.ceil(float(parallax.max())) + 2
        stride = width + 2 * margin
        places = np.rint(self._columns - np.copysign(parallax, self._shift)).astype(np.int32)
        places += (np.arange(height, dtype=np.int32) * stride + margin)[:, None]
        nearest = np.zeros(height * stride, np.float32)
        np.maximum.at(nearest, places.ravel(), parallax.ravel())
        closed = nearest.copy()  # a surface that this imager sees at a larger scale has gaps of a pixel, which hide too
        np.maximum(closed[:-1], nearest[1:], out=closed[:-1])
        np.maximum(closed[1:], nearest[:-1], out=closed[1:])
        seen[jumps] &= closed[places] - parallax <= 1.0


class _SmoothNoise:
    """Normal noise over a picture, with a standard deviation of 1, that is correlated over ``patch`` pixels."""

    def __init__(self, height: int, width: int, patch: float) -> None:
        self._shape = height, width
        self._patch = patch

    def __call__(self, generator: np.random.Generator) -> Image:
        if self._patch <= 1.0:
            return generator.standard_normal(self._shape, np.float32)
        start = generator.random(2)
        rows = self._find_neighbours(self._shape[0], start[0])
        columns = self._find_neighbours(self._shape[1], start[1])
        grid = generator.standard_normal((rows[0][-1] + 2, columns[0][-1] + 2), np.float32)
        coarse = grid[rows[0]] * rows[1][:, None] + grid[rows[0] + 1] * rows[2][:, None]
        fine: Image = coarse[:, columns[0]] * columns[1] + coarse[:, columns[0] + 1] * columns[2]
        return fine

    def _find_neighbours(self, count: int, start: float) -> tuple[NDArray[np.int64], Any, Any]:
        """Return, for each pixel, the grid point before it, and its weight and the next one's, for a deviation of 1."""
        at = np.arange(count) / self._patch + start
        before = np.floor(at)
        share = at - before
        deviation = np.hypot(1.0 - share, share)
        weights = (1.0 - share) / deviation, share / deviation
        return before.astype(np.int64), weights[0].astype(np.float32), weights[1].astype(np.float32)


class _LidarNoise(DepthNoise):
    def __init__(self, spec: CameraSpec, noise: LidarNoiseOptions) -> None:
        super().__init__(spec, noise)
        self._slope = np.float32((noise.sigma_9m - noise.sigma_1m) / 8.0)
        self._sigma_0 = np.float32(noise.sigma_1m) - self._slope

    def __call__(self, depth: Image, number: int) -> Image:
        seen = depth > 0
        sigma = np.maximum(self._sigma_0 + self._slope * depth, 0)
        return self._read_out(depth + sigma * self._generator(number).standard_normal(depth.shape, np.float32), seen)
