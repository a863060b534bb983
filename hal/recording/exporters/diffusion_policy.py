"""A zarr folder as diffusion policy's replay buffer reads it: all episodes one after the other, and where each ends."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..columns import ACTION
from .content import EpisodeContent
from .job import Job
from .observations import observations, picture_name, with_channel
from .zarr_folder import GROUP, ZarrArray, make_group

__all__ = ["is_one", "write"]


def is_one(path: Path) -> bool:
    """Is this folder a replay buffer?"""
    return (path / GROUP).is_file() and (path / "meta" / "episode_ends").is_dir()


def write(job: Job, path: Path) -> None:
    """Make the folder."""
    about = job.about() | {"episodes": [content.about() for content in job.contents]}
    make_group(path, about)
    data, meta = make_group(path / "data"), make_group(path / "meta")
    lengths = [content.rows for content in job.contents]
    arrays: dict[str, ZarrArray] = {}
    with ExitStack() as stack:
        for content in job.contents:
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
    job: Job, content: EpisodeContent
) -> Iterator[tuple[str, np.dtype[Any], tuple[int, ...], Iterator[NDArray[Any]]]]:
    numbers = observations(content) | {"action": content.episode.columns[ACTION], "timestamp": content.grid}
    job.unknown(content, numbers)
    for name, values in numbers.items():
        yield name, values.dtype, values.shape[1:], iter(values)
    job.numbers_done(content)
    for stream in content.pictures:
        shape = stream.shape if len(stream.shape) == 3 else (*stream.shape, 1)
        yield picture_name(stream), stream.dtype, shape, map(with_channel, job.pictures(content, stream))
