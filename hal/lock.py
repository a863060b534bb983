"""One program at a time per device, on this computer: a name that vanishes with its owner."""

from __future__ import annotations

import errno
import socket
import struct
import time

from .errors import ControlTaken

__all__ = ["DeviceLock"]

_LONGEST = 100
"""Characters of a socket's name, of the 108 bytes that Linux has for it."""


class DeviceLock:
    """Holds something for this process, by a socket in Linux's abstract name space: nothing is left behind.

    Devices mostly refuse a second user by themselves, but late, and cannot say who the first one is.
    """

    def __init__(self, name: str, what: str, patience: float = 0.0) -> None:
        """``name`` is what it is told apart by, ``what`` it is in words: "the arm at 172.16.0.2".

        Raises ControlTaken, with the other program's number, while somebody else holds it. A device's own process of a
        program that has just ended may have to finish first: so it is waited for, ``patience`` s.
        """
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        address = f"\0hal-{name}"[:_LONGEST]
        deadline = time.monotonic() + patience
        while not self._take(address):
            if time.monotonic() > deadline:
                self._socket.close()
                raise ControlTaken(f"{what} is in use by another program on this computer{_owner(address)}")
            time.sleep(0.02)

    def _take(self, address: str) -> bool:
        try:
            self._socket.bind(address)
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


def _owner(address: str) -> str:
    """Who listens there, in words."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as asking:
        asking.settimeout(0.2)
        try:
            asking.connect(address)
            pid = struct.unpack("iII", asking.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
        except OSError:
            return ""
    return f" (process {_app_of(pid)})"


def _app_of(pid: int) -> int:
    """The program behind a device's own process: its parent."""
    try:
        with open(f"/proc/{pid}/status") as file:
            return next((int(line.split()[1]) for line in file if line.startswith("PPid:")), pid)
    except OSError:
        return pid
