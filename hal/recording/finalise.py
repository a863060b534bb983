"""From a live folder to an episode of the dataset. Killed at any moment, it can be done again.

First everything is made inside the folder, in ``final/``: the episode's files, and ``meta/`` as it will be. Then a list
of what goes where is written: from here on the episode counts as saved. Then each file is renamed to its place,
``info.json`` last, and the folder is removed. Whoever finds the list does what is left of it; whoever finds none
starts anew.
"""

from __future__ import annotations

import contextlib
import shutil
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from .columns import ACTION, GRID, SETPOINT, STATE, TIMES, video_key
from .index import check_next, read_index
from .layout import LIST, Layout, read_json, sync, write_json
from .live import Rest, read_rest
from .pace import Pace
from .stats import Stats, column_stats, merged, plain
from .tables import entry_table, new_info, read_tasks, rows_table, tasks_table
from .video import picture_stats, remux

__all__ = ["CLOSING", "finalise", "keep_mark"]

CLOSING = "closing.json"
"""In the live folder: what was said when the episode was closed."""
_FINAL = "final"
_UNCLOSED: dict[str, Any] = {
    "success": None,
    "dropped": None,
    "late": None,
    "gaps": [],
    "repeated": {},
    "trouble": "nobody closed it: the program ended, or its writer",
}


def keep_mark(partial: Path, success: bool) -> None:
    """Write a person's mark into a partial folder, where it outlives the process that writes the episode."""
    with contextlib.suppress(OSError):  # a full disk, or a folder that was moved: the writer tries once more
        write_json(partial / CLOSING, {"success": success})


def finalise(layout: Layout, partial: Path, *, recovered: bool = False) -> int | None:
    """Make an episode of a partial folder.

    Args:
        layout: The dataset, which must be locked.
        partial: The folder; its content is not trusted.
        recovered: Whether the program that recorded it did not get to finish it.

    Returns:
        The episode's number; None where the folder holds no row: then it is removed.

    Raises:
        DatasetError: The dataset's index is missing or damaged, or the folder would write over a finished episode or
            outside of the dataset.
        OSError: The disk does not take it; the folder stays as it is then.
    """
    _check_no_links(partial)
    if not (partial / LIST).exists():
        rest = read_rest(partial)
        if rest is None or rest.length == 0:
            layout.remove(partial)
            return None
        moves = _prepare(layout, rest, recovered)
        write_json(partial / LIST, moves)
    return _move(layout, partial)


def _check_no_links(partial: Path) -> None:
    """A link would let what is written or cut off here change a file elsewhere."""
    for path in (partial, *partial.rglob("*")):
        if path.is_symlink():
            raise ValueError(f"{path.name} is a link")


def _move(layout: Layout, partial: Path) -> int:
    shared = {layout.info, layout.stats, layout.tasks}
    moves = []
    for source, target in read_json(partial / LIST):
        here, there = partial / source, layout.target(target)
        if Path(source).is_absolute() or ".." in Path(source).parts:
            raise ValueError(f"{source!r} is not a file of this folder")
        if here.exists():
            if there.exists() and there not in shared:
                raise DatasetError("belongs to a finished episode; it is not written over", file=target)
            moves.append((here, there))
    for here, there in moves:
        there.parent.mkdir(parents=True, exist_ok=True)
        here.replace(there)
        sync(there.parent)
    layout.remove(partial)
    return int(read_json(layout.info)["total_episodes"]) - 1


def _prepare(layout: Layout, rest: Rest, recovered: bool) -> list[tuple[str, str]]:
    """Make everything; which file of the folder goes where comes back, in that order."""
    import pyarrow.parquet as pq

    about = rest.about
    there = read_index(layout)
    check_next(layout, there)
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
    write_json(final / "stats.json", plain({key: merged(before.get(key), found) for key, found in stats.items()}))
    made.append((final / "stats.json", layout.stats))
    total = {"total_episodes": number + 1, "total_frames": start + rows, "total_tasks": len(tasks)}
    write_json(final / "info.json", info | total | {"splits": {"train": f"0:{number + 1}"}})
    made.append((final / "info.json", layout.info))
    for source, _ in made:
        sync(source)
    sync(final)
    return [(str(source.relative_to(rest.folder)), str(target.relative_to(layout.root))) for source, target in made]


def _columns(rest: Rest, t_start: float) -> dict[str, NDArray[Any]]:
    """Columns (rows, n) of a live folder, and the action: what the arm was told to be at by the next row.

    Times count from the first row on.
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
    """Where a column begins in a row."""
    keys = [column[0] for column in columns]
    return sum(len(names) for _, _, names in columns[: keys.index(key)])


def _about(rest: Rest, number: int, t_start: float, recovered: bool) -> dict[str, Any]:
    """Return the content of the episode's own file: what was known at its start and at its end."""
    closing = rest.folder / CLOSING
    closed = _UNCLOSED | (read_json(closing) if closing.exists() else {})
    about = {key: value for key, value in rest.about.items() if key not in ("columns", "cameras_kept")}
    found = {"episode": number, "length": rest.length, "t_start": t_start, "pace": _pace(rest)}
    return found | closed | {"recovered": recovered} | about


def _pace(rest: Rest) -> dict[str, float]:
    """How fast the time of each arm's own clock passed, as a share of the rig's; in lock-step they are one clock."""
    pace = Pace(() if rest.about["clock"] == "lock_step" else rest.about["columns"])
    for row in rest.rows:
        pace.add(row)
    return pace.as_json()
