"""An export while it is written: its contents, and an output that appears only when complete."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import CommandError
from ..layout import STATE, put_in_place
from .actions import ActionForm, rotation_observations
from .content import EpisodeContent, observations


@dataclass
class ExportJob:
    """The task of a format's module: episodes and options of one export."""

    source: Path
    contents: tuple[EpisodeContent, ...]
    camera: str | None = None
    gripper_camera: str | None = None
    valid: float = 0.1
    action: ActionForm = field(default_factory=ActionForm)
    on_episode: Callable[[int, int], object] = lambda done, total: None
    """Called with the number of written episodes and of all, after each."""
    notes: list[str] = field(default_factory=list)
    """Warnings to read before training on it."""

    def episodes(self) -> Iterator[EpisodeContent]:
        """Yield the episodes, each of which is to be written before the next one."""
        for done, content in enumerate(self.contents, start=1):
            yield content
            self.on_episode(done, len(self.contents))

    def check(self) -> None:
        """Check that the episodes can be exported together.

        Raises:
            CommandError: An episode has no arm (code ``no_arm``), or pictures unlike the first (``episodes_differ``).
        """
        first = self.contents[0]
        kept = _streams(first)
        for content in self.contents:
            number = content.episode.number
            if not content.arms:
                raise CommandError(f"episode {number} has no arm", code="no_arm")
            if (found := _streams(content)) != kept:
                odd = sorted(found.keys() ^ kept.keys()) or sorted(key for key in kept if found[key] != kept[key])
                raise CommandError(
                    f"episodes {first.episode.number} and {number} differ in {', '.join(odd)}; "
                    "leave some out with --episodes, --cameras or --no-depth",
                    code="episodes_differ",
                )

    def unknown(self, content: EpisodeContent, columns: dict[str, NDArray[Any]]) -> None:
        """Note columns with unknown values (NaN): training on them fails silently."""
        for name, values in columns.items():
            if np.issubdtype(values.dtype, np.floating) and not np.isfinite(values).all():
                self.notes.append(f"{name} of episode {content.episode.number} has unknown values (NaN)")

    def observations(self, content: EpisodeContent) -> dict[str, NDArray[Any]]:
        """Return the observations of an episode, and the orientation of its tcp in the form of the actions."""
        return observations(content) | rotation_observations(content, self.action.rotation)

    def about(self) -> dict[str, Any]:
        """Return the metadata of all episodes together."""
        first = self.contents[0]
        episode = first.episode
        return {
            "source": str(self.source),
            "fps": episode.fps,
            "robot_type": episode.info.get("robot_type"),
            "arms": [{"name": arm.name, "joints": first.joints(arm)} for arm in first.arms],
            "action": self.action._asdict(),
            "action_names": self.action.names(first),
            "state_names": episode.names(STATE),
            "objects": list(first.objects),
            "cameras": first.lenses(),
            "tasks": sorted({content.episode.task for content in self.contents}),
        }


def _streams(content: EpisodeContent) -> dict[str, tuple[int, ...]]:
    return {f"{stream.what} of {stream.camera}": stream.shape for stream in content.pictures}


@contextlib.contextmanager
def write_atomically(path: Path, *, force: bool, is_ours: Callable[[Path], bool]) -> Iterator[Path]:
    """Yield a temporary path beside ``path``. It is renamed at the end, and removed after an error.

    ``force`` replaces what ``is_ours`` says is an export.

    Raises:
        CommandError: Something exists at ``path`` (code ``exists``), or it is not an export (``not_an_export``).
    """
    _check(path, force=force, is_ours=is_ours)
    path.parent.mkdir(parents=True, exist_ok=True)
    _sweep(path)
    beside = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        yield beside
        _check(path, force=force, is_ours=is_ours)  # it may have come meanwhile
        if path.is_dir():
            put_in_place(beside, path, replaces=True)
        else:
            beside.replace(path)
    except BaseException:
        _remove(beside)
        raise


def _check(path: Path, *, force: bool, is_ours: Callable[[Path], bool]) -> None:
    if not path.exists():
        return
    if not force:
        raise CommandError(f"{path} exists; overwrite it with --force", code="exists")
    if path.is_symlink() or not is_ours(path):
        raise CommandError(
            f"{path} was not written by this program, so it is not overwritten; choose another name",
            code="not_an_export",
        )


def _sweep(path: Path) -> None:
    """Remove the temporary files of a killed program."""
    name = re.compile(rf"\.{re.escape(path.name)}\.(\d+)\.partial")
    for file in path.parent.iterdir():
        match = name.fullmatch(file.name)
        if match is not None and not Path(f"/proc/{match[1]}").exists():
            _remove(file)


def _remove(path: Path) -> None:
    if path.is_dir():
        shutil.rmtree(path, ignore_errors=True)
    else:
        path.unlink(missing_ok=True)
