"""A limit on calls of a client library that wait for the robot's answer without one.

A library that sees the robot's mode change waits for the answer to its motion for ever, and ``pylibfranka`` keeps
Python's lock meanwhile: neither a thread nor a signal handler of this process runs. A POSIX timer does not need
Python: the C library starts a thread that closes the library's connection, and the library raises its own error.
"""

from __future__ import annotations

import ctypes
import os
import socket
import time
from contextlib import suppress
from typing import Any

LONGEST_CALL = 1.1
"""Limit of a call, s. The libraries themselves wait 1 s for a state."""
_SIGEV_THREAD = 2


class _Event(ctypes.Structure):
    _fields_ = (
        ("value", ctypes.c_void_p),
        ("number", ctypes.c_int),
        ("notify", ctypes.c_int),
        ("function", ctypes.c_void_p),
        ("attributes", ctypes.c_void_p),
        ("reserved", ctypes.c_char * 32),
    )


class _Times(ctypes.Structure):
    """itimerspec of timer_settime(2): seconds and nanoseconds of the period, and of the first time."""

    _fields_ = (("period", ctypes.c_long * 2), ("first", ctypes.c_long * 2))


class CallLimit:
    """Limits what runs in its ``with`` block; afterwards :meth:`expired` returns whether the connection was closed."""

    def __init__(self, address: str | None = None, port: int = 0) -> None:
        """Limit calls of the library that this process has connected to a port. Without a connection, do nothing."""
        self._connection = _find_connection(address, port)
        self._expired = False
        self._timer = ctypes.c_void_p()
        self._set: Any = None
        if self._connection < 0:
            return
        library = ctypes.CDLL("librt.so.1", use_errno=True)  # newer C libraries have its functions themselves
        close = ctypes.cast(ctypes.CDLL(None).close, ctypes.c_void_p).value
        event = _Event(self._connection, 0, _SIGEV_THREAD, close)
        if library.timer_create(time.CLOCK_MONOTONIC, ctypes.byref(event), ctypes.byref(self._timer)) != 0:
            raise OSError(ctypes.get_errno(), "no timer for the calls of the client library")
        self._set, self._delete = library.timer_settime, library.timer_delete
        seconds, rest = divmod(LONGEST_CALL, 1.0)
        self._on = ctypes.byref(_Times(first=(int(seconds), int(1e9 * rest))))
        self._off = ctypes.byref(_Times())

    def start(self) -> None:
        """Limit what follows, from now on."""
        if self._set is not None:
            self._set(self._timer, 0, self._on, None)

    def stop(self) -> None:
        if self._set is not None:
            self._set(self._timer, 0, self._off, None)

    __enter__ = start

    def __exit__(self, *_: object) -> None:
        self.stop()

    def expired(self) -> bool:
        """Return whether a call took too long; to be called before the library is used again.

        The library goes on to use the number of its closed connection: here it becomes a connection that the other
        side has closed.
        """
        if self._set is None or self._expired:
            return self._expired
        try:
            os.fstat(self._connection)
        except OSError:
            self._expired = True
            dead, other = socket.socketpair()
            other.close()
            if dead.fileno() == self._connection:
                dead.detach()
            else:
                os.dup2(dead.fileno(), self._connection)
                dead.close()
        return self._expired

    def close(self) -> None:
        """Delete the timer: the number of the connection will be that of another file. Idempotent."""
        if self._set is not None:
            self._set = None
            self._delete(self._timer)


def _find_connection(address: str | None, port: int) -> int:
    """Return the descriptor of this process's TCP connection to a port; -1 if there is none."""
    for number in map(int, os.listdir("/proc/self/fd")):
        with suppress(OSError):  # the list itself is closed already; others have no peer
            if os.readlink(f"/proc/self/fd/{number}").startswith("socket:"):
                with socket.socket(fileno=os.dup(number)) as found:
                    if found.getpeername() == (address, port):
                        return number
    return -1
