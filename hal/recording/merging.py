"""Merge datasets that were recorded with the same rig into one, and curate a dataset: delete, extract, re-task.

Rows are renumbered, statistics are combined from those of the episodes, and small videos are joined. Large videos,
depth files and rows that stay as they are become hard links to those of the parts. Nothing is encoded again.
"""

from __future__ import annotations

import contextlib
import logging
import os
from collections.abc import Callable, Collection, Sequence
from pathlib import Path
from typing import Any

from ..errors import CommandError, DatasetError
from .building import DatasetBuilder, EpisodeLabel, EpisodeSource, link_file
from .changing import existing_episodes, refuse_foreign
from .checking import format_differences
from .dataset import Dataset, Episode
from .index import check_next_episode, stray_files
from .layout import (
    CHUNK,
    GROUP,
    DatasetLayout,
    building_folder,
    finish_replacement,
    lock_dataset,
    put_in_place,
    require_libraries,
    video_names,
)

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
    finish_replacement(out)
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
                    f"{layout.root} has an unfinished episode or change; finish it first, with recover()",
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
            file = str(strays[0].relative_to(layout.root))
            raise DatasetError("belongs to no episode and would be lost: move it", file=file, code="index_wrong")
    for dataset in datasets[1:]:
        found = format_differences(datasets[0].info, dataset.info) + _camera_differences(datasets[0], dataset)
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


def _camera_differences(one: Dataset, other: Dataset) -> list[str]:
    """Return the differences in the stored depth and streams, which ``meta/info.json`` does not show."""
    there, here = (
        {name: (camera.get("depth_unit_m"), camera.get("streams")) for name, camera in info.items()}
        for info in (one.episodes[0].info["cameras"], other.episodes[0].info["cameras"])
    )
    return [] if there == here else [f"depth and streams are {there} there, and {here} here"]
