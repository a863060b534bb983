"""Locks on devices across the programs of this computer; a lock disappears with the process that holds it."""

from __future__ import annotations

import errno
import hashlib
import socket
import struct
import time
from pathlib import Path

from .errors import ControlTaken

APP_MARK = "hal-app="
"""Argument of a device's own process, followed by the process number of the program that started it."""
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
        ControlTaken: Another program holds the lock; the message has its process number. ``code`` is ``still_closing``
            if that program has ended and only its process for the device is left.
    """

    def __init__(self, name: str, what: str, patience: float = 0.0) -> None:
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        address = f"\0hal-{name}"
        if len(address.encode()) > _LONGEST:  # the end of a serial adapter's path tells it from others
            address = f"\0hal-{hashlib.sha256(name.encode()).hexdigest()}"
        deadline = time.monotonic() + patience
        while not self._bind(address):
            if time.monotonic() > deadline:
                self._socket.close()
                raise _error(what, _holder(address))
            time.sleep(0.02)

    def _bind(self, address: str) -> bool:
        try:
            self._socket.bind(address)
        except OSError as error:
            if error.errno == errno.EADDRINUSE:
                return False
            self._socket.close()
            raise
        self._socket.listen(socket.SOMAXCONN)  # each refused program stays in the queue: nothing is ever accepted
        return True

    def release(self) -> None:
        """Release the lock. Idempotent."""
        self._socket.close()


def _holder(address: str) -> int:
    """Return the number of the process that listens at this address; 0 if it cannot be found out."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as client:
        client.settimeout(0.2)
        try:
            client.connect(address)
            pid: int = struct.unpack("iII", client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12))[0]
        except OSError:
            return 0
    return pid


def _error(what: str, holder: int) -> ControlTaken:
    """Return the error for a device that the process ``holder`` uses, named by the program behind that process."""
    program = holder
    try:
        arguments = Path(f"/proc/{holder}/cmdline").read_text().split("\0")
        app = next((argument.removeprefix(APP_MARK) for argument in arguments if argument.startswith(APP_MARK)), None)
        if app is not None:
            parent = _status(holder, "PPid")
            if _status(int(parent), "NSpid") != app:  # another process has adopted it
                return ControlTaken(
                    f"{what} is still in use by process {holder}, the rest of a program that has ended: wait until it "
                    "has stopped the device, a few seconds",
                    code="still_closing",
                )
            program = int(parent)
    except OSError:  # it has just ended, or belongs to another user
        pass
    number = f" (process {program})" if program else ""
    return ControlTaken(f"{what} is in use by another program on this computer{number}")


def _status(pid: int, key: str) -> str:
    """Return the last value of ``key`` in a process's status: the one in its own container, if that has one."""
    lines = Path(f"/proc/{pid}/status").read_text().splitlines()
    return next((line.split()[-1] for line in lines if line.startswith(f"{key}:")), "")
