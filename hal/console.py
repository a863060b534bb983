"""The console: a page in a browser that shows a rig and, as a gamepad, drives it. Abstract; a driver brings it."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any, NamedTuple

from .errors import CommandError

if TYPE_CHECKING:
    from .camera import Camera
    from .rig import Rig

__all__ = ["PORT", "Console", "Listen"]

LOOPBACK = "127.0.0.1"
PORT = 8470
"""Where the console listens unless told otherwise; the next free port where that is taken."""
_PORTS = 65535


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
    def close(self) -> None:
        """End it. Idempotent."""
