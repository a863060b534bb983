"""How commands and states lie in the memory that an app shares with the process that owns the devices.

The layouts stand here, once, for both sides. Numbers are doubles; NaN stands for what a driver cannot know and never
leaves this file: it becomes None in the public records.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..commands import Kind
from ..gripper import GripperReading
from ..inbox import CommandRecord, DeadmanRecord
from ..pose import Pose, frozen
from ..robot import Reading
from ..types import Fault, GripperState, Limited, RobotState, RobotStatus, Stamp, Trip
from .mailbox import Mailbox

__all__ = ["AppRecord", "GripperCommand", "GroupMemory", "HostRecord", "RobotMail", "ServoRecord"]

_TEXTS = (48, 160, 240)  # bytes for a fault's code, cause and remedy
_APP = "dQ"
_HOST = "dQQ?"
_DEADMAN = "??Qd"
_GRIPPER_COMMAND = "Qddd"
_GRIPPER_STATE = "ddQdd?bd"
_UNKNOWN, _NO, _YES = -1, 0, 1


class AppRecord(NamedTuple):
    """What the app says to every servo of a group."""

    t: float
    """Heartbeat, s."""
    stops: int
    """Counts calls of ``rig.stop()``."""


class HostRecord(NamedTuple):
    """What the process that owns the devices says of itself."""

    t: float
    ticks: int
    missed: int
    """Ticks that came too late and were skipped."""
    ready: bool


class GripperCommand(NamedTuple):
    """A gripper's newest command."""

    seq: int
    width: float
    speed: float
    force: float


class ServoRecord(NamedTuple):
    """What the servo adds to a reading."""

    status: RobotStatus
    trip: Trip
    limited: Limited
    target_seq: int
    session: int
    arrived: bool
    refused: int
    """Number of the newest command that the servo refused, 0 for none."""
    t_written: float
    """When the set-point was handed to the driver, s."""
    t_stop: float
    """When the last braking began, s."""
    q_set: Sequence[float]
    dq_set: Sequence[float]


def _text(value: str, size: int) -> bytes:
    return value.encode()[:size]


def _plain(value: bytes) -> str:
    return value.rstrip(b"\0").decode(errors="ignore")


def _maybe(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    return None if math.isnan(values[0]) else values


class RobotMail:
    """The mailboxes of one arm with ``n`` joints and of its gripper."""

    def __init__(self, buffer: memoryview, n: int) -> None:
        self.n = n
        self._nothing = (math.nan,) * n
        boxes = []
        offset = 0
        for layout in self.layouts(n):
            boxes.append(Mailbox(buffer[offset:], layout))
            offset += Mailbox.size(layout)
        self.command, self.deadman, self.rearms, self.state, self.gripper_command, self.gripper = boxes
        # What was decoded last, with its number: most ticks find nothing new.
        self._command: tuple[int, CommandRecord] | None = None
        self._deadman: tuple[int, DeadmanRecord] | None = None
        self._grip: tuple[int, GripperCommand] | None = None

    @staticmethod
    def layouts(n: int) -> tuple[str, ...]:
        """Formats, in the order in which the boxes lie."""
        width = max(2 * n, 7)
        state = f"ddQ{n}d{n}d{n}d{n}d{n}d7d7d6d{n}d6diiiQQ?Qdd?" + "".join(f"{size}s" for size in _TEXTS)
        return (f"QddidQH{width}d", _DEADMAN, "Q", state, _GRIPPER_COMMAND, _GRIPPER_STATE)

    @classmethod
    def size(cls, n: int) -> int:
        """Bytes that the mailboxes take."""
        return sum(Mailbox.size(layout) for layout in cls.layouts(n))

    # From the app to the servo.

    def put_command(self, record: CommandRecord) -> None:
        """Send a command."""
        width = max(2 * self.n, 7)
        values = tuple(record.values) + (0.0,) * (width - len(record.values))
        self.command.write(
            record.seq,
            record.t,
            record.deadline,
            record.kind,
            record.t_event,
            record.session,
            len(record.values),
            *values,
        )

    def get_command(self) -> CommandRecord | None:
        """The newest command."""
        found = self.command.read()
        if found is None:
            return None
        if self._command is None or self._command[0] != found[0]:
            seq, t, deadline, kind, t_event, session, count, *values = found[1]
            record = CommandRecord(seq, session, t, deadline, Kind(kind), tuple(values[:count]), t_event)
            self._command = found[0], record
        return self._command[1]

    def put_deadman(self, record: DeadmanRecord) -> None:
        """Say how the dead-man stands."""
        self.deadman.write(record.held, record.connected, record.presses, record.t_alive)

    def get_deadman(self) -> DeadmanRecord | None:
        """How the dead-man stood last."""
        found = self.deadman.read()
        if found is None:
            return None
        if self._deadman is None or self._deadman[0] != found[0]:
            self._deadman = found[0], DeadmanRecord(*found[1])
        return self._deadman[1]

    def get_rearms(self) -> int:
        """How often ``control.rearm()`` was called."""
        found = self.rearms.read()
        return int(found[1][0]) if found else 0

    def get_gripper_command(self) -> GripperCommand | None:
        """The newest command to the gripper."""
        found = self.gripper_command.read()
        if found is None:
            return None
        if self._grip is None or self._grip[0] != found[0]:
            self._grip = found[0], GripperCommand(*found[1])
        return self._grip[1]

    # From the servo to the app.

    def put_state(
        self,
        reading: Reading,
        servo: ServoRecord,
        tcp: Sequence[float],
        tcp_set: Sequence[float],
        twist: Sequence[float],
    ) -> None:
        """Publish an arm's state."""
        nothing = self._nothing
        fault = reading.fault
        texts = (_text(fault.code, 48), _text(fault.cause, 160), _text(fault.remedy, 240)) if fault else (b"", b"", b"")
        self.state.write(
            reading.t,
            reading.t_device,
            reading.seq,
            *reading.q,
            *reading.dq,
            *(reading.tau or nothing),
            *servo.q_set,
            *servo.dq_set,
            *tcp,
            *tcp_set,
            *twist,
            *(reading.tau_ext or nothing),
            *(reading.wrench_ext or (math.nan,) * 6),
            servo.status,
            servo.trip,
            servo.limited,
            servo.target_seq,
            servo.session,
            servo.arrived,
            servo.refused,
            servo.t_written,
            servo.t_stop,
            fault is not None,
            *texts,
        )

    def get_state(self) -> tuple[RobotState, ServoRecord] | None:
        """The newest state; None before the first one."""
        found = self.state.read()
        if found is None:
            return None
        values, n = found[1], self.n
        k = 3 + 6 * n + 26
        # One array; everything below is a read-only view of it.
        numbers = frozen(values[3:k])
        q, dq, tau, q_set, dq_set = (numbers[i * n : (i + 1) * n] for i in range(5))
        rest = numbers[5 * n :]
        tau_ext, wrench_ext = rest[20 : 20 + n], rest[20 + n :]
        status, trip, limited, target_seq, session, arrived, refused, t_written, t_stop, faulty, *texts = values[k:]
        servo = ServoRecord(
            RobotStatus(status), Trip(trip), Limited(limited), target_seq, session, arrived, refused,
            t_written, t_stop, q_set, dq_set,
        )  # fmt: skip
        state = RobotState(
            stamp=Stamp(values[0], values[1], values[2]),
            q=q,
            dq=dq,
            tau=_maybe(tau),
            q_set=q_set,
            dq_set=dq_set,
            tcp=Pose.trusted(rest[0:3], rest[3:7]),
            tcp_set=Pose.trusted(rest[7:10], rest[10:14]),
            tcp_twist=rest[14:20],
            tau_ext=_maybe(tau_ext),
            wrench_ext=_maybe(wrench_ext),
            status=servo.status,
            trip=servo.trip,
            fault=Fault(*(_plain(text) for text in texts)) if faulty else None,
            limited=servo.limited,
            target_seq=target_seq,
        )
        return state, servo

    def peek(self) -> ServoRecord | None:
        """Only what the servo said, without making arrays: for every ``send``."""
        found = self.state.read()
        if found is None:
            return None
        values, n = found[1], self.n
        k = 3 + 6 * n + 26
        status, trip, limited, target_seq, session, arrived, refused, t_written, t_stop = values[k : k + 9]
        return ServoRecord(
            RobotStatus(status), Trip(trip), Limited(limited), target_seq, session, arrived, refused,
            t_written, t_stop, values[3 + 3 * n : 3 + 4 * n], values[3 + 4 * n : 3 + 5 * n],
        )  # fmt: skip

    def put_gripper(self, reading: GripperReading) -> None:
        """Publish a gripper's state."""
        grasped = _UNKNOWN if reading.grasped is None else (_YES if reading.grasped else _NO)
        force = math.nan if reading.force is None else reading.force
        self.gripper.write(
            reading.t,
            reading.t_device,
            reading.seq,
            reading.width,
            reading.width_target,
            reading.moving,
            grasped,
            force,
        )

    def get_gripper(self) -> GripperState | None:
        """A gripper's newest state; None before the first one."""
        found = self.gripper.read()
        if found is None:
            return None
        t, t_device, seq, width, target, moving, grasped, force = found[1]
        return GripperState(
            stamp=Stamp(t, t_device, seq),
            width=width,
            width_target=target,
            moving=moving,
            grasped=None if grasped == _UNKNOWN else grasped == _YES,
            force=None if math.isnan(force) else force,
        )


class GroupMemory:
    """All mailboxes of a group: the app's word to all servos, the host's word, then one :class:`RobotMail` an arm."""

    def __init__(self, buffer: memoryview, joints: Sequence[tuple[str, int]]) -> None:
        self.app = Mailbox(buffer, _APP)
        offset = Mailbox.size(_APP)
        self.host = Mailbox(buffer[offset:], _HOST)
        offset += Mailbox.size(_HOST)
        self.robots: dict[str, RobotMail] = {}
        for name, n in joints:
            self.robots[name] = RobotMail(buffer[offset:], n)
            offset += RobotMail.size(n)

    @staticmethod
    def size(joints: Sequence[tuple[str, int]]) -> int:
        """Bytes that it takes; ``joints`` names each arm and its number of joints."""
        return Mailbox.size(_APP) + Mailbox.size(_HOST) + sum(RobotMail.size(n) for _, n in joints)

    def get_app(self) -> AppRecord:
        """The app's newest word."""
        found = self.app.read()
        return AppRecord(*found[1]) if found else AppRecord(0.0, 0)

    def get_host(self) -> HostRecord:
        """The host's newest word."""
        found = self.host.read()
        return HostRecord(*found[1]) if found else HostRecord(0.0, 0, 0, False)
