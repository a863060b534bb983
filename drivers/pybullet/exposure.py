"""One frame of a simulated camera: the pictures of all its sensors, taken at one moment."""

from __future__ import annotations

from dataclasses import replace
from typing import NamedTuple

from hal.camera import RawFrame, handed_out
from hal.errors import ConfigError, DeviceNotFound, Problem
from hal.geometry import Pose
from hal.specs import CameraSpec

from .depth_noise import depth_noise
from .rendering import Images, Renderer
from .world import World

__all__ = ["Exposure", "camera_pose", "check_view"]

_SIDES = ("infrared", "infrared_right")


class _Shot(NamedTuple):
    """What is drawn in one go: the streams of one view."""

    spec: CameraSpec
    T_color: Pose
    """Pose of the view in that of the colour sensor."""


class Exposure:
    """Takes the frames of one camera. Raises ConfigError when its noise cannot be.

    Colour, depth and segmentation are of one view, which is colour's or depth's. Each infrared picture has a view of
    its own, and costs another drawing, unless it is that very view.
    """

    def __init__(self, spec: CameraSpec) -> None:
        self.spec = spec
        self._T_color = handed_out(spec)
        self._noise = depth_noise(spec)
        self._sides = {name: _side(spec, name) for name in _SIDES if name in spec.streams}
        left = self._sides.get("infrared")
        if left is not None and (left.spec.K, left.T_color) == (spec.K, self._T_color):
            del self._sides["infrared"]  # it is drawn with the others
        streams = tuple(name for name in spec.streams if name not in self._sides and name != "infrared_right")
        self._main = _Shot(replace(spec, streams=streams), self._T_color) if streams else None

    def take(self, world: World, renderer: Renderer, t: float, t_device: float, number: int) -> RawFrame:
        """The frame ``number`` of the world as it is."""
        here = camera_pose(world, self.spec)
        view = _moved(here, self._T_color)
        images = Images(None, None, None, None)
        if self._main is not None:
            images = renderer.render(self._main.spec, view)
        sides = {
            name: renderer.render(shot.spec, _moved(here, shot.T_color)).infrared for name, shot in self._sides.items()
        }
        depth = images.depth
        if self._noise is not None and depth is not None:
            depth = self._noise(depth, number)
        return RawFrame(
            t,
            t_device,
            number,
            images.color,
            depth,
            sides.get("infrared", images.infrared),
            images.segmentation,
            view,
            sides.get("infrared_right"),
            skew=0.0 if images.color is not None and depth is not None else None,
        )


def _moved(pose: Pose, by: Pose) -> Pose:
    return pose @ by if by != Pose() else pose


def _side(spec: CameraSpec, name: str) -> _Shot:
    sensor = spec.sensors.get(name)
    view = Pose(sensor.position, sensor.orientation) if sensor is not None else handed_out(spec)
    return _Shot(replace(spec, streams=("infrared",), K=spec.K_infrared or spec.K), view)


def camera_pose(world: World, spec: CameraSpec) -> Pose:
    """Where the colour sensor's optical frame is in the world now."""
    view = spec.view
    if view is None:
        return Pose()
    here = Pose(view.position, view.orientation)
    if view.robot is None:
        return here
    link = world.pose(view.robot, view.link)
    return Pose(link["position"], link["orientation"]) @ here


def check_view(world: World, spec: CameraSpec) -> None:
    """Raise ConfigError when a camera cannot be where it says that it is."""
    view = spec.view
    if view is None:
        message = "a simulated camera needs look_at, pose or attached to know where it is"
        raise ConfigError([Problem("cameras", f"cameras.{spec.name}", message)])
    if view.robot is not None:
        try:
            world.pose(view.robot, view.link)
        except DeviceNotFound as error:
            raise ConfigError([Problem("cameras", f"cameras.{spec.name}.attached", str(error))]) from None
