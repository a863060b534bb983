"""Pictures on their way from the camera's process to the app: a ring in memory that both share.

The writer turns the library's pictures into the app's right inside a slot; the reader copies them out. Where every
picture counts, the writer waits for a slot that was read; a live camera's writer never waits. There the reader finds
the newest picture, and throws away a copy whose slot was written to meanwhile.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hal.driver import CameraTally, RawFrame
from hal.errors import ConnectionLost
from hal.specs import CameraSpec

__all__ = ["Images", "PictureRing"]

Images = Mapping[str, NDArray[Any]]
"""One array for each stream."""

SLOTS = 4
_STATE = struct.Struct("<4Q")  # pictures written, pictures read, sets repeated, sets mismatched
_NUMBER = struct.Struct("<Q")
_HEADER = struct.Struct("<Qddqd")  # number, t, t_device, seq, skew (NaN where there is none)
_ALIGNMENT = 64


class PictureRing:
    """For the camera ``spec``, in ``buffer``, which is :meth:`size` bytes and starts as zeros. Numbers start at 1."""

    def __init__(self, buffer: memoryview, spec: CameraSpec) -> None:
        self._buffer = buffer
        self._starts: list[int] = []
        self._images: list[dict[str, NDArray[Any]]] = []
        place = _ALIGNMENT
        for _ in range(SLOTS):
            self._starts.append(place)
            place += _ALIGNMENT
            images = {}
            for name, (shape, kind) in _layers(spec).items():
                images[name] = np.frombuffer(buffer, kind, int(np.prod(shape)), place).reshape(shape)
                place += _aligned(images[name].nbytes)
            self._images.append(images)

    @staticmethod
    def size(spec: CameraSpec) -> int:
        """Bytes that the ring of this camera takes."""
        layers = _layers(spec).values()
        pixels = sum(_aligned(int(np.prod(shape)) * np.dtype(kind).itemsize) for shape, kind in layers)
        return _ALIGNMENT + SLOTS * (_ALIGNMENT + pixels)

    @property
    def written(self) -> int:
        """Number of the newest picture."""
        return int(_NUMBER.unpack_from(self._buffer, 0)[0])

    @property
    def is_full(self) -> bool:
        """Would the next picture take the place of one that nobody has read?"""
        written, read, _, _ = _STATE.unpack_from(self._buffer, 0)
        return bool(written - read >= SLOTS)

    @property
    def tally(self) -> CameraTally:
        """What was not handed out."""
        return CameraTally(*_STATE.unpack_from(self._buffer, 0)[2:])

    def count(self, tally: CameraTally) -> None:
        """Note what was not handed out."""
        struct.pack_into("<2Q", self._buffer, 16, *tally)

    def forget(self) -> int:
        """Nobody will read what is there; the number of the newest picture comes back."""
        _NUMBER.pack_into(self._buffer, 8, self.written)
        return self.written

    def begin(self) -> Images:
        """Where the next picture goes. It may be begun anew any number of times before its :meth:`end`."""
        slot = (self.written + 1) % SLOTS
        _NUMBER.pack_into(self._buffer, self._starts[slot], 0)
        return self._images[slot]

    def end(self, t: float, t_device: float, seq: int, skew: float | None) -> int:
        """The picture is whole; its number comes back."""
        number = self.written + 1
        start = self._starts[number % SLOTS]
        _HEADER.pack_into(self._buffer, start, 0, t, t_device, seq, float("nan") if skew is None else skew)
        _NUMBER.pack_into(self._buffer, start, number)
        _NUMBER.pack_into(self._buffer, 0, number)
        return number

    def take(self, after: int, every: bool = False) -> tuple[int, RawFrame] | None:
        """A copy of the newest picture, or of the one next to ``after`` if every one counts; None if there is none.

        Raises ConnectionLost where every one counts and that one was written over.
        """
        while (number := self.written) > after:
            number = after + 1 if every else number
            slot = number % SLOTS
            before, t, t_device, seq, skew = _HEADER.unpack_from(self._buffer, self._starts[slot])
            copies = {name: image.copy() for name, image in self._images[slot].items()}
            if before == number and _NUMBER.unpack_from(self._buffer, self._starts[slot])[0] == number:
                _NUMBER.pack_into(self._buffer, 8, number)
                return number, _frame(copies, t, t_device, seq, skew)
            if every:  # the writer waits for the reader: who looks again would look for ever
                raise ConnectionLost(f"picture {number} was written over before it was read")
        return None


def _frame(images: Images, t: float, t_device: float, seq: int, skew: float) -> RawFrame:
    return RawFrame(
        t=t,
        t_device=t_device,
        seq=seq,
        color=images.get("color"),
        depth=images.get("depth"),
        infrared=images.get("infrared"),
        segmentation=None,
        T_world_camera=None,
        infrared_right=images.get("infrared_right"),
        skew=None if np.isnan(skew) else skew,
    )


def _layers(spec: CameraSpec) -> dict[str, tuple[tuple[int, ...], DTypeLike]]:
    """Shape and type of the pictures of each stream."""
    flat = (spec.height, spec.width)
    layers: dict[str, tuple[tuple[int, ...], DTypeLike]] = {
        "color": ((*flat, 3), np.uint8),
        "depth": (flat, np.float32),
        "infrared": (flat, np.uint8),
        "infrared_right": (flat, np.uint8),
    }
    return {name: layer for name, layer in layers.items() if name in spec.streams}


def _aligned(size: int) -> int:
    return -(-size // _ALIGNMENT) * _ALIGNMENT
