"""A file or folder that appears when it is whole, and takes nobody's place unasked."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ...errors import CommandError
from ..layout import ACTION, STATE
from .content import EpisodeContent, Pictures

__all__ = [
    "Job",
    "Progress",
    "fresh",
]

# [job.py] All that an export is made of, and how far it is.


class Progress(NamedTuple):
    """How far an export is."""

    episode: int
    """Number of the episode that is being written."""
    share: float
    """Of all of it, 0..1."""


@dataclass
class Job:
    """What is to be written, for the module that writes it."""

    source: Path
    contents: tuple[EpisodeContent, ...]
    camera: str | None = None
    gripper_camera: str | None = None
    valid: float = 0.1
    report: Callable[[Progress], None] | None = None
    notes: list[str] = field(default_factory=list)
    """What a person should know before training on it."""
    _done: int = 0

    def check(self) -> None:
        """CommandError where the episodes do not have the same pictures, or none of the arms' numbers."""
        first = self.contents[0]
        kept = _streams(first)
        for content in self.contents:
            number = content.episode.number
            if not content.arms:
                raise CommandError(f"episode {number} has no arm in it")
            if (found := _streams(content)) != kept:
                odd = sorted(found.keys() ^ kept.keys()) or sorted(key for key in kept if found[key] != kept[key])
                raise CommandError(
                    f"episodes {first.episode.number} and {number} differ in {', '.join(odd)}; "
                    "leave some out with --episodes, --cameras or --no-depth"
                )

    def unknown(self, content: EpisodeContent, columns: dict[str, NDArray[Any]]) -> None:
        """Note what holds values that were never known: training on them fails without a word."""
        for name, values in columns.items():
            if np.issubdtype(values.dtype, np.floating) and not np.isfinite(values).all():
                self.notes.append(f"{name} of episode {content.episode.number} has values that were not known (NaN)")

    def pictures(self, content: EpisodeContent, stream: Pictures) -> Iterator[NDArray[Any]]:
        """The pictures of a stream, one by one, while the person is told how far it is."""
        for picture in stream:
            yield picture
            self._step(content, 1)

    def numbers_done(self, content: EpisodeContent) -> None:
        """The numbers of an episode are written."""
        self._step(content, content.rows)

    def _step(self, content: EpisodeContent, count: int) -> None:
        self._done += count
        if self.report is not None:
            total = sum(each.rows * (1 + len(each.pictures)) for each in self.contents)
            self.report(Progress(content.episode.number, min(1.0, self._done / max(1, total))))

    def about(self) -> dict[str, Any]:
        """What a form says of all episodes together."""
        first = self.contents[0]
        episode = first.episode
        return {
            "source": str(self.source),
            "fps": episode.fps,
            "robot_type": episode.info.get("robot_type"),
            "arms": [{"name": arm.name, "joints": first.joints(arm)} for arm in first.arms],
            "action_names": episode.names(ACTION),
            "state_names": episode.names(STATE),
            "objects": list(first.objects),
            "cameras": first.lenses(),
            "tasks": sorted({content.episode.task for content in self.contents}),
        }


def _streams(content: EpisodeContent) -> dict[str, tuple[int, ...]]:
    return {f"{stream.what} of {stream.camera}": stream.shape for stream in content.pictures}


@contextlib.contextmanager
def fresh(path: Path, *, force: bool, is_ours: Callable[[Path], bool]) -> Iterator[Path]:
    """Another name beside ``path``, to write to; it is renamed at the end, and removed when something fails.

    CommandError where something is there already, unless ``force`` is given and ``is_ours`` knows it.
    """
    _check(path, force=force, is_ours=is_ours)
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep(path)
    beside = _beside(path, "partial")
    try:
        yield beside
        _check(path, force=force, is_ours=is_ours)  # it may have come meanwhile
        _replace(path, beside)
    except BaseException:
        _remove(beside)
        raise


def _replace(path: Path, beside: Path) -> None:
    if not path.is_dir():
        beside.replace(path)
        return
    old = _beside(path, "old")  # a folder that is not empty cannot be replaced at once
    path.rename(old)
    try:
        beside.rename(path)
    except BaseException:
        old.rename(path)
        raise
    _remove(old)


def _check(path: Path, *, force: bool, is_ours: Callable[[Path], bool]) -> None:
    if not path.exists():
        return
    if not force:
        raise CommandError(f"{path} is there already; --force overwrites it")
    if path.is_symlink() or not is_ours(path):
        raise CommandError(f"{path} was not written by this program, so it is not overwritten; choose another name")


def _beside(path: Path, what: str) -> Path:
    return path.with_name(f".{path.name}.{os.getpid()}.{what}")


def _sweep(path: Path) -> None:
    """Remove what a program that was killed did not get to, and put back what it had just moved away."""
    name = re.compile(rf"\.{re.escape(path.name)}\.(\d+)\.(partial|old)")
    for file in path.parent.iterdir():
        match = name.fullmatch(file.name)
        if match is None or Path(f"/proc/{match[1]}").exists():
            continue
        if match[2] == "old" and not path.exists():
            file.rename(path)
        else:
            _remove(file)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
