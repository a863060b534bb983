"""Depth pictures in a file of their own, without loss: zstd over differences of neighbours, low and high bytes apart.

A file is one line of JSON (size, unit), then a record per row of the episode: length and checksum of what follows, and
that. A record of no length says that the row shows the same picture as the one before. Records are appended and flushed
one by one, so a program that is killed leaves whole ones, and at most half of one, which is cut off.
"""

from __future__ import annotations

import io
import json
import math
import os
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

__all__ = ["DepthFile", "DepthReader", "numbers_to_units", "to_units", "unit_for"]

_RECORD = struct.Struct("<II")  # length, checksum
_LEVEL = 1
_MOST = 65535
_LINE, _SIDE = 4096, 16384
"""Bytes of the first line, and pixels of a side, at most: a damaged file must not ask for all memory."""
_UNITS = (0.0001, 0.00025, 0.0005, 0.001, 0.002, 0.005, 0.01)

Units = NDArray[np.uint16]


def unit_for(depth_max: float) -> float:
    """The finest unit, in m, in which 16 bits reach as far as a simulated camera sees."""
    return next((unit for unit in _UNITS if depth_max <= _MOST * unit), depth_max / _MOST)


def to_units(depth: NDArray[np.float32], unit: float) -> Units:
    """Metres in whole units, rounded to the nearest one; 0 for what was not measured, or does not fit."""
    whole = np.rint(depth / np.float32(unit))
    whole[~((whole >= 0.0) & (whole <= _MOST))] = 0.0  # what is not a number, too
    units: Units = whole.astype("<u2")
    return units


def numbers_to_units(numbers: NDArray[np.int32]) -> Units:
    """Return numbers of bodies (H, W), -1 for none, as units. ValueError for a number above 65534."""
    if numbers.size and not (numbers.min() >= -1 and numbers.max() < _MOST):
        raise ValueError("a number of a body does not fit into 16 bits")
    units: Units = (numbers + 1).astype("<u2")
    return units


class DepthFile:
    """Appends pictures to an open, unbuffered file."""

    def __init__(self, file: io.RawIOBase, width: int, height: int, unit: float) -> None:
        import zstandard

        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)
        self._file = file
        head = {"format": "delta, byte shuffle, zstd", "width": width, "height": height, "unit_m": unit}
        _write(file, json.dumps(head).encode() + b"\n")
        self._unit = unit

    def add(self, depth: NDArray[np.float32] | None) -> None:
        """One row's picture (H, W) in m; None for the same one again."""
        self.add_units(None if depth is None else to_units(depth, self._unit))

    def add_units(self, units: Units | None) -> None:
        """One row's picture (H, W) in units of the file; None for the same one again."""
        payload = b"" if units is None else self._compressor.compress(_shuffled(units))
        _write(self._file, _RECORD.pack(len(payload), crc32(payload)) + payload)


class DepthReader:
    """The whole records of a file; reads them one by one."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with self.path.open("rb") as file:
            head: dict[str, Any] = json.loads(file.readline(_LINE))
            self.shape = (int(head["height"]), int(head["width"]))
            self.unit = float(head["unit_m"])
            if not (all(1 <= side <= _SIDE for side in self.shape) and 0.0 < self.unit < math.inf):
                raise ValueError(f"its first line is damaged: {head}")
            self._places = list(_records(file, self.path.stat().st_size))

    def __len__(self) -> int:
        return len(self._places)

    def end_of(self, count: int) -> int:
        """Where the first ``count`` records end in the file, bytes."""
        if count == 0:
            with self.path.open("rb") as file:
                return len(file.readline())
        start, length = self._places[count - 1]
        return start + length

    def units(self) -> Iterator[Units]:
        """Yield every row's picture (H, W), in units of :attr:`unit` m. ValueError for a damaged one."""
        import zstandard

        expand = zstandard.ZstdDecompressor()
        picture = np.zeros(self.shape, "<u2")
        with self.path.open("rb") as file:
            for k, (start, length) in enumerate(self._places):
                if length:
                    file.seek(start - _RECORD.size)
                    _, check = _RECORD.unpack(file.read(_RECORD.size))
                    data = file.read(length)
                    if crc32(data) != check or zstandard.frame_content_size(data) != picture.nbytes:
                        raise ValueError(f"picture {k} is damaged")
                    picture = _unshuffled(expand.decompress(data), self.shape)
                yield picture

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        """Every row's picture (H, W) in m; 0 where nothing was measured."""
        unit = np.float32(self.unit)
        return (units.astype(np.float32) * unit for units in self.units())


def _records(file: io.BufferedReader, size: int) -> Iterator[tuple[int, int]]:
    """Start and length of each whole record, from where the file stands."""
    while True:
        head = file.read(_RECORD.size)
        if len(head) < _RECORD.size:
            return
        length, check = _RECORD.unpack(head)
        start = file.tell()
        if start + length > size:
            return
        last = start + length == size
        if last and crc32(file.read(length)) != check:
            return
        file.seek(start + length)
        yield start, length


def _shuffled(units: Units) -> bytes:
    steps = units.copy()
    steps[:, 1:] -= units[:, :-1]
    return np.ascontiguousarray(steps.view(np.uint8).reshape(-1, 2).T).tobytes()


def _unshuffled(data: bytes, shape: tuple[int, int]) -> Units:
    steps = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(2, -1).T).view("<u2").reshape(shape)
    units: Units = np.cumsum(steps, axis=1, dtype=np.uint16)
    return units


def _write(file: io.RawIOBase, data: bytes) -> None:
    """All of it: an unbuffered file may take only a part. OSError when the disk is full."""
    rest = memoryview(data)
    while rest:
        written = file.write(rest)
        rest = rest[written or 0 :]


def cut(path: Path, count: int) -> None:
    """Leave the first ``count`` records."""
    os.truncate(path, DepthReader(path).end_of(count))
