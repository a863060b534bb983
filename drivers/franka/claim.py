"""One program at a time per arm, on this computer: a name that vanishes with its owner."""

from __future__ import annotations

import errno
import socket
import struct
import time

from hal.errors import ControlTaken

__all__ = ["Claim"]

_LONGEST = 100
"""Characters of a socket's name, of the 108 bytes that Linux has for it."""


class Claim:
    """Holds an arm for this process, by a socket in Linux's abstract name space: nothing is left behind.

    The robot itself refuses a second client too, but cannot say who the first one is.
    """

    def __init__(self, host: str, patience: float = 1.0) -> None:
        """Raises ControlTaken, with the other process's number, while somebody else holds the arm at ``host``.

        The arm's process of a program that has just ended brakes first: so it is waited for, ``patience`` s.
        """
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        name = f"\0hal-franka-{host}"[:_LONGEST]
        deadline = time.monotonic() + patience
        while not self._take(name):
            if time.monotonic() > deadline:
                self._socket.close()
                owner = _owner(name)
                raise ControlTaken(f"the arm at {host} is in use by another program on this computer{owner}")
            time.sleep(0.02)

    def _take(self, name: str) -> bool:
        try:
            self._socket.bind(name)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return False
            self._socket.close()
            raise
        self._socket.listen(1)
        return True

    def release(self) -> None:
        """Let go. Idempotent."""
        self._socket.close()


def _owner(name: str) -> str:
    """Who listens there, in words."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.settimeout(0.2)
        try:
            asking.connect(name)
            pid = struct.unpack("iII", asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
        except OSError:
            return ""
    return f" (process {_app_of(pid)})"


def _app_of(pid: int) -> int:
    """The program behind an arm's own process: its parent."""
    try:
        with open(f"/proc/{pid}/status") as file:
            return next((int(line.split()[1]) for line in file if line.startswith("PPid:")), pid)
    except OSError:
        return pid
