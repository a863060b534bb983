"""Recover interrupted episodes, and repair a dataset: a lost index, damaged statistics."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from ..errors import CommandError, DatasetError
from .about import read_about
from .checking import check_index, check_rows
from .codecs import Stats, merge_stats, stats_as_lists
from .dataset import Episode
from .finish import (
    entries_table,
    entry_row,
    finished_episode,
    new_info,
    recover_all,
    stats_of,
    tasks_table,
    totals,
    write_table,
)
from .index import merged_stats, stray_files, validated_info
from .layout import (
    DatasetLayout,
    lock_dataset,
    read_json,
    require_libraries,
    video_names,
    write_json,
)
from .validation import dataset_errors, wrong_file


def recover(out: str | Path) -> list[str]:
    """Finish every interrupted episode of the dataset in the folder ``out``.

    Such an episode ends with its last complete row. It keeps the mark that was given; without one, ``success`` is
    None.

    Returns:
        What was done, a line per episode.

    Raises:
        DriverMissing: A library is not installed.
        CommandError: There is no such folder (code ``no_folder``), or another program is recording into it
            (``dataset_locked``).
        DatasetError: The dataset's index is missing or damaged; see :func:`repair`.
        HalError: An unfinished episode is damaged (code ``damaged_episode``).
        OSError: The disk refuses.
    """
    layout = _layout(out)
    if not layout.episodes.is_dir():
        return []
    with lock_dataset(layout):
        return recover_all(layout)


def repair(out: str | Path) -> list[str]:
    """Rebuild the index of the dataset in the folder ``out`` if it does not match the episodes, then recover it.

    The index is all of ``meta/``. It is rebuilt from ``episodes/``, ``data/`` and ``videos/``.
    Arguments, return value and errors are those of :func:`recover`; DatasetError names the file of an episode without
    which the index cannot be rebuilt.
    """
    layout = _layout(out)
    if not layout.episodes.is_dir():
        raise DatasetError(
            f"{layout.root} has no folder episodes: there is no recording of this program to repair",
            code="foreign_dataset",
        )
    with lock_dataset(layout):
        done = [finished_episode(layout, partial) for partial in layout.interrupted]
        if wrong := list(check_index(layout)):
            done.append(f"{_rebuild(layout, wrong)}; it was wrong: {wrong[0]}")
            for left in check_index(layout):
                raise left
        return done + recover_all(layout)


def _layout(out: str | Path) -> DatasetLayout:
    require_libraries()
    layout = DatasetLayout(out)
    if not layout.root.is_dir():
        raise CommandError(f"there is no folder {layout.root}", code="no_folder")
    return layout


# The index.


def _rebuild(layout: DatasetLayout, wrong: Sequence[DatasetError]) -> str:
    """Write what is wrong in ``meta/`` again; return what was done.

    Statistics over all episodes follow from those of each episode; everything else is made from the episodes' files.
    """
    stats = layout.stats.relative_to(layout.root).as_posix()
    if {error.file for error in wrong} == {stats}:
        write_json(layout.stats, stats_as_lists(merged_stats(layout)))
        return f"{stats} was made again from the statistics of each episode"
    count = _rebuild_all(layout)
    return f"the index was rebuilt from {count} episode{'' if count == 1 else 's'}"


def _rebuild_all(layout: DatasetLayout) -> int:
    """Write all of ``meta/`` again from the episodes, ``info.json`` last. Return the number of episodes."""
    count = max(layout.numbers(), default=-1) + 1
    info = _info(layout, count)
    episodes = [Episode(layout, number, info) for number in range(count)]
    places = [(episode.number, episode.place) for episode in episodes]
    strays = stray_files(layout, places, video_names(info["features"]))
    for path in strays:
        if not path.is_relative_to(layout.info.parent):
            raise wrong_file(layout, path, "belongs to no episode in episodes/")
    tasks: dict[int, str] = {}
    parts: dict[str, list[Stats]] = {}
    entries: dict[int, list[dict[str, Any]]] = {}
    start = 0
    for episode in episodes:
        check_rows(episode, start)
        task = tasks.setdefault(int(episode.columns["task_index"][0]), episode.task)
        if task != episode.task:
            raise DatasetError(f"the task is {episode.task!r}, and {task!r} in other episodes", episode=episode.number)
        stats = stats_of(episode)
        about = episode.info | {"episode": episode.number}
        row = entry_row(about, episode.place, start, episode.fps, stats)
        entries.setdefault(episode.place.entry, []).append(row)
        for key, found in stats.items():
            parts.setdefault(key, []).append(found)
        start += episode.length
    for file, rows in entries.items():
        write_table(layout.entry(file), entries_table(rows))
    for path in strays:  # files of an earlier index, which LeRobot would read
        path.unlink()
    if sorted(tasks) != list(range(len(tasks))):
        raise DatasetError(f"the episodes have tasks of the numbers {sorted(tasks)}", file="data")
    write_table(layout.tasks, tasks_table([tasks[k] for k in sorted(tasks)]), keep_schema=True)
    write_json(layout.stats, stats_as_lists({key: merge_stats(found) for key, found in parts.items()}))
    write_json(layout.info, info | totals(count, start, len(tasks)))
    return count


def _info(layout: DatasetLayout, count: int) -> dict[str, Any]:
    """Return ``meta/info.json`` with the columns that all episodes have; its counts are not up to date."""
    if count == 0:
        raise DatasetError("there is no episode from which the index could be rebuilt", file="episodes")
    abouts = [read_about(layout, number) for number in range(count)]
    kept = [(about["features"], about["fps"], about["robot_type"]) for about in abouts if "features" in about]
    for number, other in enumerate(kept):
        if other != kept[0]:
            raise DatasetError("has other columns than episode 0", file=f"episodes/{number:06d}.json", episode=number)
    if kept:
        return new_info(*kept[0])
    try:
        with dataset_errors(layout, layout.info):
            return validated_info(read_json(layout.info))
    except DatasetError as error:
        raise DatasetError(
            "was recorded by an older version, which kept the names of the columns in meta/info.json only; copy that "
            "file from a dataset that was recorded with the same rig, and repair again",
            file="episodes/000000.json",
        ) from error
