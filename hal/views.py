"""Views of a rig, abstract: the console in a browser, the renderer of simulated cameras, the viewers."""

from __future__ import annotations

import socket
from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, NamedTuple

from .arguments import choice, number
from .errors import CommandError
from .geometry import Pose
from .host.hosts import Host
from .specs import CameraSpec

if TYPE_CHECKING:
    from .camera import Camera
    from .rig import Rig

LOOPBACK = "127.0.0.1"
PORT = 8470
"""Default port of the console; the next free one if it is taken."""
_PORTS = 65535
PHASES = ("resetting", "ready", "recording", "saving", "done")
"""Phases of a program that records episodes."""
ACTIONS = ("record", "finish", "fail", "discard")
"""Requests of a page to that program: start an episode, save it as a success, save it as a failure, discard it."""
SETTINGS = ("robot", "speed", "frame", "scene")
"""Settings that the page in control may change: the arm to drive, its speed, its frame; ``scene`` resets the scene."""
FRAMES = ("base", "tcp")
"""Frames along whose axes an arm may be driven."""


class Console(ABC):
    """A page in a browser that displays a rig and, as a gamepad, drives it; and its server.

    With ``driven_by``, the pad that drives if it is not the page, the page only displays and stops. ``wait_ready`` is
    called once and first; everything else may be called from any thread.
    """

    notes: tuple[str, ...] = ()
    """Messages for the user, for the banner."""

    def __init__(self, rig: Rig, listen: Listen, *, driven_by: str | None) -> None:
        self.rig = rig
        self.listen = listen
        self.driven_by = driven_by
        self.driver: str | None = None
        """Name of the page in control, for example ``page 3``; None if there is none."""

    @abstractmethod
    def wait_ready(self) -> None:
        """Wait until pages can be opened; raise the server's error if it failed."""

    @property
    @abstractmethod
    def link(self) -> str:
        """Address to open in a browser. It permits to drive, so it is a secret."""

    @property
    @abstractmethod
    def tunnel(self) -> str:
        """Command that makes the link work on another computer; empty if none is needed."""

    @abstractmethod
    def show_camera(self, camera: Camera) -> None:
        """Display a camera's frames to the pages that show it."""

    @abstractmethod
    def say(self, text: str) -> None:
        """Display a line on every page."""

    @abstractmethod
    def explain(self, labels: Mapping[str, Any]) -> None:
        """Label the page's controls; the labels are those of :meth:`hal.teleop.Teleop.labels`."""

    @abstractmethod
    def show_driving(self, view: DrivingView) -> None:
        """Display which arm is driven, how fast and in which frame; never waits. Only the newest view counts."""

    @abstractmethod
    def on_setting(self, changed: Callable[[str, str | float], None]) -> None:
        """Call a function when the page in control changes a setting of the newest :class:`DrivingView`.

        Args:
            changed: Gets the setting and its value: the name of an arm, a share of the mapping's speeds, a frame, or
                ``"reset"`` for ``scene``. It must only note them and return, as with :meth:`on_action`. The program
                decides: it must change the arm or the frame only while the dead-man is released, and stop the arm
                before it resets the scene. Its next :class:`DrivingView` shows the result.
        """

    @abstractmethod
    def show_recording(self, view: RecordingView) -> None:
        """Display the state of a recording; never waits. The first call adds the panel to the pages.

        Only the newest view counts. While an episode is recorded, call it at least every 10 s: after that pages report
        that there is no news.
        """

    @abstractmethod
    def on_action(self, taken: Callable[[str], None]) -> None:
        """Call a function with one of :data:`ACTIONS` when the page in control presses that button.

        Args:
            taken: It may be called when the action is no longer possible. It is called in the thread that brings the
                pad's state, and delaying that trips the arm: note the action and return. Its exceptions are printed. A
                later function replaces this one.
        """

    @abstractmethod
    def close(self) -> None:
        """Stop the server. Idempotent."""


class Listen(NamedTuple):
    """Address and port to listen at."""

    address: str = LOOPBACK
    """Address of an interface; this computer only, unless the user chose another."""
    port: int = PORT
    fixed: bool = False
    """Whether the user chose the port, so that no other will do."""

    @classmethod
    def parse(cls, text: str | None) -> Listen:
        """Return the address and port of a text.

        Args:
            text: ``ADDRESS[:PORT]`` or ``:PORT``, IPv6 addresses in brackets; None for the default.

        Raises:
            CommandError: Anything else (``code`` is ``bad_address``).
        """
        if text is None:
            return cls()
        hint = f"; for a port alone write :{text}" if text.isdigit() else ""
        wrong = CommandError(
            f"--listen takes an address and a port, for example 0.0.0.0:{PORT}, not {text!r}{hint}", code="bad_address"
        )
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
        """Raise CommandError if a server cannot listen there: not an address of this computer, or a taken port."""
        port = self.port if self.fixed else 0
        try:
            family, kind, protocol, _, place = socket.getaddrinfo(self.address, port, type=socket.SOCK_STREAM)[0]
            with socket.socket(family, kind, protocol) as probe:
                probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(place)
        except (OSError, UnicodeError) as error:
            reason = getattr(error, "strerror", None) or error
            raise CommandError(
                f"--listen: cannot listen at {self.address}, port {self.port}: {reason}", code="bad_address"
            ) from None


@dataclass(frozen=True, slots=True)
class DrivingView:
    """State of teleoperation, as pages display it.

    Raises:
        CommandError: An unknown frame or setting, or an impossible speed.
    """

    robot: str
    """Name of the arm that the pad drives."""
    speed: float = 1.0
    """Share of the mapping's speeds, above 0, at most :attr:`speed_max`."""
    speed_max: float = 1.0
    """Greatest :attr:`speed` that a page may set, at most 1."""
    frame: str = "base"
    """Axes that the controls move along, ``base`` or ``tcp``."""
    settings: tuple[str, ...] = ()
    """Those of :data:`SETTINGS` that the page in control may change."""
    note: str = ""
    """Who drives at present, in one line, for a program in which not only the pad does."""

    def __post_init__(self) -> None:
        if not 0.0 < self.speed <= self.speed_max <= 1.0:
            raise CommandError(f"a speed must be above 0 and at most 1, not {self.speed} of {self.speed_max}")
        choice("a frame", self.frame, FRAMES)
        for name in self.settings:
            choice("a setting", name, SETTINGS)


@dataclass(frozen=True, slots=True)
class RecordingView:
    """State of a recording, as pages display it.

    Raises:
        CommandError: An unknown phase or action, or an impossible time.
    """

    phase: str
    """One of :data:`PHASES`."""
    prompt: str
    """Instruction to the user, one line."""
    task: str
    episode: int
    """Number in the dataset of the present episode, or of the next one."""
    saved: int
    """Episodes saved in this run: :attr:`succeeded` and :attr:`failed`."""
    wanted: int
    """Episodes to save in this run; 0 for no limit."""
    succeeded: int
    failed: int
    discarded: int
    seconds: float
    """Length of the present episode, s."""
    frames: int
    """Rows of the present episode so far."""
    dropped: int
    """Rows that are missing in it."""
    free_bytes: int
    """Free space on the disk."""
    trouble: str
    """A problem that needs attention; empty if there is none."""
    actions: tuple[str, ...]
    """Those of :data:`ACTIONS` that are possible now."""

    def __post_init__(self) -> None:
        choice("a phase", self.phase, PHASES)
        for action in self.actions:
            choice("an action", action, ACTIONS)
        number("seconds", self.seconds, least=0.0)


class WorldView(ABC):
    """A view that mirrors the simulated world of a host, in real time in a process of its own."""

    notes: tuple[str, ...] = ()
    """Messages for the user, for the banner."""

    @abstractmethod
    def wait_ready(self) -> None:
        """Wait until it displays the world; raise the error that it met while starting."""

    @abstractmethod
    def note_edit(self, method: str, params: dict[str, Any], revision: int) -> None:
        """Repeat an edit of the world before a snapshot of that revision is displayed."""

    @abstractmethod
    def describe(self) -> str:
        """Return a few words about it, for the banner."""

    @abstractmethod
    def close(self) -> None:
        """Stop it. Idempotent."""


class CameraRenderer(WorldView):
    """The renderer of all simulated cameras of a world."""

    def __init__(self, host: Host, cameras: Sequence[CameraSpec], renderer: str) -> None:
        self.host = host
        self.cameras = {camera.name: camera for camera in cameras}
        self.renderer = renderer

    def __contains__(self, camera: object) -> bool:
        return camera in self.cameras

    @abstractmethod
    def source(self, camera: str) -> object:
        """Return what the driver of this camera takes its images from."""


class ReplayFrame(NamedTuple):
    """What a rig does at one time of a recording."""

    wait: float
    """Time since the frame before, s."""
    joints: dict[str, dict[str, float]]
    """Positions of the joints of each arm and its gripper, rad or m, by name."""
    tcp_set: dict[str, Pose]
    """Commanded pose of each arm's tcp, base frame."""
    bodies: dict[str, Sequence[float]]
    """Pose (7,) of each object in the world."""


class Viewer3D(WorldView):
    """A rig's arms in 3D on the console's page, with a draggable handle on each tcp."""

    def __init__(self, rig: Rig) -> None:
        self.rig = rig

    @property
    @abstractmethod
    def address(self) -> str:
        """Path of the Unix socket at which the view is served for the console, known from the start."""

    @abstractmethod
    def goal(self, robot: str) -> Pose | None:
        """Return the pose to which the handle of an arm was dragged, base frame; None if it is on the tcp.

        It is a wish, not a permission: the program that moves the arm needs a dead-man.
        """

    @abstractmethod
    def clear_goal(self, robot: str) -> None:
        """Put the handle back onto the tcp."""
