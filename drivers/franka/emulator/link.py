"""The network side of an arm: one client at a time, requests over TCP, states and commands over UDP."""

from __future__ import annotations

import contextlib
import select
import socket
import time
from typing import NamedTuple

from .protocol import HEADER

__all__ = ["Incoming", "Session", "listen"]

_LARGEST = 65536
"""Bytes; no request is larger."""
_MOST = 64
"""Commands that are read at once; a flood of them does not hold the arm up."""
_INTRODUCTION = 2.0
"""s until a connection that has not said Connect makes room for the next one."""
_SEND_LIMIT = 1.0
"""s that a client may take to accept a response."""


class Incoming(NamedTuple):
    """A request as it came in."""

    code: int
    number: int
    payload: bytes


def listen(host: str, port: int) -> socket.socket:
    """A listening socket. Raises OSError with host and port in its text when they are taken or not this machine's."""
    listener = socket.socket(socket.AF_INET, socket.SOCK_STREAM)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(4)
    except OSError as error:
        listener.close()
        raise OSError(error.errno, f"cannot listen on {host}:{port}: {error.strerror}") from None
    listener.setblocking(False)
    return listener


class Session:
    """One connected client."""

    def __init__(self, connection: socket.socket, host: str) -> None:
        self.tcp = connection
        self.tcp.settimeout(_SEND_LIMIT)
        self.tcp.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        self.peer: str = connection.getpeername()[0]
        self.name = "{}:{}".format(*connection.getpeername())
        self.udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self.udp.bind((host, 0))
        self.udp.setblocking(False)
        self.connected = False
        """Has it said Connect, and was that accepted?"""
        self._since = time.monotonic()
        self._port = 0
        self._received = bytearray()

    def open_udp(self, port: int) -> None:
        """From now on states go to the client's port."""
        self._port = port
        self.connected = True

    def requests(self) -> list[Incoming]:
        """What came in over TCP. Raises ConnectionError at the end, and for what cannot be a request."""
        data = self.tcp.recv(_LARGEST)
        if not data:
            raise ConnectionError("the client closed the connection")
        self._received += data
        found = []
        while len(self._received) >= HEADER.size:
            code, number, size = HEADER.unpack_from(self._received)
            if not HEADER.size <= size <= _LARGEST:
                raise ConnectionError(f"a request of {size} bytes")
            if len(self._received) < size:
                break
            found.append(Incoming(code, number, bytes(self._received[HEADER.size : size])))
            del self._received[:size]
        return found

    def gone(self) -> bool:
        """Has the client hung up, with nothing left to read, or never introduced itself?"""
        if not self.connected and time.monotonic() > self._since + _INTRODUCTION:
            return True
        try:
            readable = select.select([self.tcp], [], [], 0.0)[0]
            return bool(readable) and not self.tcp.recv(1, socket.MSG_PEEK)
        except OSError:
            return True

    def reply(self, code: int, number: int, body: bytes) -> None:
        """Answer a request. Raises OSError when the client does not take it."""
        self.tcp.sendall(HEADER.pack(code, number, HEADER.size + len(body)) + body)

    def send_state(self, packet: bytes | bytearray | memoryview) -> None:
        """A state that cannot be sent is lost, as it is on a network."""
        with contextlib.suppress(OSError):
            self.udp.sendto(packet, (self.peer, self._port))

    def commands(self) -> list[bytes]:
        """The datagrams that came in, oldest first."""
        found: list[bytes] = []
        with contextlib.suppress(OSError):
            while len(found) < _MOST:
                found.append(self.udp.recv(2048))
        return found

    def close(self) -> None:
        """Let go of both sockets."""
        self.tcp.close()
        self.udp.close()
