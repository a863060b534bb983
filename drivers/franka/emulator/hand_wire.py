"""The Franka Hand's messages, protocol 3: packed, little-endian. Pure: no socket in it.

Layouts and numbers are those of the public headers of libfranka-common (``research_interface/gripper``).
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

__all__ = ["PORT", "VERSION", "Code", "HandState", "Request", "Requests", "Status", "response"]

PORT = 1338
VERSION = 3

_HEADER = struct.Struct("<HII")  # command, id, size with the header
_STATUS = struct.Struct("<H")
_STATE = struct.Struct("<IddBH")


class Code(IntEnum):
    """What a client may ask for."""

    CONNECT = 0
    HOMING = 1
    GRASP = 2
    MOVE = 3
    STOP = 4


_PAYLOAD = {
    Code.CONNECT: struct.Struct("<HH"),  # protocol of the client, its UDP port
    Code.HOMING: struct.Struct("<"),
    Code.GRASP: struct.Struct("<5d"),  # width, epsilon inner, epsilon outer (m), speed (m/s), force (N)
    Code.MOVE: struct.Struct("<2d"),  # width (m), speed (m/s)
    Code.STOP: struct.Struct("<"),
}


class Status(IntEnum):
    """How a command ended. Franka's client makes False of UNSUCCESSFUL, and exceptions of FAIL and ABORTED."""

    SUCCESS = 0
    FAIL = 1
    UNSUCCESSFUL = 2
    ABORTED = 3


class Request(NamedTuple):
    """One command of a client."""

    code: Code
    id: int
    values: tuple[float, ...]


class Requests:
    """Cuts a stream of bytes into requests."""

    def __init__(self) -> None:
        self._pending = b""

    def feed(self, data: bytes) -> Iterator[Request]:
        """The requests that are whole with ``data``. Raises ValueError for what no client says."""
        self._pending += data
        while len(self._pending) >= _HEADER.size:
            number, id_, size = _HEADER.unpack_from(self._pending)
            code = Code(number)
            payload = _PAYLOAD[code]
            if size != _HEADER.size + payload.size:
                raise ValueError(f"a {code.name} of {size} bytes; it has {_HEADER.size + payload.size}")
            if len(self._pending) < size:
                return
            values = payload.unpack_from(self._pending, _HEADER.size)
            self._pending = self._pending[size:]
            yield Request(code, id_, values)


def response(request: Request, status: Status, version: int | None = None) -> bytes:
    """The answer to ``request``; that to a CONNECT bears the server's version."""
    body = _STATUS.pack(status) + (b"" if version is None else _STATUS.pack(version))
    return _HEADER.pack(request.code, request.id, _HEADER.size + len(body)) + body


class HandState(NamedTuple):
    """What the hand sends by UDP, over and over."""

    message_id: int
    width: float
    """m"""
    max_width: float
    """m; known after homing."""
    is_grasped: bool
    temperature: int
    """Degrees Celsius."""

    def pack(self) -> bytes:
        """The 23 bytes of the datagram."""
        return _STATE.pack(self.message_id & 0xFFFFFFFF, self.width, self.max_width, self.is_grasped, self.temperature)
