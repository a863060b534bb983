"""Depth files without loss, and statistics of columns and pictures."""

from __future__ import annotations

import io
import json
import math
import os
import struct
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any
from zlib import crc32

import numpy as np
from numpy.typing import NDArray

# Depth files: zstd over the differences of neighbouring pixels, low and high bytes apart.
#
# A file is one line of JSON (size, unit), then a record per row of the episode: length, checksum, data. An empty record
# means that the row shows the same picture as the one before. Records are appended and flushed one by one, so a killed
# program leaves complete ones, and at most one that is cut off.

_RECORD = struct.Struct("<II")  # length, checksum
_LEVEL = 1
_MOST = 65535
_LINE, _SIDE = 4096, 16384
"""Bytes of the first line, and pixels of a side, at most: a damaged file must not ask for all memory."""
_UNITS = (0.0001, 0.00025, 0.0005, 0.001, 0.002, 0.005, 0.01)

Units = NDArray[np.uint16]


def depth_unit_for(depth_max: float) -> float:
    """Return the finest unit, m, in which 16 bits reach ``depth_max``, m, of a simulated camera."""
    return next((unit for unit in _UNITS if depth_max <= _MOST * unit), depth_max / _MOST)


def to_units(depth: NDArray[np.float32], unit: float) -> Units:
    """Return depth (H, W) in m as whole units, rounded to nearest; 0 for what was not measured or does not fit."""
    whole = np.rint(depth / np.float32(unit))
    whole[~((whole >= 0.0) & (whole <= _MOST))] = 0.0  # also true for NaN
    units: Units = whole.astype("<u2")
    return units


def ids_to_units(numbers: NDArray[Any], lowest: float = -1) -> Units:
    """Return whole numbers (H, W) from ``lowest`` on as units from 0 on: those of bodies, -1 for none.

    Raises ValueError for one that does not fit into 16 bits.
    """
    first = int(lowest)
    if numbers.size and not (numbers.min() >= first and numbers.max() <= _MOST + first):
        raise ValueError(f"a number is not in {first}..{_MOST + first}, and does not fit into 16 bits")
    return (numbers.astype(np.int64) - first).astype("<u2")


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
        """Append one row's picture (H, W), m; None repeats the one before."""
        self.add_units(None if depth is None else to_units(depth, self._unit))

    def add_units(self, units: Units | None) -> None:
        """Append one row's picture (H, W), in the file's units; None repeats the one before."""
        payload = b"" if units is None else self._compressor.compress(_shuffle(units))
        _write(self._file, _RECORD.pack(len(payload), crc32(payload)) + payload)


class DepthReader:
    """Reads the complete records of a depth file. Raises ValueError or KeyError for a damaged first line."""

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        with self.path.open("rb") as file:
            head: dict[str, Any] = json.loads(file.readline(_LINE))
            self.shape = (int(head["height"]), int(head["width"]))
            self.unit = float(head["unit_m"])
            if not (all(1 <= side <= _SIDE for side in self.shape) and 0.0 < self.unit < math.inf):
                raise ValueError(f"its first line is damaged: {head}")
            places = list(_records(file, self.path.stat().st_size))
        self._places = np.array(places, np.int64).reshape(-1, 2)
        """(rows, 2) start and length of each record, bytes."""

    @property
    def nbytes(self) -> int:
        """Size of the reader in memory, bytes."""
        return self._places.nbytes

    def __len__(self) -> int:
        return len(self._places)

    def end_of(self, count: int) -> int:
        """Return the position in the file at which the first ``count`` records end, bytes."""
        if count == 0:
            with self.path.open("rb") as file:
                return len(file.readline())
        return int(self._places[count - 1].sum())

    def units(self) -> Iterator[Units]:
        """Yield every row's picture (H, W), in units of :attr:`unit` m. Raises ValueError for a damaged one."""
        picture = np.zeros(self.shape, "<u2")
        with self.path.open("rb") as file:
            for k, length in enumerate(self._places[:, 1]):
                if length:
                    picture = self._decode(file, k)
                yield picture

    def __iter__(self) -> Iterator[NDArray[np.float32]]:
        """Yield every row's picture (H, W), m; 0 for what was not measured."""
        unit = np.float32(self.unit)
        return (units.astype(np.float32) * unit for units in self.units())

    def __getitem__(self, k: int) -> NDArray[np.float32]:
        """Return the picture (H, W) of row ``k``, m; no other one is decoded.

        Raises IndexError if there is no such row, and ValueError if its picture is damaged.
        """
        own = self.stored_row(k)
        if not self._places[own][1]:
            return np.zeros(self.shape, np.float32)
        with self.path.open("rb") as file:
            depth: NDArray[np.float32] = self._decode(file, own).astype(np.float32) * np.float32(self.unit)
            return depth

    def stored_row(self, k: int) -> int:
        """Return the row that holds the picture of row ``k``: an earlier one if it shows the same picture again."""
        own = range(len(self))[k]
        while own and not self._places[own][1]:
            own -= 1
        return own

    def _decode(self, file: io.BufferedReader, k: int) -> Units:
        import zstandard

        start, length = self._places[k].tolist()
        file.seek(start - _RECORD.size)
        _, check = _RECORD.unpack(file.read(_RECORD.size))
        data = file.read(length)
        if crc32(data) != check or zstandard.frame_content_size(data) != 2 * math.prod(self.shape):
            raise ValueError(f"picture {k} is damaged")
        return _unshuffle(zstandard.ZstdDecompressor().decompress(data), self.shape)


def _records(file: io.BufferedReader, size: int) -> Iterator[tuple[int, int]]:
    """Yield start and length of each complete record, from the file's current position."""
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


def _shuffle(units: Units) -> bytes:
    steps = units.copy()
    steps[:, 1:] -= units[:, :-1]
    return np.ascontiguousarray(steps.view(np.uint8).reshape(-1, 2).T).tobytes()


def _unshuffle(data: bytes, shape: tuple[int, int]) -> Units:
    steps = np.ascontiguousarray(np.frombuffer(data, np.uint8).reshape(2, -1).T).view("<u2").reshape(shape)
    return np.cumsum(steps, axis=1, dtype=np.uint16)


def _write(file: io.RawIOBase, data: bytes) -> None:
    """Write all of ``data``: an unbuffered file may accept only a part at a time."""
    rest = memoryview(data)
    while rest:
        written = file.write(rest)
        rest = rest[written or 0 :]


def copy_records(source: Path, target: Path, first: int, end: int) -> None:
    """Write rows ``first`` to ``end - 1`` of a depth file into another one, as they are compressed."""
    reader = DepthReader(source)
    if not 0 <= first < end <= len(reader):
        raise ValueError(f"it has {len(reader)} pictures, and not {first} to {end - 1}")
    begin = reader.stored_row(first)
    target.parent.mkdir(parents=True, exist_ok=True)
    with source.open("rb") as read, target.open("wb") as write:
        write.write(read.readline())
        for start, stop in ((begin, begin + 1), (first + 1, end)):
            read.seek(reader.end_of(start))
            write.write(read.read(reader.end_of(stop) - reader.end_of(start)))


def truncate_records(path: Path, count: int) -> None:
    """Cut a depth file after its first ``count`` records."""
    os.truncate(path, DepthReader(path).end_of(count))


# Statistics of columns and pictures, as a LeRobotDataset keeps them to normalise by.

Stats = dict[str, NDArray[Any]]
"""``min``, ``max``, ``mean``, ``std``, ``q01`` ... ``q99``, each of the column's shape, and ``count`` (1,)."""

_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_LEVELS = 256
_FINE = 120
"""Rows of pixels that are counted per picture, at least; as accurate as all of them, and far quicker."""


def column_stats(values: NDArray[Any]) -> Stats:
    """Return the statistics of a column (rows, n), without unknown values (NaN); NaN if there are only those."""
    table = np.asarray(values, np.float64)
    known = np.isfinite(table)
    found: Stats = {key: np.full(table.shape[1], np.nan) for key in ("min", "max", "mean", "std", *_QUANTILES)}
    for k in range(table.shape[1]):
        numbers = table[known[:, k], k]
        if numbers.size:
            found["min"][k], found["max"][k] = numbers.min(), numbers.max()
            found["mean"][k], found["std"][k] = numbers.mean(), numbers.std()
            constant = found["min"][k] == found["max"][k]  # as many numbers are, and the quantiles take long
            levels = numbers[:1].repeat(5) if constant else np.quantile(numbers, list(_QUANTILES.values()))
            for key, value in zip(_QUANTILES, levels, strict=True):
                found[key][k] = value
    return found | {"count": np.array([len(table)], np.int64)}


class PictureStats:
    """Statistics of pictures, by a histogram of each colour."""

    def __init__(self) -> None:
        self._seen = np.zeros((3, _LEVELS), np.int64)
        self._pictures = 0

    def add(self, picture: NDArray[np.uint8]) -> None:
        """Add one picture (H, W, 3) RGB."""
        step = max(1, min(picture.shape[:2]) // _FINE)
        for k in range(3):
            self._seen[k] += np.bincount(picture[::step, ::step, k].ravel(), minlength=_LEVELS)
        self._pictures += 1

    def stats(self) -> Stats:
        """Return the statistics of the colours.

        Each is of shape (3, 1, 1), scaled to 0..1; ``count`` is the number of pictures.
        """
        levels = np.arange(_LEVELS) / (_LEVELS - 1)
        total = np.maximum(1, self._seen.sum(axis=1))
        mean = self._seen @ levels / total
        std = np.sqrt(np.maximum(0.0, self._seen @ levels**2 / total - mean**2))
        there = self._seen > 0
        share = np.cumsum(self._seen, axis=1) / total[:, None]
        found = {
            "min": levels[there.argmax(axis=1)],
            "max": levels[_LEVELS - 1 - there[:, ::-1].argmax(axis=1)],
            "mean": mean,
            "std": std,
            **{key: levels[(share >= level).argmax(axis=1)] for key, level in _QUANTILES.items()},
        }
        return {key: value.reshape(3, 1, 1) for key, value in found.items()} | {"count": np.array([self._pictures])}


def merge_stats(parts: Sequence[Mapping[str, Any]]) -> Stats:
    """Return the statistics of several parts together: exact but for the quantiles, which are averaged by row count.

    A number that a part does not know (NaN) does not count.
    """
    if len(parts) == 1:
        return {key: np.asarray(value) for key, value in parts[0].items()}
    return merge_stacked({key: np.array([part[key] for part in parts], np.float64) for key in parts[0]})


def merge_stacked(stacked: Mapping[str, NDArray[Any]]) -> Stats:
    """Return the same as :func:`merge_stats` for arrays whose first axis is that of the parts."""
    rows = stacked["count"].reshape(-1, *(1,) * (stacked["mean"].ndim - 1))

    def average(values: NDArray[Any]) -> NDArray[Any]:
        weights = rows * ~np.isnan(values)
        with np.errstate(invalid="ignore"):
            found: NDArray[Any] = (weights * np.nan_to_num(values)).sum(axis=0) / weights.sum(axis=0)
        return found

    mean = average(stacked["mean"])
    return {
        "min": np.fmin.reduce(stacked["min"]),
        "max": np.fmax.reduce(stacked["max"]),
        "mean": mean,
        "std": np.sqrt(np.maximum(0.0, average(stacked["std"] ** 2 + stacked["mean"] ** 2) - mean**2)),
        **{key: average(stacked[key]) for key in _QUANTILES},
        "count": stacked["count"].sum(axis=0).astype(np.int64),
    }


def exchange_flags(whole: Stats, old: Mapping[str, NDArray[Any]], new: Mapping[str, NDArray[Any]]) -> Stats:
    """Return the statistics of a column of 0 and 1, ``whole`` before some of its parts changed from ``old`` to ``new``.

    Those of the parts are stacked along a first axis; ``count`` stays.
    """
    total, counts = whole["count"], old["count"]
    ones = np.rint(whole["mean"] * total) + np.rint(new["mean"] * counts).sum(0) - np.rint(old["mean"] * counts).sum(0)
    mean = ones / total
    return {
        "min": (ones == total).astype(np.float64),
        "max": (ones > 0).astype(np.float64),
        "mean": mean,
        "std": np.sqrt(np.maximum(0.0, mean - mean**2)),
        **{key: whole[key] + ((new[key] - old[key]) * counts).sum(0) / total for key in _QUANTILES},
        "count": total,
    }


def stats_as_lists(stats: Mapping[str, Stats]) -> dict[str, dict[str, list[Any]]]:
    """Return the statistics of each column as lists, ready for JSON.

    A column in which a number was never known is left out: JSON has no NaN, and an invented number would mislead.
    """
    complete = {key: found for key, found in stats.items() if all(np.isfinite(each).all() for each in found.values())}
    return {key: {name: each.tolist() for name, each in found.items()} for key, found in complete.items()}
