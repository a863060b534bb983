"""What is wrong with the depth of a real camera, done to a picture in which nothing is.

**Stereo** (D400 series). Depth is z = f b / d, with the disparity d in pixels, so an error of d becomes one of z that
grows with its square: RMS = subpixel z^2 / (f b). That is the formula of Intel's white paper on tuning these cameras
("Tuning depth cameras for best performance"); 0.08 pixels is what one of its authors advises to reckon with
(realsenseai/librealsense issue 3904; 0.032 at best). The matcher's finest step is 1/32 pixel (their white paper on
subpixel linearity). It compares patches, not pixels, so neighbours err alike, which is why planes look bumpy (issue
1910); how large the bumps are is chosen here. The left imager is its reference: what the right one does not see, behind
the left edge of a nearer thing or left of its own picture, has no depth (data sheet, "Invalid Depth Band", quoted in
issue 12072).

**Lidar** (L515). Standard deviation 2.5 mm at 1 m and 15.5 mm at 9 m, off a target that reflects 95 % of the light
(issue 5808); on a line between them, which is chosen here.

Not there: errors of calibration, errors that stay from frame to frame, plain surfaces, glass, mirrors, the sun.
"""

from __future__ import annotations

import math
import zlib
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hal.camera import handed_out
from hal.specs import CameraSpec, SensorSpec

from .depth_settings import LidarNoise, StereoNoise, noise_of

__all__ = ["DepthNoise", "depth_noise"]

Image = NDArray[np.float32]


class DepthNoise(Protocol):
    """Does to depth what a camera does."""

    def __call__(self, depth: Image, number: int) -> Image:
        """Depth (H, W), m, 0 where there is none, as it would be measured; ``number`` is that of the frame."""


def depth_noise(spec: CameraSpec) -> DepthNoise | None:
    """The noise that the rig asks for; None where it asks for none. Raises ConfigError."""
    noise = noise_of(spec)
    if noise is None or "depth" not in spec.sensors:
        return None
    kind = _Stereo if isinstance(noise, StereoNoise) else _Lidar
    return kind(spec, noise)  # type: ignore[arg-type]  # each kind has its own settings


class _Measured:
    """What every kind has: its chance, its range, its unit."""

    def __init__(self, spec: CameraSpec, noise: StereoNoise | LidarNoise) -> None:
        assert spec.depth_sensor is not None  # noise_of says so
        self._range = spec.depth_min, spec.depth_max
        self._unit = np.float32(spec.depth_sensor.unit)
        self._seed = noise.seed, zlib.crc32(spec.name.encode())

    def _chance(self, number: int) -> np.random.Generator:
        return np.random.Generator(np.random.SFC64([*self._seed, number]))

    def _read_out(self, depth: Image, seen: NDArray[np.bool_]) -> Image:
        """In whole units, and only within the range."""
        np.rint(depth / self._unit, out=depth)
        depth *= self._unit
        seen &= (depth >= self._range[0]) & (depth <= self._range[1])
        depth[~seen] = 0
        return depth


class _Stereo(_Measured):
    def __init__(self, spec: CameraSpec, noise: StereoNoise) -> None:
        super().__init__(spec, noise)
        sensor = spec.sensors["depth"]
        assert spec.depth_sensor is not None
        baseline = spec.depth_sensor.baseline
        self._noise = noise
        self._scale = np.float32(sensor.K[0][0] * baseline)
        """Depth x disparity, m x pixels of the captured depth picture."""
        self._bumps = _Bumps(spec.height, spec.width, noise.patch * spec.K[0][0] / sensor.K[0][0])
        left = handed_out(spec).inverse().transform(sensor.position)
        self._imagers = [_Imager(spec, sensor, offset, baseline) for offset in (left, left + [baseline, 0.0, 0.0])]

    def __call__(self, depth: Image, number: int) -> Image:
        seen = depth > 0
        disparity = np.divide(self._scale, depth, out=np.zeros_like(depth), where=seen)
        if self._noise.shadow:
            for imager in self._imagers:
                imager.look(disparity, seen)
        disparity += np.float32(self._noise.subpixel) * self._bumps(self._chance(number))
        if self._noise.step > 0.0:
            step = np.float32(self._noise.step)
            np.rint(disparity / step, out=disparity)
            disparity *= step
        seen &= disparity > 0
        return self._read_out(np.divide(self._scale, disparity, out=np.zeros_like(depth), where=seen), seen)


class _Imager:
    """One of the pair: what of the picture that is handed out does it see?"""

    def __init__(self, spec: CameraSpec, sensor: SensorSpec, offset: NDArray[np.float64], baseline: float) -> None:
        """``offset`` is where it is in the frame of the picture that is handed out, m; their axes are parallel."""
        K, own = np.array(spec.K), np.array(sensor.K)
        columns, rows = np.arange(spec.width), np.arange(spec.height)
        dx, dy, _ = offset / (sensor.K[0][0] * baseline)
        self._shift = np.float32(K[0, 0] * dx)
        """By how many columns a thing is further left for this imager, for each pixel of disparity: its parallax."""
        self._columns = columns.astype(np.float32)
        self._x = (own[0, 0] * (columns - K[0, 2]) / K[0, 0] + own[0, 2]).astype(np.float32)
        self._y = (own[1, 1] * (rows - K[1, 2]) / K[1, 1] + own[1, 2]).astype(np.float32)[:, None]
        """Where the pixels lie in its own picture, were they infinitely far away."""
        self._dx, self._dy = np.float32(own[0, 0] * dx), np.float32(own[1, 1] * dy)
        self._size = sensor.width - 0.5, sensor.height - 0.5
        self._is_view = bool(np.abs(offset).max() < 1e-6)

    def look(self, disparity: Image, seen: NDArray[np.bool_]) -> None:
        """Take out of ``seen`` what lies outside its picture, or behind something nearer."""
        x = self._x - self._dx * disparity
        y = self._y - self._dy * disparity if self._dy else self._y
        seen &= (x >= -0.5) & (x <= self._size[0]) & (y >= -0.5) & (y <= self._size[1])
        if not self._is_view and self._shift:
            self._hide(disparity, seen)

    def _hide(self, disparity: Image, seen: NDArray[np.bool_]) -> None:
        """Each pixel falls into a column of this imager; where a nearer one falls there too, it is hidden."""
        parallax = abs(self._shift) * disparity
        jumps = np.abs(np.diff(parallax, axis=1)).max(axis=1) > 1.0
        if not jumps.any():  # nothing hides what is next to it
            return
        parallax = parallax[jumps]
        height, width = parallax.shape
        margin = math.ceil(float(parallax.max())) + 2
        stride = width + 2 * margin
        places = np.rint(self._columns - np.copysign(parallax, self._shift)).astype(np.int32)
        places += (np.arange(height, dtype=np.int32) * stride + margin)[:, None]
        nearest = np.zeros(height * stride, np.float32)
        np.maximum.at(nearest, places.ravel(), parallax.ravel())
        closed = nearest.copy()  # a surface that this imager sees more of has gaps of a pixel: they hide, too
        np.maximum(closed[:-1], nearest[1:], out=closed[:-1])
        np.maximum(closed[1:], nearest[:-1], out=closed[1:])
        seen[jumps] &= closed[places] - parallax <= 1.0


class _Bumps:
    """Chance over a picture, normal with a deviation of 1 in every pixel, that changes slowly from pixel to pixel."""

    def __init__(self, height: int, width: int, patch: float) -> None:
        self._shape = height, width
        self._patch = patch

    def __call__(self, chance: np.random.Generator) -> Image:
        if self._patch <= 1.0:
            return chance.standard_normal(self._shape, np.float32)
        begin = chance.random(2)
        rows = self._between(self._shape[0], begin[0])
        columns = self._between(self._shape[1], begin[1])
        grid = chance.standard_normal((rows[0][-1] + 2, columns[0][-1] + 2), np.float32)
        coarse = grid[rows[0]] * rows[1][:, None] + grid[rows[0] + 1] * rows[2][:, None]
        fine: Image = coarse[:, columns[0]] * columns[1] + coarse[:, columns[0] + 1] * columns[2]
        return fine

    def _between(self, count: int, begin: float) -> tuple[NDArray[np.int64], Any, Any]:
        """For each pixel the point of the grid before it, and the weights of that and the next, of deviation 1."""
        at = np.arange(count) / self._patch + begin
        before = np.floor(at)
        share = at - before
        deviation = np.hypot(1.0 - share, share)
        weights = (1.0 - share) / deviation, share / deviation
        return before.astype(np.int64), weights[0].astype(np.float32), weights[1].astype(np.float32)


class _Lidar(_Measured):
    def __init__(self, spec: CameraSpec, noise: LidarNoise) -> None:
        super().__init__(spec, noise)
        self._rise = np.float32((noise.sigma_9m - noise.sigma_1m) / 8.0)
        self._begin = np.float32(noise.sigma_1m) - self._rise

    def __call__(self, depth: Image, number: int) -> Image:
        seen = depth > 0
        sigma = np.maximum(self._begin + self._rise * depth, 0)
        return self._read_out(depth + sigma * self._chance(number).standard_normal(depth.shape, np.float32), seen)
