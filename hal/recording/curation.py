"""Split a dataset into several, and trim the rows at both ends of an episode in which nothing moves."""

from __future__ import annotations

import math
from collections.abc import Callable, Collection, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError
from .changing import existing_episodes
from .dataset import Dataset, Episode, KeptRows
from .index import column_values, make_column
from .layout import (
    GRID,
    SETPOINT,
    STATE,
    TIMES,
    DatasetLayout,
    EpisodePlace,
    building_folder,
    current_key,
    put_in_place,
    video_names,
)
from .merging import extract, merge, open_dataset
from .validation import checked_name, dataset_errors
from .videos import key_frames


def shares(count: int, parts: Mapping[str, float], seed: int = 0) -> dict[str, list[int]]:
    """Return the episodes of each part of a random split, the same for the same seed.

    Args:
        count: Number of episodes.
        parts: Share of each part, by its name; at most 1 in all.
        seed: Of the random order.

    Raises:
        CommandError: The shares are not above 0 and at most 1 in all, or a part would be empty (code ``bad_split``).
    """
    total = math.fsum(parts.values())
    if not all(share > 0.0 for share in parts.values()) or not total <= 1.0 + 1e-9:
        raise CommandError(f"shares must be above 0, and at most 1 in all, not {total:g}", code="bad_split")
    order = np.random.default_rng(seed).permutation(count).tolist()
    edges = [0, *(round(count * float(edge)) for edge in np.cumsum(list(parts.values())))]
    found = {name: sorted(order[first:end]) for name, (first, end) in zip(parts, pairwise(edges), strict=True)}
    if empty := [name for name, numbers in found.items() if not numbers]:
        raise CommandError(f"{empty[0]} would have none of {count} episodes", code="bad_split")
    return found


def split(dataset: str | Path | Dataset, parts: Mapping[str, Collection[int]], out: str | Path) -> dict[str, int]:
    """Write several datasets of the episodes of one, which is only read. They appear together, when all are complete.

    Args:
        dataset: The dataset, or its folder.
        parts: Numbers of the episodes of each part, by its name; no episode in two. Episodes in none are left out.
        out: New folder; each part becomes a folder of its name in it.

    Returns:
        The number of episodes of each part.

    Raises:
        CommandError: A part is empty or has no valid name, or an episode is in two (code ``bad_split``), or ``out``
            exists (``output_exists``), or another process splits into it (``dataset_locked``); otherwise as
            :func:`~hal.recording.extract`.
        DatasetError: The dataset is damaged.
    """
    numbers = [number for part in parts.values() for number in set(part)]
    if len(set(numbers)) < len(numbers) or not parts or not all(parts.values()):
        raise CommandError("every part needs episodes, and no episode may be in two parts", code="bad_split")
    for name in parts:
        try:
            checked_name(name)
        except ValueError as error:
            raise CommandError(f"the part {name!r} {error}", code="bad_split") from None
    target = Path(out).expanduser().absolute()
    if target.exists():
        raise CommandError(f"{target} exists; choose a new folder", code="output_exists")
    opened = open_dataset(dataset)
    with building_folder(DatasetLayout(target), "splitting") as building:
        whole = building.root / "parts"
        counts = {name: extract(opened, part, whole / name) for name, part in parts.items()}
        put_in_place(whole, target, replaces=False)
    return counts


def trim(
    dataset: str | Path | Dataset,
    kept: Mapping[int, KeptRows],
    out: str | Path | None = None,
    *,
    on_episode: Callable[[int, int], object] = lambda done, total: None,
) -> int:
    """Remove rows at both ends of episodes, with their pictures and depth; nothing is encoded again.

    Every other number, the true times among them, stays as it is. ``objects_at_start`` becomes the poses in the first
    row that is kept, and ``trimmed`` in the episode's file tells which rows of the recording are left.

    Args:
        dataset: The dataset, or its folder.
        kept: The rows to keep of each episode, by its number, as from :func:`find_motion`; others keep all.
        out: Folder of the result; None replaces the dataset when the result is complete.
        on_episode: Called with the number of episodes that are written and of all, after each.

    Returns:
        The number of removed rows.

    Raises:
        CommandError: There is no such episode (code ``no_episodes``), it has no such rows, or the first of them has no
            key frame (``bad_rows``); otherwise as :func:`~hal.recording.merge`.
        DatasetError: The dataset is damaged.
    """
    opened = open_dataset(dataset)
    existing_episodes(opened, kept)
    episodes = opened.episodes
    removed = 0
    for number, rows in kept.items():
        length = episodes[number].length
        if not 0 <= rows.first < rows.end <= length:
            raise CommandError(
                f"episode {number} has {length} rows, and not {rows.first} to {rows.end - 1}", code="bad_rows"
            )
        if (key_row := _key_row(episodes[number], rows.first)) != rows.first:
            raise CommandError(
                f"row {rows.first} of episode {number} has no key frame; row {key_row} has", code="bad_rows"
            )
        removed += length - (rows.end - rows.first)

    def view(episode: Episode) -> Episode:
        rows = kept.get(episode.number, KeptRows(0, episode.length))
        return episode if rows == (0, episode.length) else _TrimmedEpisode(episode, rows)

    merge([opened], opened.root if out is None else out, view=view, on_episode=on_episode)
    return removed


class _TrimmedEpisode(Episode):
    """Some rows of an episode, one after the other, as an episode: what :func:`~hal.recording.merge` writes."""

    def __init__(self, episode: Episode, rows: KeptRows) -> None:
        times = episode.columns[GRID]
        # Whole microseconds, nearly, in binary: times and their sum with the start keep every bit.
        self._shift = round(float(times[rows.first]) * 2**20) / 2**20
        super().__init__(episode._layout, episode.number, episode._meta, self._trimmed_about(episode, rows))
        self._whole = episode
        self.rows = rows

    def _trimmed_about(self, episode: Episode, rows: KeptRows) -> dict[str, Any]:
        about, place = dict(episode.info), episode.place
        last = float(episode.columns[GRID][rows.end - 1])
        gaps = [gap for gap in about.get("gaps") or () if gap["to_s"] >= self._shift and gap["from_s"] <= last]
        shifted = [{key: gap[key] - self._shift for key in ("from_s", "to_s")} for gap in gaps]
        objects = dict(about.get("objects_at_start") or {})
        for name in objects:
            pose = episode.columns.get(f"rig.object.{name}")
            if pose is not None and np.isfinite(pose[rows.first]).all():
                objects[name] = pose[rows.first].tolist()
        before = about.get("trimmed") or {"first": 0, "rows": episode.length}
        begins = {name: place.video(name) for name in video_names(episode._meta["features"])}
        videos = {name: (file, first + rows.first) for name, (file, first) in begins.items()}
        moved = EpisodePlace(place.entry, (place.data[0], place.data[1] + rows.first), videos)
        return about | {
            "length": rows.end - rows.first,
            "t_start": float(about["t_start"]) + self._shift,
            "dropped": None if about.get("dropped") is None else sum(gap["rows"] for gap in gaps),
            "gaps": [gap | times for gap, times in zip(gaps, shifted, strict=True)],
            "objects_at_start": objects,
            "trimmed": {"first": before["first"] + rows.first, "rows": before["rows"]},
            **moved.as_json(),
        }

    def read_table(self) -> Any:
        """Return the rows as an Arrow table, with times since the first one."""
        import pyarrow as pa

        rows = self.rows
        assert rows is not None
        table = self._whole.read_table().slice(rows.first, rows.end - rows.first)
        count = np.arange(self.length)
        changed: dict[str, NDArray[Any]] = {"frame_index": count, "timestamp": (count / self.fps).astype(np.float32)}
        if "next.done" in table.column_names:
            changed["next.done"] = count == self.length - 1
        for place, name in enumerate(table.column_names):
            if current_key(name).startswith(TIMES):
                values = column_values(table[name]).copy()
                values[:, 0] -= self._shift
                table = table.set_column(place, name, make_column(values))
            elif name in changed:
                table = table.set_column(place, name, pa.array(changed[name]))
        return table

    def check_pictures(self) -> None:
        self._whole.check_pictures()


def find_motion(episode: Episode, *, speed: float = 0.02, width: float = 0.001, keep: float = 0.2) -> KeptRows:
    """Find the rows between which an episode moves; only rows before and after them are idle.

    A row moves if a joint is at least as fast as ``speed``, measured or commanded. A gripper moves from where its
    width, measured or commanded, first differs from that of the first row, to where it last differs from that of the
    last one. Unknown numbers count as motion. The first kept row has a key frame in every video, so that no picture is
    encoded again.

    Args:
        episode: The episode.
        speed: Slowest motion of a joint, rad/s.
        width: Smallest motion of a gripper, m.
        keep: Time that is kept before and after the motion, s.

    Returns:
        The rows to keep; all of them if nothing moves.

    Raises:
        CommandError: A threshold is not above 0, or ``keep`` is negative (code ``bad_threshold``).
        DatasetError: The episode is damaged.
    """
    if not (0.0 < speed < math.inf and 0.0 < width < math.inf and 0.0 <= keep < math.inf):
        raise CommandError("thresholds must be above 0, and the time to keep at least 0", code="bad_threshold")
    rows = episode.length
    begins, ends = [], []
    for key, velocity in ((STATE, "observation.velocity"), (SETPOINT, "rig.setpoint_velocity")):
        if key not in episode.columns:
            continue
        positions = episode.columns[key].reshape(rows, -1).astype(np.float64)
        gripper = np.array([name.split(".")[-1] == "gripper" for name in episode.names(key)])
        moving = _moving(positions[:, ~gripper], episode.columns.get(velocity), episode.fps, speed)
        begins.append(_first(moving))
        ends.append(_first(moving[::-1]))
        widths = positions[:, gripper]
        begins.append(_first(_differs(widths, widths[:1], width)))
        ends.append(_first(_differs(widths, widths[-1:], width)[::-1]))
    margin = math.ceil(keep * episode.fps - 1e-9)
    begin, end = min(begins, default=rows), rows - min(ends, default=rows)
    if begin >= rows:
        return KeptRows(0, rows)
    return KeptRows(_key_row(episode, max(0, begin - 1 - margin)), min(rows, end + margin))


def _moving(
    positions: NDArray[np.float64], velocities: NDArray[np.floating] | None, fps: int, speed: float
) -> NDArray[np.bool_]:
    """Return the rows (rows,) in which a joint moves. Velocities that are unknown follow from the positions."""
    steps = np.abs(np.diff(positions, axis=0, append=positions[-1:])) * fps
    if velocities is not None and velocities.size == positions.size:
        known = np.abs(velocities.reshape(positions.shape).astype(np.float64))
        steps = np.where(np.isfinite(known), known, steps)
    return _differs(steps, np.zeros_like(steps), speed)


def _differs(values: NDArray[np.float64], others: NDArray[np.float64], least: float) -> NDArray[np.bool_]:
    """Return the rows (rows,) in which a number differs by ``least`` or more, or is unknown."""
    found: NDArray[np.bool_] = ~np.all(np.abs(values - others) < least, axis=1)
    return found


def _first(flags: NDArray[np.bool_]) -> int:
    """Return the place of the first True; the length if there is none."""
    return int(flags.argmax()) if flags.any() else len(flags)


def _key_row(episode: Episode, row: int) -> int:
    """Return the last row, at most ``row``, that has a key frame in every video."""
    if row == 0:
        return 0
    there = np.ones(row + 1, bool)
    for path in episode.picture_files(".mp4"):
        with dataset_errors(episode._layout, path, episode.number):
            there &= key_frames(path, episode.first_picture(path), row + 1, episode.fps)
    return int(np.flatnonzero(there)[-1]) if there.any() else 0
