"""Rows on their way from the app to the process that writes them: a bounded queue in memory that both share.

A slot holds one row of numbers, and the pictures that are new in it. The app fills a free slot and counts it; the
writer uses it in place and counts it, too. Neither ever waits for the other here. What the writer has to say (free
space, what went wrong) stands beside it, so that nobody has to ask.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Sequence
from typing import Any, NamedTuple

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


Images = dict[str, NDArray[Any]]
"""One camera's pictures in a slot, by their streams; only those that are kept."""

_TYPES: dict[str, tuple[type[np.generic], tuple[int, ...]]] = {
    "color": (np.uint8, (3,)),
    "depth": (np.float32, ()),
    "infrared": (np.uint8, ()),
    "infrared_right": (np.uint8, ()),
    "segmentation": (np.int32, ()),
}
"""Type and further dimensions of each stream's pictures."""


def _streams(camera: CameraSetup) -> Iterator[tuple[str, type[np.generic], tuple[int, ...]]]:
    """Yield each stream that is kept, and type and shape of its pictures."""
    for stream in (*camera.videos.values(), *camera.depths.values()):
        dtype, more = _TYPES[stream]
        yield stream, dtype, (camera.height, camera.width, *more)


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
                pictures: Images = {}
                for stream, dtype, shape in _streams(camera):
                    picture = np.frombuffer(buffer, dtype, int(np.prod(shape)), place).reshape(shape)
                    pictures[stream] = picture
                    place += _aligned(picture.nbytes)
                images.append(pictures)
            self._slots.append(Slot(values, tuple(images)))

    @staticmethod
    def size(width: int, cameras: Sequence[CameraSetup], slots: int) -> int:
        """Bytes that it takes."""
        row = _aligned(8 * width)
        for camera in cameras:
            for _, dtype, shape in _streams(camera):
                row += _aligned(np.dtype(dtype).itemsize * int(np.prod(shape)))
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
