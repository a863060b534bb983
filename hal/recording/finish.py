"""Make an episode of a live folder, recover interrupted ones, and rebuild a lost index.

Finishing can be interrupted at any moment and repeated. All files are made inside the partial folder, in ``final/``:
the episode's own, and ``meta/`` as it will be. Then a list of destinations is written: from here on the episode counts
as saved. Then each file is renamed to its place, ``info.json`` last, and the folder is removed. If the list exists,
only the renaming is completed; if not, everything is made again.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError, DatasetError, HalError
from .checking import check_index, check_rows
from .codecs import Stats, column_stats, merge_stats, picture_stats, remux, stats_as_lists
from .dataset import Episode
from .index import _TASK, check_next_episode, dataset_errors, read_about, read_index, read_tasks, validated_info
from .layout import (
    ACTION,
    CHUNK,
    GRID,
    MOVES,
    SETPOINT,
    STATE,
    TIMES,
    VERSION,
    DatasetLayout,
    lock_dataset,
    read_json,
    require_libraries,
    sync_to_disk,
    video_key,
    write_json,
)
from .live import LiveContent, read_live
from .metadata import ClockPace

__all__ = [
    "CLOSING",
    "entry_table",
    "finalise",
    "write_mark",
    "new_info",
    "recover",
    "recover_all",
    "repair",
    "rows_table",
    "tasks_table",
    "write_table",
]


def new_info(features: Mapping[str, Any], fps: int, robot_type: str) -> dict[str, Any]:
    """Return ``meta/info.json`` of a dataset without episodes."""
    videos = any(feature["dtype"] == "video" for feature in features.values())
    place = "chunk-{chunk_index:03d}/file-{file_index:03d}"
    return {
        "codebase_version": VERSION,
        "robot_type": robot_type,
        "total_episodes": 0,
        "total_frames": 0,
        "total_tasks": 0,
        "chunks_size": CHUNK,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": "0:0"},
        "data_path": f"data/{place}.parquet",
        "video_path": f"videos/{{video_key}}/{place}.mp4" if videos else None,
        "features": dict(features),
    }


def rows_table(columns: Mapping[str, NDArray[Any]], features: Mapping[str, Any]) -> Any:
    """Return the Arrow table of an episode's rows, from columns (rows, n), in the order and types of ``features``."""
    import pyarrow as pa

    arrays = {}
    for key, feature in features.items():
        if feature["dtype"] == "video":
            continue
        flat = pa.array(np.ascontiguousarray(columns[key].astype(feature["dtype"])).reshape(-1))
        size = int(feature["shape"][0])
        arrays[key] = flat if size == 1 else pa.FixedSizeListArray.from_arrays(flat, size)
    return pa.table(arrays)


def entry_table(
    number: int, length: int, start: int, task: str, cameras: list[str], fps: int, stats: Mapping[str, Stats]
) -> Any:
    """Return the one row of ``meta/episodes`` for an episode.

    Args:
        number: Number of the episode.
        length: Its rows.
        start: Number of its first row in the whole dataset.
        task: Description of the task.
        cameras: Names of the videos.
        fps: Rows per second.
        stats: Statistics of each column and video.
    """
    import pyarrow as pa

    chunk, file = pa.array([number // CHUNK]), pa.array([number % CHUNK])
    row: dict[str, Any] = {
        "episode_index": pa.array([number]),
        "tasks": pa.array([[task]]),
        "length": pa.array([length]),
        "data/chunk_index": chunk,
        "data/file_index": file,
        "dataset_from_index": pa.array([start]),
        "dataset_to_index": pa.array([start + length]),
    }
    for camera in cameras:
        place = f"videos/{video_key(camera)}"
        row |= {f"{place}/chunk_index": chunk, f"{place}/file_index": file}
        row |= {f"{place}/from_timestamp": pa.array([0.0]), f"{place}/to_timestamp": pa.array([length / fps])}
    row |= {"meta/episodes/chunk_index": chunk, "meta/episodes/file_index": file}
    for key, found in stats.items():
        row.update({f"stats/{key}/{name}": pa.array([value.tolist()]) for name, value in found.items()})
    return pa.table(row)


def write_table(path: Path, table: Any) -> None:
    """Write a Parquet file, whole or not at all."""
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".new")
    beside.unlink(missing_ok=True)
    pq.write_table(table, beside, use_dictionary=False, write_statistics=False)
    sync_to_disk(beside)
    beside.replace(path)
    sync_to_disk(path.parent)


def tasks_table(tasks: list[str]) -> Any:
    """Return ``meta/tasks.parquet``: a pandas frame whose index is the task's text, as LeRobot reads it."""
    import pyarrow as pa

    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), _TASK: pa.array(tasks, pa.string())})
    columns: list[dict[str, Any]] = [
        {"name": "task_index", "field_name": "task_index", "pandas_type": "int64", "numpy_type": "int64"},
        {"name": None, "field_name": _TASK, "pandas_type": "unicode", "numpy_type": "object"},
    ]
    pandas = {
        "index_columns": [_TASK],
        "column_indexes": [{"name": None, "field_name": None, "pandas_type": "unicode", "numpy_type": "object"}],
        "columns": [column | {"metadata": None} for column in columns],
        "pandas_version": "2.0.0",
    }
    return table.replace_schema_metadata({b"pandas": json.dumps(pandas).encode()})


# From a live folder to an episode.

CLOSING = "closing.json"
"""File in the live folder with the metadata of the episode's end."""
_FINAL = "final"
_UNCLOSED: dict[str, Any] = {
    "success": None,
    "dropped": None,
    "late": None,
    "gaps": [],
    "repeated": {},
    "trouble": "it was not closed: the program or its writer ended",
}


def write_mark(partial: Path, success: bool) -> None:
    """Write the operator's mark into a partial folder, where it survives the writer's process."""
    with contextlib.suppress(OSError):  # a full disk or a moved folder: the writer tries again
        write_json(partial / CLOSING, {"success": success})


def finalise(layout: DatasetLayout, partial: Path, *, recovered: bool = False) -> int | None:
    """Make an episode of a partial folder.

    Args:
        layout: The dataset, which must be locked.
        partial: The folder; its content is not trusted.
        recovered: Whether the program that recorded it was interrupted.

    Returns:
        The episode's number; None if the folder held no row, and was removed.

    Raises:
        DatasetError: The dataset's index is missing or damaged, or the folder would overwrite a finished episode (code
            ``would_overwrite``).
        ValueError: The folder is damaged, contains a link or points outside of the dataset.
        OSError: The disk refuses; the folder stays as it is.
    """
    _check_no_links(partial)
    if not (partial / MOVES).exists():
        rest = read_live(partial)
        if rest is None or rest.length == 0:
            layout.remove(partial)
            return None
        moves = _prepare(layout, rest, recovered)
        write_json(partial / MOVES, moves)
    return _move(layout, partial)


def _check_no_links(partial: Path) -> None:
    """Raise ValueError for a link, through which writing or truncating here would change a file elsewhere."""
    for path in (partial, *partial.rglob("*")):
        if path.is_symlink():
            raise ValueError(f"{path.name} is a link")


def _move(layout: DatasetLayout, partial: Path) -> int:
    shared = {layout.info, layout.stats, layout.tasks}
    moves = []
    for source, target in read_json(partial / MOVES):
        here, there = partial / source, layout.target(target)
        if Path(source).is_absolute() or ".." in Path(source).parts:
            raise ValueError(f"{source!r} is not a file of this folder")
        if here.exists():
            if there.exists() and there not in shared:
                raise DatasetError(
                    "belongs to a finished episode; it is not overwritten", file=target, code="would_overwrite"
                )
            moves.append((here, there))
    for here, there in moves:
        there.parent.mkdir(parents=True, exist_ok=True)
        here.replace(there)
        sync_to_disk(there.parent)
    layout.remove(partial)
    return int(read_json(layout.info)["total_episodes"]) - 1


def _prepare(layout: DatasetLayout, rest: LiveContent, recovered: bool) -> list[tuple[str, str]]:
    """Make all files. Return (source, destination) of each, in the order in which they are to be moved."""
    import pyarrow.parquet as pq

    about = rest.about
    there = read_index(layout)
    check_next_episode(layout, there)
    info = there or new_info(about["features"], about["fps"], about["robot_type"])
    number, start, fps = int(info["total_episodes"]), int(info["total_frames"]), int(info["fps"])
    final = rest.folder / _FINAL
    shutil.rmtree(final, ignore_errors=True)
    final.mkdir()
    tasks = read_tasks(layout.tasks)
    if about["task"] not in tasks:
        tasks.append(about["task"])
    made: list[tuple[Path, Path]] = []

    t_start = float(rest.rows[0, _place(about["columns"], GRID)])
    columns = _columns(rest, t_start)
    rows = len(rest.rows)
    columns |= {
        "timestamp": np.arange(rows)[:, None] / fps,
        "frame_index": np.arange(rows)[:, None],
        "episode_index": np.full((rows, 1), number),
        "index": np.arange(start, start + rows)[:, None],
        "task_index": np.full((rows, 1), tasks.index(about["task"])),
    }
    pq.write_table(rows_table(columns, info["features"]), final / "data.parquet", write_page_checksum=True)
    made.append((final / "data.parquet", layout.data(number)))
    stats: dict[str, Stats] = {key: column_stats(values) for key, values in columns.items()}
    for camera in rest.cameras:
        for name in camera.videos:
            video = final / f"{name}.mp4"
            remux(rest.folder / video.name, video, rows)
            stats[video_key(name)] = picture_stats(video, rows, fps).stats()
            made.append((video, layout.video(name, number)))
        for name in camera.depths:
            made.append((rest.folder / f"{name}.depth", layout.depth(name, number)))
    write_json(final / "about.json", _about(rest, number, t_start, recovered))
    made.append((final / "about.json", layout.about(number)))

    videos = [name for camera in rest.cameras for name in camera.videos]
    entry = entry_table(number, rows, start, about["task"], videos, fps, stats)
    pq.write_table(entry, final / "entry.parquet", use_dictionary=False, write_statistics=False)
    made.append((final / "entry.parquet", layout.entry(number)))
    pq.write_table(tasks_table(tasks), final / "tasks.parquet")
    made.append((final / "tasks.parquet", layout.tasks))
    before = read_json(layout.stats) if layout.stats.exists() else {}
    write_json(
        final / "stats.json", stats_as_lists({key: merge_stats(before.get(key), found) for key, found in stats.items()})
    )
    made.append((final / "stats.json", layout.stats))
    total = {"total_episodes": number + 1, "total_frames": start + rows, "total_tasks": len(tasks)}
    write_json(final / "info.json", info | total | {"splits": {"train": f"0:{number + 1}"}})
    made.append((final / "info.json", layout.info))
    for source, _ in made:
        sync_to_disk(source)
    sync_to_disk(final)
    return [(str(source.relative_to(rest.folder)), str(target.relative_to(layout.root))) for source, target in made]


def _columns(rest: LiveContent, t_start: float) -> dict[str, NDArray[Any]]:
    """Return the columns (rows, n) of a live folder, with times since the first row.

    The action is the set-point one row later.
    """
    columns: dict[str, NDArray[Any]] = {}
    place = 0
    for key, _, names in rest.about["columns"]:
        columns[key] = rest.rows[:, place : place + len(names)]
        place += len(names)
    for key, values in columns.items():
        if key.startswith(TIMES):
            values[:, 0] -= t_start
    setpoint = columns[SETPOINT]
    columns[ACTION] = np.concatenate([setpoint[1:], setpoint[-1:]])
    assert columns[ACTION].shape[1] == columns[STATE].shape[1]
    return columns


def _place(columns: list[list[Any]], key: str) -> int:
    """Return the index of a column's first number in a row."""
    keys = [column[0] for column in columns]
    return sum(len(names) for _, _, names in columns[: keys.index(key)])


def _about(rest: LiveContent, number: int, t_start: float, recovered: bool) -> dict[str, Any]:
    """Return the content of the episode's metadata file: what was known at its start and at its end."""
    closing = rest.folder / CLOSING
    closed = _UNCLOSED | (read_json(closing) if closing.exists() else {})
    about = {key: value for key, value in rest.about.items() if key not in ("columns", "cameras_kept")}
    found = {"episode": number, "length": rest.length, "t_start": t_start, "pace": _pace(rest)}
    return found | closed | {"recovered": recovered} | about


def _pace(rest: LiveContent) -> dict[str, float]:
    """Return the pace of each arm's own clock relative to the rig's; empty in lock-step, where they are one clock."""
    pace = ClockPace(() if rest.about["clock"] == "lock_step" else rest.about["columns"])
    for row in rest.rows:
        pace.add(row)
    return pace.as_json()


# Recovery.


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

    The index is all of ``meta/``. It is rebuilt from ``episodes/``, ``data/`` and ``videos/``, which are only read.
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
        done = [_finished(layout, partial) for partial in layout.interrupted]
        if (wrong := next(check_index(layout), None)) is not None:
            count = _rebuild(layout)
            done.append(f"the index was rebuilt from {count} episode{'' if count == 1 else 's'}; it was wrong: {wrong}")
            for left in check_index(layout):
                raise left
        return done + recover_all(layout)


def recover_all(layout: DatasetLayout) -> list[str]:
    """Do the same as :func:`recover`, for a dataset that is locked already."""
    layout.sweep()
    done = [_finished(layout, partial) for partial in layout.interrupted]
    if layout.partials():
        read_index(layout)
    return done + [_finished(layout, partial) for partial in layout.partials()]


def _finished(layout: DatasetLayout, partial: Path) -> str:
    try:
        number = finalise(layout, partial, recovered=True)
    except OSError:
        raise
    except Exception as error:
        why = str(error) if isinstance(error, DatasetError) else f"{type(error).__name__}: {error}"
        raise HalError(
            f"{partial} cannot be made an episode ({why}); move it elsewhere and retry", code="damaged_episode"
        ) from error
    if number is None:
        return f"{partial.name} held no whole row and was removed"
    return f"{partial.name} was not finished: recovered as episode {number}"


def _layout(out: str | Path) -> DatasetLayout:
    require_libraries()
    layout = DatasetLayout(out)
    if not layout.root.is_dir():
        raise CommandError(f"there is no folder {layout.root}", code="no_folder")
    return layout


# The index.


def _rebuild(layout: DatasetLayout) -> int:
    """Write all of ``meta/`` again from the episodes, ``info.json`` last. Return the number of episodes."""
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
        total = {key: merge_stats(total.get(key), found) for key, found in stats.items()}
        start += episode.length
    if sorted(tasks) != list(range(len(tasks))):
        raise DatasetError(f"the episodes have tasks of the numbers {sorted(tasks)}", file="data")
    write_table(layout.tasks, tasks_table([tasks[k] for k in sorted(tasks)]))
    write_json(layout.stats, stats_as_lists(total))
    counts = {"total_episodes": count, "total_frames": start, "total_tasks": len(tasks)}
    write_json(layout.info, info | counts | {"splits": {"train": f"0:{count}"}})
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
        with dataset_errors(layout.root, layout.info):
            return validated_info(read_json(layout.info))
    except DatasetError as error:
        raise DatasetError(
            "was recorded by an older version, which kept the names of the columns in meta/info.json only; copy that "
            "file from a dataset that was recorded with the same rig, and repair again",
            file="episodes/000000.json",
        ) from error


def _stats(layout: DatasetLayout, episode: Episode) -> dict[str, Stats]:
    rows = episode.length
    stats = {key: column_stats(values.reshape(rows, -1)) for key, values in episode.columns.items()}
    episode.check_pictures()
    for path in (path for camera in episode.cameras for path in episode.files(camera).values()):
        if path.suffix == ".mp4":
            with dataset_errors(layout.root, path, episode.number):
                stats[path.parent.parent.name] = picture_stats(path, rows, episode.fps).stats()
    return stats
