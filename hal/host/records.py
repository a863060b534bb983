"""How commands and states lie in the memory that an app shares with the process that owns the devices.

The layouts stand here, once, for both sides. Numbers are doubles; NaN stands for what a driver cannot know and never
leaves this file: it becomes None in the public records.
"""

from __future__ import annotations

import math
import struct
import threading
from collections.abc import Iterable, Sequence
from enum import IntEnum
from math import isnan, nan
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..commands import CHUNK_POINTS, CommandRecord, DeadmanRecord, Kind
from ..driver import Reading
from ..geometry import Pose
from ..types import Fault, GripperOutcome, GripperState, Limited, RobotState, RobotStatus, Stamp, Trip
from .memory import History, Mailbox, Newest, SeriesBox, newest

if TYPE_CHECKING:
    from ..driver import GripperReading
    from ..specs import GroupSpec

__all__ = [
    "AppRecord",
    "FORMAT",
    "GripperAct",
    "GripperCommand",
    "GripperMail",
    "GripperRecord",
    "GroupMemory",
    "HostRecord",
    "Marks",
    "RobotMail",
    "ServoRecord",
    "StateLayout",
    "fault_at",
    "fault_of",
    "fault_values",
]

# [fault_layout.py] How a fault lies in memory: a mark that there is one, then three texts of fixed length.

_TEXTS = (48, 160, 240)  # bytes for a fault's code, cause and remedy
FORMAT = "?" + "".join(f"{size}s" for size in _TEXTS)
"""For :mod:`struct`; four values."""
_FAULT = struct.Struct("<" + FORMAT)
_NO_FAULT = (False, b"", b"", b"")


def fault_values(fault: Fault | None) -> tuple[Any, ...]:
    """The values of a record; texts that are too long are cut."""
    if fault is None:
        return _NO_FAULT
    texts = (fault.code, fault.cause, fault.remedy)
    return (True, *(text.encode()[:size] for text, size in zip(texts, _TEXTS, strict=True)))


def fault_of(there: bool, *texts: bytes) -> Fault | None:
    """The fault that such values stand for."""
    return Fault(*(text.rstrip(b"\0").decode(errors="ignore") for text in texts)) if there else None


def fault_at(record: bytes, offset: int) -> Fault | None:
    """The fault that lies in a record; most have none, which one byte says."""
    return fault_of(*_FAULT.unpack_from(record, offset)) if record[offset] else None


# [state_layout.py] How an arm's state lies in memory: a stamp, one run of doubles, then what the servo and a
# fault say.
#
# A reader takes only what it needs: the servo's part for every ``send``, or the whole state, whose arrays are
# read-only
# views of the record's own bytes.
#

_STAMP = struct.Struct("<ddQ")
_SERVO = struct.Struct("<iiiQQ?Qdd")
_STATUSES = {int(status): status for status in RobotStatus}
_TRIPS = {int(trip): trip for trip in Trip}


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


class StateLayout:
    """The record of an arm with ``n`` joints.

    The doubles, in this order: q, dq, tau, q_set, dq_set (n each); tcp, tcp_set (7 each), tcp_twist (6); tau_ext (n),
    wrench_ext (6).
    """

    def __init__(self, n: int) -> None:
        self.n = n
        self._count = 6 * n + 26
        self._servo_at = _STAMP.size + 8 * self._count
        self._set_at = _STAMP.size + 8 * 3 * n
        self._set_points = struct.Struct(f"<{2 * n}d")
        self._nothing = (nan,) * n

    @property
    def format(self) -> str:
        """Of the whole record, for :mod:`struct`."""
        parts = (_STAMP.format, f"{self._count}d", _SERVO.format, FORMAT)
        return "".join(part.removeprefix("<") for part in parts)

    def values(
        self,
        reading: Reading,
        servo: ServoRecord,
        tcp: Sequence[float],
        tcp_set: Sequence[float],
        twist: Sequence[float],
    ) -> tuple[Any, ...]:
        """What a record holds: a reading, what the servo adds to it, and what kinematics makes of both."""
        nothing = self._nothing
        return (
            *reading[:3],  # t, t_device, seq
            *reading.q,
            *reading.dq,
            *(reading.tau or nothing),
            *servo.q_set,
            *servo.dq_set,
            *tcp,
            *tcp_set,
            *twist,
            *(reading.tau_ext or nothing),
            *(reading.wrench_ext or (nan,) * 6),
            *servo[:9],  # all but the set-points
            *fault_values(reading.fault),
        )

    def servo(self, record: bytes) -> ServoRecord:
        """What the servo says in a record."""
        status, trip, limited, *rest = _SERVO.unpack_from(record, self._servo_at)
        sets = self._set_points.unpack_from(record, self._set_at)
        n = self.n
        return ServoRecord._make((_STATUSES[status], _TRIPS[trip], _limited(limited), *rest, sets[:n], sets[n:]))

    def state(self, record: bytes) -> RobotState:
        """The whole of a record."""
        n, end = self.n, self._servo_at
        numbers: NDArray[np.float64] = np.frombuffer(record, "<f8", self._count, _STAMP.size)
        status, trip, limited, target_seq, *_ = _SERVO.unpack_from(record, end)
        tau = numbers[2 * n : 3 * n]
        rest = numbers[5 * n :]
        tau_ext, wrench_ext = rest[20 : 20 + n], rest[20 + n :]
        return RobotState(
            stamp=Stamp(*_STAMP.unpack_from(record, 0)),
            q=numbers[:n],
            dq=numbers[n : 2 * n],
            tau=_known(tau),
            q_set=numbers[3 * n : 4 * n],
            dq_set=numbers[4 * n : 5 * n],
            tcp=Pose.trusted(rest[:3], rest[3:7]),
            tcp_set=Pose.trusted(rest[7:10], rest[10:14]),
            tcp_twist=rest[14:20],
            tau_ext=_known(tau_ext),
            wrench_ext=_known(wrench_ext),
            status=_STATUSES[status],
            trip=_TRIPS[trip],
            fault=fault_at(record, end + _SERVO.size),
            limited=_limited(limited),
            target_seq=target_seq,
        )


def _limited(bits: int) -> Limited:
    return Limited(bits) if bits else Limited.NONE


def _known(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    return None if isnan(values[0]) else values


# [gripper_mail.py] How a gripper's commands and states lie in the memory that an app shares with the process that
# owns it.

_COMMAND = "QQB5d"
_STATE = "ddQdd?bdQB?"
_LAYOUT = struct.Struct("<" + _STATE + FORMAT)
GRIPPER_STATES = 512
"""So many states of a gripper stay readable: 2 s at 240 Hz, 5 s at 100 Hz."""
_UNKNOWN, _NO, _YES = -1, 0, 1


class GripperAct(IntEnum):
    """What a gripper is told to do."""

    MOVE = 1
    GRASP = 2
    HOME = 3
    STOP = 4


class GripperCommand(NamedTuple):
    """A gripper's newest command. Only a motion has a width (m), a speed (m/s) and a force (N)."""

    seq: int
    """Counts the commands of one gripper, from 1."""
    stops: int
    """How often ``rig.stop()`` had been called when it was sent: a later stop ends it before it begins."""
    act: GripperAct
    width: float = 0.0
    speed: float = 0.0
    force: float = 0.0
    inner: float = 0.0
    """A grasped thing may be so much narrower than ``width``, m."""
    outer: float = 0.0
    """A grasped thing may be so much wider than ``width``, m."""


class GripperRecord(NamedTuple):
    """What the process that owns a gripper says of it."""

    state: GripperState
    lost: bool
    """The device did not answer when it was asked last; ``state`` is an older one, and its fault says why."""


class GripperMail:
    """The mailboxes of one gripper."""

    def __init__(self, buffer: memoryview) -> None:
        self.command = Mailbox(buffer, _COMMAND)
        self.state = Mailbox(buffer[Mailbox.size(_COMMAND) :], _STATE + FORMAT, GRIPPER_STATES)
        self.history = History(self.state, _state)
        """The last :data:`STATES` states."""
        self.get_command = newest(self.command, _command)
        """The newest command; None before the first one."""
        self.get = newest(self.state, _record)
        """The newest record; None before the first one."""

    @classmethod
    def size(cls) -> int:
        """Bytes that the mailboxes take."""
        return Mailbox.size(_COMMAND) + Mailbox.size(_STATE + FORMAT, GRIPPER_STATES)

    def put_command(self, command: GripperCommand) -> None:
        """Tell the gripper what to do; the newest command wins."""
        self.command.write(*command)

    def put(
        self,
        reading: GripperReading,
        target_seq: int = 0,
        outcome: GripperOutcome = GripperOutcome.NONE,
        fault: Fault | None = None,
        lost: bool = False,
    ) -> None:
        """Publish a reading, and how the command with the number ``target_seq`` goes."""
        grasped = _UNKNOWN if reading.grasped is None else (_YES if reading.grasped else _NO)
        force = math.nan if reading.force is None else reading.force
        values = (*reading[:6], grasped, force, target_seq, outcome, lost)  # reading: t .. moving
        self.state.write(*values, *fault_values(fault))


def _command(values: tuple[Any, ...]) -> GripperCommand:
    seq, stops, act, *numbers = values
    return GripperCommand(seq, stops, GripperAct(act), *numbers)


def _record(values: tuple[Any, ...]) -> GripperRecord:
    t, t_device, seq, width, target, moving, grasped, force, target_seq, outcome, lost, *fault = values
    state = GripperState(
        stamp=Stamp(t, t_device, seq),
        width=width,
        width_target=target,
        moving=moving,
        grasped=None if grasped == _UNKNOWN else grasped == _YES,
        force=None if math.isnan(force) else force,
        outcome=GripperOutcome(outcome),
        fault=fault_of(*fault),
        target_seq=target_seq,
    )
    return GripperRecord(state, lost)


def _state(record: bytes) -> GripperState:
    return _record(_LAYOUT.unpack(record)).state


_APP = "dQ"
_HOST = "dQQ?"
_DEADMAN = "??Qd"
STATES = 1024
"""So many states of an arm stay readable: 4 s at 240 Hz, 1 s at 1 kHz."""


class AppRecord(NamedTuple):
    """What the app says to every arm and gripper of a group."""

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


class Marks(NamedTuple):
    """What the app says to one servo now and then."""

    rearms: int
    """Counts calls of ``control.rearm()``."""
    ended: int
    """The newest session that the app ended."""


_NO_MARKS = Marks(0, 0)


class RobotMail:
    """The mailboxes of one arm with ``n`` joints."""

    def __init__(self, buffer: memoryview, n: int) -> None:
        self.n = n
        self._layout = StateLayout(n)
        boxes = []
        offset = 0
        for layout, slots in self.layouts(n):
            boxes.append(Mailbox(buffer[offset:], layout, slots))
            offset += Mailbox.size(layout, slots)
        self.command, self.deadman, self.marks, self.state = boxes
        self._chunk = SeriesBox(buffer[offset:], _chunk_capacity(n))
        state = self.state
        self.get_command = newest(self.command, self._command)
        """The newest command."""
        self.get_deadman = newest(self.deadman, DeadmanRecord._make)
        """How the dead-man stood last."""
        self.get_state = Newest(state.seq, state.read_bytes, self._layout.state).get
        """The newest state; None before the first one."""
        self.peek = Newest(state.seq, state.read_bytes, self._layout.servo).get
        """Only what the servo said: for every ``send``."""
        self.history = History(state, self._layout.state)
        """The last :data:`STATES` states."""
        self._newest_marks = newest(self.marks, Marks._make)
        self._marking = threading.Lock()

    @staticmethod
    def layouts(n: int) -> tuple[tuple[str, int], ...]:
        """Formats and numbers of slots, in the order in which the boxes lie."""
        width = max(2 * n, 7)
        return ((f"QddidQH{width}d", 2), (_DEADMAN, 2), ("QQ", 2), (StateLayout(n).format, STATES))

    @classmethod
    def size(cls, n: int) -> int:
        """Bytes that the mailboxes take."""
        return sum(Mailbox.size(*layout) for layout in cls.layouts(n)) + SeriesBox.size(_chunk_capacity(n))

    # From the app to the servo.

    def put_command(self, record: CommandRecord) -> None:
        """Send a command. A chunk goes into a box of its own first: most commands are short, and often sent."""
        width = max(2 * self.n, 7)
        if record.kind is Kind.JOINT_CHUNK:
            self._chunk.write(record.t, record.seq, record.values)
            record = record._replace(values=())
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

    def put_deadman(self, record: DeadmanRecord) -> None:
        """Say how the dead-man stands."""
        self.deadman.write(record.held, record.connected, record.presses, record.t_alive)

    def get_marks(self) -> Marks:
        """Rearms, and the newest session that the app ended."""
        return self._newest_marks() or _NO_MARKS

    def rearm(self) -> None:
        """Say that ``control.rearm()`` was called once more."""
        with self._marking:
            marks = self.get_marks()
            self.marks.write(marks.rearms + 1, marks.ended)

    def end(self, session: int) -> None:
        """Say that this session is over."""
        with self._marking:
            self.marks.write(self.get_marks().rearms, session)

    def _command(self, values: tuple[Any, ...]) -> CommandRecord:
        seq, t, deadline, kind, t_event, session, count, *rest = values
        told = tuple(rest[:count])
        if kind == Kind.JOINT_CHUNK:
            chunk = self._chunk.read()
            # Another number: overtaken by the next chunk, whose command comes in a moment.
            told = tuple(chunk[3]) if chunk is not None and chunk[2] == seq else ()
        return CommandRecord(seq, session, t, deadline, Kind(kind), told, t_event)

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
        self.state.write(*self._layout.values(reading, servo, tcp, tcp_set, twist))


def _chunk_capacity(n: int) -> int:
    return CHUNK_POINTS * (n + 1)


class GroupMemory:
    """All mailboxes of a group: the app's word to all units, the host's word, then those of each arm and gripper."""

    def __init__(self, buffer: memoryview, robots: Iterable[tuple[str, int]], grippers: Iterable[str] = ()) -> None:
        """``robots`` names each arm and its number of joints."""
        self.app = Mailbox(buffer, _APP)
        offset = Mailbox.size(_APP)
        self.host = Mailbox(buffer[offset:], _HOST)
        offset += Mailbox.size(_HOST)
        self._newest_app = newest(self.app, AppRecord._make)
        self._newest_host = newest(self.host, HostRecord._make)
        self.robots: dict[str, RobotMail] = {}
        for name, n in robots:
            self.robots[name] = RobotMail(buffer[offset:], n)
            offset += RobotMail.size(n)
        self.grippers: dict[str, GripperMail] = {}
        for name in grippers:
            self.grippers[name] = GripperMail(buffer[offset:])
            offset += GripperMail.size()

    @classmethod
    def of(cls, buffer: memoryview, spec: GroupSpec) -> GroupMemory:
        """The mailboxes of this group."""
        return cls(buffer, *_names(spec))

    @classmethod
    def size_of(cls, spec: GroupSpec) -> int:
        """Bytes that the mailboxes of this group take."""
        return cls.size(*_names(spec))

    @staticmethod
    def size(robots: Iterable[tuple[str, int]], grippers: Iterable[str] = ()) -> int:
        """Bytes that it takes, for the same arguments as it is made from."""
        arms = sum(RobotMail.size(n) for _, n in robots)
        return Mailbox.size(_APP) + Mailbox.size(_HOST) + arms + GripperMail.size() * len(list(grippers))

    def get_app(self) -> AppRecord:
        """The app's newest word."""
        return self._newest_app() or AppRecord(0.0, 0)

    def get_host(self) -> HostRecord:
        """The host's newest word."""
        return self._newest_host() or HostRecord(0.0, 0, 0, False)


def _names(spec: GroupSpec) -> tuple[list[tuple[str, int]], list[str]]:
    return [(robot.name, len(robot.joints)) for robot in spec.robots], [gripper.name for gripper in spec.grippers]
