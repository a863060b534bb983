"""Pictures on their way from the process that draws them to the app: a ring per camera in memory that both share.

A picture is copied twice: into the ring, and out of it into an array of the reader's own. Nobody ever waits for the
other side: the writer marks a slot as unfinished, fills it, then marks it with the picture's number, and a reader
that finds another number after its copy than before it throws the copy away. A writer that is killed in the middle
leaves one unfinished slot, which no reader takes.
"""

from __future__ import annotations

import math
import struct
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from ..camera import RawFrame
from ..geometry import Pose
from ..specs import CameraSpec

__all__ = ["FrameRing"]

_SLOTS = 4
"""Per camera. A reader has two periods of the camera to copy a picture before its slot is written again."""
_NUMBER = struct.Struct("<Q")
_HEADER = struct.Struct("<Qddd7d")  # number, t, t_device, skew (NaN for none), position and quaternion of the camera
_ALIGNMENT = 64
_POLL = 0.0005
"""s between two looks while a picture is due."""
_EARLY = 0.85
"""Share of a period after a picture before which the next one is not looked for."""
_TRIES = 3


class FrameRing:
    """Rings for the cameras of ``specs`` in ``buffer``, which is :meth:`size` bytes and starts as zeros.

    One process writes, in one thread; per camera one thread reads. Numbers start at 1; gaps are pictures that the
    reader did not see.
    """

    def __init__(self, buffer: memoryview, specs: Sequence[CameraSpec]) -> None:
        self._buffer = buffer
        self._cameras: dict[str, _Camera] = {}
        offset = 0
        for spec in specs:
            self._cameras[spec.name] = _Camera(buffer, offset, spec)
            offset += _Camera.size(spec)

    @staticmethod
    def size(specs: Sequence[CameraSpec]) -> int:
        """Bytes that the rings of these cameras take."""
        return sum(_Camera.size(spec) for spec in specs)

    def put(self, camera: str, frame: RawFrame) -> int:
        """Copy a picture into the ring; returns its number. ``frame.seq`` is not looked at."""
        return self._cameras[camera].put(frame)

    def take(self, camera: str, after: int, timeout: float) -> RawFrame | None:
        """A copy of the newest picture if its number is above ``after``; waits up to ``timeout`` s, then None."""
        ring = self._cameras[camera]
        deadline = time.monotonic() + timeout
        while True:
            frame = ring.take(after)
            now = time.monotonic()
            if frame is not None:
                ring.arrived = now
                return frame
            if now >= deadline:
                return None
            due = ring.arrived + _EARLY * ring.period
            time.sleep(min(deadline - now, max(_POLL, due - now)))


class _Camera:
    """The ring of one camera."""

    def __init__(self, buffer: memoryview, offset: int, spec: CameraSpec) -> None:
        self._buffer = buffer
        self._offset = offset
        self.period = 1.0 / spec.rate_hz
        self.arrived = 0.0
        stride = self._stride(spec)
        self._starts = [offset + _ALIGNMENT + place * stride for place in range(_SLOTS)]
        self._images: list[dict[str, NDArray[Any]]] = []
        for start in self._starts:
            images, place = {}, start + _aligned(_HEADER.size)
            for name, (shape, dtype) in _layers(spec).items():
                count = int(np.prod(shape))
                images[name] = np.frombuffer(buffer, dtype, count, place).reshape(shape)
                place += _aligned(images[name].nbytes)
            self._images.append(images)

    @staticmethod
    def _stride(spec: CameraSpec) -> int:
        layers = _layers(spec).values()
        pixels = sum(_aligned(int(np.prod(shape)) * np.dtype(dtype).itemsize) for shape, dtype in layers)
        return _aligned(_HEADER.size) + pixels

    @classmethod
    def size(cls, spec: CameraSpec) -> int:
        return _ALIGNMENT + _SLOTS * cls._stride(spec)

    def put(self, frame: RawFrame) -> int:
        number = self._newest() + 1
        start, images = self._starts[number % _SLOTS], self._images[number % _SLOTS]
        _NUMBER.pack_into(self._buffer, start, 0)
        for name, image in images.items():
            np.copyto(image, getattr(frame, name))
        pose = frame.T_world_camera or Pose()
        numbers = (*pose.position.tolist(), *pose.orientation.tolist())
        skew = math.nan if frame.skew is None else frame.skew
        _HEADER.pack_into(self._buffer, start, 0, frame.t, frame.t_device, skew, *numbers)
        _NUMBER.pack_into(self._buffer, start, number)
        _NUMBER.pack_into(self._buffer, self._offset, number)
        return number

    def take(self, after: int) -> RawFrame | None:
        for _ in range(_TRIES):
            number = self._newest()
            if number <= after:
                return None
            start, images = self._starts[number % _SLOTS], self._images[number % _SLOTS]
            before, t, t_device, skew, *pose = _HEADER.unpack_from(self._buffer, start)
            copies = {name: image.copy() for name, image in images.items()}
            if before == number and _NUMBER.unpack_from(self._buffer, start)[0] == number:
                return RawFrame(
                    t,
                    t_device,
                    number,
                    copies.get("color"),
                    copies.get("depth"),
                    copies.get("infrared"),
                    copies.get("segmentation"),
                    Pose(pose[:3], pose[3:]),
                    copies.get("infrared_right"),
                    None if math.isnan(skew) else skew,
                )
        return None

    def _newest(self) -> int:
        return int(_NUMBER.unpack_from(self._buffer, self._offset)[0])


def _layers(spec: CameraSpec) -> dict[str, tuple[tuple[int, ...], DTypeLike]]:
    """Shape and type of each picture that the camera streams."""
    flat = (spec.height, spec.width)
    layers: dict[str, tuple[tuple[int, ...], DTypeLike]] = {
        "color": ((*flat, 3), np.uint8),
        "depth": (flat, np.float32),
        "infrared": (flat, np.uint8),
        "infrared_right": (flat, np.uint8),
        "segmentation": (flat, np.int32),
    }
    return {name: layer for name, layer in layers.items() if name in spec.streams}


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT
