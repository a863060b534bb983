"""The newest record of a mailbox, decoded once."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, Generic, TypeVar

from .mailbox import Mailbox

__all__ = ["Newest", "newest"]

Raw = TypeVar("Raw")
Record = TypeVar("Record")


class Newest(Generic[Raw, Record]):
    """Most looks at a mailbox find nothing new: those cost one comparison."""

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


def newest(box: Mailbox, decode: Callable[[tuple[Any, ...]], Record]) -> Callable[[], Record | None]:
    """A function that gives the newest record of ``box``."""
    return Newest(box.seq, box.read, decode).get
