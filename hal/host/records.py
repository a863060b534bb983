"""Layouts of all commands and states in the memory that an app shares with the process that owns the devices.

Both sides use these layouts. Numbers are doubles; NaN stands for an unknown value and never leaves this file: it
becomes None in the public records.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Iterable, Sequence
from enum import IntEnum
from math import isnan, nan
from typing import TYPE_CHECKING, Any, NamedTuple
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

from ..commands import CHUNK_POINTS, NO_SESSION, CommandRecord, DeadmanRecord, Kind, SessionRecord
from ..driver import Reading
from ..errors import Fault
from ..geometry import Pose
from ..types import ControlMode, GripperOutcome, GripperState, Limited, RobotState, RobotStatus, Stamp, Trip
from .memory import History, Mailbox, Newest, SeriesBox, make_reader

if TYPE_CHECKING:
    from ..driver import GripperReading
    from ..specs import GroupSpec

_TEXTS = (48, 160, 240)  # bytes for a fault's code, cause and remedy
FAULT_FORMAT = "?" + "".join(f"{size}s" for size in _TEXTS)
"""Format of a fault for :mod:`struct`: a mark that there is one, then three texts of fixed length."""
_FAULT = struct.Struct("<" + FAULT_FORMAT)
_NO_FAULT = (False, b"", b"", b"")


def fault_values(fault: Fault | None) -> tuple[Any, ...]:
    """Return the four values of a fault's record; texts that are too long are cut."""
    if fault is None:
        return _NO_FAULT
    texts = (fault.code, fault.cause, fault.remedy)
    return (True, *(text.encode()[:size] for text, size in zip(texts, _TEXTS, strict=True)))


def make_fault(there: bool, *texts: bytes) -> Fault | None:
    """Return the fault of such values; None if there is none."""
    return Fault(*(text.rstrip(b"\0").decode(errors="ignore") for text in texts)) if there else None


def read_fault(record: bytes, offset: int) -> Fault | None:
    """Return the fault in a record; most have none, which one byte shows."""
    return make_fault(*_FAULT.unpack_from(record, offset)) if record[offset] else None


_STAMP = struct.Struct("<ddQ")
_SERVO = struct.Struct("<iiiQQ?Qddiid?iQQ?")
_T_WRITTEN = struct.calcsize("<iiiQQ?Q")
_CONTROLLERS = {int(mode): mode for mode in ControlMode}
_STATUSES = {int(status): status for status in RobotStatus}
_TRIPS = {int(trip): trip for trip in Trip}


class ServoRecord(NamedTuple):
    """State of the servo, which is added to a reading."""

    status: RobotStatus
    trip: Trip
    limited: Limited
    target_seq: int
    session: int
    arrived: bool
    refused: int
    """Number of the newest command that the servo refused; 0 for none."""
    t_written: float
    """Time at which the set-point was handed to the driver, s."""
    t_stop: float
    """Time at which the last braking began, s."""
    q_set: Sequence[float]
    dq_set: Sequence[float]
    controller: ControlMode = ControlMode.POSITION
    tau_set: Sequence[float] = ()
    """Torques of the last set-point, Nm; empty if it has none, and in a record that was read."""
    held_back: Limited = Limited.NONE
    """Limits that reduced the one motion of the session (``move_to``), since it was opened."""
    progress: float = 0.0
    """Share of that motion that is done, from 0 to 1."""
    off_path: bool = False
    """Whether the arm cannot continue on the path of that motion: it was moved too far off, or no plan leads on."""
    overrun: Limited = Limited.NONE
    """Limit that the arm reached when ``Trip.LIMIT`` was latched; ``NONE`` if it could not be braked."""
    stops: int = 0
    """Number of calls of ``rig.stop()`` that :attr:`trip` takes into account."""
    rearms: int = 0
    """Number of rearms that were handled."""
    allowed: bool = False
    """Whether the session may move the arm and its gripper."""


class StateLayout:
    """Layout of the state of an arm with ``n`` joints: a stamp, one run of doubles, the servo's state, the fault.

    The doubles, in this order: q, dq, tau, q_set, dq_set (n each); tcp, tcp_set (7 each), tcp_twist (6); tau_ext (n),
    wrench_ext (6); tau_set (n). A reader decodes only what it needs: the servo's part for every ``send``, or the whole
    state, whose arrays are read-only views of the record's own bytes.
    """

    def __init__(self, n: int) -> None:
        self.n = n
        self._count = 7 * n + 26
        self._servo_at = _STAMP.size + 8 * self._count
        self._set_at = _STAMP.size + 8 * 3 * n
        self._set_points = struct.Struct(f"<{2 * n}d")
        self._nothing = (nan,) * n
        self.times = (0, self._servo_at + _T_WRITTEN, self._servo_at + _T_WRITTEN + 8)
        """Places of the times in a record: of the state, of the set-point and of the last braking."""

    @property
    def format(self) -> str:
        """Format of the whole record for :mod:`struct`."""
        parts = (_STAMP.format, f"{self._count}d", _SERVO.format, FAULT_FORMAT)
        return "".join(part.removeprefix("<") for part in parts)

    def values(
        self,
        reading: Reading,
        servo: ServoRecord,
        tcp: Sequence[float],
        tcp_set: Sequence[float],
        twist: Sequence[float],
    ) -> tuple[Any, ...]:
        """Return the values of a record.

        Args:
            reading: What the device reports.
            servo: State of the servo.
            tcp: Pose of the tcp at the measured joints (7,): position, m, then quaternion xyzw.
            tcp_set: Pose of the tcp at the set-point (7,).
            twist: Twist of the tcp (6,), m/s and rad/s.
        """
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
            *(servo.tau_set or nothing),
            *servo[:9],  # all but the set-points
            servo.controller,
            *servo[13:],  # what follows the torques
            *fault_values(reading.fault),
        )

    def servo(self, record: bytes) -> ServoRecord:
        """Return the servo's part of a record."""
        values = _SERVO.unpack_from(record, self._servo_at)
        status, trip, limited, *rest = values[:9]
        controller, held_back, progress, off_path, overrun, *end = values[9:]
        sets = self._set_points.unpack_from(record, self._set_at)
        n, first = self.n, (_STATUSES[status], _TRIPS[trip], _decode_limits(limited))
        motion = (_decode_limits(held_back), progress, off_path, _decode_limits(overrun), *end)
        return ServoRecord._make((*first, *rest, sets[:n], sets[n:], _CONTROLLERS[controller], (), *motion))

    def state(self, record: bytes) -> RobotState:
        """Return the whole state in a record."""
        n, end = self.n, self._servo_at
        numbers: NDArray[np.float64] = np.frombuffer(record, "<f8", self._count, _STAMP.size)
        status, trip, limited, target_seq, *rest = _SERVO.unpack_from(record, end)
        controller = _CONTROLLERS[rest[5]]
        tau = numbers[2 * n : 3 * n]
        tail = numbers[5 * n :]
        tau_ext, wrench_ext, tau_set = tail[20 : 20 + n], tail[20 + n : 26 + n], tail[26 + n :]
        return RobotState(
            stamp=Stamp(*_STAMP.unpack_from(record, 0)),
            q=numbers[:n],
            dq=numbers[n : 2 * n],
            tau=_drop_unknown(tau),
            q_set=numbers[3 * n : 4 * n],
            dq_set=numbers[4 * n : 5 * n],
            tcp=Pose.from_arrays(tail[:3], tail[3:7]),
            tcp_set=Pose.from_arrays(tail[7:10], tail[10:14]),
            tcp_twist=tail[14:20],
            tau_ext=_drop_unknown(tau_ext),
            wrench_ext=_drop_unknown(wrench_ext),
            status=_STATUSES[status],
            trip=_TRIPS[trip],
            fault=read_fault(record, end + _SERVO.size),
            limited=_decode_limits(limited),
            target_seq=target_seq,
            controller=controller,
            tau_set=_drop_unknown(tau_set),
        )


def _decode_limits(bits: int) -> Limited:
    return Limited(bits) if bits else Limited.NONE


def _drop_unknown(values: NDArray[np.float64]) -> NDArray[np.float64] | None:
    return None if isnan(values[0]) else values


_GRIPPER_COMMAND = "QQQB5d"
_GRIPPER_STATE = "ddQddd?bdQB?"
_GRIPPER_LAYOUT = struct.Struct("<" + _GRIPPER_STATE + FAULT_FORMAT)
GRIPPER_STATES = 512
"""Number of states of a gripper that stay readable: 2 s at 240 Hz, 5 s at 100 Hz."""
_UNKNOWN, _NO, _YES = -1, 0, 1


class GripperAct(IntEnum):
    """Kind of a gripper's command."""

    MOVE = 1
    GRASP = 2
    HOME = 3
    STOP = 4


class GripperCommand(NamedTuple):
    """A gripper's newest command. Only a motion has a width (m), a speed (m/s) and a force (N)."""

    seq: int
    """Number of the command, per gripper, from 1."""
    stops: int
    """Calls of ``rig.stop()`` before it was sent: a later stop ends it before it begins."""
    session: int
    """The session of the arm that sent it, and which must be allowed to move; 0 for a command outside of a session."""
    act: GripperAct
    width: float = 0.0
    speed: float = 0.0
    force: float = 0.0
    inner: float = 0.0
    """A grasped object may be this much narrower than ``width``, m."""
    outer: float = 0.0
    """A grasped object may be this much wider than ``width``, m."""


class GripperRecord(NamedTuple):
    """State of a gripper as the process that owns it publishes it."""

    state: GripperState
    lost: bool
    """Whether the device did not answer; ``state`` is then an older one, and its fault gives the reason."""


class GripperMail:
    """The mailboxes of one gripper."""

    def __init__(self, buffer: memoryview) -> None:
        self.command = Mailbox(buffer, _GRIPPER_COMMAND)
        self.state = Mailbox(buffer[Mailbox.size(_GRIPPER_COMMAND) :], _GRIPPER_STATE + FAULT_FORMAT, GRIPPER_STATES)
        self.history = History(self.state, _gripper_state)
        """The last :data:`GRIPPER_STATES` states."""
        self.get_command = make_reader(self.command, _command, None)
        """Returns the newest command; None before the first one."""
        self.get = make_reader(self.state, _record, None)
        """Returns the newest record; None before the first one."""

    @classmethod
    def size(cls) -> int:
        """Return the number of bytes that the mailboxes need."""
        return Mailbox.size(_GRIPPER_COMMAND) + Mailbox.size(_GRIPPER_STATE + FAULT_FORMAT, GRIPPER_STATES)

    def put_command(self, command: GripperCommand) -> None:
        """Send a command; the newest command wins."""
        self.command.write(*command)

    def put(
        self,
        reading: GripperReading,
        target_seq: int = 0,
        outcome: GripperOutcome = GripperOutcome.NONE,
        fault: Fault | None = None,
        lost: bool = False,
        force: float = math.nan,
    ) -> None:
        """Publish a reading.

        Args:
            reading: What the device reports.
            target_seq: Number of the newest command.
            outcome: How that command goes.
            fault: Why it failed, or why the gripper does not answer.
            lost: Whether the device did not answer; ``reading`` is then an older one.
            force: Force of that command, N.
        """
        grasped = _UNKNOWN if reading.grasped is None else (_YES if reading.grasped else _NO)
        pressed = math.nan if reading.force is None else reading.force
        values = (*reading[:5], force, reading.moving, grasped, pressed, target_seq, outcome, lost)  # t .. width_target
        self.state.write(*values, *fault_values(fault))


def _command(values: tuple[Any, ...]) -> GripperCommand:
    seq, stops, session, act, *numbers = values
    return GripperCommand(seq, stops, session, GripperAct(act), *numbers)


def _record(values: tuple[Any, ...]) -> GripperRecord:
    t, t_device, seq, width, target, asked, moving, grasped, force, target_seq, outcome, lost, *fault = values
    state = GripperState(
        stamp=Stamp(t, t_device, seq),
        width=width,
        width_target=target,
        force_target=asked,
        moving=moving,
        grasped=None if grasped == _UNKNOWN else grasped == _YES,
        force=None if math.isnan(force) else force,
        outcome=GripperOutcome(outcome),
        fault=make_fault(*fault),
        target_seq=target_seq,
    )
    return GripperRecord(state, lost)


def _gripper_state(record: bytes) -> GripperState:
    return _record(_GRIPPER_LAYOUT.unpack(record)).state


_APP = "dQ"
_HOST = "dQQ?"
_DEADMAN = "??Qd"
_WAY = 1 << 62
"""Added to the number of a session, for the way of its motion: no number of a command is so large."""
STATES = 1024
"""Number of states of an arm that stay readable: 4 s at 240 Hz, 1 s at 1 kHz."""


class AppRecord(NamedTuple):
    """Record from the app to every arm and gripper of a group."""

    t: float
    """Heartbeat, s."""
    stops: int
    """Number of calls of ``rig.stop()``."""


class HostRecord(NamedTuple):
    """Record of the process that owns the devices about itself."""

    t: float
    ticks: int
    missed: int
    """Number of ticks that came too late and were skipped."""
    ready: bool


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
        self.command, self.deadman, self.session, self.state = boxes
        self._chunk = SeriesBox(buffer[offset:], _chunk_capacity(n))
        state = self.state
        self.get_command = make_reader(self.command, self._command, None)
        """Returns the newest command; None before the first one."""
        self.get_deadman = make_reader(self.deadman, DeadmanRecord._make, None)
        """Returns the newest record of the dead-man; None before the first one."""
        self.get_state = Newest(state, state.read_bytes, self._layout.state, None).get
        """Returns the newest state; None before the first one."""
        self.peek = Newest(state, state.read_bytes, self._layout.servo, None).get
        """Returns only the servo's part of the newest state: for every ``send``."""
        self.history = History(state, self._layout.state)
        """The last :data:`STATES` states."""
        self.state_times = self._layout.times
        """Where in a state there are times."""
        self.get_session = make_reader(self.session, SessionRecord._make, NO_SESSION)
        """Returns the newest state of the app's session."""

    @staticmethod
    def layouts(n: int) -> tuple[tuple[str, int], ...]:
        """Return formats and numbers of slots of the mailboxes, in their order in memory."""
        width = max(2 * n, 7)
        return ((f"QddidQH{width}d", 2), (_DEADMAN, 2), ("QQQ", 2), (StateLayout(n).format, STATES))

    @classmethod
    def size(cls, n: int) -> int:
        """Return the number of bytes that the mailboxes need."""
        return sum(Mailbox.size(*layout) for layout in cls.layouts(n)) + SeriesBox.size(_chunk_capacity(n))

    # From the app to the servo.

    def put_command(self, record: CommandRecord) -> None:
        """Send a command. A chunk is written to a box of its own first: most commands are short, and frequent."""
        width = max(2 * self.n, 7)
        if record.kind is Kind.JOINT_CHUNK:
            self.put_chunk(record.seq, record.values)
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

    def put_chunk(self, number: int, values: Sequence[float]) -> None:
        """Write the numbers of the chunk whose command has this number, and comes next."""
        self._chunk.write(0.0, number, values)

    def read_chunk(self) -> tuple[int, array[float]] | None:
        """Return the newest chunk as (number of its command, values); None before the first one."""
        chunk = self._chunk.read()
        return None if chunk is None else chunk[2:]

    def put_way(self, session: int, points: Sequence[Sequence[float]]) -> None:
        """Publish joint positions (k, n) on the way of a session's one motion, for views: it has no other chunks."""
        every = -(-len(points) // CHUNK_POINTS)
        self.put_chunk(_WAY + session, [x for point in points[(len(points) - 1) % every :: every] for x in point])

    def read_way(self, session: int) -> tuple[float, ...]:
        """Return the positions on the way of the motion of this session; empty if it makes none."""
        chunk = self.read_chunk()
        return tuple(chunk[1]) if chunk is not None and chunk[0] == _WAY + session else ()

    def put_deadman(self, record: DeadmanRecord) -> None:
        """Publish the state of the dead-man."""
        self.deadman.write(record.held, record.connected, record.presses, record.t_alive)

    def put_session(self, record: SessionRecord) -> None:
        """Publish the state of the app's session."""
        self.session.write(*record)

    def _command(self, values: tuple[Any, ...]) -> CommandRecord:
        seq, t, deadline, kind, t_event, session, count, *rest = values
        numbers = tuple(rest[:count])
        if kind == Kind.JOINT_CHUNK:
            chunk = self.read_chunk()
            # Another number: overtaken by the next chunk, whose command comes in a moment.
            numbers = tuple(chunk[1]) if chunk is not None and chunk[0] == seq else ()
        return CommandRecord(seq, session, t, deadline, Kind(kind), numbers, t_event)

    # From the servo to the app.

    def put_state(
        self,
        reading: Reading,
        servo: ServoRecord,
        tcp: Sequence[float],
        tcp_set: Sequence[float],
        twist: Sequence[float],
    ) -> None:
        """Publish an arm's state (see :meth:`StateLayout.values`)."""
        self.state.write(*self._layout.values(reading, servo, tcp, tcp_set, twist))


def _chunk_capacity(n: int) -> int:
    return CHUNK_POINTS * (n + 1)


class GroupMemory:
    """All mailboxes of a group: the app's, the host's, then those of each arm and gripper."""

    def __init__(self, buffer: memoryview, robots: Iterable[tuple[str, int]], grippers: Iterable[str] = ()) -> None:
        """Lay the mailboxes out in ``buffer``; ``robots`` holds each arm's name and number of joints."""
        self.app = Mailbox(buffer, _APP)
        offset = Mailbox.size(_APP)
        self.host = Mailbox(buffer[offset:], _HOST)
        offset += Mailbox.size(_HOST)
        self.get_app = make_reader(self.app, AppRecord._make, AppRecord(0.0, 0))
        """Returns the app's newest record."""
        self.get_host = make_reader(self.host, HostRecord._make, HostRecord(0.0, 0, 0, False))
        """Returns the host's newest record."""
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
        """Return the mailboxes of this group."""
        return cls(buffer, *_names(spec))

    @classmethod
    def size_of(cls, spec: GroupSpec) -> int:
        """Return the number of bytes that the mailboxes of this group need."""
        return cls.size(*_names(spec))

    @staticmethod
    def size(robots: Iterable[tuple[str, int]], grippers: Iterable[str] = ()) -> int:
        """Return the number of bytes for the same arguments as the constructor's."""
        arms = sum(RobotMail.size(n) for _, n in robots)
        return Mailbox.size(_APP) + Mailbox.size(_HOST) + arms + GripperMail.size() * len(list(grippers))


def _names(spec: GroupSpec) -> tuple[list[tuple[str, int]], list[str]]:
    return [(robot.name, len(robot.joints)) for robot in spec.robots], [gripper.name for gripper in spec.grippers]


_RECORDS = (AppRecord, DeadmanRecord, GripperCommand, HostRecord, ServoRecord, SessionRecord)
_NUMBERS = (ControlMode, GripperAct, GripperOutcome, Kind, Limited, RobotStatus, Trip)
_FORMATS = (_APP, _HOST, _GRIPPER_COMMAND, _GRIPPER_STATE, GRIPPER_STATES, *RobotMail.layouts(7), _chunk_capacity(7))
LAYOUT = crc32(repr((_FORMATS, [record._fields for record in _RECORDS], [list(kind) for kind in _NUMBERS])).encode())
"""Number for the layout of all mailboxes: processes in which it differs must not share memory."""
