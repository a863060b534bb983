"""What a device said in the last seconds, out of a mailbox with many slots."""

from __future__ import annotations

import struct
from collections.abc import Callable
from typing import Generic, Protocol, TypeVar

from ..types import Stamp
from .mailbox import Mailbox

__all__ = ["History"]

_T = struct.Struct("<d")


class Stamped(Protocol):
    """A record that bears a stamp."""

    @property
    def stamp(self) -> Stamp: ...


State = TypeVar("State", bound=Stamped)


class History(Generic[State]):
    """States whose records begin with their time, s. Costs the writer nothing, and never makes it wait."""

    def __init__(self, box: Mailbox, decode: Callable[[bytes], State]) -> None:
        self._box = box
        self._decode = decode

    def since(self, t: float) -> list[State]:
        """Every state that is newer than ``t``, oldest first, as far back as they are kept."""
        newest = self._box.seq()
        first = self._first_after(t, newest)
        found = (self._box.bytes_at(number) for number in range(first, newest + 1))
        return [self._decode(record) for record in found if record is not None]

    def around(self, t: float) -> tuple[State, State] | None:
        """The last state at or before ``t`` and the first one after it, or the newest twice where there is none after.

        None where ``t`` is older than what is kept, and before the first state.
        """
        newest = self._box.seq()
        after = self._first_after(t, newest)
        before = self._box.bytes_at(after - 1)
        if before is None or _T.unpack_from(before)[0] > t:
            return None
        later = self._box.bytes_at(after) if after <= newest else before
        return None if later is None else (self._decode(before), self._decode(later))

    def _first_after(self, t: float, newest: int) -> int:
        """Number of the first state that is newer than ``t``; ``newest + 1`` where none is."""
        low, high = min(self._box.oldest, newest + 1), newest + 1
        while low < high:
            middle = (low + high) // 2
            record = self._box.bytes_at(middle)
            if record is None or _T.unpack_from(record)[0] <= t:  # gone meanwhile: it was old
                low = middle + 1
            else:
                high = middle
        return low
