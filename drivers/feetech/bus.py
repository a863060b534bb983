"""A bus of Feetech servos on a serial line, which all devices of a process on it share.

Frames: Feetech's protocol of its SMS and STS series, as in its library (feetech-servo-sdk 1.0.0). The line is half
duplex: whoever asks waits for the answers before anything else is sent. Set-points are not answered.
"""

from __future__ import annotations

import os
import select
import struct
import termios
import threading
from collections.abc import Collection, Mapping
from time import monotonic
from typing import Any, NamedTuple

from hal.errors import ConnectionLost, Fault
from hal.lock import DeviceLock
from hal.serial_line import explain, open_line, read_line, set_baud

PING, READ, WRITE, SYNC_READ, SYNC_WRITE = 0x01, 0x02, 0x03, 0x82, 0x83
ALL = 0xFE
"""Id at which every motor listens."""
BAUD = 1_000_000
BAUDS = (500_000, 115_200, 57_600, 38_400)
"""Other rates that a motor may be set to, as far as the kernel has them."""
_ANSWER, _OPENING = 0.007, 0.02
"""Longest time to wait for answers in a cycle of 100 Hz, and while a device is opened, s."""
STATE, STATE_SIZE = 40, 31
"""First register of a motor's state, and the number of bytes that are read from there."""
_STATE = struct.Struct("<B x H 4x H 5x x HHH BB x B 3x H")
_PATIENCE = 2.0
"""Longest time to wait for another program to release the port, s."""
_RETRY = 0.25
"""Time between two tries to open a lost port, s."""


class Answer(NamedTuple):
    """A motor's answer."""

    id: int
    error: int
    """Bits of what is wrong with the motor (:data:`~.chain.ERRORS`)."""
    data: bytes


class MotorState(NamedTuple):
    """Registers 40 to 70 of a motor. Positions and speeds are in counts of 1/4096 turn, and per s."""

    t: float
    """When it was asked, s."""
    error: int
    on: int
    """Whether its torque is on."""
    goal: int
    torque_limit: int
    """1/1000 of its stall torque."""
    position: int
    velocity: int
    load: int
    """Duty cycle of its bridge, 1/1000."""
    voltage: int
    """0.1 V"""
    temperature: int
    """deg C"""
    current: int
    """6.5 mA"""


def signed(value: int, bit: int) -> int:
    """Return a number whose sign is in a bit of its own."""
    return -(value & ~(1 << bit)) if value >> bit & 1 else value


def encode(id: int, instruction: int, data: bytes = b"") -> bytes:
    """Return a frame. An answer has the motor's errors in the place of the instruction."""
    body = bytes((id, len(data) + 2, instruction)) + data
    return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))


def split(came: bytes) -> tuple[list[Answer], bytes, int]:
    """Return the whole frames in what has come, the rest, and the number of frames with a wrong checksum."""
    found: list[Answer] = []
    spoilt = 0
    while (start := came.find(b"\xff\xff")) >= 0:
        came = came[start:]
        if len(came) < 4 or (came[2] < ALL + 1 and came[3] >= 2 and len(came) < came[3] + 4):
            return found, came, spoilt
        end = came[3] + 4
        if came[2] > ALL or came[3] < 2:
            came = came[1:]
        elif ~sum(came[2 : end - 1]) & 0xFF == came[end - 1]:
            found.append(Answer(came[2], came[4], came[5 : end - 1]))
            came = came[end:]
        else:
            spoilt += 1
            came = came[2:]
    return found, came[-1:], spoilt


class ServoBus:
    """An open port. Use :meth:`acquire`.

    Attributes:
        states: The newest state of each motor, by its id.
        opened: How often the port was opened: after it was lost, its motors may be others.
    """

    _buses: dict[str, ServoBus] = {}  # noqa: RUF012  # shared on purpose
    _guard = threading.Lock()

    def __init__(self, port: str) -> None:
        self.port = port
        self.ids: list[int] = []
        self.states: dict[int, MotorState] = {}
        self.opened = 0
        self.fault: Fault | None = None
        self._lock = DeviceLock(f"feetech-{os.path.realpath(port)}", f"the servo bus at {port}", _PATIENCE)
        self._line: int | None = None
        self._users = 0
        self._seen: set[object] = set()
        """Who has the newest states."""
        self._wait = False
        """Whether answers were missing: the next cycle lets late ones pass, so that none counts as a newer one."""
        self._t_tried = 0.0
        self.reset_statistics()

    @classmethod
    def acquire(cls, port: str) -> ServoBus:
        """Return the process's bus at a port, and open it if it is not open yet.

        Raises:
            ConnectionLost: It cannot be opened; the message says what to do.
            ControlTaken: Another program on this computer uses it.
        """
        with cls._guard:
            bus = cls._buses.get(port) or cls(port)
            if bus._line is None:
                bus._open()
            if bus._line is None and not bus._users:
                bus._lock.release()
            bus.check()
            cls._buses[port] = bus
            bus._users += 1
            return bus

    def release(self, ids: Collection[int]) -> None:
        """Give up one use of the bus, and these motors; the last one closes it."""
        with self._guard:
            self.ids = [id for id in self.ids if id not in ids]
            self._users -= 1
            if not self._users:
                del self._buses[self.port]
                self._close()
                self._lock.release()

    def reset_statistics(self) -> None:
        """Start to count from zero."""
        self.cycles = self.lost = self.surplus = self.spoilt = 0

    def _open(self) -> None:
        self._t_tried = monotonic()
        try:
            self._line = open_line(self.port, BAUD)
        except OSError as error:
            self._lose(error)
        else:
            self.fault, self._wait = None, False
            self.opened += 1
            self.states.clear()

    def _close(self) -> None:
        line, self._line = self._line, None
        if line is not None:
            os.close(line)

    def _lose(self, error: OSError) -> None:
        self._close()
        cause, _, remedy = explain(error).partition("; ")
        self.fault = Fault("port", f"{self.port}: {cause}", remedy)

    def check(self) -> int:
        """Return the open line. Raises ConnectionLost if the port does not work."""
        if self._line is None:
            raise ConnectionLost.of("servo bus", self.fault or Fault("closed", "it is not open", "open the rig"))
        return self._line

    def send(self, id: int, instruction: int, data: bytes) -> None:
        """Send a frame. Raises ConnectionLost."""
        frame, line = encode(id, instruction, data), self.check()
        try:
            if os.write(line, frame) < len(frame):
                raise BlockingIOError(11, "it takes no more data")
        except OSError as error:
            self._lose(error)
            self.check()

    def write(self, address: int, values: Mapping[int, bytes]) -> None:
        """Write registers of several motors at the same time: bytes of the same length, by id. No one answers."""
        size = len(next(iter(values.values())))
        data = b"".join(bytes((id,)) + value for id, value in values.items())
        self.send(ALL, SYNC_WRITE, bytes((address, size)) + data)

    def ask(
        self,
        id: int,
        instruction: int,
        data: bytes,
        wanted: Collection[int],
        limit: float = _OPENING,
        linger: float = 0.0,
    ) -> dict[int, Answer]:
        """Send a frame, and return the answers of the motors that are wanted, as far as they come in time.

        Args:
            id: Of the motor, or :data:`ALL`.
            instruction: For example :data:`READ`.
            data: Of the frame.
            wanted: Ids of the motors that answer.
            limit: Longest time to wait, s.
            linger: Time to wait for further answers once all have come, s.

        Raises:
            ConnectionLost: The port does not work.
        """
        self._drain()
        self.send(id, instruction, data)
        found: dict[int, Answer] = {}
        came, end = b"", monotonic() + limit
        while (left := end - monotonic()) > 0.0:
            line = self.check()
            if not select.select([line], [], [], left)[0]:
                break
            try:
                answers, came, spoilt = split(came + read_line(line))
            except OSError as error:
                self._lose(error)
                continue
            self.spoilt += spoilt
            for answer in answers:
                if answer.id in wanted and answer.id not in found:
                    found[answer.id] = answer
                else:
                    self.surplus += 1
            if len(found) == len(wanted):
                if not linger:
                    break
                end, linger = monotonic() + linger, 1e-9
        return found

    def _drain(self) -> None:
        """Drop what has come too late, or twice."""
        try:
            answers, _, _ = split(read_line(self.check()))
        except OSError as error:
            self._lose(error)
            self.check()
        else:
            self.surplus += len(answers)

    def read(self, id: int, address: int, size: int) -> bytes | None:
        """Return registers of a motor; None if it does not answer. Raises ConnectionLost."""
        for _ in range(3):
            answer = self.ask(id, READ, bytes((address, size)), (id,)).get(id)
            if answer is not None and len(answer.data) == size:
                return answer.data
        return None

    def exchange(self, user: object, now: float) -> None:
        """Bring :attr:`states` up to date: all motors are asked at once, once in each cycle of the users.

        Raises:
            ConnectionLost: The port does not work. It is opened again from time to time.
        """
        if self._line is None and monotonic() - self._t_tried > _RETRY:
            self._open()
        self.check()
        if self._seen and user not in self._seen:
            self._seen.add(user)
            return
        self._seen = {user}
        if self._wait:
            self._wait = False
            self._drain()
            return
        answers = self.ask(ALL, SYNC_READ, bytes((STATE, STATE_SIZE, *self.ids)), self.ids, _ANSWER)
        self.cycles += 1
        self.lost += len(self.ids) - len(answers)
        self._wait = len(answers) < len(self.ids)
        for id, answer in answers.items():
            if len(answer.data) == STATE_SIZE:
                self.states[id] = decode_state(now, answer)

    def find_baud(self, id: int) -> int | None:
        """Return the rate at which a motor answers, if it is not :data:`BAUD`; None if it does at none."""
        line = self.check()
        try:
            for baud in BAUDS:
                set_baud(line, baud)
                if self.ask(id, PING, b"", (id,)):
                    return baud
        finally:
            if self._line is not None:
                set_baud(line, BAUD)
                termios.tcflush(line, termios.TCIOFLUSH)
        return None

    def statistics(self) -> dict[str, Any]:
        """Return what was counted."""
        return {"cycles": self.cycles, "lost": self.lost, "surplus": self.surplus, "spoilt": self.spoilt}


def decode_state(now: float, answer: Answer) -> MotorState:
    """Return the state in an answer to a question that was asked at ``now``, s."""
    on, goal, limit, position, velocity, load, voltage, temperature, status, current = _STATE.unpack(answer.data)
    return MotorState(
        now,
        answer.error | status,
        on,
        signed(goal, 15),
        limit,
        signed(position, 15),
        signed(velocity, 15),
        signed(load, 10),
        voltage,
        temperature,
        signed(current, 15),
    )
