"""Merge datasets that were recorded with the same rig into one, and curate a dataset: delete, extract, mark, re-task.

Rows are renumbered, statistics are combined from those of the episodes, and videos and depth files become hard links to
those of the parts: nothing is encoded again, and nothing is copied on the same file system.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from ..errors import CommandError, DatasetError
from .checking import format_differences
from .codecs import Stats, column_stats, merge_stats, stats_as_lists
from .dataset import Dataset, Episode
from .finish import entry_table, new_info, tasks_table, write_table
from .index import dataset_errors, read_about, read_entry
from .layout import CHUNK, DatasetLayout, lock_dataset, require_libraries, video_key, write_json

__all__ = ["EpisodeLabel", "delete_episodes", "extract", "finish_replacement", "mark_episodes", "merge", "set_task"]

_THREADS = 4


class EpisodeLabel(NamedTuple):
    """What can be changed about a recorded episode."""

    task: str
    success: bool | None
    """Whether it is marked a success; None for no mark."""


class _Source(NamedTuple):
    part: DatasetLayout
    episode: Episode
    label: EpisodeLabel


def merge(
    parts: Sequence[str | Path],
    out: str | Path,
    *,
    key: Callable[[Episode], Any] | None = None,
    label: Callable[[Episode], EpisodeLabel | None] | None = None,
    on_episode: Callable[[int, int], object] = lambda done, total: None,
) -> int:
    """Merge datasets into one. The parts are only read; the result appears when it is complete.

    Args:
        parts: Folders of the datasets.
        out: Folder of the result: a new one, or one of the parts, which is replaced.
        key: Sorts the episodes; of several with the same key the first is kept. None for the order of the parts.
        label: Returns the task and the mark of an episode in the result; None leaves it out. By default its own.
        on_episode: Called with the number of merged episodes and of all, after each.

    Returns:
        The number of episodes in the result.

    Raises:
        CommandError: A part has unfinished episodes (code ``unfinished_episodes``), no episode (``no_episodes``) or
            another format than the first (``other_dataset``), or ``out`` exists (``output_exists``).
        DatasetError: A part is damaged.
        OSError: The disk refuses.
    """
    require_libraries()
    finish_replacement(out)
    target = DatasetLayout(out)
    building, replaced = _beside(target, "merging"), _beside(target, "replaced")
    layouts = [DatasetLayout(part) for part in parts]
    replaces = target.root in [layout.root for layout in layouts]
    if not replaces and target.root.exists() and (not target.root.is_dir() or any(target.root.iterdir())):
        raise CommandError(f"{target.root} exists; choose a new folder", code="output_exists")
    with contextlib.ExitStack() as locks:
        for layout in {layout.root: layout for layout in layouts}.values():
            if not layout.root.is_dir():
                raise CommandError(f"there is no folder {layout.root}", code="no_folder")
            locks.enter_context(lock_dataset(layout))
            if layout.partials():
                raise CommandError(
                    f"{layout.root} has an unfinished episode; finish it first, with recover()",
                    code="unfinished_episodes",
                )
        sources = _sources(layouts, key, label or _label)
        shutil.rmtree(building, ignore_errors=True)
        _build(DatasetLayout(building), sources, on_episode)
        os.sync()  # the parts may be removed next
        if replaces:
            shutil.rmtree(replaced, ignore_errors=True)
            target.root.rename(replaced)
        elif target.root.exists():
            target.root.rmdir()
        building.rename(target.root)
        shutil.rmtree(replaced, ignore_errors=True)
    return len(sources)


def extract(dataset: str | Path, episodes: Collection[int], out: str | Path) -> int:
    """Write a new dataset of some episodes of another one, which is only read.

    Args:
        dataset: Folder of the dataset.
        episodes: Numbers of the episodes.
        out: Folder of the result: a new one, or that of the dataset, which then keeps only these episodes.

    Returns:
        The number of episodes in the result.

    Raises:
        CommandError: There is no such episode (code ``no_episodes``); otherwise as :func:`merge`.
        DatasetError: The dataset is damaged.
    """
    chosen = _existing(dataset, episodes)
    return merge([dataset], out, label=lambda episode: _label(episode) if episode.number in chosen else None)


def delete_episodes(dataset: str | Path, episodes: Collection[int]) -> int:
    """Delete episodes; those after them get lower numbers. Return the number of episodes that are left.

    Raises:
        CommandError: There is no such episode, or none would be left (code ``no_episodes``); otherwise as
            :func:`merge`.
        DatasetError: The dataset is damaged.
    """
    doomed = _existing(dataset, episodes)
    return merge([dataset], dataset, label=lambda episode: None if episode.number in doomed else _label(episode))


def set_task(dataset: str | Path, task: str, episodes: Collection[int] | None = None) -> None:
    """Change the task of episodes; None for all. Raises as :func:`extract`."""
    chosen = range(len(Dataset(dataset))) if episodes is None else _existing(dataset, episodes)
    merge(
        [dataset],
        dataset,
        label=lambda episode: EpisodeLabel(task, episode.success) if episode.number in chosen else _label(episode),
    )


def mark_episodes(dataset: str | Path, marks: Mapping[int, bool | None]) -> None:
    """Mark episodes as a success (True), a failure (False) or neither (None). Raises as :func:`extract`."""
    _existing(dataset, marks)
    layout = DatasetLayout(dataset)
    with lock_dataset(layout):
        for number, success in marks.items():
            write_json(layout.about(number), read_about(layout, number) | {"success": success})


def _label(episode: Episode) -> EpisodeLabel:
    return EpisodeLabel(episode.task, episode.success)


def _existing(dataset: str | Path, episodes: Collection[int]) -> frozenset[int]:
    """Return the numbers of episodes, all of which exist."""
    count = len(Dataset(dataset))
    if unknown := sorted(set(episodes) - set(range(count))):
        raise CommandError(
            f"there is no episode {unknown[0]} in {dataset}; there are {count}, from 0 on", code="no_episodes"
        )
    if not episodes:
        raise CommandError("no episode was selected", code="no_episodes")
    return frozenset(episodes)


def _beside(layout: DatasetLayout, what: str) -> Path:
    """Return a hidden folder on the same file system."""
    return layout.root.with_name(f".{layout.root.name}.{what}")


def finish_replacement(out: str | Path) -> None:
    """Put a dataset back that :func:`merge` was about to replace when it was interrupted; do nothing otherwise."""
    target = DatasetLayout(out)
    replaced = _beside(target, "replaced")
    if replaced.is_dir() and not target.root.exists():
        replaced.rename(target.root)


def _sources(
    layouts: Sequence[DatasetLayout],
    key: Callable[[Episode], Any] | None,
    label: Callable[[Episode], EpisodeLabel | None],
) -> list[_Source]:
    """Return the episodes of all parts, in the order of the result. Raises CommandError if their formats differ."""
    datasets = [Dataset(layout.root) for layout in layouts]
    for dataset in datasets[1:]:
        found = format_differences(datasets[0].info, dataset.info) + _camera_differences(datasets[0], dataset)
        if found:
            raise CommandError(
                f"{datasets[0].root} (there) and {dataset.root} (here) differ: {'; '.join(found)}",
                code="other_dataset",
            )
    sources = [
        _Source(layout, episode, new)
        for layout, dataset in zip(layouts, datasets, strict=True)
        for episode in dataset.episodes
        if (new := label(episode)) is not None
    ]
    if not sources:
        raise CommandError("no episode would be left: remove the folder instead", code="no_episodes")
    if key is not None:
        first: dict[Any, _Source] = {}
        for source in sources:
            first.setdefault(key(source.episode), source)
        sources = [first[value] for value in sorted(first)]
    if len(sources) > CHUNK * CHUNK:
        raise CommandError(f"{len(sources)} episodes are too many for one dataset", code="too_many")
    return sources


def _camera_differences(one: Dataset, other: Dataset) -> list[str]:
    """Return the differences in the stored depth and streams, which ``meta/info.json`` does not show."""
    there, here = (
        {name: (camera.get("depth_unit_m"), camera.get("streams")) for name, camera in info.items()}
        for info in (one.episodes[0].info["cameras"], other.episodes[0].info["cameras"])
    )
    return [] if there == here else [f"depth and streams are {there} there, and {here} here"]


def _build(layout: DatasetLayout, sources: Sequence[_Source], on_episode: Callable[[int, int], object]) -> None:
    """Write a whole dataset, ``info.json`` last."""
    info = new_info(*(sources[0].episode._meta[name] for name in ("features", "fps", "robot_type")))
    tasks = list(dict.fromkeys(source.label.task for source in sources))
    starts = [0, *accumulate(source.episode.length for source in sources)]

    def add(number: int) -> dict[str, Stats]:
        return _add(layout, number, starts[number], tasks.index(sources[number].label.task), sources[number])

    total: dict[str, Stats] = {}
    layout.episodes.mkdir(parents=True)
    with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:  # PyArrow releases the interpreter lock
        try:
            for number, stats in enumerate(pool.map(add, range(len(sources)))):
                total = {key: merge_stats(total.get(key), found) for key, found in stats.items()}
                on_episode(number + 1, len(sources))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
    write_table(layout.tasks, tasks_table(tasks))
    write_json(layout.stats, stats_as_lists(total))
    counts = {"total_episodes": len(sources), "total_frames": starts[-1], "total_tasks": len(tasks)}
    write_json(layout.info, info | counts | {"splits": {"train": f"0:{len(sources)}"}})


def _add(layout: DatasetLayout, number: int, start: int, task: int, source: _Source) -> dict[str, Stats]:
    """Write the files of one episode, with its new numbers; return its statistics."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    part, episode, label = source
    path, rows = part.data(episode.number), episode.length
    renumbered = {
        "episode_index": np.full(rows, number),
        "index": np.arange(start, start + rows),
        "task_index": np.full(rows, task),
    }
    with (
        dataset_errors(part.root, path, episode.number),
        pq.ParquetFile(path, page_checksum_verification=True) as file,
    ):
        table = file.read(use_threads=False)
        if table.num_rows != rows:
            raise ValueError(f"it has {table.num_rows} rows, and the episode has {rows}")
        for name, values in renumbered.items():
            table = table.set_column(table.schema.get_field_index(name), name, pa.array(values, pa.int64()))
    _write(layout.data(number), lambda file: pq.write_table(table, file, write_page_checksum=True))

    stats = _read_stats(part, episode) | {name: column_stats(values[:, None]) for name, values in renumbered.items()}
    videos = []
    for pictures in (file for camera in episode.cameras for file in episode.files(camera).values()):
        name = pictures.parent.parent.name
        if pictures.suffix == ".mp4":
            videos.append(name.removeprefix(video_key("")))
            place = layout.video(videos[-1], number)
        else:
            place = layout.depth(name, number)
        with dataset_errors(part.root, pictures, episode.number):
            _link(pictures, place)
    entry = entry_table(number, rows, start, label.task, videos, episode.fps, stats)
    _write(layout.entry(number), lambda file: pq.write_table(entry, file, use_dictionary=False, write_statistics=False))
    about = json.dumps(episode.info | {"episode": number} | label._asdict(), indent=1)
    layout.about(number).write_text(about + "\n", encoding="utf-8")
    return stats


def _read_stats(part: DatasetLayout, episode: Episode) -> dict[str, Stats]:
    """Return the statistics of an episode's columns and videos, from its row of the index."""
    path = part.entry(episode.number)
    stats: dict[str, Stats] = {}
    with dataset_errors(part.root, path, episode.number):
        for name, value in read_entry(path).items():
            if name.startswith("stats/"):
                _, key, what = name.split("/")
                stats.setdefault(key, {})[what] = np.array(value)
        if missing := [key for key in episode._meta["features"] if key not in stats]:
            raise DatasetError(f"has no statistics of {', '.join(missing)}", file=str(path.relative_to(part.root)))
    return stats


def _write(path: Path, write: Callable[[Path], object]) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    write(path)


def _link(source: Path, target: Path) -> None:
    """Make a hard link, or a copy on a file system that has none or is another one."""
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except FileNotFoundError:
        raise
    except OSError:
        shutil.copyfile(source, target)
