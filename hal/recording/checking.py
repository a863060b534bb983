"""Compare every file of a dataset with its index: rows, pictures, depth, time stamps."""

from __future__ import annotations

import contextlib
import json
from collections import deque
from collections.abc import Callable, Collection, Iterator
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import DatasetError
from .dataset import Dataset, Episode
from .index import read_about, read_entry, read_index, read_tasks, reading
from .layout import BOOKKEEPING, STATE, Layout

__all__ = ["check_dataset", "check_index", "check_rows"]

# [index.py] The JSON files of a dataset, read as untrusted input: shapes, sizes and names are checked before they
# are used.


_CLOSE = 1e-4
"""s by which LeRobot lets a time stamp differ."""


def check_dataset(dataset: Dataset, episodes: Collection[int] | None = None) -> Iterator[DatasetError]:
    """Yield everything that is wrong with a dataset, or with these episodes of it.

    Every row is read and every picture is decoded. The index is checked where ``episodes`` is None.
    """
    if episodes is None:
        yield from check_index(Layout(dataset.root))
    start: int | None = 0
    for episode in dataset.episodes:
        first = start
        try:
            start = None if start is None else start + episode.length
        except DatasetError:
            start = None  # of the episodes to come, it is not known where they begin
        if episodes is None or episode.number in episodes:
            for check in _checks(episode, first):
                try:
                    check()
                except DatasetError as error:
                    yield error


def _checks(episode: Episode, start: int | None) -> Iterator[Callable[[], object]]:
    yield partial(check_rows, episode, start)
    with contextlib.suppress(DatasetError):  # the first check found the same
        for camera in episode.cameras:
            for stream in episode.files(camera):
                yield partial(_read_all, episode, camera, stream)


def _read_all(episode: Episode, camera: str, stream: str) -> None:
    deque(episode.pictures(camera, stream), maxlen=0)


def check_rows(episode: Episode, start: int | None) -> None:
    """Raise DatasetError where an episode's rows are not numbered as the index counts them, or times go backwards.

    ``start`` is the number of its first row in the whole dataset; None where it is not known.
    """
    columns, rows = episode.columns, np.arange(episode.length)
    file = episode.data_file

    def need(right: Any, what: str) -> None:
        if not np.all(right):
            raise DatasetError(what, file=file, episode=episode.number)

    for key in BOOKKEEPING:
        need(columns[key].ndim == 1, f"{key} is not one number per row")
    need(columns["frame_index"] == rows, "frame_index does not count the rows")
    need(columns["episode_index"] == episode.number, "episode_index is another episode's")
    need(np.diff(columns["index"]) == 1, "index does not count the rows")
    need(start is None or columns["index"][0] == start, f"index does not begin with {start}")
    need(np.diff(columns["task_index"]) == 0, "has rows of several tasks")
    need(np.abs(columns["timestamp"] - rows / episode.fps) < _CLOSE + 1e-6 * rows, "timestamp is not that of the grid")
    for name, times in episode.stamps.items():
        if name == "grid":
            need(np.isfinite(times), "observation.time.grid has values that are not numbers")
            need(np.diff(times) > 0.0, "observation.time.grid does not increase")
        elif name.startswith(("robot.", "camera.")):
            need(np.diff(times[np.isfinite(times)]) >= 0.0, f"observation.time.{name} goes backwards")


def check_index(layout: Layout) -> Iterator[DatasetError]:
    """Yield everything in ``meta/`` that is wrong in itself, or does not fit the episodes' own files."""
    try:
        info = read_index(layout)
    except DatasetError as error:
        yield error
        return
    if info is None:
        return

    def wrong(path: Path, what: str, number: int | None = None) -> DatasetError:
        return DatasetError(what, file=str(path.relative_to(layout.root)), episode=number)

    total, numbers = int(info["total_episodes"]), layout.numbers()
    for number in range(total):
        if number not in numbers:
            yield wrong(layout.about(number), "is missing", number)
    for path in layout.finished():
        if (number := layout.number_of(path)) >= total:
            yield wrong(path, "is not in the index", number)
    tasks: list[str] = []
    try:
        with reading(layout.root, layout.tasks):
            tasks = read_tasks(layout.tasks)
        if len(tasks) != info.get("total_tasks"):
            yield wrong(layout.tasks, f"has {len(tasks)} tasks, and meta/info.json lists {info.get('total_tasks')}")
    except DatasetError as error:
        yield error
    start: int | None = 0
    for number in range(total):
        try:
            start = None if start is None else _check_entry(layout, number, start, tasks)
        except DatasetError as error:
            start = None
            yield error
    if start is not None and start != info["total_frames"]:
        yield wrong(layout.info, f"lists {info['total_frames']} rows, and the episodes have {start}")
    try:
        with reading(layout.root, layout.stats):
            stats = json.loads(layout.stats.read_text(encoding="utf-8"), parse_constant=_no_constant)
            if start is not None and stats[STATE]["count"] != [start]:
                yield wrong(layout.stats, f"counts {stats[STATE]['count']} rows, and there are {start}")
    except DatasetError as error:
        yield error


def _check_entry(layout: Layout, number: int, start: int, tasks: list[str]) -> int:
    """Check an episode's row in ``meta/episodes``; return where the next episode begins."""
    about, path = read_about(layout, number), layout.entry(number)
    end = start + int(about["length"])
    expected = {
        "episode_index": number,
        "length": about["length"],
        "dataset_from_index": start,
        "dataset_to_index": end,
        "tasks": [about["task"]],
    }
    with reading(layout.root, path, number):
        row = read_entry(path)
        for key, value in expected.items():
            if row[key] != value:
                raise DatasetError(
                    f"{key} is {row[key]!r}, and must be {value!r}",
                    file=str(path.relative_to(layout.root)),
                    episode=number,
                )
    if about["task"] not in tasks:
        raise DatasetError(
            f"the task {about['task']!r} is missing", file=str(layout.tasks.relative_to(layout.root)), episode=number
        )
    return end


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")
