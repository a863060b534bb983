"""Rows on their way from the app to the process that writes them, with what that process reports back."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..host.memory import Mailbox
from ..host.ring import STREAM_TYPES, ArrayRing, Images
from .layout import CameraSetup

__all__ = ["Images", "RowRing", "Slot"]

_STATUS = "dH2000s"  # free space in bytes, length of the trouble's text, the text
_TEXT = 2000
_VALUES = -1, ""
"""Key of a row's numbers; a picture's is the index of its camera, and its stream."""

_Key = tuple[int, str]


class Slot(NamedTuple):
    """One row."""

    values: NDArray[np.float64]
    images: tuple[Images, ...]
    """In the order of the cameras; a picture that is not new keeps what the slot held before."""


class RowRing:
    """A queue of rows, each of ``width`` numbers and the pictures of ``cameras``; the writer uses them in place."""

    def __init__(self, buffer: memoryview, width: int, cameras: Sequence[CameraSetup], slots: int) -> None:
        """Lay the queue out in ``buffer``, which has :meth:`size` bytes and starts as zeros."""
        self._status = Mailbox(buffer, _STATUS)
        self._report: tuple[float, str] = (0.0, "")
        self._ring = ArrayRing(buffer[_status_size() :], _arrays(width, cameras), slots)
        indices = range(len(cameras))
        self._slots = {
            id(slot): Slot(
                slot[_VALUES],
                tuple({stream: a for (k, stream), a in slot.items() if k == camera} for camera in indices),
            )
            for slot in self._ring.slots
        }

    @staticmethod
    def size(width: int, cameras: Sequence[CameraSetup], slots: int) -> int:
        """Return the number of bytes that the queue needs."""
        return _status_size() + ArrayRing.bytes_of(_arrays(width, cameras), slots)

    # The app's side.

    @property
    def waiting(self) -> int:
        """Rows that the writer has not used yet."""
        return self._ring.waiting

    @property
    def full(self) -> bool:
        """Whether there is no free slot."""
        return self._ring.is_full

    def next(self) -> Slot:
        """Return the free slot to be filled; call it only if the ring is not full."""
        return self._slots[id(self._ring.open_slot())]

    def announce(self) -> None:
        """Publish the slot that was filled."""
        self._ring.publish()

    @property
    def free_bytes(self) -> int:
        """Free space on the disk, as the writer found it last; 0 before."""
        found = self._status.read()
        return int(found[1][0]) if found is not None else 0

    @property
    def trouble(self) -> str:
        """Why the writer has stopped writing; empty while it writes."""
        found = self._status.read()
        return found[1][2][: found[1][1]].decode(errors="replace") if found is not None else ""

    # The writer's side.

    def oldest(self) -> Slot | None:
        """Return the next row to be written; None if there is none."""
        slot = self._ring.oldest()
        return None if slot is None else self._slots[id(slot)]

    def used(self) -> None:
        """Free the slot of the oldest row."""
        self._ring.release_oldest()

    def say(self, free_bytes: int | None = None, trouble: str | None = None) -> None:
        """Report free space, trouble or both to the app; what is None stays as it was."""
        free, text = self._report
        self._report = free, text = (
            free if free_bytes is None else float(free_bytes),
            text if trouble is None else trouble,
        )
        data = text.encode()[:_TEXT]
        self._status.write(free, len(data), data)


def _status_size() -> int:
    return -(-Mailbox.size(_STATUS) // 64) * 64  # the arrays stay aligned


def _arrays(width: int, cameras: Sequence[CameraSetup]) -> dict[_Key, tuple[tuple[int, ...], DTypeLike]]:
    """Return shape and type of everything in a row."""
    arrays: dict[_Key, tuple[tuple[int, ...], DTypeLike]] = {_VALUES: ((width,), np.float64)}
    for index, camera in enumerate(cameras):
        for stream in (*camera.videos.values(), *camera.depths.values()):
            dtype, more = STREAM_TYPES[stream]
            arrays[index, stream] = (camera.height, camera.width, *more), dtype
    return arrays
