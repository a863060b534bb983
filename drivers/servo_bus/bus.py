"""A bus of servos on a serial line, which all devices of a process on it share.

The line is half duplex: whoever asks waits for the answers before anything else is sent. Set-points are not answered.
"""

from __future__ import annotations

import os
import select
import termios
import threading
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from time import monotonic
from typing import Any

from hal.errors import ConnectionLost, Fault
from hal.lock import DeviceLock
from hal.serial_line import explain, open_line, read_line, set_baud

from .protocol import ALL, PING, READ, SYNC_READ, SYNC_WRITE, WRITE, Answer, Block, MotorState, ServoProtocol
from .settings import ANSWER as _ANSWER

_OPENING = 0.02
"""Longest time to wait for an answer while a device is opened, s."""
_AWAY = 0.08
"""Silence after which a motor may have lost its power, s: a motor that restarts takes longer."""
_PATIENCE = 2.0
"""Longest time to wait for another program to release the port, s."""
_RETRY = 0.25
"""Time between two tries to open a lost port, s."""
_ADAPTERS = Path("/sys/bus/usb-serial/devices")
"""Where Linux keeps what it knows about serial adapters."""


def find_latency(port: str) -> tuple[int, str]:
    """Return for how long an FTDI adapter collects answers, ms, and how to end that; 0 for another one."""
    timer = _ADAPTERS / Path(port).resolve().name / "latency_timer"
    try:
        return int(timer.read_text()), f"echo 1 | sudo tee {timer}"
    except (OSError, ValueError):
        return 0, ""


class ServoBus:
    """An open port. Use :meth:`acquire`.

    Attributes:
        states: The newest state of each motor, by its id.
        opened: How often the port was opened: after it was lost, its motors may be others.
    """

    _buses: dict[str, ServoBus] = {}  # noqa: RUF012  # shared on purpose
    _guard = threading.Lock()

    def __init__(self, port: str, protocol: ServoProtocol, baud: int) -> None:
        self.port, self.protocol, self.baud = port, protocol, baud
        self.ids: list[int] = []
        self.states: dict[int, MotorState] = {}
        self._status: dict[int, bytes] = {}
        """The newest :attr:`ServoProtocol.status` of each motor."""
        self._turn = 0
        """Number of motors whose status was asked for in turn."""
        self.opened = 0
        self.fault: Fault | None = None
        self._lock = DeviceLock(f"servo-bus-{os.path.realpath(port)}", f"the servo bus at {port}", _PATIENCE)
        self._line: int | None = None
        self._users = 0
        self._seen: set[object] = set()
        """Who has the newest states."""
        self._asked, self._t_asked = protocol.state, 0.0
        """What was asked for last, and the time of the cycle in which the states were, s."""
        self._owed: set[int] = set()
        """Motors that have not answered that yet."""
        self._answers: dict[int, tuple[float, Answer]] = {}
        """Time and state of motors, until their status is known."""
        self._t_tried = 0.0
        self.reset_statistics()

    @classmethod
    def acquire(cls, port: str, protocol: ServoProtocol, baud: int | None = None) -> ServoBus:
        """Return the process's bus at a port, and open it if it is not open yet; ``baud`` is in bit/s.

        Raises:
            ConnectionLost: It cannot be opened; the message says what to do.
            ControlTaken: Another program on this computer uses it.
        """
        with cls._guard:
            bus = cls._buses.get(port) or cls(port, protocol, baud or protocol.baud)
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
            self._line = open_line(self.port, self.baud)
        except OSError as error:
            self._lose(error)
        else:
            self.fault = None
            self.opened += 1
            for known in (self._owed, self._answers, self.states, self._status):
                known.clear()

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

    @contextmanager
    def _use_line(self) -> Iterator[int]:
        """Give the open line, whose errors end the connection. Raises ConnectionLost."""
        line = self.check()
        try:
            yield line
        except OSError as error:
            self._lose(error)
            self.check()

    def send(self, id: int, instruction: int, data: bytes) -> None:
        """Send a frame. Raises ConnectionLost."""
        frame = self.protocol.encode(id, instruction, data)
        with self._use_line() as line:
            if os.write(line, frame) < len(frame):
                raise BlockingIOError(11, "it takes no more data")

    def write(self, address: int, values: Mapping[int, bytes]) -> None:
        """Write registers of several motors at the same time: bytes of the same length, by id. No one answers."""
        size = len(next(iter(values.values())))
        data = b"".join(bytes((id,)) + value for id, value in values.items())
        self.send(ALL, SYNC_WRITE, self.protocol.place(address, size) + data)

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

        That is ``limit``, s, and ``linger``, s, for further answers once all have come. Raises ConnectionLost.
        """
        self._drain()
        self.send(id, instruction, data)
        found: dict[int, Answer] = {}
        came, end = b"", monotonic() + limit
        while (left := end - monotonic()) > 0.0:
            with self._use_line() as line:
                if not select.select([line], [], [], left)[0]:
                    break
                answers, came, spoilt = self.protocol.split(came + read_line(line))
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

    def _drain(self) -> list[Answer]:
        """Return what has come too late, or twice."""
        with self._use_line() as line:
            answers = self.protocol.split(read_line(line))[0]
        self.surplus += len(answers)
        return answers

    def read(self, id: int, address: int, size: int) -> bytes | None:
        """Return registers of a motor; None if it does not answer. Raises ConnectionLost."""
        for _ in range(3):
            answer = self.ask(id, READ, self.protocol.place(address, size), (id,)).get(id)
            if answer is not None and len(answer.data) == size:
                return answer.data
        return None

    def store(self, id: int, address: int, data: bytes) -> bool:
        """Write registers of a motor, and return whether it confirms that. Raises ConnectionLost."""
        return bool(self.ask(id, WRITE, self.protocol.place(address) + data, (id,)))

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
        self._read_motors(now)
        for id in [id for id in self._answers if self.protocol.status is None or id in self._status]:
            self.states[id] = self.protocol.decode_state(*self._answers.pop(id), self._status.get(id, b""))

    def _read_motors(self, now: float) -> None:
        """Take the late answers to the last question, which are as old as that; then ask for states and for status.

        If an answer is lost, nothing is asked in this cycle: it may come even later, and must not count as a newer one.
        """
        state, status, end = self.protocol.state, self.protocol.status, monotonic() + _ANSWER
        late = self._asked if self._owed else None
        if self._owed:
            self._note({answer.id: answer for answer in self._drain() if answer.id in self._owed})
            lost, self._owed = self._owed, set()
            for id in lost:
                if id in self.states and now - self.states[id].t > _AWAY:
                    self._status.pop(id, None)
            if lost:
                return
        if late != state or status is None:
            self._t_asked = now
            self.cycles += 1
            self._note(self.read_all(state, self.ids, end))
        if status is not None and not self._owed:
            self._note(self.read_all(status, self._choose(), end))

    def _note(self, answers: Mapping[int, Answer]) -> None:
        """Store the answers to the last question."""
        found = {id: answer for id, answer in answers.items() if len(answer.data) == self._asked[1]}
        self._owed -= {*found}
        if self._asked == self.protocol.state:
            self._answers.update((id, (self._t_asked, answer)) for id, answer in found.items())
        else:
            self._status.update((id, answer.data) for id, answer in found.items())

    def _choose(self) -> list[int]:
        """Return the motors whose status is read now: two that are new or report an error, and two in turn.

        That of all motors, which are new after a silence, would take longer than a cycle waits.
        """
        new = [id for id in self._answers if id not in self._status]
        urgent = [*new, *(id for id, (_, answer) in self._answers.items() if answer.error)][:2]
        self._turn += 2
        return sorted({*urgent, *(self.ids[k % len(self.ids)] for k in (self._turn, self._turn + 1))})

    def read_all(self, block: Block, ids: Collection[int], end: float) -> dict[int, Answer]:
        """Ask motors for registers at once; return the answers that come until ``end``, s. Raises ConnectionLost."""
        address, size = block
        asked = self.protocol.place(address, size) + bytes(ids)
        found = self.ask(ALL, SYNC_READ, asked, ids, end - monotonic())
        self._asked, self._owed = block, {*ids} - {*found}
        self.lost += len(ids) - len(found)
        return {id: answer for id, answer in found.items() if len(answer.data) == size}

    def find_baud(self, id: int) -> int | None:
        """Return the rate at which a motor answers, if it is not the bus's; None if it does at none."""
        line = self.check()
        try:
            for baud in self.protocol.bauds:
                set_baud(line, baud)
                if baud != self.baud and self.ask(id, PING, b"", (id,)):
                    return baud
        finally:
            if self._line is not None:
                set_baud(line, self.baud)
                termios.tcflush(line, termios.TCIOFLUSH)
        return None

    def statistics(self) -> dict[str, Any]:
        """Return what was counted."""
        return {"cycles": self.cycles, "lost": self.lost, "surplus": self.surplus, "spoilt": self.spoilt}
