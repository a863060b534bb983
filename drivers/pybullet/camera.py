"""The simulated camera, and where it gets its pictures from."""

from __future__ import annotations

from collections.abc import Callable
from typing import ClassVar, Protocol

from hal.camera import CameraDriver, RawFrame
from hal.errors import ConfigError, DeviceNotFound, NotSupported, Problem
from hal.host.frames import FrameRing
from hal.pose import Pose
from hal.specs import CameraSpec

from .rendering import Renderer
from .world import World

__all__ = ["DirectSource", "FrameSource", "PyBulletCamera", "SharedSource", "camera_pose", "draw"]


class FrameSource(Protocol):
    """Where the pictures of one camera come from."""

    def grab(self, timeout: float) -> RawFrame | None:
        """As :meth:`hal.camera.CameraDriver.grab`."""


class PyBulletCamera(CameraDriver):
    """A camera in the simulated world; ``source`` is a :class:`FrameSource`."""

    simulated: ClassVar[bool] = True

    def open(self) -> None:
        if not hasattr(self.source, "grab"):
            raise NotSupported(f"camera {self.spec.name} is simulated: it needs a simulated world to look at")

    def grab(self, timeout: float) -> RawFrame | None:
        source: FrameSource = self.source  # type: ignore[assignment]  # checked by open
        return source.grab(timeout)

    def close(self) -> None:
        """Nothing to let go of: the pictures' owner is the rig."""


class DirectSource:
    """Lock-step: draws the present state of the world, in the caller's thread."""

    def __init__(self, world: World, renderer: Renderer, spec: CameraSpec, now: Callable[[], float]) -> None:
        check_view(world, spec)
        self._world = world
        self._renderer = renderer
        self._spec = spec
        self._now = now
        self._seq = 0

    def grab(self, timeout: float) -> RawFrame:
        self._seq += 1
        return draw(self._world, self._renderer, self._spec, self._now(), self._world.t, self._seq)


class SharedSource:
    """Real time: the newest picture of the process that draws. ``check`` raises when that process is gone."""

    def __init__(self, ring: FrameRing, spec: CameraSpec, check: Callable[[], None]) -> None:
        self._ring = ring
        self._spec = spec
        self._check = check
        self._seq = 0

    def grab(self, timeout: float) -> RawFrame | None:
        frame = self._ring.take(self._spec.name, self._seq, timeout)
        if frame is None:
            self._check()
        else:
            self._seq = frame.seq
        return frame


def draw(world: World, renderer: Renderer, spec: CameraSpec, t: float, t_device: float, seq: int) -> RawFrame:
    """The picture that a camera takes of the world as it is."""
    pose = camera_pose(world, spec)
    images = renderer.render(spec, pose)
    return RawFrame(t, t_device, seq, images.color, images.depth, images.infrared, images.segmentation, pose)


def camera_pose(world: World, spec: CameraSpec) -> Pose:
    """Where the camera's optical frame is in the world now."""
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
