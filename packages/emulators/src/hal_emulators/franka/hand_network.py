"""Network side of the emulated hand: messages of protocol 3, one client on TCP, states by UDP.

Messages are packed and little-endian. Layouts and numbers are those of the public headers of libfranka-common
(``research_interface/gripper``).
"""

from __future__ import annotations

import contextlib
import math
import selectors
import socket
import struct
from collections.abc import Iterator
from enum import IntEnum
from typing import NamedTuple

# Messages.

HAND_PORT = 1338
HAND_VERSION = 3

_HEADER = struct.Struct("<HII")  # command, id, size with the header
_STATUS = struct.Struct("<H")
_STATE = struct.Struct("<IddBH")


class HandCode(IntEnum):
    CONNECT = 0
    HOMING = 1
    GRASP = 2
    MOVE = 3
    STOP = 4


_PAYLOAD = {
    HandCode.CONNECT: struct.Struct("<HH"),  # protocol of the client, its UDP port
    HandCode.HOMING: struct.Struct("<"),
    HandCode.GRASP: struct.Struct("<5d"),  # width, epsilon inner, epsilon outer (m), speed (m/s), force (N)
    HandCode.MOVE: struct.Struct("<2d"),  # width (m), speed (m/s)
    HandCode.STOP: struct.Struct("<"),
}


class HandStatus(IntEnum):
    """Outcome of a command. Franka's client returns False for UNSUCCESSFUL, and raises for FAIL and ABORTED."""

    SUCCESS = 0
    FAIL = 1
    UNSUCCESSFUL = 2
    ABORTED = 3


class HandRequest(NamedTuple):
    code: HandCode
    id: int
    values: tuple[float, ...]


class HandRequestParser:
    """Splits a stream of bytes into requests."""

    def __init__(self) -> None:
        self._pending = b""

    def feed(self, data: bytes) -> Iterator[HandRequest]:
        """Yield the requests that ``data`` completes. Raises ValueError for invalid data."""
        self._pending += data
        while len(self._pending) >= _HEADER.size:
            number, id_, size = _HEADER.unpack_from(self._pending)
            code = HandCode(number)
            payload = _PAYLOAD[code]
            if size != _HEADER.size + payload.size:
                raise ValueError(f"a {code.name} of {size} bytes; it has {_HEADER.size + payload.size}")
            if len(self._pending) < size:
                return
            values = payload.unpack_from(self._pending, _HEADER.size)
            self._pending = self._pending[size:]
            yield HandRequest(code, id_, values)


def hand_response(request: HandRequest, status: HandStatus, version: int | None = None) -> bytes:
    """Return the answer to ``request``; that to a CONNECT contains the server's version."""
    body = _STATUS.pack(status) + (b"" if version is None else _STATUS.pack(version))
    return _HEADER.pack(request.code, request.id, _HEADER.size + len(body)) + body


class HandStatePacket(NamedTuple):
    """State that the hand sends by UDP."""

    message_id: int
    width: float
    """m"""
    max_width: float
    """m; valid after homing."""
    is_grasped: bool
    temperature: int
    """Degrees Celsius."""

    def pack(self) -> bytes:
        return _STATE.pack(self.message_id & 0xFFFFFFFF, self.width, self.max_width, self.is_grasped, self.temperature)


# Sockets.


class HandClient:
    """A connected client: its requests, and the answers that it waits for."""

    def __init__(self, sock: socket.socket, ip: str) -> None:
        self.sock = sock
        self.ip = ip
        self.udp_port: int | None = None
        """UDP port for its states; known after CONNECT."""
        self._requests = HandRequestParser()
        self._answers: list[tuple[float, bytes]] = []
        """Due times on the monotonic clock and answers, in order."""
        sock.setblocking(False)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def receive(self) -> list[HandRequest]:
        """Return its new requests. Raises OSError after a disconnect, and ValueError for invalid data."""
        data = self.sock.recv(4096)
        if not data:
            raise ConnectionResetError("the client disconnected")
        return list(self._requests.feed(data))

    def answer(self, data: bytes, due: float) -> None:
        """Send an answer at the time ``due``."""
        self._answers.append((due, data))
        self._answers.sort(key=lambda answer: answer[0])

    @property
    def due(self) -> float:
        """Due time of the next answer; infinite without one."""
        return self._answers[0][0] if self._answers else math.inf

    def send_due(self, now: float) -> None:
        """Send the answers that are due. Raises OSError after a disconnect."""
        while self.due <= now:
            self.sock.sendall(self._answers.pop(0)[1])  # a few bytes always fit into the socket's buffer


class HandNetwork:
    """A listener and at most one client. Assumption: a second client is accepted and disconnected at once."""

    def __init__(self, address: tuple[str, int]) -> None:
        self._address = address
        self._wake_in, self._wake_out = socket.socketpair()
        self._wake_out.setblocking(False)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._wake_in, selectors.EVENT_READ)
        self._listener: socket.socket | None = None
        self._udp: socket.socket | None = None
        self.client: HandClient | None = None

    @property
    def listening(self) -> bool:
        return self._listener is not None

    def listen(self) -> None:
        """Accept clients. Raises OSError if the address is in use."""
        self._listener = socket.create_server(self._address)
        self._listener.setblocking(False)
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._udp = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._udp.bind((self._address[0], 0))

    def wake(self) -> None:
        """End a :meth:`wait` in another thread."""
        with contextlib.suppress(OSError):
            self._wake_out.send(b"!")

    def wait(self, timeout: float) -> list[selectors.SelectorKey]:
        """Wait for input, for at most ``timeout`` s. Only this may run without the lock."""
        return [key for key, _ in self._selector.select(timeout)]

    def receive(self, keys: list[selectors.SelectorKey]) -> list[HandRequest]:
        """Return the client's requests after a :meth:`wait`."""
        requests: list[HandRequest] = []
        sources = [key.fileobj for key in keys]
        for source in sources:
            if source is self._wake_in:
                self._wake_in.recv(64)
            elif self.client is not None and source is self.client.sock:
                try:
                    requests += self.client.receive()
                except (OSError, ValueError):  # it disconnected, or is not a client of a hand
                    self.disconnect()
        if (
            self._listener is not None and self._listener in sources
        ):  # last: the client before may just have disconnected
            self._accept(self._listener)
        return requests

    def _accept(self, listener: socket.socket) -> None:
        try:
            sock, (ip, _) = listener.accept()
        except OSError:  # disconnected already
            return
        if self.client is not None:
            sock.close()
            return
        self.client = HandClient(sock, ip)
        self._selector.register(sock, selectors.EVENT_READ)

    def send_answers(self, now: float) -> None:
        if self.client is not None:
            try:
                self.client.send_due(now)
            except OSError:
                self.disconnect()

    def send_state(self, state: HandStatePacket) -> None:
        client = self.client
        if client is not None and client.udp_port is not None and self._udp is not None:
            with contextlib.suppress(OSError):
                self._udp.sendto(state.pack(), (client.ip, client.udp_port))

    def disconnect(self) -> None:
        client, self.client = self.client, None
        if client is not None:
            self._selector.unregister(client.sock)
            client.sock.close()

    def shut(self) -> None:
        """Disconnect the client, and accept no further ones."""
        self.disconnect()
        listener, self._listener = self._listener, None
        if listener is not None:
            self._selector.unregister(listener)
            listener.close()
        if self._udp is not None:
            self._udp.close()

    def close(self) -> None:
        self.shut()
        self._selector.close()
        self._wake_in.close()
        self._wake_out.close()
