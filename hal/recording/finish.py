"""Make an episode of a live folder: all of its files, and the index with it.

Finishing can be interrupted at any moment and repeated. All files are made inside the partial folder, in ``final/``:
the episode's own, and ``meta/`` as it will be. Then a list of destinations is written: from here on the episode counts
as saved. Then each file is renamed to its place, ``info.json`` last, and the folder is removed. If the list exists,
only the renaming is completed; if not, everything is made again.
"""

from __future__ import annotations

import contextlib
import json
import shutil
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError, HalError
from .about import split_about
from .codecs import Stats, column_stats, merge_stats, stats_as_lists
from .dataset import Episode
from .index import (
    _TASK,
    check_next_episode,
    column_values,
    make_column,
    next_place,
    read_index,
    read_tasks,
)
from .layout import (
    ACTION,
    CHUNK,
    GRID,
    GROUP,
    MOVES,
    SETPOINT,
    SOURCE,
    SOURCES,
    STATE,
    TIMES,
    VERSION,
    VIDEO_MB,
    DatasetLayout,
    EpisodePlace,
    read_json,
    sync_to_disk,
    video_key,
    write_json,
)
from .live import LiveContent, read_live
from .metadata import ClockPace
from .validation import dataset_errors
from .videos import picture_stats, remux


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
        "video_files_size_in_mb": VIDEO_MB,
        "fps": fps,
        "splits": {"train": "0:0"},
        "data_path": f"data/{place}.parquet",
        "video_path": f"videos/{{video_key}}/{place}.mp4" if videos else None,
        "features": dict(features),
    }


def totals(episodes: int, rows: int, tasks: int) -> dict[str, Any]:
    """Return the entries of ``meta/info.json`` that count what a dataset has."""
    counts = {"total_episodes": episodes, "total_frames": rows, "total_tasks": tasks}
    return counts | {"splits": {"train": f"0:{episodes}"}}


def rows_table(columns: Mapping[str, NDArray[Any]], features: Mapping[str, Any]) -> Any:
    """Return the Arrow table of an episode's rows, from columns (rows, n), in the order and types of ``features``."""
    import pyarrow as pa

    types = {key: feature["dtype"] for key, feature in features.items() if feature["dtype"] != "video"}
    return pa.table({key: make_column(columns[key].astype(dtype)) for key, dtype in types.items()})


def entry_row(
    about: Mapping[str, Any], place: EpisodePlace, start: int, fps: int, stats: Mapping[str, Mapping[str, Any]]
) -> dict[str, Any]:
    """Return an episode's row of ``meta/episodes``; its first one in the whole dataset is row ``start``."""
    number, length = about["episode"], about["length"]
    row = {"episode_index": number, "tasks": [about["task"]], "length": length, **_at("data", place.data[0])}
    row |= {"dataset_from_index": start, "dataset_to_index": start + length}
    for key in (key for key in stats if key.startswith(video_key(""))):
        file, first = place.video(key.removeprefix(video_key("")))
        times = {"from_timestamp": first / fps, "to_timestamp": (first + length) / fps}
        row |= _at(f"videos/{key}", file) | {f"videos/{key}/{name}": time for name, time in times.items()}
    row |= _at("meta/episodes", place.entry) | {"success": about["success"], "dropped": about.get("dropped")}
    for name, camera in about["cameras"].items():
        row |= {f"camera_matrix/{name}": camera["K"], f"camera_distortion/{name}": camera["distortion"]}
    return row | stats_row(stats)


def stats_row(stats: Mapping[str, Mapping[str, Any]]) -> dict[str, Any]:
    """Return the statistics of an episode's columns and videos as columns of ``meta/episodes``."""
    return {f"stats/{key}/{name}": value.tolist() for key, found in stats.items() for name, value in found.items()}


def _at(lead: str, file: int) -> dict[str, int]:
    return {f"{lead}/chunk_index": file // CHUNK, f"{lead}/file_index": file % CHUNK}


def entries_table(rows: Sequence[Mapping[str, Any]]) -> Any:
    """Return the Arrow table of some rows of ``meta/episodes``."""
    import pyarrow as pa

    types = {"success": pa.bool_(), "dropped": pa.int64()}
    types |= {name: pa.list_(pa.float64()) for name in rows[0] if name.startswith("camera_distortion/")}
    return pa.table({name: pa.array([row[name] for row in rows], types.get(name)) for name in rows[0]})


def write_table(path: Path, table: Any, *, keep_schema: bool = False) -> None:
    """Write a Parquet file, whole or not at all; ``keep_schema`` with the metadata of the schema."""
    import pyarrow.parquet as pq

    path.parent.mkdir(parents=True, exist_ok=True)
    beside = path.with_name(path.name + ".new")
    beside.unlink(missing_ok=True)
    lean: dict[str, Any] = {"use_dictionary": False, "write_statistics": False, "compression": "zstd"}
    pq.write_table(table, beside, store_schema=keep_schema, **lean)
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
    return move_files(layout, partial)


def _check_no_links(partial: Path) -> None:
    """Raise ValueError for a link, through which writing or truncating here would change a file elsewhere."""
    for path in (partial, *partial.rglob("*")):
        if path.is_symlink():
            raise ValueError(f"{path.name} is a link")


def move_files(layout: DatasetLayout, partial: Path) -> int:
    """Move the files of a partial folder to their places, and remove it. Return the number of the last episode.

    Only a change of finished episodes replaces files of theirs.
    """
    moves = []
    for source, target in read_json(partial / MOVES):
        here, there = partial / source, layout.target(target)
        if Path(source).is_absolute() or ".." in Path(source).parts:
            raise ValueError(f"{source!r} is not a file of this folder")
        if here.exists():
            own = partial == layout.change or there.is_relative_to(layout.info.parent)
            if there.exists() and not own:
                raise DatasetError(
                    "belongs to a finished episode; it is not overwritten", file=target, code="would_overwrite"
                )
            moves.append((here, there))
    for k, (here, there) in enumerate(moves):
        there.parent.mkdir(parents=True, exist_ok=True)
        here.replace(there)
        if k + 1 == len(moves) or moves[k + 1][1].parent != there.parent:
            sync_to_disk(there.parent)
    layout.remove(partial)
    return int(read_json(layout.info)["total_episodes"]) - 1


def recover_all(layout: DatasetLayout) -> list[str]:
    """Finish what was interrupted in a dataset, which must be locked; see :func:`~hal.recording.recover`."""
    layout.sweep()
    done = [finished_episode(layout, partial) for partial in layout.interrupted]
    if layout.partials():
        read_index(layout)
    return done + [finished_episode(layout, partial) for partial in layout.partials()]


def finished_episode(layout: DatasetLayout, partial: Path) -> str:
    """Make an episode of an interrupted partial folder, or complete a change; return what was done."""
    try:
        number = finalise(layout, partial, recovered=True)
    except OSError:
        raise
    except Exception as error:
        why = str(error) if isinstance(error, DatasetError) else f"{type(error).__name__}: {error}"
        raise HalError(
            f"{partial} cannot be made an episode ({why}); move it elsewhere and retry", code="damaged_episode"
        ) from error
    if partial == layout.change:
        return f"a change of episodes was interrupted: {'it was not begun' if number is None else 'completed'}"
    if number is None:
        return f"{partial.name} held no whole row and was removed"
    return f"{partial.name} was not finished: recovered as episode {number}"


def _prepare(layout: DatasetLayout, rest: LiveContent, recovered: bool) -> list[tuple[str, str]]:
    """Make all files. Return (source, destination) of each, in the order in which they are to be moved."""
    import pyarrow.parquet as pq

    about = rest.about
    there = read_index(layout)
    check_next_episode(layout, there)
    info = there or new_info(about["features"], about["fps"], about["robot_type"])
    number, start, fps = int(info["total_episodes"]), int(info["total_frames"]), int(info["fps"])
    place = next_place(layout, info)
    final = rest.folder / _FINAL
    shutil.rmtree(final, ignore_errors=True)
    final.mkdir()
    tasks = read_tasks(layout.tasks)
    if about["task"] not in tasks:
        tasks.append(about["task"])
    made: list[tuple[Path, Path]] = []

    def put(name: str, target: Path) -> Path:
        made.append((final / name, target))
        return final / name

    t_start, columns = _columns(rest)
    rows = len(rest.rows)
    closed = _about(rest, number, t_start, recovered)
    columns |= {
        "intervention": interventions(columns),
        "next.success": last_row(rows, closed["success"] is True),
        "next.done": last_row(rows, True),
        "timestamp": np.arange(rows)[:, None] / fps,
        "frame_index": np.arange(rows)[:, None],
        "episode_index": np.full((rows, 1), number),
        "index": np.arange(start, start + rows)[:, None],
        "task_index": np.full((rows, 1), tasks.index(about["task"])),
    }
    data = put("data.parquet", layout.data(place.data[0]))
    pq.write_table(rows_table(columns, info["features"]), data, write_page_checksum=True)
    stats: dict[str, Stats] = {key: column_stats(values) for key, values in columns.items()}
    for camera in rest.cameras:
        for name in camera.videos:
            video = put(f"{name}.mp4", layout.video(name, place.video(name)[0]))
            remux(rest.folder / video.name, video, rows)
            stats[video_key(name)] = picture_stats(video, rows, fps).stats()
        for name in camera.depths:
            made.append((rest.folder / f"{name}.depth", layout.depth(name, number)))
    place, entries = _continue_episode(layout, closed, place, start, fps, stats)
    own, name, common = split_about(closed | place.as_json())
    if not layout.common(name).exists():
        write_json(put("common.json", layout.common(name)), common)
    write_json(put("about.json", layout.about(number)), own, indent=None)

    write_table(put("entry.parquet", layout.entry(place.entry)), entries)
    pq.write_table(tasks_table(tasks), put("tasks.parquet", layout.tasks))
    write_json(put("stats.json", layout.stats), stats_as_lists(_add_stats(layout, stats)))
    write_json(put("info.json", layout.info), info | totals(number + 1, start + rows, len(tasks)))
    for source, _ in made:
        sync_to_disk(source)
    sync_to_disk(final)
    return [(str(source.relative_to(rest.folder)), str(target.relative_to(layout.root))) for source, target in made]


def _add_stats(layout: DatasetLayout, stats: Mapping[str, Stats]) -> dict[str, Stats]:
    """Return the statistics of all episodes with those of one more."""
    before = read_json(layout.stats) if layout.stats.exists() else {}
    return {key: merge_stats([*filter(None, [before.get(key)]), found]) for key, found in stats.items()}


def _continue_episode(
    layout: DatasetLayout,
    about: Mapping[str, Any],
    place: EpisodePlace,
    start: int,
    fps: int,
    stats: Mapping[str, Stats],
) -> tuple[EpisodePlace, Any]:
    """Return a new episode's place and its file of ``meta/episodes``: the last one with one more row, or a new one.

    That is part of the index, which :func:`repair` makes anew, and not of a finished episode.
    """
    import pyarrow as pa
    import pyarrow.parquet as pq

    before = place._replace(entry=place.entry - 1)
    path = layout.entry(before.entry)
    if place.entry > 0 and path.exists():
        table = pq.read_table(path)
        more = entries_table([entry_row(about, before, start, fps, stats)])
        if len(table) < GROUP and set(table.column_names) == set(more.column_names):
            return before, pa.concat_tables([table, more.select(table.column_names).cast(table.schema)])
    return place, entries_table([entry_row(about, place, start, fps, stats)])


def last_row(rows: int, value: bool) -> NDArray[np.bool_]:
    """Return a column (rows, 1) that is False but, with ``value``, in the last row."""
    found = np.zeros((rows, 1), bool)
    found[-1] = value
    return found


def interventions(columns: Mapping[str, NDArray[Any]]) -> NDArray[np.bool_]:
    """Return where (rows, 1) a person drives in an episode of a policy or a program."""
    if SOURCE not in columns:  # an unfinished episode of an older version
        return np.zeros((len(columns[GRID]), 1), bool)
    person = columns[SOURCE] == SOURCES.index("person")
    found: NDArray[np.bool_] = person & (columns[SOURCE] > SOURCES.index("person")).any()
    return found


def _columns(rest: LiveContent) -> tuple[float, dict[str, NDArray[Any]]]:
    """Return the time of the first row of a live folder, s, and its columns (rows, n), with times since then.

    The action is the set-point one row later.
    """
    columns: dict[str, NDArray[Any]] = {}
    place = 0
    for key, _, names in rest.about["columns"]:
        columns[key] = rest.rows[:, place : place + len(names)]
        place += len(names)
    t_start = float(columns[GRID][0, 0])
    for key, values in columns.items():
        if key.startswith(TIMES):
            values[:, 0] -= t_start
    setpoint = columns[SETPOINT]
    columns[ACTION] = np.concatenate([setpoint[1:], setpoint[-1:]])
    assert columns[ACTION].shape[1] == columns[STATE].shape[1]
    return t_start, columns


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


def stats_of(episode: Episode) -> dict[str, Stats]:
    """Return the statistics of an episode's columns and videos, read again. Raises DatasetError for damaged files."""
    rows = episode.length
    table = episode.read_table()
    stats = {key: column_stats(column_values(table[key])) for key in table.column_names}
    episode.check_pictures()
    for path in episode.picture_files(".mp4"):
        with dataset_errors(episode._layout, path, episode.number):
            first = episode.first_picture(path)
            stats[path.parent.parent.name] = picture_stats(path, rows, episode.fps, first).stats()
    return stats
