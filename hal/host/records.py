"""How commands and states lie in the memory that an app shares with the process that owns the devices.

The layouts stand here, once, for both sides. Numbers are doubles; NaN stands for what a driver cannot know and never
leaves this file: it becomes None in the public records.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Callable, Sequence
from typing import Any, Generic, NamedTuple, TypeVar

from ..commands import Kind
from ..gripper import GripperReading
from ..inbox import CommandRecord, DeadmanRecord
from ..robot import Reading
from ..types import GripperState, Stamp
from .mailbox import Mailbox
from .state_layout import ServoRecord, StateLayout

__all__ = ["AppRecord", "GripperCommand", "GroupMemory", "HostRecord", "RobotMail", "ServoRecord"]

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


class Marks(NamedTuple):
    """What the app says to one servo now and then."""

    rearms: int
    """Counts calls of ``control.rearm()``."""
    ended: int
    """The newest session that the app ended."""


_NO_MARKS = Marks(0, 0)


class GripperCommand(NamedTuple):
    """A gripper's newest command."""

    seq: int
    width: float
    speed: float
    force: float


Raw = TypeVar("Raw")
Record = TypeVar("Record")


class _Newest(Generic[Raw, Record]):
    """The newest record of a mailbox, decoded once: most looks find nothing new."""

    __slots__ = ("_decode", "_known", "_read", "_seq")

    def __init__(
        self, seq: Callable[[], int], read: Callable[[], tuple[int, Raw] | None], decode: Callable[[Raw], Record]
    ) -> None:
        self._seq = seq
        self._read = read
        self._decode = decode
        self._known: tuple[int, Record | None] = (0, None)  # its number, and itself; replaced together

    def get(self) -> Record | None:
        """None before the first one."""
        known = self._known
        if self._seq() != known[0]:
            found = self._read()
            if found is not None and found[0] != known[0]:
                self._known = known = (found[0], self._decode(found[1]))
        return known[1]


def _newest(box: Mailbox, decode: Callable[[tuple[Any, ...]], Record]) -> Callable[[], Record | None]:
    return _Newest(box.seq, box.read, decode).get


class RobotMail:
    """The mailboxes of one arm with ``n`` joints and of its gripper."""

    def __init__(self, buffer: memoryview, n: int) -> None:
        self.n = n
        self._layout = StateLayout(n)
        boxes = []
        offset = 0
        for layout in self.layouts(n):
            boxes.append(Mailbox(buffer[offset:], layout))
            offset += Mailbox.size(layout)
        self.command, self.deadman, self.marks, self.state, self.gripper_command, self.gripper = boxes
        state = self.state
        self.get_command = _newest(self.command, _command)
        """The newest command."""
        self.get_deadman = _newest(self.deadman, DeadmanRecord._make)
        """How the dead-man stood last."""
        self.get_gripper_command = _newest(self.gripper_command, GripperCommand._make)
        """The newest command to the gripper."""
        self.get_state = _Newest(state.seq, state.read_bytes, self._layout.state).get
        """The newest state; None before the first one."""
        self.peek = _Newest(state.seq, state.read_bytes, self._layout.servo).get
        """Only what the servo said: for every ``send``."""
        self.get_gripper = _newest(self.gripper, _gripper)
        """A gripper's newest state; None before the first one."""
        self._newest_marks = _newest(self.marks, Marks._make)
        self._marking = threading.Lock()

    @staticmethod
    def layouts(n: int) -> tuple[str, ...]:
        """Formats, in the order in which the boxes lie."""
        width = max(2 * n, 7)
        return (f"QddidQH{width}d", _DEADMAN, "QQ", StateLayout(n).format, _GRIPPER_COMMAND, _GRIPPER_STATE)

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


def _command(values: tuple[Any, ...]) -> CommandRecord:
    seq, t, deadline, kind, t_event, session, count, *rest = values
    return CommandRecord(seq, session, t, deadline, Kind(kind), tuple(rest[:count]), t_event)


def _gripper(values: tuple[Any, ...]) -> GripperState:
    t, t_device, seq, width, target, moving, grasped, force = values
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
        self._newest_app = _newest(self.app, AppRecord._make)
        self._newest_host = _newest(self.host, HostRecord._make)
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
        return self._newest_app() or AppRecord(0.0, 0)

    def get_host(self) -> HostRecord:
        """The host's newest word."""
        return self._newest_host() or HostRecord(0.0, 0, 0, False)
