"""The two ways to a Robotiq gripper: Modbus RTU on a serial line, and the text port of its URCap on a UR's controller.

Registers: instruction manual "2F-85 & 2F-140" (2019-02-06), chapters 4.3 to 4.7.
"""

from __future__ import annotations

import errno
import os
import re
import select
import socket
import struct
from collections.abc import Callable, Generator
from time import monotonic, sleep
from typing import NamedTuple

from hal.errors import ConnectionLost
from hal.serial_line import explain, open_line, read_line

from .settings import RobotiqSettings

TEXT_PORT = 63352
SILENCE = 0.12
"""Time without an answer after which the gripper counts as lost, s."""
_ANSWER = 0.04
"""Time after which a serial line is asked again, s: the usual adapter alone keeps an answer for 16 ms."""
_RETRY = 0.25
"""Time between two tries to connect, s."""
_PATIENCE = 0.005
"""Longest wait for answers in one call, s."""
_ADVICE = {errno.ECONNREFUSED: "install Robotiq's URCap on the controller, and switch it on"}
_READ, _WRITE = 3, 16
_OUTPUT, _INPUT = 0x03E8, 0x07D0
_TEXT = re.compile(rb"\s*(ack|([A-Z]{3}) +(\d+|\?))\s*$")


class Request(NamedTuple):
    """What the gripper is to do; the names are those of the manual, without their r."""

    act: int
    gto: int = 0
    pr: int = 0
    sp: int = 0
    fr: int = 0


class Status(NamedTuple):
    """What the gripper reports; the names are those of the manual, without their g."""

    t: float
    """When it was asked for it, s on the monotonic clock."""
    act: int
    gto: int
    sta: int
    obj: int
    flt: int
    pr: int
    po: int


def crc16(data: bytes) -> bytes:
    value = 0xFFFF
    for byte in data:
        value ^= byte
        for _ in range(8):
            value = value >> 1 ^ 0xA001 if value & 1 else value >> 1
    return value.to_bytes(2, "little")


Question = tuple[bytes, Callable[[bytes], "bytes | None"]]
"""What to send, and how to find the answer in what has come: None until it is complete."""
Exchange = Generator[Question, bytes, "Status | None"]
"""Questions, each of which gets its answer; returns a status if it asked for one."""


class _Modbus:
    def __init__(self, settings: RobotiqSettings) -> None:
        self.slave = settings.slave
        self.path = str(settings.port)

    def connect(self) -> int:
        return open_line(self.path, 115_200)

    def _ask(self, function: int, data: bytes, size: int) -> Question:
        head = bytes((self.slave, function))

        def find(came: bytes) -> bytes | None:
            start = came.find(head)
            frame = came[start : start + size] if start >= 0 else b""
            return frame[2:-2] if len(frame) == size and crc16(frame[:-2]) == frame[-2:] else None

        return (frame := head + data) + crc16(frame), find

    def write(self, request: Request) -> Exchange:
        values = bytes((request.act | request.gto << 3, 0, 0, request.pr, request.sp, request.fr))
        yield self._ask(_WRITE, struct.pack(">HHB", _OUTPUT, 3, 6) + values, 8)
        return None

    def read(self, t: float) -> Exchange:
        answer = yield self._ask(_READ, struct.pack(">HH", _INPUT, 3), 11)
        bits, _, fault, echo, position, _ = answer[1:]
        return Status(t, bits & 1, bits >> 3 & 1, bits >> 4 & 3, bits >> 6, fault & 15, echo, position)


class _Text:
    def __init__(self, settings: RobotiqSettings) -> None:
        self.host = str(settings.host)

    def connect(self) -> int:
        line = socket.socket()
        line.setblocking(False)
        line.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        line.connect_ex((self.host, TEXT_PORT))
        return line.detach()

    def write(self, request: Request) -> Exchange:
        act, gto, position, speed, force = request
        move = f" POS {position} SPE {speed} FOR {force}" if gto else ""
        yield f"SET ACT {act} GTO {gto}{move}\n".encode(), lambda came: _find_text(came, b"ack")
        return None

    def read(self, t: float) -> Exchange:
        values = []  # in this order, so that what the fingers do is never older than their target
        for name in (b"ACT", b"GTO", b"PRE", b"STA", b"OBJ", b"FLT", b"POS"):
            values.append((yield b"GET %s\n" % name, lambda came, name=name: _find_text(came, name)))  # type: ignore[misc]
        act, gto, echo, state, found, fault, position = map(int, values)
        return Status(t, act, gto, state, found, fault, echo, position)


def _find_text(came: bytes, name: bytes) -> bytes | None:
    """Return the value in an answer, which has no end of its own; a ``?`` stands for a gripper that is off."""
    found = _TEXT.match(came)
    if found is None or name not in (found[1], found[2]) or found[3] == b"?":
        return None
    return found[3] or b"ack"


class Link:
    """Connection to a gripper, which reconnects by itself; no call blocks but :meth:`open`."""

    def __init__(self, name: str, settings: RobotiqSettings) -> None:
        self._name, self._place = name, settings.place
        self._protocol = _Modbus(settings) if settings.port is not None else _Text(settings)
        self._answer_time = _ANSWER if settings.port is not None else SILENCE
        self.line: int | None = None
        self._why = "connecting"
        """Why there is no connection."""
        self._t_tried = 0.0
        self._forget()

    def _forget(self) -> None:
        self.status: Status | None = None
        """Newest status; None until the first one of a connection."""
        self.pending: Request | None = None
        """Newest request, until the gripper has taken it; dropped with the connection."""
        self._writing: Request | None = None
        self._exchange: Exchange | None = None
        self._question: Question = b"", lambda came: None
        self._came = b""
        self._repeated = False
        self._t_asked = self._t_sent = self._t_quiet = 0.0
        """When the question was asked first, and last, and until when late answers are dropped, s."""

    def open(self, timeout: float = 2.0) -> None:
        """Connect, and wait for the first status. Raises ConnectionLost."""
        self._connect()
        deadline = monotonic() + (timeout if self.line is not None else 0.0)
        while True:
            try:
                self.poll()
                return
            except ConnectionLost:
                if monotonic() > deadline:
                    self.close()
                    raise
                sleep(0.002)

    def close(self) -> None:
        line, self.line = self.line, None
        if line is not None:
            os.close(line)

    def _connect(self) -> None:
        self.close()
        self._forget()
        self._t_tried = monotonic()
        try:
            self.line = self._protocol.connect()
        except OSError as error:
            self._lose(error)

    def _lose(self, why: OSError | str) -> None:
        if isinstance(why, OSError):
            why = explain(why, _ADVICE)
        self.close()
        self.status, self._why = None, why

    def poll(self) -> None:
        """Exchange what is due, and keep the newest status. Raises ConnectionLost, and connects again meanwhile."""
        now = monotonic()
        if self.line is None and now - self._t_tried > _RETRY:
            self._connect()
        deadline = now + _PATIENCE
        try:
            while self.line is not None and self._advance(self.line, now) and now < deadline:
                select.select([self.line], [], [], deadline - now)
                now = monotonic()
        except OSError as error:
            self._lose(error)
        if self.line is not None and self._exchange is not None and now - self._t_asked > SILENCE:
            self._lose("it does not answer; check its power (24 V) and its cable, and end other programs that use it")
        if self.status is None:
            raise ConnectionLost(f"{self._name} at {self._place}: {self._why}")

    def _advance(self, line: int, now: float) -> bool:
        """Take what has come, and send what is due; return whether an answer is awaited."""
        came = read_line(line)
        if self._exchange is None:
            if now < self._t_quiet:
                return False  # late answers to a repeated question are dropped
            write = self._writing = self.pending if self._writing is None else None  # a status follows each request
            self._exchange = self._protocol.read(now) if write is None else self._protocol.write(write)
            self._ask(line, next(self._exchange), now)
            return True
        self._came += came
        answer = self._question[1](self._came)
        if answer is None:
            if now - self._t_sent > self._answer_time:
                self._repeated |= self._t_sent > 0.0
                self._send(line, now)
            return True
        try:
            self._ask(line, self._exchange.send(answer), now)
            return True
        except StopIteration as end:
            self._exchange = None
            if self._repeated:
                last_answer = now + self._t_sent - self._t_asked
                self._repeated, self._t_quiet = False, last_answer + self._answer_time / 2.0
            if self._writing is not None and self.pending is self._writing:
                self.pending = None
            if end.value is None:
                return self._advance(line, now)  # what the gripper makes of it
            self.status = end.value
            return False

    def _ask(self, line: int, question: Question, now: float) -> None:
        self._question, self._t_asked = question, now
        self._send(line, now)

    def _send(self, line: int, now: float) -> None:
        self._came, self._t_sent = b"", now
        try:
            os.write(line, self._question[0])
        except BlockingIOError:
            self._t_sent = 0.0  # still connecting: again in the next turn
