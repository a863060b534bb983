"""The simulated camera, and where it gets its pictures from."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import PurePath
from typing import ClassVar, Protocol

from hal.camera import CameraDriver, RawFrame
from hal.driver import CameraInfo, nominal_info
from hal.errors import ConnectionLost, NotSupported
from hal.host.ring import FrameRing
from hal.specs import CameraSpec

from .depth_settings import noise_of
from .exposure import Exposure, camera_pose, check_view
from .rendering import Renderer
from .world import World

__all__ = ["DirectSource", "FrameSource", "PyBulletCamera", "SharedSource", "camera_pose"]


class FrameSource(Protocol):
    """Where the pictures of one camera come from."""

    def grab(self, timeout: float) -> RawFrame | None:
        """As :meth:`hal.camera.CameraDriver.grab`."""


class PyBulletCamera(CameraDriver):
    """A camera in the simulated world; ``source`` is a :class:`FrameSource`."""

    simulated: ClassVar[bool] = True

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._open = False
        info = nominal_info(spec, "simulated", f"simulated {PurePath(spec.model).stem}")
        sensor = spec.depth_sensor if noise_of(spec) is not None else None
        # With noise, depth comes in whole units, as from a real camera.
        self._info = replace(info, depth_scale=sensor.unit) if sensor is not None else info

    @property
    def info(self) -> CameraInfo:
        """The figures of the camera's model, which the pictures are drawn by."""
        return self._info

    def open(self) -> None:
        if not hasattr(self.source, "grab"):
            raise NotSupported(f"camera {self.spec.name} is simulated: it needs a simulated world to look at")
        self._open = True

    def grab(self, timeout: float) -> RawFrame | None:
        if not self._open:
            raise ConnectionLost(f"camera {self.spec.name} is not open")
        source: FrameSource = self.source  # type: ignore[assignment]  # checked by open
        try:
            return source.grab(timeout)
        except ConnectionLost as error:  # whatever drew the pictures is gone, and is not begun anew
            lost = ConnectionLost(f"{error}; open the rig anew")
            lost.final = True
            raise lost from error

    def close(self) -> None:
        """Nothing to let go of: the pictures' owner is the rig."""
        self._open = False


class DirectSource:
    """Lock-step: draws the present state of the world, in the caller's thread, and each state once."""

    def __init__(self, world: World, renderer: Renderer, spec: CameraSpec, now: Callable[[], float]) -> None:
        check_view(world, spec)
        self._world = world
        self._renderer = renderer
        self._exposure = Exposure(spec)
        self._now = now
        self._seq = 0
        self._drawn: tuple[tuple[int, int], RawFrame] | None = None
        """The newest frame, and the world's version that it shows."""

    def grab(self, timeout: float) -> RawFrame:
        version = self._world.version
        if self._drawn is None or self._drawn[0] != version:
            self._seq += 1
            frame = self._exposure.take(self._world, self._renderer, self._now(), self._world.t, self._seq)
            self._drawn = version, frame
        return self._drawn[1]


class SharedSource:
    """Real time: the newest picture of the process that draws. ``check`` raises when that process is gone."""

    def __init__(self, ring: FrameRing, check: Callable[[], None]) -> None:
        self._ring = ring
        self._check = check
        self._seq = 0

    def grab(self, timeout: float) -> RawFrame | None:
        frame = self._ring.wait(self._seq, timeout)
        if frame is None:
            self._check()
        else:
            self._seq = frame.seq
        return frame
