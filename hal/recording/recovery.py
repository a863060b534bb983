"""``recover`` finishes episodes that were interrupted; ``repair`` also rebuilds a lost index from the episodes."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from ..errors import CommandError, DatasetError, HalError
from .checking import check_index, check_rows
from .columns import video_key
from .finalise import finalise
from .index import read_about, read_index, reading, validated_info
from .layout import Layout, locked, read_json, write_json
from .library import require
from .reader import Episode
from .stats import Stats, column_stats, merged, plain
from .tables import entry_table, new_info, tasks_table, write_table
from .video import picture_stats

__all__ = ["recover", "recover_all", "repair"]


def recover(out: str | Path) -> list[str]:
    """Finish every episode of the dataset in the folder ``out`` that was begun and not finished.

    Such an episode ends with its last whole row. Its mark is the one that a person gave, else ``success`` is None.

    Returns:
        What was done, a line per episode.

    Raises:
        DriverMissing: A library is not installed.
        CommandError: There is no such folder, or another program is recording into it.
        DatasetError: The dataset's index is missing or damaged; see :func:`repair`.
        HalError: A folder of an unfinished episode is damaged.
        OSError: The disk.
    """
    layout = _layout(out)
    if not layout.episodes.is_dir():
        return []
    with locked(layout):
        return recover_all(layout)


def repair(out: str | Path) -> list[str]:
    """Rebuild the index of the dataset in the folder ``out`` where it does not fit the episodes, then recover it.

    The index is all of ``meta/``. It is rebuilt from ``episodes/``, ``data/`` and ``videos/``, which are only read.
    Arguments, return value and errors are those of :func:`recover`; DatasetError names the file of an episode without
    which the index cannot be rebuilt.
    """
    layout = _layout(out)
    if not layout.episodes.is_dir():
        raise DatasetError(f"{layout.root} has no folder episodes: no recording of this program to be repaired")
    with locked(layout):
        done = [_finished(layout, partial) for partial in layout.interrupted]
        if (wrong := next(check_index(layout), None)) is not None:
            count = _rebuild(layout)
            done.append(f"the index was rebuilt from {count} episode{'' if count == 1 else 's'}; it was wrong: {wrong}")
            for left in check_index(layout):
                raise left
        return done + recover_all(layout)


def recover_all(layout: Layout) -> list[str]:
    """Do the same as :func:`recover` for a dataset that is locked."""
    layout.sweep()
    done = [_finished(layout, partial) for partial in layout.interrupted]
    if layout.partials():
        read_index(layout)
    return done + [_finished(layout, partial) for partial in layout.partials()]


def _finished(layout: Layout, partial: Path) -> str:
    try:
        number = finalise(layout, partial, recovered=True)
    except OSError:
        raise
    except Exception as error:
        why = str(error) if isinstance(error, DatasetError) else f"{type(error).__name__}: {error}"
        raise HalError(f"{partial} cannot be made an episode ({why}); move it elsewhere, and go on") from error
    if number is None:
        return f"{partial.name} held no whole row and was removed"
    return f"{partial.name} was not finished: recovered as episode {number}"


def _layout(out: str | Path) -> Layout:
    require()
    layout = Layout(out)
    if not layout.root.is_dir():
        raise CommandError(f"there is no folder {layout.root}")
    return layout


# The index.


def _rebuild(layout: Layout) -> int:
    """Write all of ``meta/`` anew from the episodes, ``info.json`` last; return how many episodes there are."""
    recorded = [path for path in layout.finished() if not path.is_relative_to(layout.info.parent)]
    count = max(map(layout.number_of, recorded), default=-1) + 1
    info = _info(layout, count)
    tasks: dict[int, str] = {}
    total: dict[str, Stats] = {}
    start = 0
    for episode in (Episode(layout, number, info) for number in range(count)):
        check_rows(episode, start)
        task = tasks.setdefault(int(episode.columns["task_index"][0]), episode.task)
        if task != episode.task:
            raise DatasetError(f"the task is {episode.task!r}, and {task!r} in other episodes", episode=episode.number)
        stats = _stats(layout, episode)
        videos = [key.removeprefix(video_key("")) for key in stats if key not in episode.columns]
        entry = entry_table(episode.number, episode.length, start, task, videos, episode.fps, stats)
        write_table(layout.entry(episode.number), entry)
        total = {key: merged(total.get(key), found) for key, found in stats.items()}
        start += episode.length
    if sorted(tasks) != list(range(len(tasks))):
        raise DatasetError(f"the episodes have tasks of the numbers {sorted(tasks)}", file="data")
    write_table(layout.tasks, tasks_table([tasks[k] for k in sorted(tasks)]))
    write_json(layout.stats, plain(total))
    counts = {"total_episodes": count, "total_frames": start, "total_tasks": len(tasks)}
    write_json(layout.info, info | counts | {"splits": {"train": f"0:{count}"}})
    return count


def _info(layout: Layout, count: int) -> dict[str, Any]:
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
        with reading(layout.root, layout.info):
            return validated_info(read_json(layout.info))
    except DatasetError as error:
        raise DatasetError(
            "was recorded by an older version, which kept the names of the columns in meta/info.json only; copy that "
            "file from a dataset that was recorded with the same rig, and repair again",
            file="episodes/000000.json",
        ) from error


def _stats(layout: Layout, episode: Episode) -> dict[str, Stats]:
    rows = episode.length
    stats = {key: column_stats(values.reshape(rows, -1)) for key, values in episode.columns.items()}
    episode.check_pictures()
    for path in (path for camera in episode.cameras for path in episode.files(camera).values()):
        if path.suffix == ".mp4":
            with reading(layout.root, path, episode.number):
                stats[path.parent.parent.name] = picture_stats(path, rows, episode.fps).stats()
    return stats
