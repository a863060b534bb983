"""Write a zarr folder for diffusion policy's replay buffer: all episodes one after the other, and where each ends."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .content import EpisodeContent, add_channel, picture_name
from .output import ExportJob

# The zarr format, version 2, which every zarr library reads: an array is a JSON file (``.zarray``) and a file per
# chunk; a group is a folder with another JSON file. Chunks are compressed with zstd after their bytes are shuffled,
# which halves them.

GROUP, _ARRAY, _ATTRIBUTES = ".zgroup", ".zarray", ".zattrs"
_VERSION = 2
_LEVEL = 3
_CHUNK = 2_000_000
"""Size of a chunk before compression, bytes."""


def make_group(folder: Path, attributes: dict[str, Any] | None = None) -> Path:
    """Create a group with its attributes."""
    folder.mkdir()
    _write_json(folder / GROUP, {"zarr_format": _VERSION})
    if attributes:
        _write_json(folder / _ATTRIBUTES, attributes)
    return folder


class ZarrArray:
    """An array in a new folder that grows by ``rows`` rows of a shape, and is complete when it is closed."""

    def __init__(self, folder: Path, shape: tuple[int, ...], dtype: np.dtype[Any], rows: int) -> None:
        import zstandard

        folder.mkdir()
        self._folder = folder
        self._dtype = np.dtype(dtype).newbyteorder("<")
        size = int(np.prod(shape, dtype=np.int64)) * self._dtype.itemsize
        self._length = max(1, min(rows, _CHUNK // max(1, size)))
        self._chunk = np.zeros((self._length, *shape), self._dtype)
        self._rows = 0
        self._compressor = zstandard.ZstdCompressor(level=_LEVEL)

    def add(self, values: NDArray[Any]) -> None:
        """Add one row."""
        place = self._rows % self._length
        self._chunk[place] = values
        self._rows += 1
        if place == self._length - 1:
            self._write_chunk()

    def close(self) -> None:
        """Write the remaining rows and the header."""
        if rest := self._rows % self._length:
            self._chunk[rest:] = 0
            self._write_chunk()
        shuffle = [{"id": "shuffle", "elementsize": self._dtype.itemsize}] if self._dtype.itemsize > 1 else None
        head = {
            "zarr_format": _VERSION,
            "shape": [self._rows, *self._chunk.shape[1:]],
            "chunks": list(self._chunk.shape),
            "dtype": self._dtype.str,
            "compressor": {"id": "zstd", "level": _LEVEL},
            "filters": shuffle,
            "fill_value": 0,
            "order": "C",
        }
        _write_json(self._folder / _ARRAY, head)

    def _write_chunk(self) -> None:
        number = (self._rows - 1) // self._length
        name = ".".join([str(number), *("0" for _ in self._chunk.shape[1:])])
        plain = self._chunk.view(np.uint8).reshape(-1, self._dtype.itemsize)
        (self._folder / name).write_bytes(self._compressor.compress(np.ascontiguousarray(plain.T).data))


def _write_json(path: Path, data: Any) -> None:
    path.write_text(json.dumps(data, indent=1) + "\n", encoding="utf-8")


def is_export(path: Path) -> bool:
    """Return whether this folder is a replay buffer."""
    return (path / GROUP).is_file() and (path / "meta" / "episode_ends").is_dir()


def write(job: ExportJob, path: Path) -> None:
    """Write the folder."""
    about = job.about() | {"episodes": [content.about() for content in job.contents]}
    make_group(path, about)
    data, meta = make_group(path / "data"), make_group(path / "meta")
    lengths = [content.rows for content in job.contents]
    arrays: dict[str, ZarrArray] = {}
    with ExitStack() as stack:
        for content in job.episodes():
            for name, dtype, shape, parts in _columns(job, content):
                if name not in arrays:
                    arrays[name] = ZarrArray(data / name, shape, dtype, sum(lengths))
                    stack.callback(arrays[name].close)
                for part in parts:
                    arrays[name].add(part)
    ends = ZarrArray(meta / "episode_ends", (), np.dtype(np.int64), len(lengths))
    for end in np.cumsum(lengths):
        ends.add(end)
    ends.close()


def _columns(
    job: ExportJob, content: EpisodeContent
) -> Iterator[tuple[str, np.dtype[Any], tuple[int, ...], Iterator[NDArray[Any]]]]:
    numbers = job.observations(content) | {"action": job.action.values(content), "timestamp": content.grid}
    for k, arm in enumerate(content.arms):
        if (force := content.later_force(arm)) is not None:
            numbers[f"action_robot{k}_gripper_force"] = force[:, None]
    job.unknown(content, numbers)
    for name, values in numbers.items():
        yield name, values.dtype, values.shape[1:], iter(values)
    for stream in content.pictures:
        shape = stream.shape if len(stream.shape) == 3 else (*stream.shape, 1)
        yield picture_name(stream), stream.dtype, shape, map(add_channel, stream)
