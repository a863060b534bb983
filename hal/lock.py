"""Locks on devices across the programs of this computer; a lock disappears with the process that holds it."""

from __future__ import annotations

import errno
import socket
import struct
import time

from .errors import ControlTaken

__all__ = ["DeviceLock"]

_LONGEST = 100
"""Greatest length of a socket's name; Linux has 108 bytes for it."""


class DeviceLock:
    """Exclusive use of a device, held through a socket in Linux's abstract name space, which leaves nothing behind.

    Devices usually refuse a second user by themselves, but late, and without naming the first one.

    Args:
        name: Unique name of the device.
        what: Description of the device for messages, for example "the arm at 172.16.0.2".
        patience: Longest time to wait for another program to release it, s: the device's process of a program that has
            just ended may need a moment.

    Raises:
        ControlTaken: Another program holds the lock; the message has its process number.
    """

    def __init__(self, name: str, what: str, patience: float = 0.0) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        address = f"\0hal-{name}"[:_LONGEST]
        deadline = time.monotonic() + patience
        while not self._bind(address):
            if time.monotonic() > deadline:
                self._socket.close()
                raise ControlTaken(f"{what} is in use by another program on this computer{_owner(address)}")
            time.sleep(0.02)

    def _bind(self, address: str) -> bool:
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
        """Release the lock. Idempotent."""
        self._socket.close()


def _owner(address: str) -> str:
    """Return the process that listens at this address, in words."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(0.2)
        try:
            client.connect(address)
            pid = struct.unpack("iII", client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
        except OSError:
            return ""
    return f" (process {_app_of(pid)})"


def _app_of(pid: int) -> int:
    """Return the program behind a device's own process: its parent."""
    try:
        with open(f"/proc/{pid}/status") as file:
            return next((int(line.split()[1]) for line in file if line.startswith("PPid:")), pid)
    except OSError:
        return pid
