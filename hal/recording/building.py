"""Write a dataset of episodes of other ones: file by file, each a link where it stays as it is.

Nothing is encoded again. Rows get new numbers, statistics are those of the parts' index, and small videos are joined.
"""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import threading
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DatasetError
from .about import split_about
from .codecs import Stats, column_stats, copy_records, merge_stacked, merge_stats, stats_as_lists
from .dataset import Dataset, Episode
from .finish import entries_table, entry_row, last_row, new_info, stats_of, stats_row, tasks_table, write_table
from .index import read_entries, read_stats, read_table, read_tasks
from .layout import GROUP, VIDEO_MB, DatasetLayout, EpisodePlace, video_key, video_names, write_json
from .validation import dataset_errors
from .videos import VideoPart, can_be_joined, join_videos

_THREADS = 4
_ROWS = 1000
"""Rows of a group of rows, at least: a group takes some kB of its own, and is read whole."""


class EpisodeLabel(NamedTuple):
    """What can be changed about a recorded episode."""

    task: str
    success: bool | None
    """Whether it is marked a success; None for no mark."""


class EpisodeSource(NamedTuple):
    """An episode of the result: where it comes from, and its label there."""

    dataset: Dataset
    episode: Episode
    label: EpisodeLabel


class DatasetBuilder:
    """Writes a dataset of episodes of other ones: file by file, each a link where it stays as it is."""

    def __init__(self, layout: DatasetLayout, sources: Sequence[EpisodeSource]) -> None:
        self.layout, self.sources = layout, sources
        self.features: dict[str, Any] = sources[0].episode._meta["features"]
        self.fps = sources[0].episode.fps
        self.tasks = list(dict.fromkeys(source.label.task for source in sources))
        self.starts = [0, *accumulate(source.episode.length for source in sources)]
        """Number of each episode's first row in the whole dataset; then of all rows."""
        self._entries = lru_cache(maxsize=2 * _THREADS)(read_entries)
        self._tables = lru_cache(maxsize=2 * _THREADS)(_read_stats)
        self._tasks = lru_cache(maxsize=None)(read_tasks)
        self._writing = threading.Lock()
        self._places: dict[str, list[tuple[int, int]]] = {}
        """File of each video of each episode, and the number of its first picture there."""

    def build(self, on_episode: Callable[[int, int], object]) -> None:
        """Write everything, ``info.json`` last."""
        count = len(self.sources)
        parts: dict[str, list[Stats]] = {}
        with ThreadPoolExecutor(min(_THREADS, os.cpu_count() or 1)) as pool:  # the libraries release the lock
            try:
                names = video_names(self.features)
                self._places = dict(zip(names, pool.map(self._join_videos, names), strict=True))
                done = 0
                for added, found in pool.map(self._add_group, range(0, count, GROUP)):
                    for key, stats in found.items():
                        parts.setdefault(key, []).append(stats)
                    for _ in range(added):
                        done += 1
                        on_episode(done, count)
            except BaseException:
                pool.shutdown(cancel_futures=True)
                raise
        write_table(self.layout.tasks, tasks_table(self.tasks), keep_schema=True)
        write_json(self.layout.stats, stats_as_lists({key: merge_stats(found) for key, found in parts.items()}))
        info = new_info(self.features, self.fps, self.sources[0].episode._meta["robot_type"])
        counts = {"total_episodes": count, "total_frames": self.starts[-1], "total_tasks": len(self.tasks)}
        write_json(self.layout.info, info | counts | {"splits": {"train": f"0:{count}"}})

    # Videos.

    def _join_videos(self, name: str) -> list[tuple[int, int]]:
        """Write the files of one video; return the file of each episode, and its first picture there.

        A file becomes a link if all of it is used and it is large; others are joined, up to :data:`VIDEO_MB`.
        """
        files: list[list[_Run]] = []
        for run in self._runs(name):
            if files and _fits(files[-1], run):
                files[-1].append(run)
            else:
                files.append([run])
        for number, runs in enumerate(files):
            target = self.layout.video(name, number)
            target.parent.mkdir(parents=True, exist_ok=True)
            if len(runs) == 1 and runs[0].whole:
                link_file(runs[0].part.path, target)
            else:
                with dataset_errors(self.layout.root, runs[0].part.path):
                    join_videos([run.part for run in runs], target, self.fps)
        places, file, first = [], 0, 0
        sizes = [sum(run.part.length for run in runs) for runs in files]
        for source in self.sources:
            if first == sizes[file]:
                file, first = file + 1, 0
            places.append((file, first))
            first += source.episode.length
        return places

    def _runs(self, name: str) -> list[_Run]:
        """Return the pictures of all episodes; those that follow each other in a file already are one part."""
        pictures: dict[Path, int] = {}
        for dataset in {source.dataset.root: source.dataset for source in self.sources}.values():
            for episode in dataset.episodes:
                path = episode._layout.video(name, episode.place.video(name)[0])
                pictures[path] = pictures.get(path, 0) + episode.length
        parts: list[VideoPart] = []
        for _, episode, _ in self.sources:
            file, first = episode.place.video(name)
            path = episode._layout.video(name, file)
            with dataset_errors(episode._layout.root, path, episode.number):
                path.stat()
            last = parts[-1] if parts else None
            if last is not None and (last.path, last.first + last.length) == (path, first):
                parts[-1] = last._replace(length=last.length + episode.length)
            else:
                parts.append(VideoPart(path, first, episode.length))
        return [
            _Run(part, part.path.stat().st_size * part.length / pictures[part.path], part.length == pictures[part.path])
            for part in parts
        ]

    # Rows, index, metadata and depth.

    def _add_group(self, begin: int) -> tuple[int, dict[str, Stats]]:
        """Write the files of :data:`GROUP` episodes, but not their videos; return their number and their statistics."""
        import pyarrow as pa

        group, numbers = begin // GROUP, range(begin, min(begin + GROUP, len(self.sources)))
        data = self.layout.data(group)
        data.parent.mkdir(parents=True, exist_ok=True)
        kept = self._kept_rows(numbers)
        if kept is not None:
            with dataset_errors(self.sources[begin].dataset.root, kept):
                link_file(kept, data)
        else:
            self._write_rows(data, numbers)
        rows = []
        for number in numbers:
            _, episode, label = self.sources[number]
            stats: dict[str, Any] = {video_key(name): {} for name in self._places}
            if kept is None:
                stats |= {key: column_stats(values[:, None]) for key, values in self._change_columns(number).items()}
            first = self.starts[number] - self.starts[begin]
            place = EpisodePlace(group, (group, first), {name: at[number] for name, at in self._places.items()})
            about = episode.info | {"episode": number} | label._asdict() | place.as_json()
            self._write_about(episode, number, about)
            self._add_depth(episode, number)
            rows.append(entry_row(about, place, self.starts[number], self.fps, stats))
        entries, there = entries_table(rows), self._stats(numbers)
        columns = {name: table[name] for table in (there, entries) for name in table.column_names}
        entries = pa.table({name: columns[name] for name in (*entries.column_names, *columns)})
        write_table(self.layout.entry(group), entries)
        return len(numbers), {key: merge_stacked(found) for key, found in read_stats(entries).items()}

    def _add_depth(self, episode: Episode, number: int) -> None:
        for path in (path for camera in episode.cameras for path in episode.files(camera).values()):
            if path.suffix == ".depth":
                with dataset_errors(episode._layout.root, path, episode.number):
                    target = self.layout.depth(path.parent.parent.name, number)
                    if episode.rows is None:
                        link_file(path, target)
                    else:
                        copy_records(path, target, *episode.rows)

    def _write_about(self, episode: Episode, number: int, about: Mapping[str, Any]) -> None:
        own, name, common = split_about(about)
        with self._writing:
            if not self.layout.common(name).exists():
                write_json(self.layout.common(name), common)
        if about == episode.info and name == about.get("common") and episode.rows is None:
            link_file(episode._layout.about(episode.number), self.layout.about(number))
        else:
            self.layout.about(number).write_text(json.dumps(own) + "\n", encoding="utf-8")

    def _entry(self, number: int) -> dict[str, Any]:
        """Return the row of an episode of the result in the index of its part, without the statistics."""
        episode = self.sources[number].episode
        path = episode._layout.entry(episode.place.entry)
        with dataset_errors(episode._layout.root, path, episode.number):
            return self._entries(path)[episode.number]

    def _change_columns(self, number: int) -> dict[str, NDArray[Any]]:
        """Return the columns (rows,) of an episode that depend on its number and its label."""
        _, episode, label = self.sources[number]
        rows = episode.length
        found = {
            "episode_index": np.full(rows, number),
            "index": np.arange(self.starts[number], self.starts[number] + rows),
            "task_index": np.full(rows, self.tasks.index(label.task)),
            "next.success": last_row(rows, label.success is True)[:, 0],
        }
        return {key: values for key, values in found.items() if key in self.features}

    def _stats(self, numbers: range) -> Any:
        """Return the statistics of episodes as an Arrow table with a row for each, as their parts' index has them."""
        import pyarrow as pa

        tables: list[Any] = []
        runs: list[tuple[Any, int, int]] = []
        """Table, first row and rows that follow each other in it."""
        for number in numbers:
            episode = self.sources[number].episode
            path = episode._layout.entry(episode.place.entry)
            with dataset_errors(episode._layout.root, path, episode.number):
                table, places = self._tables(path)
                row = places[episode.number]
            if episode.rows is not None:
                table, row = entries_table([stats_row(stats_of(episode))]), 0
            if runs and runs[-1][0] is table and sum(runs[-1][1:]) == row:
                runs[-1] = table, runs[-1][1], runs[-1][2] + 1
                continue
            runs.append((table, row, 1))
            there = {name.split("/")[1] for name in table.column_names}
            if missing := [key for key in self.features if key not in there]:
                file = str(path.relative_to(episode._layout.root))
                raise DatasetError(f"has no statistics of {', '.join(missing)}", file=file, episode=episode.number)
        for table, row, count in runs:
            part = table.slice(row, count)
            tables.append(part if not tables else part.select(tables[0].column_names).cast(tables[0].schema))
        return pa.concat_tables(tables).combine_chunks()

    def _kept_rows(self, numbers: range) -> Path | None:
        """Return the file that holds the rows of just these episodes as they are to be; None if there is none."""
        first = self.sources[numbers[0]].episode
        path, end = first._layout.data(first.place.data[0]), 0
        for number in numbers:
            _, episode, label = self.sources[number]
            entry = self._entry(number)
            with dataset_errors(episode._layout.root, episode._layout.tasks):
                known = self._tasks(episode._layout.tasks)
            if (
                episode.rows is not None
                or episode._layout.data(episode.place.data[0]) != path
                or episode.place.data[1] != end
                or (episode.number, entry["dataset_from_index"]) != (number, self.starts[number])
                or entry["tasks"] != [label.task]
                or known.index(label.task) != self.tasks.index(label.task)
                or ("next.success" in self.features and (entry.get("success") is True) != (label.success is True))
            ):
                return None
            end += episode.length
        sharing = [
            each for each in self.sources[numbers[0]].dataset.episodes if each.place.data[0] == first.place.data[0]
        ]
        return path if len(sharing) == len(numbers) else None

    def _write_rows(self, path: Path, numbers: range) -> None:
        """Write the rows of some episodes with their new numbers, in row groups of :data:`_ROWS` rows or more."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        with contextlib.ExitStack() as stack:
            file: Any = None
            waiting: list[Any] = []
            for number in numbers:
                episode = self.sources[number].episode
                table = episode.read_table().replace_schema_metadata()
                with dataset_errors(episode._layout.root, episode._layout.root / episode.data_file, episode.number):
                    for key, values in self._change_columns(number).items():
                        table = table.set_column(table.schema.get_field_index(key), key, pa.array(values))
                    if file is None:
                        file = stack.enter_context(pq.ParquetWriter(path, table.schema, write_page_checksum=True))
                    waiting.append(table.cast(file.schema))
                if number == numbers[-1] or sum(map(len, waiting)) >= _ROWS:
                    group = pa.concat_tables(waiting)
                    file.write_table(group, row_group_size=len(group))
                    waiting = []


def _read_stats(path: Path) -> tuple[Any, dict[int, int]]:
    """Return the statistics in a file of ``meta/episodes`` as an Arrow table, and the row of each episode in it."""
    table = read_table(path)
    names = [name for name in table.column_names if name.startswith("stats/")]
    return table.select(names), {number: row for row, number in enumerate(table["episode_index"].to_pylist())}


class _Run(NamedTuple):
    """Pictures of episodes that follow each other in one file."""

    part: VideoPart
    size: float
    """Bytes."""
    whole: bool
    """Whether they are all of the file's pictures."""


def _fits(file: Sequence[_Run], run: _Run) -> bool:
    """Return whether a run is to be joined to a file; a large file stays as it is, because copying it takes time."""
    limit = VIDEO_MB * 1e6
    if sum(each.size for each in (*file, run)) > limit or any(
        each.whole and each.size > limit / 2 for each in (file[0], run)
    ):
        return False
    return can_be_joined(file[0].part.path, run.part.path)


def link_file(source: Path, target: Path) -> None:
    """Make a hard link, or a copy on a file system that has none or is another one.

    Raises FileExistsError and changes nothing if ``target`` exists: it may be a link to a file of another dataset.
    """
    target.parent.mkdir(parents=True, exist_ok=True)
    try:
        os.link(source, target)
    except (FileNotFoundError, FileExistsError):
        raise
    except OSError:
        with source.open("rb") as read, target.open("xb") as write:
            shutil.copyfileobj(read, write, 1 << 20)
