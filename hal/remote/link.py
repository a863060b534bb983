"""Frames over one connection between two computers, and the offset between their clocks."""

from __future__ import annotations

import contextlib
import json
import math
import select
import socket
import ssl
import struct
import time
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from ..errors import ConnectionLost
from ..histogram import Histogram
from ..host.records import LAYOUT
from .boxes import ITEM, Box

PORT = 7447
GONE = 2.0
"""A computer that has sent nothing for so long is gone, s. Its arms stopped long before."""
DRIFT = 1e-3
"""Greatest difference between the rates of two monotonic clocks, each of which a time server may slew by 500 ppm."""
MOST_ROUND_TRIP = 0.15
"""Longest round trip with which a control session may be opened, s."""
ANSWER_LIMIT = 5.0
"""Longest wait for the first answer of the other end, s."""
CLOSE_LIMIT = 60.0
"""Longest time that the devices may take to close, s."""
_IDLE = 0.02
"""Longest time between two frames, s."""
_CHECK_PERIOD = 1.0
"""Time between two checks of the other end's certificate, s."""
_LARGEST = 4 << 20
"""Size of the largest frame, bytes: a long path in a request."""
_BUFFERED = 1 << 16
"""Bytes that the system may hold for a connection: more would only get old there."""
_UNSENT = 1024
"""Of these, bytes that may wait to be sent the first time: while a slow link holds frames back, none gets old here."""
_RECORD = 1 << 14
"""Size of the largest record of TLS, bytes. A read of less has taken all that had come."""
_HEADER = struct.Struct("<IQddd")
"""Length of the rest, number, time of sending; when the other end's newest frame was sent, and when it came."""
_COUNT = struct.Struct("<H")


def describe_version() -> dict[str, Any]:
    """Return what both ends compare: the version of this package and the layout of its records."""
    from importlib.metadata import version  # slow to import

    return {"version": version("robot-hal"), "layout": LAYOUT}


class ClockOffset:
    """Bounds of this computer's monotonic clock minus that of the other end, from the stamps of frames.

    A frame cannot arrive before it was sent. So each one that comes bounds the offset from above, and each one of our
    own, with the time of its arrival there, from below. The best bounds are kept, and become wider with time, as the
    clocks may drift.
    """

    def __init__(self) -> None:
        self.low, self.high = -math.inf, math.inf
        self._t = math.nan
        self.forget_round_trips()

    def forget_round_trips(self) -> None:
        """Begin new statistics of round trips."""
        self.round_trips = Histogram(50e-6, 4000)
        """Of all frames since then, s; the time at the other end is not counted."""

    def note(self, now: float, sent: float, heard: float, heard_at: float) -> None:
        """Take the stamps of a frame.

        Args:
            now: Time of its arrival, s.
            sent: Time of its sending on the clock of the other end, s.
            heard: Time of sending of our newest frame that the other end had, s; NaN for none.
            heard_at: Time of its arrival on the clock of the other end, s.

        Raises:
            ConnectionLost: The bounds exclude each other (``code`` is ``clock_stepped``).
        """
        aged = 0.0 if math.isnan(self._t) else DRIFT * (now - self._t)
        self._t = now
        self.low, self.high = self.low - aged, min(self.high + aged, now - sent)
        if not math.isnan(heard):
            self.low = max(self.low, heard - heard_at)
            self.round_trips.add((now - sent) - (heard - heard_at))
        if not self.low <= self.high:
            text = "the clocks of the two computers do not fit together any more: one of them was suspended or stepped"
            raise ConnectionLost(text, code="clock_stepped")

    @property
    def known(self) -> bool:
        """Whether there are both bounds."""
        return math.isfinite(self.low + self.high)

    @property
    def round_trip(self) -> float:
        """Shortest round trip lately, s. The offset is known to within half of it."""
        return self.high - self.low

    @property
    def value(self) -> float:
        """Offset, s: a time of the other end plus this is a time of this computer.

        The middle of the bounds, so that it makes no sign of life newer than it is by more than half a round trip, and
        on a link that has become slow by no more than half of :data:`MOST_ROUND_TRIP`.
        """
        return self.low + min(self.round_trip, MOST_ROUND_TRIP) / 2.0


class RigLink:
    """One connection. Only :meth:`post` may be called from another thread.

    Args:
        sock: The connected socket, with TLS or without.
        at: Address of the other end, for messages.
        period: Shortest time between two frames that have only records, s.
    """

    def __init__(self, sock: socket.socket, at: str, period: float = 0.0) -> None:
        self.at = at
        self.offset = ClockOffset()
        self.outgoing: Sequence[Box] = ()
        """What is sent: the newest record of each of them."""
        self.incoming: Sequence[Box] = ()
        """What takes the records that come, in the order of the other end's :attr:`outgoing`."""
        self.frames = 0
        """Number of the newest frame that was sent."""
        self.largest = _LARGEST
        """Size of the largest frame that is taken, bytes."""
        self.viewer = False
        """Whether the other end may only watch, by its certificate."""
        self.took = 0.0
        """How long the connection took the newest frame with something new, s."""
        self.check: Callable[[], object] = lambda: None
        """Raises ConnectionLost when the other end's certificate is no longer valid; called once in a second."""
        self._t_check = -math.inf
        self._sock = sock
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _BUFFERED)
        sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NOTSENT_LOWAT, _UNSENT)
        sock.setblocking(False)
        self._period = period
        self._messages: deque[Any] = deque()
        self._kept: list[Any] = []
        """Messages that came together with the one that was awaited."""
        self._unsent = memoryview(b"")
        self._buffer = bytearray()
        self._idle = False
        """Whether :meth:`wait` has found nothing to read."""
        self._sent: list[int] = []
        """Numbers of the records that were sent last."""
        self._t_sent = -math.inf
        self._timed = False
        self._newest = 0
        """Number of the newest frame that came."""
        self._heard = (math.nan, math.nan)
        """When that was sent, on the other end's clock, and when it came, s."""
        self._t_heard = time.monotonic()

    @property
    def tls(self) -> str:
        """Version of TLS and the cipher; empty without."""
        cipher = self._sock.cipher() if isinstance(self._sock, ssl.SSLSocket) else None
        return f"{cipher[1]}, {cipher[0]}" if cipher is not None else ""

    def post(self, message: Any) -> None:
        """Send a message (JSON) with the next frame. It arrives after all records that are newer than it."""
        self._messages.append(message)

    def wait(self, timeout: float, *others: Any) -> bool:
        """Wait until something comes, at most ``timeout`` s; return whether it came from one of the ``others``."""
        ready = select.select([self._sock, *others], [self._sock] if self._unsent else [], [], timeout)[0]
        self._idle = self._sock not in ready
        return any(other in ready for other in others)

    # Receiving.

    def receive(self) -> list[Any]:
        """Take what has come: pass the newest records to :attr:`incoming`, and return the messages.

        Raises:
            ConnectionLost: The other end is gone, silent (``code`` is ``link_silent``), or sends nonsense
                (``bad_frame``); or a clock was stepped.
        """
        self._read()
        now = time.monotonic()
        messages, self._kept = self._kept, []
        records: list[tuple[int, bytes]] = []
        try:
            while (body := self._take_frame(now)) is not None:
                newest, message = self._split(body)
                if records and newest:  # a picture is in one frame only
                    newest = [new if new[1] else old for old, new in zip(records, newest, strict=True)]
                records = newest or records
                if message:
                    messages.append(json.loads(message))
            if records and self.incoming and self.offset.known:
                shift = self.offset.value
                for box, (number, record) in zip(self.incoming, records, strict=True):
                    box.take(number, record, shift, now)
        except (ValueError, struct.error) as error:
            raise ConnectionLost(f"{self.at} sent what cannot be read: {error}", code="bad_frame") from error
        if now - self._t_heard > GONE:
            raise ConnectionLost(f"{self.at} has sent nothing for {now - self._t_heard:.1f} s", code="link_silent")
        if now - self._t_check > _CHECK_PERIOD:
            self._t_check = now
            self.check()
        return messages

    def _read(self) -> None:
        if self._idle:
            self._idle = False
            return
        try:
            before = len(self._buffer)
            while len(self._buffer) < self.largest:
                data = self._sock.recv(1 << 16)  # more would be memory that the system maps each time
                if not data and len(self._buffer) > before:
                    return  # what came last is taken first: it may say why
                if not data:
                    raise ConnectionLost(f"{self.at} closed the connection", code="link_closed")
                self._buffer += data
                if len(data) < _RECORD:
                    return
        except (BlockingIOError, ssl.SSLWantReadError):
            pass
        except OSError as error:
            if isinstance(error, ConnectionLost):
                raise
            raise ConnectionLost(f"the connection to {self.at} is lost: {error}", code="link_closed") from error

    def _take_frame(self, now: float) -> bytes | None:
        """Return the rest of the next frame that is newer than those before; None if it is not there yet."""
        while len(self._buffer) >= _HEADER.size:
            length, number, sent, heard, heard_at = _HEADER.unpack_from(self._buffer)
            if length > self.largest:
                raise ValueError(f"a frame of {length} bytes")
            end = _HEADER.size + length
            if len(self._buffer) < end:
                return None
            body = bytes(self._buffer[_HEADER.size : end])
            del self._buffer[:end]
            if number > self._newest:
                self.offset.note(now, sent, heard, heard_at)
                self._newest, self._heard, self._t_heard = number, (sent, now), now
                return body
        return None

    @staticmethod
    def _split(body: bytes) -> tuple[list[tuple[int, bytes]], bytes]:
        """Return the records of a frame, each with its number, and its message; empty if there is none."""
        records, offset = [], _COUNT.size
        for _ in range(_COUNT.unpack_from(body)[0]):
            number, length = ITEM.unpack_from(body, offset)
            offset += ITEM.size
            records.append((number, body[offset : offset + length]))
            offset += length
        return records, body[offset:]

    # Sending.

    def send(self) -> None:
        """Send a frame if there is something new and the connection takes it; never waits.

        Raises:
            ConnectionLost: The other end is gone.
        """
        now = time.monotonic()
        if self._flush() or (now - self._t_sent < self._period and not self._messages):
            return
        message = json.dumps(self._messages.popleft()).encode() if self._messages else b""
        numbers = [box.number() for box in self.outgoing]  # after the message: the records are as new
        if not message and numbers == self._sent and now - self._t_sent < _IDLE:
            return
        parts = [_COUNT.pack(len(numbers))]
        for box, number in zip(self.outgoing, numbers, strict=True):
            parts += box.pack(number)
        parts.append(message)
        self.frames += 1
        self._timed = numbers != self._sent
        self._sent, self._t_sent = numbers, now
        length = sum(map(len, parts))
        head = _HEADER.pack(length, self.frames, time.monotonic(), *self._heard)
        self._unsent = memoryview(b"".join((head, *parts)))
        self._flush()

    def _flush(self) -> bool:
        """Send what is left of the last frame; return whether something is still left."""
        try:
            while self._unsent:
                self._unsent = self._unsent[self._sock.send(self._unsent) :]
                if self._timed:
                    self.took = time.monotonic() - self._t_sent
        except (BlockingIOError, ssl.SSLWantWriteError):
            pass
        except OSError as error:
            raise ConnectionLost(f"the connection to {self.at} is lost: {error}", code="link_closed") from error
        return bool(self._unsent)

    def await_message(self, timeout: float = ANSWER_LIMIT) -> Any:
        """Return the next message.

        Raises:
            ConnectionLost: None came within ``timeout`` s (``code`` is ``no_answer``); or as for :meth:`receive`.
        """
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            self.send()
            self.wait(_IDLE)
            messages = self.receive()
            if messages:
                self._kept = messages[1:]
                return messages[0]
        raise ConnectionLost(f"{self.at} did not answer within {timeout:g} s", code="no_answer")

    def say_last(self, message: Any) -> None:
        """Send a last message, and wait until the other end, which then closes the connection, has it."""
        self.post(message)
        with contextlib.suppress(ConnectionLost):
            self.await_message()

    def statistics(self) -> dict[str, Any]:
        """Return the round trips and the offset of the clocks, s, and the number of frames that were sent."""
        offset = self.offset
        found = {"round_trip_s": offset.round_trip, "offset_s": offset.value, "frames": self.frames}
        return {**found, "round_trips_s": offset.round_trips.summary()}

    def close(self) -> None:
        """Close the connection. Idempotent."""
        self._sock.close()
