"""What shows a simulated world: the renderer behind its cameras, and a window. Abstract; drivers bring them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import Any

from .host.hosts import Host
from .specs import CameraSpec

__all__ = ["Pictures", "Shown", "Viewer"]


class Shown(ABC):
    """Something that mirrors the world of a host, in a process of its own in real time."""

    notes: tuple[str, ...] = ()
    """What a person should know, for the banner."""

    @abstractmethod
    def wait_ready(self) -> None:
        """Wait until it shows the world; raises the error that it met while it started."""

    @abstractmethod
    def edited(self, method: str, params: dict[str, Any], revision: int) -> None:
        """The world was edited: do the same before a snapshot of that revision is shown."""

    @abstractmethod
    def describe(self) -> str:
        """What it is, in words, for the banner."""

    @abstractmethod
    def close(self) -> None:
        """End it. Idempotent."""


class Pictures(Shown):
    """The renderer of all simulated cameras of a world."""

    def __init__(self, host: Host, cameras: Sequence[CameraSpec], renderer: str) -> None:
        self.host = host
        self.cameras = {camera.name: camera for camera in cameras}
        self.renderer = renderer

    def __contains__(self, camera: object) -> bool:
        return camera in self.cameras

    @abstractmethod
    def source(self, camera: str) -> object:
        """Where the driver of this camera gets its pictures from."""


class Viewer(Shown):
    """A window onto the world. Its keyboard may serve as a gamepad."""

    def __init__(self, host: Host) -> None:
        self.host = host

    @abstractmethod
    def keyboard(self) -> object | None:
        """Where the driver of the keyboard's gamepad gets its record from; None when the window has none."""
