"""The process that watches the keys of the viewer's window."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

from hal.errors import ConnectionLost
from hal.host.mailbox import Mailbox
from hal.host.process import Channel, SharedMemory

from .keyboard import KEYS, LAYOUT, KeyboardRecord, grip
from .viewer_process import HEARTBEAT
from .x11 import Keyboard

__all__ = ["KeyWatch", "main"]

_PERIOD = 0.005
"""How often the keys are looked at, s."""
_FROZEN = 0.5
"""A window that has shown nothing new for so long, s, is no ground to move an arm on."""
_LAST_WISH = 1.0
"""s that the process of a closed window has to end by itself."""


class KeyWatch:
    """Writes what the keyboard does into the record that the app reads."""

    def __init__(self, mailbox: Mailbox) -> None:
        self._mailbox = mailbox
        self._record = KeyboardRecord(0.0, 0.0, 0, 0, 0.0)
        self._t = 0.0

    def look(self, held: frozenset[str], now: float, shown: float) -> None:
        """Note that these keys are down now, on a window that was alive at ``shown``."""
        last = self._record
        mask = sum(1 << bit for bit, key in enumerate(KEYS) if key in held)
        dt = min(now - self._t, 0.1)
        self._t = now
        opening = grip(last.grip, held, dt)
        changed = (mask, opening) != (last.mask, last.grip)
        t_event = now if changed else last.t_event
        t_alive = now if now - shown < _FROZEN else shown
        self._record = KeyboardRecord(t_alive, t_event, last.events + changed, mask, opening)
        self._mailbox.write(*self._record)


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process; ``memories`` are the window's heartbeat and the record of the keys.

    It ends when the window does, which is how the app knows.
    """
    parent = os.getppid()
    keyboard = Keyboard(KEYS, config["window"])
    heartbeat = Mailbox(memories[0].buffer, HEARTBEAT)
    watch = KeyWatch(Mailbox(memories[1].buffer, LAYOUT))
    channel.send({"ready": {}})
    while os.getppid() == parent:
        beat = heartbeat.read()
        if not keyboard.present():
            time.sleep(_LAST_WISH)
            with suppress(ProcessLookupError):  # PyBullet without its window hangs, busily
                os.kill(config["pid"], signal.SIGKILL)
            return
        watch.look(keyboard.held(), time.monotonic(), beat[1][0] if beat else 0.0)
        try:
            message = channel.poll()
        except ConnectionLost:
            return
        if message is not None and message["method"] == "close":
            return
        time.sleep(_PERIOD)
