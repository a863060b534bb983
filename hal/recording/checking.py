"""Checks of a dataset: every file against its index, and whether a new recording has the same format."""

from __future__ import annotations

import contextlib
import json
import math
from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from ..errors import CommandError, DatasetError
from ..types import STREAMS
from .about import read_about
from .codecs import Stats, merge_stacked, merge_stats
from .dataset import Dataset, Episode
from .foreign import is_foreign
from .index import check_next_episode, read_entries, read_index, read_tasks, stats_parts, stray_files
from .layout import (
    BOOKKEEPING,
    MORE_STREAMS,
    STATE,
    VERSION,
    CameraSetup,
    DatasetLayout,
    EpisodePlace,
    video_names,
)
from .validation import dataset_errors, wrong_file

_CLOSE = 1e-4
"""Difference of a time stamp that LeRobot tolerates, s."""
_CLOSE_STATS = 1e-6
"""Difference of a statistic that comes from rounding, as a share of the largest value."""


def check_dataset(dataset: Dataset, episodes: Collection[int] | None = None) -> Iterator[DatasetError]:
    """Yield every error in a dataset, or in some of its episodes. Reads every row and decodes every picture.

    ``episodes`` None checks all, and the index too.
    """
    layout = DatasetLayout(dataset.root)
    if episodes is None:
        yield from check_index(layout)
    tasks: list[str] | None = None
    with contextlib.suppress(DatasetError), dataset_errors(layout, layout.tasks):  # check_index found the same
        tasks = None if is_foreign(layout) else read_tasks(layout.tasks)
    start: int | None = 0
    for episode in dataset.episodes:
        first = start
        try:
            start = None if start is None else start + episode.length
        except DatasetError:
            start = None  # of the episodes to come, it is not known where they begin
        if episodes is None or episode.number in episodes:
            for check in _checks(episode, first, tasks):
                try:
                    check()
                except DatasetError as error:
                    yield error


def _checks(episode: Episode, start: int | None, tasks: list[str] | None) -> Iterator[Callable[[], object]]:
    yield partial(check_rows, episode, start, tasks)
    with contextlib.suppress(DatasetError):  # the first check found the same
        for camera in episode.cameras:
            for stream in episode.files(camera):
                yield partial(_read_all, episode, camera, stream)


def _read_all(episode: Episode, camera: str, stream: str) -> None:
    deque(episode.pictures(camera, stream), maxlen=0)


def check_rows(episode: Episode, start: int | None, tasks: Sequence[str] | None = None) -> None:
    """Raise DatasetError if an episode's rows are not numbered as in the index, or times run backwards.

    ``start`` is the number of its first row in the whole dataset, ``tasks`` are all tasks in the order of their
    numbers; None if unknown.
    """
    columns, rows = episode.columns, np.arange(episode.length)
    file = episode.data_file

    def need(right: Any, what: str) -> None:
        if not np.all(right):
            raise DatasetError(what, file=file, episode=episode.number)

    for key in BOOKKEEPING:
        need(columns[key].ndim == 1, f"{key} is not one number per row")
    need(columns["frame_index"] == rows, "frame_index does not count the rows")
    need(np.diff(columns["index"]) == 1, "index does not count the rows")
    need(start is None or columns["index"][0] == start, f"index does not begin with {start}")
    need(np.diff(columns["task_index"]) == 0, "has rows of several tasks")
    task = int(columns["task_index"][0])
    need(
        tasks is None or [*tasks[task : task + 1]] == [episode.task], f"has rows of another task than {episode.task!r}"
    )
    need(np.abs(columns["timestamp"] - rows / episode.fps) < _CLOSE + 1e-6 * rows, "timestamp is not that of the grid")
    for name, times in episode.stamps.items():
        if name == "grid":
            need(np.isfinite(times), "rig.time.grid has values that are not numbers")
            need(np.diff(times) > 0.0, "rig.time.grid does not increase")
        elif name.startswith(("robot.", "camera.")):
            need(np.diff(times[np.isfinite(times)]) >= 0.0, f"rig.time.{name} goes backwards")


def check_index(layout: DatasetLayout) -> Iterator[DatasetError]:
    """Yield every error in ``meta/``, in itself or against the episodes' own files."""
    if is_foreign(layout):  # the index was read; there is nothing to compare it with
        return
    try:
        info = read_index(layout)
    except DatasetError as error:
        yield error
        return
    if info is None:
        return
    yield from _check_files(layout, info)
    tasks, found = _check_tasks(layout, info)
    yield from found
    start: int | None = 0
    entries: dict[int, dict[int, Any]] = {}
    for number in range(int(info["total_episodes"])):
        try:
            start = None if start is None else _check_entry(layout, number, start, tasks, entries)
        except DatasetError as error:
            start = None
            yield error
    yield from _check_totals(layout, info, start)
    yield from _check_stats(layout, start)


def _check_files(layout: DatasetLayout, info: Mapping[str, Any]) -> Iterator[DatasetError]:
    """Yield episodes without a description, and files that the index does not know."""
    numbers = layout.numbers()
    places: list[tuple[int, EpisodePlace]] = []
    for number in range(int(info["total_episodes"])):
        about: dict[str, Any] = {}
        if number not in numbers:
            yield wrong_file(layout, layout.about(number), "is missing", number)
        with contextlib.suppress(DatasetError):  # reported with its row of the index
            about = read_about(layout, number)
        places.append((number, EpisodePlace.of(number, about)))
    for path in stray_files(layout, places, video_names(info["features"])):
        yield wrong_file(layout, path, "is not in the index")


def _check_tasks(layout: DatasetLayout, info: Mapping[str, Any]) -> tuple[list[str], list[DatasetError]]:
    """Return the tasks, and what is wrong with their file."""
    try:
        with dataset_errors(layout, layout.tasks):
            tasks = read_tasks(layout.tasks)
    except DatasetError as error:
        return [], [error]
    if len(tasks) == info.get("total_tasks"):
        return tasks, []
    what = f"has {len(tasks)} tasks, and meta/info.json lists {info.get('total_tasks')}"
    return tasks, [wrong_file(layout, layout.tasks, what)]


def _check_totals(layout: DatasetLayout, info: Mapping[str, Any], rows: int | None) -> Iterator[DatasetError]:
    """Yield a wrong number of rows; ``rows`` is that of the episodes, None if it is unknown."""
    if rows is not None and rows != info["total_frames"]:
        yield wrong_file(layout, layout.info, f"lists {info['total_frames']} rows, and the episodes have {rows}")
    with contextlib.suppress(DatasetError):  # reported with the rows of its episodes
        data = layout.root / "data"
        found = sum(_count_rows(layout, path) for path in layout.finished() if path.is_relative_to(data))
        if found > info["total_frames"]:  # too few are reported with their episode
            what = f"lists {info['total_frames']} rows, and the files in data/ have {found}"
            yield wrong_file(layout, layout.info, what)


def _check_stats(layout: DatasetLayout, rows: int | None) -> Iterator[DatasetError]:
    """Yield where ``meta/stats.json`` is damaged, or wrong for so many rows; None if their number is unknown."""
    try:
        with dataset_errors(layout, layout.stats):
            stats = json.loads(layout.stats.read_text(encoding="utf-8"), parse_constant=_no_constant)
            if rows is not None and stats[STATE]["count"] != [rows]:
                yield wrong_file(layout, layout.stats, f"counts {stats[STATE]['count']} rows, and there are {rows}")
            elif rows is not None:
                yield from (wrong_file(layout, layout.stats, what) for what in _stats_differences(layout, stats))
    except DatasetError as error:
        yield error


def _stats_differences(layout: DatasetLayout, stats: Mapping[str, Any]) -> Iterator[str]:
    """Yield where ``meta/stats.json`` is not what follows from the statistics of each episode.

    A number that some episodes do not know was averaged over those that were there when it was added: only its extremes
    are compared.
    """
    parts: dict[str, list[Stats]] = {}
    partly: set[str] = set()
    for key, found in stats_parts(layout):
        parts.setdefault(key, []).append(merge_stacked(found))
        if np.isnan(found["mean"]).any():
            partly.add(key)
    expected = {key: found for key, each in parts.items() if np.isfinite((found := merge_stats(each))["mean"]).all()}
    if missing := [key for key in expected if key not in stats]:
        yield f"has no statistics of {', '.join(missing[:3])}"
    for key, found in expected.items():
        if key not in stats:
            continue
        scale = np.maximum(np.abs(found["min"]), np.abs(found["max"]))
        for name, value in found.items():
            if key in partly and name not in ("min", "max"):
                continue
            there = np.array(stats[key][name], np.float64)
            close = _CLOSE_STATS * (1.0 if name == "count" else scale) + 1e-12
            if there.shape != value.shape or not np.all(np.abs(there - value) <= close):
                yield f"{name} of {key} is not that of the episodes"


def _check_entry(
    layout: DatasetLayout, number: int, start: int, tasks: list[str], entries: dict[int, dict[int, Any]]
) -> int:
    """Check an episode's row in ``meta/episodes``. Return the number of the next episode's first row.

    ``entries`` keeps the files that were read, by their numbers.
    """
    about = read_about(layout, number)
    place = EpisodePlace.of(number, about)
    path = layout.entry(place.entry)
    end = start + int(about["length"])
    expected = {
        "episode_index": number,
        "length": about["length"],
        "dataset_from_index": start,
        "dataset_to_index": end,
        "tasks": [about["task"]],
    }
    with dataset_errors(layout, path, number):
        if place.entry not in entries:
            entries[place.entry] = read_entries(path)
        row = entries[place.entry][number]
        for key, value in expected.items():
            if row[key] != value:
                raise wrong_file(layout, path, f"{key} is {row[key]!r}, and must be {value!r}", number)
    if about["task"] not in tasks:
        raise wrong_file(layout, layout.tasks, f"the task {about['task']!r} is missing", number)
    return end


def _count_rows(layout: DatasetLayout, path: Path) -> int:
    """Return the number of rows in a file, also of those that belong to no episode."""
    import pyarrow.parquet as pq

    with dataset_errors(layout, path):
        return int(pq.read_metadata(path).num_rows)


def _no_constant(name: str) -> Any:
    raise ValueError(f"{name} is not JSON")


_SAID_ELSEWHERE = ("video.fps", "video.width", "video.height")
"""Entries of a video that the dataset's own fps, and the video's shape, repeat."""


def known_columns(layout: DatasetLayout) -> dict[str, list[str]] | None:
    """Return the names of the numbers in each column of a dataset; None if there is none yet, or it is damaged."""
    with contextlib.suppress(DatasetError):
        info = read_index(layout)
        if info is not None:
            return {key: list(feature.get("names") or []) for key, feature in info["features"].items()}
    return None


def check_compatible(layout: DatasetLayout, about: Mapping[str, Any], cameras: Sequence[CameraSetup]) -> None:
    """Check whether episodes of this format, with this metadata, can be added to a dataset.

    Raises:
        CommandError: The dataset has another format (code ``other_dataset``; the message lists all differences), or
            the folder holds something else (``foreign_dataset``).
        DatasetError: The dataset is damaged.
    """
    root = layout.root
    if root.exists() and not root.is_dir():
        raise CommandError(f"{root} is a file; a recording needs a folder", code="foreign_dataset")
    foreign = f"the dataset in {root} was not recorded by this program; choose a new folder"
    if layout.info.exists() and not layout.numbers():
        raise CommandError(foreign, code="foreign_dataset")
    info = read_index(layout)
    if info is None:
        if root.is_dir() and not layout.episodes.is_dir() and any(root.iterdir()):
            text = f"{root} holds other files than a recording; choose a new folder"
            raise CommandError(text, code="foreign_dataset")
        return
    last = int(info["total_episodes"]) - 1
    if not layout.interrupted:
        check_next_episode(layout, info)
    if info["codebase_version"] != VERSION:
        raise CommandError(foreign, code="foreign_dataset")
    found = [*format_differences(info, about)]
    if last >= 0:
        kept = {camera.name: {"streams": camera.more, "depth_unit_m": camera.depth_unit} for camera in cameras}
        found += hardware_differences(read_about(layout, last), {**about, "cameras": kept})
    if found:
        raise CommandError(
            f"the dataset in {root} has another format: {'; '.join(found)}; choose a new folder", code="other_dataset"
        )


def format_differences(there: Mapping[str, Any], here: Mapping[str, Any]) -> Iterator[str]:
    """Yield the differences in columns, videos, rate and arms of two datasets, from their ``meta/info.json``."""
    for name, ours in (("fps", here["fps"]), ("robot_type", here.get("robot_type") or "")):
        if there.get(name) != ours:
            yield f"{name} is {there.get(name)} there, and {ours} here"
    old, new = there["features"], here["features"]
    if missing := [key for key in old if key not in new]:
        yield f"only there: {', '.join(missing)}"
    if added := [key for key in new if key not in old]:
        yield f"only here: {', '.join(added)}"
    for key in (key for key in old if key in new):
        yield from _feature(key, old[key], new[key])


def _feature(key: str, there: Mapping[str, Any], here: Mapping[str, Any]) -> Iterator[str]:
    for what in ("dtype", "shape"):
        if there.get(what) != here.get(what):
            yield f"{what} of {key} is {there.get(what)} there, and {here.get(what)} here"
    if there.get("names") != here.get("names"):
        yield _names(key, there.get("names") or [], here.get("names") or [])
    video, ours = there.get("info") or {}, here.get("info") or {}
    for what in dict.fromkeys([*video, *ours]):
        if what not in _SAID_ELSEWHERE and video.get(what) != ours.get(what):
            yield f"{what} of {key} is {video.get(what)} there, and {ours.get(what)} here"


def _names(key: str, old: Sequence[str], new: Sequence[str]) -> str:
    """Describe in which names a column differs, with at most three on each side."""
    parts = []
    for where, names, others in (("there", old, new), ("here", new, old)):
        if own := [name for name in names if name not in others]:
            parts.append(f"only {where} it has {', '.join(own[:3])}{' and more' if len(own) > 3 else ''}")
    return f"the names of {key} differ: {'; '.join(parts) or 'their order is another'}"


def hardware_differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    """Yield differences in what no feature shows; the arguments are two episodes' metadata."""
    yield from _camera_differences(old["cameras"], new["cameras"])
    for arms in zip(*(about["rig"]["resolved"]["robots"] for about in (old, new)), strict=False):
        there, here = ((arm.get("gripper") or {}).get("width_max") for arm in arms)
        if there and here and not math.isclose(there, here, rel_tol=0.01):
            yield f"the gripper of {arms[1]['name']} opens {there:g} m there, and {here:g} m here"


def _camera_differences(old: Mapping[str, Any], new: Mapping[str, Any]) -> Iterator[str]:
    """Yield differences in the depth and the exact streams of cameras in both."""
    exact = [name for name in MORE_STREAMS if STREAMS[name].exact]
    for camera in (name for name in new if name in old):
        streams, ours = (each[camera].get("streams") or () for each in (old, new))
        there, here = (each[camera].get("depth_unit_m") for each in (old, new))
        kept = [("depth", there is not None, here is not None)]
        for stream, before, now in (*kept, *((stream, stream in streams, stream in ours) for stream in exact)):
            if before != now:
                yield f"{stream} of {camera} is kept {'there, and not here' if before else 'here, and not there'}"
        if there is not None and here is not None and not math.isclose(there, here, rel_tol=1e-6):
            yield f"depth of {camera} is in units of {1e3 * there:g} mm there, and {1e3 * here:g} mm here"
