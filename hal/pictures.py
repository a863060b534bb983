"""What shows a simulated world: the renderer behind its cameras, and a window. Abstract; drivers bring them."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from .host.hosts import Host
from .pose import Pose
from .specs import CameraSpec

if TYPE_CHECKING:
    from .rig import Rig

__all__ = ["Pictures", "Shown", "Viewer", "Viewer3D"]


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
    """A window onto the world."""

    def __init__(self, host: Host) -> None:
        self.host = host


class Viewer3D(Shown):
    """A page with a rig's arms in three dimensions, and a handle on each tcp that a person may drag."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    @property
    @abstractmethod
    def link(self) -> str:
        """What a person opens."""

    @abstractmethod
    def goal(self, robot: str) -> Pose | None:
        """Where a person has dragged the handle of this arm: a pose of the tcp in the arm's base frame, or None.

        A wish, not a permission: whoever moves the arm there asks its dead-man.
        """

    @abstractmethod
    def clear_goal(self, robot: str) -> None:
        """Put the handle back onto the tcp."""
