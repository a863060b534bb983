"""Mailboxes in shared memory: the newest record of one writer for any number of readers.

A mailbox holds two slots, or more if readers need a history. The writer fills the oldest one, then announces it by one
aligned 8-byte store, so a writer that is killed in the middle of a write leaves the last whole record in place, and no
reader ever waits. Each slot carries its number and a checksum: a reader that was overtaken, or that runs on a processor
which reorders stores, notices and tries again, a bounded number of times.
"""

from __future__ import annotations

import math
import struct
from array import array
from collections.abc import Callable, Sequence
from typing import Any, Generic, Protocol, TypeVar
from zlib import crc32

from ..types import Stamp

_HEADER = 8  # bytes: the announced number, in the machine's own order: this memory is never sent
_SLOT = struct.Struct("<QQ")  # number, checksum
_TRIES = 16


class _Slots:
    """Memory of slots with ``capacity`` payload bytes each (a power of two of them), and the number of the newest."""

    __slots__ = ("_announced", "_buffer", "_mask", "_payloads", "_seq", "_starts")

    def __init__(self, buffer: memoryview, capacity: int, slots: int = 2) -> None:
        stride = self._stride(capacity)
        self._buffer = buffer[: _HEADER + slots * stride]
        self._announced = self._buffer[:_HEADER].cast("Q")
        self._mask = slots - 1
        self._starts = tuple(_HEADER + k * stride for k in range(slots))
        self._payloads = tuple(self._buffer[s + _SLOT.size : s + _SLOT.size + capacity] for s in self._starts)
        self._seq: int = self._announced[0]

    @staticmethod
    def _stride(capacity: int) -> int:
        return (_SLOT.size + capacity + 7) // 8 * 8

    @classmethod
    def _size(cls, capacity: int, slots: int = 2) -> int:
        if slots < 2 or slots & (slots - 1):
            raise ValueError(f"the number of slots must be a power of two, not {slots}")
        return _HEADER + slots * cls._stride(capacity)

    def _announce(self, length: int) -> int:
        """Announce the free slot, of which ``length`` bytes were filled; returns its number."""
        seq = self._seq + 1
        which = seq & self._mask
        _SLOT.pack_into(self._buffer, self._starts[which], seq, crc32(self._payloads[which][:length]))
        self._announced[0] = seq
        self._seq = seq
        return seq

    def seq(self) -> int:
        """Number of the newest record; 0 before the first."""
        return self._announced[0]

    def release(self) -> None:
        """Release the buffer, so that the memory behind it can be unmapped."""
        for view in (*self._payloads, self._announced):
            view.release()
        self._buffer.release()


class Mailbox(_Slots):
    """Records of one fixed ``layout``, a :mod:`struct` format without a byte-order mark.

    One process writes, in one thread at a time; everyone may read, each process through a Mailbox of its own.
    """

    __slots__ = ("_layout", "_newest")

    def __init__(self, buffer: memoryview, layout: str, slots: int = 2) -> None:
        self._layout = struct.Struct("<" + layout)
        self._newest: tuple[int, bytes] | None = None  # replaced as one: several threads may read
        super().__init__(buffer, self._layout.size, slots)

    @classmethod
    def size(cls, layout: str, slots: int = 2) -> int:
        """Return the number of bytes that a mailbox of this layout needs; a multiple of 8."""
        return cls._size(struct.calcsize("<" + layout), slots)

    def write(self, *values: Any) -> int:
        """Announce a record and return its number. Raises ``struct.error`` if the values do not fit the layout."""
        self._layout.pack_into(self._payloads[(self._seq + 1) & self._mask], 0, *values)
        return self._announce(self._layout.size)

    @property
    def record_size(self) -> int:
        """Number of bytes of a record."""
        return self._layout.size

    def write_bytes(self, record: bytes | bytearray) -> int:
        """Announce a record of :attr:`record_size` bytes, packed elsewhere, and return its number."""
        self._payloads[(self._seq + 1) & self._mask][:] = record
        return self._announce(len(record))

    def read(self) -> tuple[int, tuple[Any, ...]] | None:
        """Return the newest whole record as (number, values); None before the first one.

        If a write is in progress at every try: the last record that this reader has read.
        """
        found = self.read_bytes()
        return None if found is None else (found[0], self._layout.unpack(found[1]))

    def read_bytes(self) -> tuple[int, bytes] | None:
        """Return the same, not unpacked."""
        newest = self._newest
        for _ in range(_TRIES):
            seq = self._announced[0]
            if seq == (newest[0] if newest is not None else 0):
                break
            record = self.bytes_at(seq)
            if record is not None:
                self._newest = newest = (seq, record)
                break
        return newest

    def bytes_at(self, seq: int) -> bytes | None:
        """Return the whole record of this number, not unpacked; None if it is not there yet, or not any more."""
        which = seq & self._mask
        number, check = _SLOT.unpack_from(self._buffer, self._starts[which])
        record = bytes(self._payloads[which])
        return record if number == seq > 0 and crc32(record) == check else None

    @property
    def oldest(self) -> int:
        """Number of the oldest record that is not about to be written over."""
        return max(1, self._announced[0] - self._mask + 1)


_SERIES = struct.Struct("<dQQ")  # time, revision, count


class SeriesBox(_Slots):
    """A time, a revision and a series of numbers whose length may change from record to record, up to ``capacity``."""

    __slots__ = ("_capacity", "_newest")

    def __init__(self, buffer: memoryview, capacity: int) -> None:
        self._capacity = capacity
        self._newest: tuple[int, float, int, array[float]] | None = None  # replaced as one
        super().__init__(buffer, _SERIES.size + 8 * capacity)

    @classmethod
    def size(cls, capacity: int) -> int:
        """Return the number of bytes that it needs."""
        return cls._size(_SERIES.size + 8 * capacity)

    def write(self, t: float, revision: int, values: Sequence[float]) -> int:
        """Announce a record and return its number. Raises ValueError for more than ``capacity`` numbers."""
        count = len(values)
        if count > self._capacity:
            raise ValueError(f"{count} numbers do not fit into {self._capacity}")
        payload = self._payloads[(self._seq + 1) & self._mask]
        _SERIES.pack_into(payload, 0, t, revision, count)
        end = _SERIES.size + 8 * count
        payload[_SERIES.size : end] = array("d", values).tobytes()
        return self._announce(end)

    def read(self) -> tuple[int, float, int, array[float]] | None:
        """Return the newest whole record as (number, time, revision, values); None before the first one."""
        newest = self._newest
        for _ in range(_TRIES):
            seq = self._announced[0]
            if seq == (newest[0] if newest is not None else 0):
                break
            which = seq & self._mask
            number, check = _SLOT.unpack_from(self._buffer, self._starts[which])
            t, revision, count = _SERIES.unpack_from(self._payloads[which], 0)
            if count > self._capacity:
                continue  # torn
            payload = bytes(self._payloads[which][: _SERIES.size + 8 * count])
            if number == seq > 0 and crc32(payload) == check:
                self._newest = newest = (seq, t, revision, array("d", payload[_SERIES.size :]))
                break
        return newest


Raw = TypeVar("Raw")
Record = TypeVar("Record")


class Newest(Generic[Raw, Record]):
    """Decodes the newest record of a mailbox once; a call that finds nothing new costs one comparison."""

    __slots__ = ("_announced", "_decode", "_known", "_read")

    def __init__(
        self,
        box: Mailbox,
        read: Callable[[], tuple[int, Raw] | None],
        decode: Callable[[Raw], Record],
        first: Record,
    ) -> None:
        self._announced = box._announced
        self._read = read
        self._decode = decode
        self._known = 0, first  # its number, and itself; replaced together

    def get(self) -> Record:
        """Return the newest record, decoded; ``first`` before there is one."""
        known = self._known
        if self._announced[0] != known[0]:
            found = self._read()
            if found is not None and found[0] != known[0]:
                self._known = known = (found[0], self._decode(found[1]))
        return known[1]


def make_reader(box: Mailbox, decode: Callable[[tuple[Any, ...]], Record], first: Record) -> Callable[[], Record]:
    """Return a function that returns the newest record of ``box``, decoded; ``first`` before there is one."""
    return Newest(box, box.read, decode, first).get


_T = struct.Struct("<d")


class Stamped(Protocol):
    """A record with a stamp."""

    @property
    def stamp(self) -> Stamp: ...


State = TypeVar("State", bound=Stamped)


class History(Generic[State]):
    """The states of the last seconds, from a mailbox with many slots whose records begin with their time, s."""

    def __init__(self, box: Mailbox, decode: Callable[[bytes], State]) -> None:
        self._box = box
        self._decode = decode

    def read_since(self, t: float) -> list[State]:
        """Return every state newer than ``t`` (s), oldest first, as far back as they are kept."""
        newest = self._box.seq()
        first = self._find_first(t, newest)
        found = (self._box.bytes_at(number) for number in range(first, newest + 1))
        return [self._decode(record) for record in found if record is not None]

    def begin(self) -> float:
        """Return the time of the oldest state that is kept, s; minus infinity if there is none."""
        record = self._box.bytes_at(self._box.oldest)
        return -math.inf if record is None else float(_T.unpack_from(record)[0])

    def find_around(self, t: float) -> tuple[State, State] | None:
        """Return the last state at or before ``t`` (s) and the first after it, or the newest twice.

        None if ``t`` is older than what is kept, and before the first state.
        """
        newest = self._box.seq()
        after = self._find_first(t, newest)
        before = self._box.bytes_at(after - 1)
        if before is None or _T.unpack_from(before)[0] > t:
            return None
        later = self._box.bytes_at(after) if after <= newest else before
        return None if later is None else (self._decode(before), self._decode(later))

    def _find_first(self, t: float, newest: int) -> int:
        """Return the number of the first state newer than ``t`` (s); ``newest + 1`` if there is none."""
        low, high = min(self._box.oldest, newest + 1), newest + 1
        while low < high:
            middle = (low + high) // 2
            record = self._box.bytes_at(middle)
            if record is None or _T.unpack_from(record)[0] <= t:  # gone meanwhile: it was old
                low = middle + 1
            else:
                high = middle
        return low
