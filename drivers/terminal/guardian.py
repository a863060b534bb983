"""Restores a terminal when the program that changed it cannot: it was killed, or ended by os._exit.

Run as a program, by the file's path, it is a process in a session of its own, out of reach of the terminal's signals.
It holds the terminal and one end of a pipe, into which the program writes what is to be undone, as a line of JSON; the
newest line counts. When the pipe closes, for whatever reason, the guardian undoes that and ends. It needs only the
standard library and starts without ``site``, so it is ready in a few milliseconds.
"""

from __future__ import annotations

import json
import os
import select
import sys
import termios
import time
from typing import Any

__all__ = ["restore", "settings"]

_LONGEST_WRITE = 1.0  # s; a terminal that takes nothing (Ctrl-S, a cut link) must not block


def settings(fd: int) -> list[Any]:
    """Return the settings of the terminal, as JSON."""
    *flags, characters = termios.tcgetattr(fd)
    return [*flags, [c if isinstance(c, int) else c.decode("latin-1") for c in characters]]


def restore(fd: int, undo: dict[str, Any]) -> None:
    """Write the text ``undo["write"]``, and go from settings ``undo["ours"]`` back to ``undo["before"]``.

    Settings that another program, such as a shell, has changed since are left alone. Unread input is dropped, because
    it was not meant for the shell. Never raises: a terminal that is gone needs nothing.
    """
    try:
        termios.tcflush(fd, termios.TCIFLUSH)
        _write(fd, undo["write"].encode())
        if settings(fd) == undo["ours"]:
            *flags, characters = undo["before"]
            encoded = [c if isinstance(c, int) else c.encode("latin-1") for c in characters]
            termios.tcsetattr(fd, termios.TCSANOW, [*flags, encoded])
            termios.tcflush(fd, termios.TCIFLUSH)
    except (OSError, termios.error):
        pass


def _write(fd: int, data: bytes) -> None:
    poller = select.poll()
    poller.register(fd, select.POLLOUT)
    deadline = time.monotonic() + _LONGEST_WRITE
    while data and poller.poll(1e3 * max(0.0, deadline - time.monotonic())):
        data = data[os.write(fd, data) :]


def _main(terminal: int) -> None:
    undo = None
    for line in sys.stdin:
        undo = json.loads(line)
    if undo is not None:
        restore(terminal, undo)


if __name__ == "__main__":
    _main(int(sys.argv[1]))
