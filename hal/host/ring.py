"""Arrays on their way between two processes: a ring of slots in shared memory, for camera frames and recorded rows.

One writer fills the slots in turn, one reader uses them, and neither ever waits for the other here. A slot is marked
as unfinished, filled, then marked with its number. There are two ways to read: the *newest* one, copied, where a copy
whose slot was written again meanwhile is thrown away; or *every* one in turn, where the writer waits while the ring is
full. A writer that is killed in the middle leaves one unfinished slot, which is never read.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Hashable, Mapping, Sequence
from typing import Any, Generic, TypeVar

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..driver import CameraTally, RawFrame
from ..errors import ConnectionLost
from ..geometry import Pose
from ..specs import CameraSpec
from ..types import STREAMS

Images = Mapping[str, NDArray[Any]]
"""The pictures of one capture, by the names of their streams."""
Key = TypeVar("Key", bound=Hashable)

_HEADER = struct.Struct(
    "<QddQd7d"
)  # number, t, t_device, seq, skew, position and quaternion of the camera; NaN: unknown
_WRITTEN, _READ, _TALLY = 0, 1, 2  # places of the numbers in the ring's head; the tally has two
_ALIGNMENT = 64
_SLOTS = 4
"""Of a camera's ring: a reader has two periods of the camera to copy a frame before its slot is written again."""
_POLL = 0.0005
"""s between two reads while a frame is due."""
_EARLY = 0.85
"""Share of a period after a frame before which the next one is not looked for."""
_TRIES = 3
_UNKNOWN_POSE = (math.nan,) * 7


def _align(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT


class ArrayRing(Generic[Key]):
    """A ring whose slots hold named arrays of fixed shapes and types. Numbers of slots count from 1."""

    def __init__(self, buffer: memoryview, arrays: Mapping[Key, tuple[tuple[int, ...], DTypeLike]], slots: int) -> None:
        """Lay the ring out in memory.

        Args:
            buffer: At least :meth:`bytes_of` bytes, zeros at first.
            arrays: Shape and type of each array in a slot.
            slots: Number of slots.
        """
        self._buffer = buffer
        self._head = buffer[:_ALIGNMENT].cast("Q")  # each is stored at once; struct.pack_into writes zeros before it
        self.slots: list[dict[Key, NDArray[Any]]] = []
        """The arrays of each slot; number k uses slot ``k % len(slots)``."""
        self._starts: list[int] = []
        self._numbers: list[memoryview] = []
        place = _ALIGNMENT
        for _ in range(slots):
            self._starts.append(place)
            self._numbers.append(buffer[place : place + 8].cast("Q"))
            place += _align(_HEADER.size)
            views = {}
            for key, (shape, dtype) in arrays.items():
                views[key] = np.frombuffer(buffer, dtype, math.prod(shape), place).reshape(shape)
                place += _align(views[key].nbytes)
            self.slots.append(views)

    @staticmethod
    def count_bytes(arrays: Mapping[Key, tuple[tuple[int, ...], DTypeLike]], slots: int) -> int:
        """Return the number of bytes that such a ring needs."""
        payload = sum(_align(math.prod(shape) * np.dtype(dtype).itemsize) for shape, dtype in arrays.values())
        return _ALIGNMENT + slots * (_align(_HEADER.size) + payload)

    @property
    def written(self) -> int:
        """Number of the newest finished slot; 0 before the first."""
        return self._head[_WRITTEN]

    @property
    def waiting(self) -> int:
        """Number of finished slots that were not read."""
        return max(0, self._head[_WRITTEN] - self._head[_READ])  # both are 0 once the memory is freed

    @property
    def is_full(self) -> bool:
        """Whether the next slot to be written was not read yet."""
        return self.waiting >= len(self.slots)

    # Writer.

    def open_slot(self) -> dict[Key, NDArray[Any]]:
        """Mark the next slot as unfinished and return its arrays, to be filled. Repeatable before :meth:`publish`."""
        which = (self.written + 1) % len(self.slots)
        self._numbers[which][0] = 0
        return self.slots[which]

    def publish(
        self, t: float = 0.0, t_device: float = 0.0, seq: int = 0, skew: float | None = None, pose: Pose | None = None
    ) -> int:
        """Finish the slot that :meth:`open_slot` returned.

        Args:
            t: When the capture was taken, on the host's clock, s.
            t_device: The same on the device's clock, s.
            seq: Number of the capture.
            skew: How much later colour was taken than depth, s; None if unknown.
            pose: Pose of the camera in the world; None if unknown.

        Returns:
            The slot's number.
        """
        number = self.written + 1
        which = number % len(self.slots)
        place = _UNKNOWN_POSE if pose is None else (*pose.position.tolist(), *pose.orientation.tolist())
        values = (0, t, t_device, seq, math.nan if skew is None else skew, *place)
        _HEADER.pack_into(self._buffer, self._starts[which], *values)
        self._numbers[which][0] = number
        self._head[_WRITTEN] = number
        return number

    # Reader of every slot, in place.

    def oldest(self) -> dict[Key, NDArray[Any]] | None:
        """Return the arrays of the oldest slot that was not read; None if there is none."""
        return self.slots[(self._head[_READ] + 1) % len(self.slots)] if self.waiting else None

    def release_oldest(self) -> None:
        """Mark the oldest slot as read, so that the writer may use it again."""
        self._head[_READ] += 1

    def release_all(self) -> int:
        """Mark every slot as read; returns the number of the newest one."""
        self._head[_READ] = newest = self.written
        return newest


class FrameRing(ArrayRing[str]):
    """The frames of one camera. One process writes, one reads."""

    def __init__(self, buffer: memoryview, spec: CameraSpec) -> None:
        super().__init__(buffer, _list_arrays(spec), _SLOTS)
        self._period = 1.0 / spec.rate_hz
        self._arrived = 0.0

    @staticmethod
    def size(spec: CameraSpec) -> int:
        """Return the number of bytes that the ring of this camera needs."""
        return ArrayRing.count_bytes(_list_arrays(spec), _SLOTS)

    def write(self, frame: RawFrame) -> int:
        """Copy a frame into the ring and return its number, which also replaces ``frame.seq``."""
        for name, image in self.open_slot().items():
            np.copyto(image, getattr(frame, name))
        return self.publish(frame.t, frame.t_device, self.written + 1, frame.skew, frame.T_world_camera)

    def read(self, after: int, every: bool = False) -> tuple[int, RawFrame] | None:
        """Return a copy of a frame that was not read yet.

        Args:
            after: Number of the frame that was read last; 0 before the first.
            every: Return the frame that follows ``after``, not the newest one.

        Returns:
            Its number and the frame; None if there is none.

        Raises:
            ConnectionLost: With ``every``, if that frame was written over.
        """
        for _ in range(_TRIES):
            number = self.written
            if number <= after:
                return None
            number = after + 1 if every else number
            which = number % len(self.slots)
            before, t, t_device, seq, skew, *pose = _HEADER.unpack_from(self._buffer, self._starts[which])
            copies = {name: image.copy() for name, image in self.slots[which].items()}
            if before == number and self._numbers[which][0] == number:
                self._head[_READ] = number
                return number, RawFrame(
                    t,
                    t_device,
                    seq,
                    T_world_camera=None if math.isnan(pose[0]) else Pose(pose[:3], pose[3:]),
                    skew=None if math.isnan(skew) else skew,
                    **copies,
                )
            if every:
                raise ConnectionLost(f"frame {number} was written over before it was read", code="frame_overwritten")
        return None

    def wait(self, after: int, timeout: float) -> RawFrame | None:
        """Return a copy of the newest frame, once its number is above ``after``; None after ``timeout`` s."""
        deadline = time.monotonic() + timeout
        while True:
            found = self.read(after)
            now = time.monotonic()
            if found is not None:
                self._arrived = now
                return found[1]
            if now >= deadline:
                return None
            due = self._arrived + _EARLY * self._period
            time.sleep(min(deadline - now, max(_POLL, due - now)))

    @property
    def tally(self) -> CameraTally:
        """Sets of frames that the writer kept back."""
        return CameraTally(*self._head[_TALLY : _TALLY + 2])

    @tally.setter
    def tally(self, tally: CameraTally) -> None:
        self._head[_TALLY], self._head[_TALLY + 1] = tally


def frame_rings(buffer: memoryview, specs: Sequence[CameraSpec]) -> dict[str, FrameRing]:
    """Return the rings of several cameras by their names, one after the other in ``buffer``."""
    rings, offset = {}, 0
    for spec in specs:
        rings[spec.name] = FrameRing(buffer[offset:], spec)
        offset += FrameRing.size(spec)
    return rings


def frame_rings_size(specs: Sequence[CameraSpec]) -> int:
    """Return the number of bytes that the rings of these cameras need."""
    return sum(FrameRing.size(spec) for spec in specs)


def _list_arrays(spec: CameraSpec) -> dict[str, tuple[tuple[int, ...], DTypeLike]]:
    """Return shape and type of the pictures of each stream of a camera."""
    return {
        name: ((spec.height, spec.width, *kind.shape), kind.dtype)
        for name, kind in STREAMS.items()
        if name in spec.streams
    }
