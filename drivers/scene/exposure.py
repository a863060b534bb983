"""From drawn pictures to the frames of a simulated camera: the views of its sensors, and their noise."""

from __future__ import annotations

import zlib
from dataclasses import replace
from functools import lru_cache
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.camera import frame_from_color
from hal.driver import RawFrame
from hal.errors import ConfigError, DeviceNotFound, Problem
from hal.geometry import Pose
from hal.randomization import vary_camera
from hal.specs import CameraSpec

from .disturbances import UNCHANGED, Randomized
from .drawn import DrawnWorld
from .renderer import RenderedImages, Renderer

if TYPE_CHECKING:
    from .depth_noise import DepthNoise

Image = NDArray[np.float32]
_SIDES = ("infrared", "infrared_right")


# --- frames ----------------------------------------------------------------------------------------------------------


class _Shot(NamedTuple):
    spec: CameraSpec
    T_color: Pose
    """Pose of the view in the frame of the colour sensor."""


class Exposure:
    """Makes the frames of one camera. Raises ConfigError for wrong noise options.

    Colour, depth and segmentation share one view, which is that of colour or depth. Each infrared picture has a view of
    its own, and costs another drawing, unless the views are the same. A randomization of the world changes them; its
    noise is that of its seed and of the number of frames since.
    """

    def __init__(self, spec: CameraSpec) -> None:
        self._nominal = spec
        self._frames_before = 0
        self._prepare(UNCHANGED)

    def _prepare(self, drawn: Randomized) -> None:
        """Build the views, and the noise, of a randomization."""
        spec = vary_camera(self._nominal, drawn.values)
        section = f"cameras.{spec.name}"
        self.randomized, self.spec = drawn, spec
        self.latency = drawn.get(section, "latency_s")
        """Time from the exposure to the program, s."""
        self._blur = PictureNoise(drawn.get(section, "color_noise"), drawn.get(section, "depth_noise"))
        self._key = drawn.seed, zlib.crc32(spec.name.encode())
        self._T_color = frame_from_color(spec)
        self._noise: DepthNoise | None = None
        if spec.options:
            from .depth_noise import depth_noise  # checks options with pydantic, which most processes do without

            self._noise = depth_noise(spec)
        self._sides = {name: _side(spec, name) for name in _SIDES if name in spec.streams}
        left = self._sides.get("infrared")
        if left is not None and (left.spec.K, left.T_color) == (spec.K, self._T_color):
            del self._sides["infrared"]  # it is drawn with the others
        streams = tuple(name for name in spec.streams if name not in self._sides and name != "infrared_right")
        self._main = _Shot(replace(spec, streams=streams), self._T_color) if streams else None

    def capture(self, world: DrawnWorld, renderer: Renderer, t: float, t_device: float, number: int) -> RawFrame:
        """Draw a frame of the present state of the world; its number also selects its noise.

        ``t`` and ``t_device`` are its stamps, s on the clocks of the rig and of the world.
        """
        if world.randomized is not self.randomized:
            self._prepare(world.randomized)
            self._frames_before = number - 1 if world.randomized.values else 0
        here = camera_pose(world, self.spec)
        view = _move_pose(here, self._T_color)
        images = RenderedImages(None, None, None, None)
        if self._main is not None:
            images = renderer.render(self._main.spec, view)
        sides = {
            name: renderer.render(shot.spec, _move_pose(here, shot.T_color)).infrared
            for name, shot in self._sides.items()
        }
        depth, count = images.depth, number - self._frames_before
        if self._noise is not None and depth is not None:
            depth = self._noise(depth, count)
        random = np.random.Generator(np.random.SFC64([*self._key, count])) if self._blur.active else None
        pictures = {**images._asdict(), **sides}
        light = {name: self._blur.blur_light(pictures.get(name), random) for name in ("color", *_SIDES)}
        return RawFrame(
            t,
            t_device,
            number,
            T_world_camera=view,
            skew=0.0 if images.color is not None and depth is not None else None,
            **{**pictures, **light, "depth": self._blur.blur_depth(depth, random)},
        )


class PictureNoise:
    """Normal noise of pictures; of depth it grows with the square of the distance, as that of stereo cameras does.

    Drawing a number for each pixel would take longer than drawing the picture: the noise is a part of one long
    sequence, which begins elsewhere for each picture. ``light`` is the standard deviation of colour and infrared, as a
    share of white, ``depth`` that of depth at 1 m, m.
    """

    def __init__(self, light: float, depth: float) -> None:
        self._light, self._depth = light, depth
        self._lighter: dict[int, tuple[NDArray[np.uint8], NDArray[np.uint8]]] = {}
        """What pictures of a size get added, and taken away."""
        self._farther: dict[int, Image] = {}
        """Noise of depth pictures of a size at 1 m, m."""
        self.active = light > 0.0 or depth > 0.0
        """Whether there is any."""

    def blur_light(
        self, picture: NDArray[np.uint8] | None, random: np.random.Generator | None
    ) -> NDArray[np.uint8] | None:
        """Return a picture of any shape with noise; ``random`` chooses it."""
        if picture is None or random is None or not self._light:
            return picture
        size, start = picture.size, int(random.integers(_STARTS))
        if size not in self._lighter:
            scaled = np.clip(np.rint(255.0 * self._light * _normal_numbers(size)), -255, 255).astype(np.int16)
            self._lighter[size] = np.maximum(scaled, 0).astype(np.uint8), np.maximum(-scaled, 0).astype(np.uint8)
        more, less = (part[start : start + size].reshape(picture.shape) for part in self._lighter[size])
        noisy = np.minimum(picture, 255 - more)  # nothing overflows, without a wider type, which would take longer
        noisy += more
        np.maximum(noisy, less, out=noisy)
        noisy -= less
        return noisy

    def blur_depth(self, depth: Image | None, random: np.random.Generator | None) -> Image | None:
        """Return depth (H, W), m, with noise where there is depth."""
        if depth is None or random is None or not self._depth:
            return depth
        size, start = depth.size, int(random.integers(_STARTS))
        if size not in self._farther:
            self._farther[size] = np.float32(self._depth) * _normal_numbers(size)
        noisy: Image = depth * depth
        noisy *= self._farther[size][start : start + size].reshape(depth.shape)
        noisy += depth
        return np.maximum(noisy, 0.0, out=noisy)


_STARTS = 1 << 16
"""Number of places where noise may begin."""


@lru_cache(maxsize=8)
def _normal_numbers(size: int) -> Image:
    """Return more than ``size`` numbers with a standard deviation of 1."""
    return np.random.default_rng(size).standard_normal(size + _STARTS, np.float32)


def _move_pose(pose: Pose, by: Pose) -> Pose:
    return pose @ by if by != Pose() else pose


def _side(spec: CameraSpec, name: str) -> _Shot:
    sensor = spec.sensors.get(name)
    view = Pose(sensor.position, sensor.orientation) if sensor is not None else frame_from_color(spec)
    return _Shot(replace(spec, streams=("infrared",), K=spec.K_infrared or spec.K), view)


def camera_pose(world: DrawnWorld, spec: CameraSpec) -> Pose:
    """Return the present pose of the colour sensor's optical frame in the world."""
    view = spec.view
    if view is None:
        return Pose()
    here = Pose(view.position, view.orientation)
    if view.robot is None:
        return here
    link = world.pose(view.robot, view.link)
    return Pose(link["position"], link["orientation"]) @ here


def check_view(world: DrawnWorld, spec: CameraSpec) -> None:
    """Raise ConfigError when a camera has no place, or is attached to a missing arm or link."""
    view = spec.view
    if view is None:
        message = "a simulated camera needs a place: look_at, pose or attached"
        raise ConfigError([Problem("cameras", f"cameras.{spec.name}", message, "camera_without_place")])
    if view.robot is not None:
        try:
            world.pose(view.robot, view.link)
        except DeviceNotFound as error:
            key = f"cameras.{spec.name}.attached"
            raise ConfigError([Problem("cameras", key, str(error), error.code)]) from None
