"""How commands and states lie in the memory that an app shares with the process that owns the devices.

The layouts stand here, once, for both sides. Numbers are doubles; NaN stands for what a driver cannot know and never
leaves this file: it becomes None in the public records.
"""

from __future__ import annotations

import threading
from collections.abc import Iterable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

from ..commands import CHUNK_POINTS, CommandRecord, DeadmanRecord, Kind
from ..driver import Reading
from .gripper_mail import GripperMail
from .history import History
from .mailbox import Mailbox, SeriesBox
from .newest import Newest, newest
from .state_layout import ServoRecord, StateLayout

if TYPE_CHECKING:
    from ..specs import GroupSpec

__all__ = ["AppRecord", "GroupMemory", "HostRecord", "Marks", "RobotMail", "ServoRecord"]

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
