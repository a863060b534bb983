"""The console: a page in a browser that shows a rig and, as a gamepad, drives it. Abstract; a driver brings it."""

from __future__ import annotations

import math
import socket
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from .errors import CommandError
from .geometry import Pose
from .host.hosts import Host
from .specs import CameraSpec

if TYPE_CHECKING:
    from .camera import Camera
    from .rig import Rig

__all__ = [
    "ACTIONS",
    "Console",
    "DrivingView",
    "Listen",
    "PHASES",
    "PORT",
    "Pictures",
    "RecordingView",
    "SETTINGS",
    "Shown",
    "Viewer",
    "Viewer3D",
]

# [console.py] The console: a page in a browser that shows a rig and, as a gamepad, drives it. Abstract; a driver
# brings it.

LOOPBACK = "127.0.0.1"
PORT = 8470
"""Where the console listens unless told otherwise; the next free port where that is taken."""
_PORTS = 65535
PHASES = ("resetting", "ready", "recording", "saving", "done")
"""What a program that records episodes may be at."""
ACTIONS = ("record", "finish", "fail", "discard")
"""What a page may ask it for: start an episode, save it as a success, save it as a failure, throw it away."""

SETTINGS = ("robot", "speed", "frame", "scene")
"""What the page in control may set: the arm that it drives, its speed, its frame; and ``scene``, which is reset."""
FRAMES = ("base", "tcp")
"""Whose axes an arm may be driven along: those of its base, or of its tool."""


class Listen(NamedTuple):
    """Where to listen."""

    address: str = LOOPBACK
    """Of an interface; other than loopback only where the user said so."""
    port: int = PORT
    fixed: bool = False
    """Was the port asked for, so that no other will do?"""

    @classmethod
    def parse(cls, text: str | None) -> Listen:
        """``ADDRESS[:PORT]`` or ``:PORT``, IPv6 in brackets; None is loopback. CommandError for anything else."""
        if text is None:
            return cls()
        hint = f"; for a port alone write :{text}" if text.isdigit() else ""
        wrong = CommandError(f"--listen takes an address and a port, for example 0.0.0.0:{PORT}, not {text!r}{hint}")
        if hint:
            raise wrong
        if text.startswith("["):
            address, bracket, rest = text[1:].partition("]")
            if not bracket or (rest and not rest.startswith(":")):
                raise wrong
            port = rest[1:]
        elif text.count(":") > 1:  # an IPv6 address without brackets
            address, port = text, ""
        else:
            address, _, port = text.partition(":")
        if port and not (port.isascii() and port.isdigit() and int(port) <= _PORTS):
            raise wrong
        return cls(address or LOOPBACK, int(port) if port else PORT, bool(port))

    def check(self) -> None:
        """Raise CommandError where nothing can listen: at an address of another machine, or at a port that is taken."""
        port = self.port if self.fixed else 0
        try:
            family, kind, protocol, _, place = socket.getaddrinfo(self.address, port, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(place)
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise CommandError(f"--listen: nothing can listen at {self.address}, port {self.port}: {reason}") from None


@dataclass(frozen=True, slots=True)
class RecordingView:
    """A recording, as pages show it. CommandError for a phase or an action that is none, or for times that are none."""

    phase: str
    """One of :data:`PHASES`."""
    prompt: str
    """What the person should do now, one line."""
    task: str
    episode: int
    """Number in the dataset of the present episode, or of the next one."""
    saved: int
    """Episodes of this run that are kept: :attr:`succeeded` and :attr:`failed`."""
    wanted: int
    """Episodes that this run is to keep; 0: no number was given."""
    succeeded: int
    failed: int
    discarded: int
    seconds: float
    """Length of the present episode."""
    frames: int
    """Its rows so far."""
    dropped: int
    """Rows that it lacks."""
    free_bytes: int
    """Free space on the disk."""
    trouble: str
    """What a person should look at; empty where all is well."""
    actions: tuple[str, ...]
    """Those of :data:`ACTIONS` that are possible now."""

    def __post_init__(self) -> None:
        if self.phase not in PHASES:
            raise CommandError(f"a recording is one of {', '.join(PHASES)}, not {self.phase!r}")
        wrong = [action for action in self.actions if action not in ACTIONS]
        if wrong:
            raise CommandError(f"an action is one of {', '.join(ACTIONS)}, not {wrong[0]!r}")
        if not (math.isfinite(self.seconds) and self.seconds >= 0.0):
            raise CommandError(f"seconds must be finite and at least 0, not {self.seconds}")


@dataclass(frozen=True, slots=True)
class DrivingView:
    """Which arm a pad drives, and how. CommandError for a frame or a setting that does not exist, or a wrong speed."""

    robot: str
    """Name of the arm that the pad drives."""
    speed: float = 1.0
    """Share of the mapping's speeds, above 0, at most :attr:`speed_max`."""
    speed_max: float = 1.0
    """Greatest :attr:`speed` that a page may set, at most 1."""
    frame: str = "base"
    """``base`` or ``tcp``: the axes that the controls move along."""
    settings: tuple[str, ...] = ()
    """Those of :data:`SETTINGS` that the page in control may set."""

    def __post_init__(self) -> None:
        if not 0.0 < self.speed <= self.speed_max <= 1.0:
            raise CommandError(f"a speed must be above 0 and at most 1, not {self.speed} of {self.speed_max}")
        if self.frame not in FRAMES:
            raise CommandError(f"a frame must be one of {', '.join(FRAMES)}, not {self.frame!r}")
        unknown = [name for name in self.settings if name not in SETTINGS]
        if unknown:
            raise CommandError(f"a setting must be one of {', '.join(SETTINGS)}, not {unknown[0]!r}")


class Console(ABC):
    """The page and the server behind it. ``wait_ready`` comes once, then everything else, from any thread."""

    notes: tuple[str, ...] = ()
    """What a person should know, for the banner."""

    def __init__(self, rig: Rig, listen: Listen, *, driven_by: str | None) -> None:
        """``driven_by`` names what drives where it is not the page, which then only shows, and stops."""
        self.rig = rig
        self.listen = listen
        self.driven_by = driven_by

    @abstractmethod
    def wait_ready(self) -> None:
        """Wait until pages can be opened; raises the error that the server met."""

    @property
    @abstractmethod
    def link(self) -> str:
        """What a person opens. Whoever has it may drive, so it is a secret."""

    @property
    @abstractmethod
    def tunnel(self) -> str:
        """The command that makes the link work on another computer; empty where none is needed."""

    @abstractmethod
    def show(self, camera: Camera) -> None:
        """Show this camera to whoever watches it."""

    @abstractmethod
    def say(self, text: str) -> None:
        """Show a line on every page."""

    @abstractmethod
    def explain(self, labels: Mapping[str, Any]) -> None:
        """Write onto the page's controls what they do: :meth:`hal.teleop.Teleop.labels`."""

    @abstractmethod
    def show_driving(self, view: DrivingView) -> None:
        """Show which arm is driven, how fast and in which frame; never waits. Only the newest view counts."""

    @abstractmethod
    def on_setting(self, changed: Callable[[str, str | float], None]) -> None:
        """Call ``changed`` when the page in control changes one of the settings of the newest :class:`DrivingView`.

        It gets the setting's name and value: the name of an arm, a share of the mapping's speeds, a frame, or
        ``"reset"`` for ``scene``. As with :meth:`on_action`, it must only note them and return. The program decides:
        it must change the arm or the frame only while the dead-man is released, and stop the arm before it resets the
        scene. What it does shows in its next :class:`DrivingView`.
        """

    @abstractmethod
    def show_recording(self, view: RecordingView) -> None:
        """Show how a recording goes, from now on; never waits. The panel for it appears with the first one.

        Only the newest counts. While an episode is recorded, say so now and then: after ten seconds without news pages
        show that there are none.
        """

    @abstractmethod
    def on_action(self, taken: Callable[[str], None]) -> None:
        """Call ``taken`` with one of :data:`ACTIONS` when the page that drives presses that button.

        It may come when it is no longer possible, and it is called in the thread that brings the pad, which trips the
        arm where it is held up: note it, and return. What it raises is printed. A later ``taken`` replaces this one.
        """

    @abstractmethod
    def close(self) -> None:
        """End it. Idempotent."""


# [pictures.py] What shows a simulated world: the renderer behind its cameras, and a window. Abstract; drivers
# bring them.


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
