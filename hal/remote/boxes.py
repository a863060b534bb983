"""The mailboxes of each direction, and the times in their records."""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Callable, Iterable, Mapping, Sequence

from ..commands import CHUNK_AHEAD, Kind
from ..host.memory import Mailbox
from ..host.records import GripperAct, GripperMail, GroupMemory, RobotMail

_DOUBLE = struct.Struct("<d")
_INT = struct.Struct("<i")
ITEM = struct.Struct("<QI")
"""Number and length of a record in a frame."""


def _time(record: bytearray, place: int) -> float:
    """Return a time of a record. Raises ValueError for NaN, which would never grow old."""
    t: float = _DOUBLE.unpack_from(record, place)[0]
    if math.isnan(t):
        raise ValueError("a time that is not a number")
    return t


class Box:
    """One kind of record: read from mailboxes at one end, and written into mailboxes at the other.

    Args:
        mailboxes: A record is written into each of them. Of several, the one with the oldest time is read.
        past: Where in a record there are times, which are never later than now; 0 and less stand for none.
        check: Raises ValueError for the bytes of a record that the reader must not see.
    """

    def __init__(
        self, *mailboxes: Mailbox, past: Sequence[int] = (0,), check: Callable[[bytearray], object] | None = None
    ) -> None:
        self._mailboxes = mailboxes
        self._past = past
        self._check = check
        self._taken = 0
        """Number, at the other end, of the record that was written last."""
        self._packed: tuple[int, tuple[bytes, bytes]] | None = None

    def number(self) -> int:
        """Return a number that grows with each record; 0 before the first."""
        return sum(map(Mailbox.seq, self._mailboxes))

    def read(self) -> bytes:
        """Return the newest record; empty before the first."""
        found = [record[1] for mailbox in self._mailboxes if (record := mailbox.read_bytes()) is not None]
        if len(found) < len(self._mailboxes):
            return b""
        return found[0] if len(found) == 1 else min(found, key=lambda record: float(_DOUBLE.unpack_from(record)[0]))

    def pack(self, number: int) -> tuple[bytes, bytes]:
        """Return the parts of a frame that have the newest record, whose :meth:`number` was this, or a newer one."""
        if self._packed is None or number != self._packed[0] or not self._mailboxes:
            record = self.read()
            self._packed = number, (ITEM.pack(number, len(record)), record)
        return self._packed[1]

    def take(self, number: int, record: bytes, shift: float, now: float) -> None:
        """Write a record that has come, unless it is the same as before.

        Args:
            number: Its number at the other end.
            record: The bytes.
            shift: What makes times of the other end times of this one, s.
            now: Time of its arrival, s.

        Raises:
            ValueError: It is no such record.
        """
        if number == self._taken or not record:
            return
        self._taken = number
        self._write(bytearray(record), shift, now)

    def _write(self, record: bytearray, shift: float, now: float) -> None:
        if len(record) != self._mailboxes[0].record_size:
            raise ValueError(f"a record of {len(record)} bytes in place of {self._mailboxes[0].record_size}")
        for place in self._past:
            t = _time(record, place)
            if t > 0.0:
                _DOUBLE.pack_into(record, place, min(t + shift, now))
        if self._check is not None:
            self._check(record)
        for mailbox in self._mailboxes:
            mailbox.write_bytes(record)


class CommandBox(Box):
    """The commands of an arm: a record, and for a chunk its numbers behind it, so that one never comes alone."""

    _SENT, _DEADLINE, _KIND, _EVENT, _COUNT = 8, 16, 24, 28, 44
    """Places in the record."""

    def __init__(self, mail: RobotMail, most_ahead: float = math.inf) -> None:
        """Make the box; no deadline is later than ``most_ahead`` s after now, except for chunks."""
        super().__init__(mail.command, past=(self._SENT, self._EVENT))
        self._mail = mail
        self._most_ahead = most_ahead
        self.on_the_way = 0.0
        """Time that a command takes at least until it is here, s: it does not count against its deadline."""

    def read(self) -> bytes:
        """Return the newest command, with its chunk."""
        record = super().read()
        if record and self._kind(record) == Kind.JOINT_CHUNK:
            chunk = self._mail.read_chunk()  # after the record: it is as new, or newer
            if chunk is not None:
                number, values = chunk
                return record + struct.pack("<Q", number) + values.tobytes()
        return record

    @classmethod
    def _kind(cls, record: bytes | bytearray) -> int:
        return int(_INT.unpack_from(record, cls._KIND)[0])

    def _write(self, record: bytearray, shift: float, now: float) -> None:
        size = self._mailboxes[0].record_size
        record, rest = record[:size], record[size:]
        if len(record) < size:
            raise ValueError(f"a command of {len(record)} bytes in place of {size}")
        chunk = Kind(self._kind(record)) is Kind.JOINT_CHUNK
        if not chunk and struct.unpack_from("<H", record, self._COUNT)[0] > max(2 * self._mail.n, 7):
            raise ValueError("a command with too many numbers")
        if chunk and rest:
            self._mail.put_chunk(struct.unpack_from("<Q", rest)[0], array("d", bytes(rest[8:])))
        deadline = _time(record, self._DEADLINE) + shift
        if not chunk:
            deadline += self.on_the_way
        most = now + (CHUNK_AHEAD if chunk else self._most_ahead)
        _DOUBLE.pack_into(record, self._DEADLINE, min(deadline, most))
        super()._write(record, shift, now)


def _check_act(record: bytearray) -> None:
    GripperAct(record[24])


def boxes_of_program(
    memories: Iterable[GroupMemory],
    robots: Mapping[str, RobotMail],
    grippers: Mapping[str, GripperMail],
    most_ahead: Mapping[str, float] | None = None,
) -> list[Box]:
    """Return what the program writes: its heartbeat; of each arm the command, dead-man, session; gripper commands.

    Args:
        memories: The memories of all groups.
        robots: Arms, in an order that both ends share.
        grippers: Likewise.
        most_ahead: Longest deadline of each arm's commands, s.
    """
    boxes = [Box(*(memory.app for memory in memories))]
    for name, mail in robots.items():
        boxes.append(CommandBox(mail, math.inf if most_ahead is None else most_ahead[name]))
        boxes.append(Box(mail.deadman, past=(10,)))
        boxes.append(Box(mail.session, past=()))
    boxes += [Box(mail.command, past=(), check=_check_act) for mail in grippers.values()]
    return boxes


def boxes_of_hosts(
    memories: Iterable[GroupMemory], robots: Mapping[str, RobotMail], grippers: Mapping[str, GripperMail]
) -> list[Box]:
    """Return what the hosts write: about themselves, and the states; the arguments are those of the other function."""
    boxes = [Box(*(memory.host for memory in memories))]
    boxes += [Box(mail.state, past=mail.state_times) for mail in robots.values()]
    boxes += [Box(mail.state) for mail in grippers.values()]
    return boxes
