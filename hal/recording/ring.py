"""Rows on their way from the app to the process that writes them: a bounded queue in memory that both share.

A slot holds one row of numbers, and the pictures that are new in it. The app fills a free slot and counts it; the
writer uses it in place and counts it, too. Neither ever waits for the other here. What the writer has to say (free
space, what went wrong) stands beside it, so that nobody has to ask.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .columns import CameraSetup

__all__ = ["Images", "RowRing", "Slot"]

_NUMBER = struct.Struct("<Q")
_SPACE = struct.Struct("<d")
_WRITTEN, _READ, _FREE, _TROUBLE = 0, 8, 16, 24
_TEXT = 2000
_HEAD = 2048
_ALIGNMENT = 64


class Images(NamedTuple):
    """One camera's pictures, as they lie in a slot; None for what is not kept."""

    color: NDArray[np.uint8] | None
    depth: NDArray[np.float32] | None


class Slot(NamedTuple):
    """One row."""

    values: NDArray[np.float64]
    images: tuple[Images, ...]
    """In the order of the cameras."""


class RowRing:
    """Rows of ``width`` numbers and the pictures of ``cameras``, in ``buffer``: :meth:`size` bytes, zeros at first."""

    def __init__(self, buffer: memoryview, width: int, cameras: Sequence[CameraSetup], slots: int) -> None:
        self._buffer = buffer
        self._slots = []
        place = _HEAD
        for _ in range(slots):
            values = np.frombuffer(buffer, np.float64, width, place)
            place += _aligned(values.nbytes)
            images = []
            for camera in cameras:
                color = depth = None
                if camera.color:
                    shape = (camera.height, camera.width, 3)
                    color = np.frombuffer(buffer, np.uint8, int(np.prod(shape)), place).reshape(shape)
                    place += _aligned(color.nbytes)
                if camera.depth_unit is not None:
                    flat = (camera.height, camera.width)
                    depth = np.frombuffer(buffer, np.float32, int(np.prod(flat)), place).reshape(flat)
                    place += _aligned(depth.nbytes)
                images.append(Images(color, depth))
            self._slots.append(Slot(values, tuple(images)))

    @staticmethod
    def size(width: int, cameras: Sequence[CameraSetup], slots: int) -> int:
        """Bytes that it takes."""
        row = _aligned(8 * width)
        for camera in cameras:
            pixels = camera.width * camera.height
            row += _aligned(3 * pixels) * camera.color + _aligned(4 * pixels) * (camera.depth_unit is not None)
        return _HEAD + slots * row

    def _get(self, place: int) -> int:
        return int(_NUMBER.unpack_from(self._buffer, place)[0])

    # The app's side.

    @property
    def waiting(self) -> int:
        """Rows that the writer has not used yet."""
        return self._get(_WRITTEN) - self._get(_READ)

    @property
    def full(self) -> bool:
        """Is there no free slot?"""
        return self.waiting >= len(self._slots)

    def next(self) -> Slot:
        """The free slot to be filled, once it is known that there is one."""
        return self._slots[self._get(_WRITTEN) % len(self._slots)]

    def announce(self) -> None:
        """It is filled."""
        _NUMBER.pack_into(self._buffer, _WRITTEN, self._get(_WRITTEN) + 1)

    @property
    def free_bytes(self) -> int:
        """Free space on the disk, as the writer saw it last; 0 before."""
        return int(_SPACE.unpack_from(self._buffer, _FREE)[0])

    @property
    def trouble(self) -> str:
        """Why the writer writes no more; empty while it does."""
        length = min(_TEXT, self._get(_TROUBLE))
        start = _TROUBLE + _NUMBER.size
        return bytes(self._buffer[start : start + length]).decode(errors="replace")

    # The writer's side.

    def oldest(self) -> Slot | None:
        """The next row to be used; None where there is none."""
        return self._slots[self._get(_READ) % len(self._slots)] if self.waiting else None

    def used(self) -> None:
        """Its slot is free again."""
        _NUMBER.pack_into(self._buffer, _READ, self._get(_READ) + 1)

    def say(self, free_bytes: int | None = None, trouble: str | None = None) -> None:
        """Tell the app."""
        if free_bytes is not None:
            _SPACE.pack_into(self._buffer, _FREE, float(free_bytes))
        if trouble is not None:
            text = trouble.encode()[:_TEXT]
            start = _TROUBLE + _NUMBER.size
            self._buffer[start : start + len(text)] = text
            _NUMBER.pack_into(self._buffer, _TROUBLE, len(text))


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT
