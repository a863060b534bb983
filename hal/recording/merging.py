"""Merge datasets that were recorded with the same rig into one, and curate a dataset: delete, extract, re-task.

Rows are renumbered, statistics are combined from those of the episodes, and small videos are joined. Large videos,
depth files and rows that stay as they are become hard links to those of the parts. Nothing is encoded again.
"""

from __future__ import annotations

import contextlib
import json
import logging
import os
import shutil
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from itertools import accumulate
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError
from .about import split_about
from .changing import existing_episodes, refuse_foreign
from .checking import format_differences, hardware_differences
from .codecs import Stats, column_stats, copy_records, merge_stacked, merge_stats, stats_as_lists
from .dataset import Dataset, Episode
from .finish import entries_table, entry_row, last_row, new_info, stats_of, stats_row, tasks_table, totals, write_table
from .index import check_next_episode, read_entries, read_stats, read_table, read_tasks, stray_files
from .layout import (
    CHUNK,
    GROUP,
    VIDEO_MB,
    DatasetLayout,
    EpisodePlace,
    building_folder,
    lock_dataset,
    put_in_place,
    require_libraries,
    video_key,
    video_names,
    write_json,
)
from .validation import dataset_errors, wrong_file
from .videos import VideoPart, can_be_joined, join_videos

_LOG = logging.getLogger("hal.recording")


def merge(
    parts: Sequence[str | Path | Dataset],
    out: str | Path,
    *,
    key: Callable[[Episode], Any] | None = None,
    label: Callable[[Episode], EpisodeLabel | None] | None = None,
    view: Callable[[Episode], Episode] = lambda episode: episode,
    on_episode: Callable[[int, int], object] = lambda done, total: None,
) -> int:
    """Merge datasets into one. The parts are only read; the result appears when it is complete.

    Args:
        parts: The datasets, or their folders. A :class:`Dataset` must not have changed since it was opened.
        out: Folder of the result: a new one, or one of the parts, which is replaced. Files in it that are no part of a
            dataset, such as notes, stay.
        key: Sorts the episodes; of several with the same key the first is kept. None for the order of the parts.
        label: Returns the task and the mark of an episode in the result; None leaves it out. By default its own.
        view: Returns an episode as it is written (:func:`~hal.recording.trim`).
        on_episode: Called with the number of merged episodes and of all, after each.

    Returns:
        The number of episodes in the result.

    Raises:
        CommandError: A part has unfinished episodes (code ``unfinished_episodes``), no episode (``no_episodes``) or
            another format than the first (``other_dataset``), or has changed (``dataset_changed``); or ``out`` exists
            (``output_exists``), or is a mount point (``mount_point``).
        DatasetError: A part is damaged.
        OSError: The disk refuses.
    """
    require_libraries()
    target = DatasetLayout(Path(out).expanduser().resolve())  # not through a link: folders beside it are renamed
    folders = [part.root if isinstance(part, Dataset) else part for part in parts]
    layouts = [DatasetLayout(Path(folder).expanduser().resolve()) for folder in folders]
    replaces = target.root in [layout.root for layout in layouts]
    if target.root.is_mount():
        raise CommandError(
            f"{target.root} is a mount point, which cannot be replaced; keep datasets in folders of it",
            code="mount_point",
        )
    if not replaces and target.root.exists() and (not target.root.is_dir() or any(target.root.iterdir())):
        raise CommandError(f"{target.root} exists; choose a new folder", code="output_exists")
    with contextlib.ExitStack() as locks:
        for layout in {layout.root: layout for layout in layouts}.values():
            if not layout.root.is_dir():
                raise CommandError(f"there is no folder {layout.root}", code="no_folder")
            refuse_foreign(layout)
            locks.enter_context(lock_dataset(layout, only_read=not (replaces and layout.root == target.root)))
            if layout.partials():
                raise CommandError(
                    f"{layout.root} has an unfinished episode or change; finish with: hal review {layout.root} "
                    "--repair",
                    code="unfinished_episodes",
                )
        for part in parts:
            if isinstance(part, Dataset) and part.has_changed():
                raise CommandError(
                    f"{part.root} has changed since it was opened; nothing was done", code="dataset_changed"
                )
        sources = _sources(layouts, key, label or _label, view)
        building = locks.enter_context(building_folder(target, "merging"))
        DatasetBuilder(building, sources).build(on_episode)
        if replaces:
            _keep_other_files(target, building)
        os.sync()  # the parts may be removed next
        put_in_place(building.root, target.root, replaces=replaces)
    return len(sources)


def _keep_other_files(old: DatasetLayout, new: DatasetLayout) -> None:
    """Link the files that are no part of a dataset, such as notes, into the dataset that takes its place."""

    def refuse(error: OSError) -> None:
        raise error

    old.sweep()
    own = {*old.finished(), *old.commons(), old.info, old.stats, old.tasks, old.episodes / ".lock"}
    for folder, folders, files in os.walk(old.root, onerror=refuse):
        links = [name for name in folders if Path(folder, name).is_symlink()]
        for path in (Path(folder, name) for name in (*files, *links)):
            target = new.root / path.relative_to(old.root)
            if path in own or target.exists():
                continue
            if path.is_symlink():
                target.parent.mkdir(parents=True, exist_ok=True)
                target.symlink_to(path.readlink())
            else:
                link_file(path, target)


def extract(dataset: str | Path | Dataset, episodes: Collection[int], out: str | Path) -> int:
    """Write a new dataset of some episodes of another one, which is only read.

    Args:
        dataset: The dataset, or its folder.
        episodes: Numbers of the episodes.
        out: Folder of the result: a new one, or that of the dataset, which then keeps only these episodes.

    Returns:
        The number of episodes in the result.

    Raises:
        CommandError: There is no such episode (code ``no_episodes``); otherwise as :func:`merge`.
        DatasetError: The dataset is damaged.
    """
    opened = open_dataset(dataset)
    chosen = existing_episodes(opened, episodes)
    return merge([opened], out, label=lambda episode: _label(episode) if episode.number in chosen else None)


def delete_episodes(dataset: str | Path | Dataset, episodes: Collection[int]) -> int:
    """Delete episodes; those after them get lower numbers. Return the number of episodes that are left.

    Raises:
        CommandError: There is no such episode, or none would be left (code ``no_episodes``); otherwise as
            :func:`merge`.
        DatasetError: The dataset is damaged.
    """
    opened = open_dataset(dataset)
    doomed = existing_episodes(opened, episodes)
    return merge([opened], opened.root, label=lambda episode: None if episode.number in doomed else _label(episode))


def set_task(dataset: str | Path | Dataset, task: str, episodes: Collection[int] | None = None) -> None:
    """Change the task of episodes; None for all. Raises as :func:`extract`."""
    opened = open_dataset(dataset)
    chosen = range(len(opened)) if episodes is None else existing_episodes(opened, episodes)
    merge(
        [opened],
        opened.root,
        label=lambda episode: EpisodeLabel(task, episode.success) if episode.number in chosen else _label(episode),
    )


def pack(dataset: str | Path) -> int:
    """Join the files of episodes that were recorded one by one: rows, index, and videos up to :data:`VIDEO_MB`.

    Nothing is encoded again, and large files are linked, so that it takes as long as the new episodes need. The
    recorder does it when :data:`LOOSE` of them have come together.

    Returns:
        The number of episodes.

    Raises as :func:`merge`.
    """
    return merge([dataset], dataset)


LOOSE = 100
"""Episodes with files of their own from which a recorder joins them when it is closed."""


def pack_if_loose(dataset: str | Path) -> None:
    """Call :func:`pack` if many episodes have files of their own, and no large file would be copied.

    Never raises; what cannot be joined stays.
    """
    try:
        episodes = Dataset(dataset).episodes if DatasetLayout(dataset).info.exists() else ()
        if episodes and episodes[-1].place.data[0] + 1 - -(-len(episodes) // GROUP) >= LOOSE:
            _check_links(DatasetLayout(Path(dataset).expanduser().resolve()))
            pack(dataset)
    except Exception as error:  # the recorder is closed, and every episode saved
        _LOG.warning("the files of %s were not joined: %s", dataset, error)


def _check_links(layout: DatasetLayout) -> None:
    """Raise OSError if files cannot be linked into a folder beside the dataset, as from a mount point."""
    probe = layout.beside(f"link-{os.getpid()}")
    os.link(layout.info, probe)
    probe.unlink()


def _label(episode: Episode) -> EpisodeLabel:
    return EpisodeLabel(episode.task, episode.success)


def open_dataset(dataset: str | Path | Dataset) -> Dataset:
    """Return a dataset, opened if it is a folder."""
    return dataset if isinstance(dataset, Dataset) else Dataset(dataset)


def _sources(
    layouts: Sequence[DatasetLayout],
    key: Callable[[Episode], Any] | None,
    label: Callable[[Episode], EpisodeLabel | None],
    view: Callable[[Episode], Episode],
) -> list[EpisodeSource]:
    """Return the episodes of all parts, in the order of the result. Raises CommandError if their formats differ."""
    datasets = [Dataset(layout.root) for layout in layouts]
    for layout, dataset in zip(layouts, datasets, strict=True):
        check_next_episode(layout, dataset.info)  # episodes that the index lacks would be lost
        places = [(episode.number, episode.place) for episode in dataset.episodes]
        if strays := stray_files(layout, places, video_names(dataset.info["features"])):
            text = "belongs to no episode and would be lost: move it"
            raise wrong_file(layout, strays[0], text, code="index_wrong")
    for dataset in datasets[1:]:
        about = (each.episodes[0].info for each in (datasets[0], dataset))
        found = [*format_differences(datasets[0].info, dataset.info), *hardware_differences(*about)]
        if found:
            raise CommandError(
                f"{datasets[0].root} (there) and {dataset.root} (here) differ: {'; '.join(found)}",
                code="other_dataset",
            )
    sources = [
        EpisodeSource(dataset, view(episode), new)
        for dataset in datasets
        for episode in dataset.episodes
        if (new := label(episode)) is not None
    ]
    if not sources:
        raise CommandError("no episode would be left: remove the folder instead", code="no_episodes")
    if key is not None:
        first: dict[Any, EpisodeSource] = {}
        for source in sources:
            first.setdefault(key(source.episode), source)
        sources = [first[value] for value in sorted(first)]
    if len(sources) > CHUNK * CHUNK:
        raise CommandError(f"{len(sources)} episodes are too many for one dataset", code="too_many")
    return sources


# The result: file by file, each a link where it stays as it is.

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
        write_json(self.layout.info, info | totals(count, self.starts[-1], len(self.tasks)))

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
                with dataset_errors(self.layout, runs[0].part.path):
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
            with dataset_errors(episode._layout, path, episode.number):
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
            with dataset_errors(self.sources[begin].episode._layout, kept):
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
        for path in episode.picture_files(".depth"):
            with dataset_errors(episode._layout, path, episode.number):
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
        with dataset_errors(episode._layout, path, episode.number):
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
            with dataset_errors(episode._layout, path, episode.number):
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
                raise wrong_file(episode._layout, path, f"has no statistics of {', '.join(missing)}", episode.number)
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
            with dataset_errors(episode._layout, episode._layout.tasks):
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
                with dataset_errors(episode._layout, episode._layout.root / episode.data_file, episode.number):
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
