"""When to look for pads: as soon as the system says that something changed, or now and then."""

from __future__ import annotations

import contextlib
import select
import time

from .node import Node
from .system import InputSystem, NodeInfo
from .watch import Watch

__all__ = ["Finder"]

_RESCAN = 0.2  # s between two looks where nobody says that something changed
_RESCAN_WATCHED = 2.0  # s, where somebody does


class Finder:
    """Looks at what is plugged in, and no more often than it must."""

    def __init__(self, system: InputSystem, *, watched: bool) -> None:
        """``watched``: the devices are those of this machine, so the kernel's inotify can tell of changes."""
        self._system = system
        self._watched = watched
        self._watch: Watch | None = None
        self._seen: object = None
        self._next = 0.0

    def look(self) -> list[NodeInfo] | None:
        """What is plugged in; None where that is what it was at the last look."""
        if self._watched and self._watch is None:
            with contextlib.suppress(OSError):  # no input devices at all, or too many watches: then without
                self._watch = Watch()
        self._next = time.monotonic() + (_RESCAN if self._watch is None else _RESCAN_WATCHED)
        mark = self._system.fingerprint()
        if mark == self._seen:
            return None
        self._seen = mark
        return self._system.nodes()

    def forget(self) -> None:
        """The next look, which is soon, counts whatever it finds."""
        self._seen = None
        self._next = min(self._next, time.monotonic() + _RESCAN)

    def due(self) -> bool:
        """Is it time for a look?"""
        return self._changed() or time.monotonic() >= self._next

    def wait(self, timeout: float) -> bool:
        """Wait for a change for up to ``timeout`` s; was there one?"""
        if self._watch is None:
            time.sleep(timeout)
            return False
        poller = select.poll()
        poller.register(self._watch.fileno(), select.POLLIN)
        return bool(poller.poll(timeout * 1e3)) and self._changed()

    def _changed(self) -> bool:
        if self._watch is None:
            return False
        try:
            return self._watch.changed()
        except OSError:  # the folder is gone, with the last device; it comes back with the next
            self._watch.close()
            self._watch = None
            return True

    def open(self, info: NodeInfo) -> Node:
        """Open a device. Raises OSError."""
        return self._system.open(info.path)

    def close(self) -> None:
        """Stop watching. Idempotent."""
        if self._watch is not None:
            self._watch.close()
        self._watch = None
