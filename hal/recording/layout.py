"""Where everything of a dataset lies, and how a file or a folder is brought there so that a crash leaves it whole."""

from __future__ import annotations

import contextlib
import fcntl
import json
import math
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import CommandError
from .columns import video_key

__all__ = ["LIST", "Layout", "locked", "read_json", "sync", "write_json"]

CHUNK = 1000
"""Files in a folder."""
LIST = "list.json"
"""In a partial folder: which of its files goes where. From then on the episode counts as saved."""
_DIGITS = "[0-9]" * 3
_ABOUT_FILES = f"{_DIGITS}{_DIGITS}.json"
_CHUNK_FILES = f"chunk-{_DIGITS}/file-{_DIGITS}"
_PATIENCE = 5.0
"""s that somebody else may take to let go of a dataset: the writer of a program that was killed just ends."""


class Layout:
    """The files of one dataset. One file of each kind per episode, so that no episode can harm another."""

    def __init__(self, root: str | Path) -> None:
        self.root = Path(root).expanduser().absolute()
        self.info = self.root / "meta" / "info.json"
        self.stats = self.root / "meta" / "stats.json"
        self.tasks = self.root / "meta" / "tasks.parquet"
        self.episodes = self.root / "episodes"
        """Ours: a JSON file per episode, and what is being recorded."""

    @staticmethod
    def _file(number: int) -> str:
        return f"chunk-{number // CHUNK:03d}/file-{number % CHUNK:03d}"

    def data(self, number: int) -> Path:
        """Rows of an episode."""
        return self.root / "data" / f"{self._file(number)}.parquet"

    def entry(self, number: int) -> Path:
        """What LeRobot knows of an episode: one row."""
        return self.root / "meta" / "episodes" / f"{self._file(number)}.parquet"

    def video(self, camera: str, number: int) -> Path:
        """Colour of a camera."""
        return self.root / "videos" / video_key(camera) / f"{self._file(number)}.mp4"

    def depth(self, camera: str, number: int) -> Path:
        """Depth of a camera."""
        return self.root / "depth" / camera / f"{self._file(number)}.depth"

    def about(self, number: int) -> Path:
        """What else is known of an episode."""
        return self.episodes / f"{number:06d}.json"

    def partial(self, number: int) -> Path:
        """The folder of an episode that is not part of the dataset yet."""
        return self.episodes / f"{number:06d}.partial"

    def partials(self) -> list[Path]:
        """All of them, oldest first."""
        return sorted(self.episodes.glob("*.partial"))

    @property
    def interrupted(self) -> list[Path]:
        """Partial folders of episodes that count as saved, and whose files are not all in their places yet."""
        return [partial for partial in self.partials() if (partial / LIST).exists()]

    def files_of(self, number: int) -> list[Path]:
        """Return where an episode's files are, or would be; of videos and depth those that exist."""
        file = self._file(number)
        found = [self.data(number), self.about(number), self.entry(number)]
        return found + [path for kind in ("videos", "depth") for path in self.root.glob(f"{kind}/*/{file}.*")]

    def finished(self) -> Iterator[Path]:
        """Yield every file of a finished episode."""
        yield from self.episodes.glob(_ABOUT_FILES)
        for kind, ending in (
            ("data", "parquet"),
            ("meta/episodes", "parquet"),
            ("videos/*", "mp4"),
            ("depth/*", "depth"),
        ):
            yield from self.root.glob(f"{kind}/{_CHUNK_FILES}.{ending}")

    @staticmethod
    def number_of(path: Path) -> int:
        """Return the number of the episode that a file of :meth:`finished` belongs to."""
        if path.suffix == ".json":
            return int(path.stem)
        return CHUNK * int(path.parent.name.removeprefix("chunk-")) + int(path.stem.removeprefix("file-"))

    def numbers(self) -> list[int]:
        """Return the numbers of the episodes whose own file is there, in order."""
        return sorted(int(path.stem) for path in self.episodes.glob(_ABOUT_FILES))

    def target(self, name: str) -> Path:
        """Return where a file of a partial folder's list goes. ValueError for a place outside of the dataset."""
        path = self.root / name
        if Path(name).is_absolute() or ".." in Path(name).parts or path == self.root:
            raise ValueError(f"{name!r} is not a place in the dataset")
        there = path.parent
        while not there.exists():
            there = there.parent
        if not there.resolve().is_relative_to(self.root.resolve()):
            raise ValueError(f"{name!r} leads out of the dataset through a link")
        return path

    def remove(self, partial: Path) -> None:
        """Remove a partial folder as a whole: whoever dies in the middle leaves nothing that looks like an episode."""
        gone = partial.with_suffix(".removed")
        shutil.rmtree(gone, ignore_errors=True)
        partial.rename(gone)
        sync(self.episodes)
        shutil.rmtree(gone, ignore_errors=True)

    def sweep(self) -> None:
        """Remove what a program that was killed did not get to."""
        for gone in self.episodes.glob("*.removed"):
            shutil.rmtree(gone, ignore_errors=True)


@contextlib.contextmanager
def locked(layout: Layout) -> Iterator[None]:
    """Nobody else adds to this dataset meanwhile; the lock goes with the process. CommandError where somebody does."""
    layout.episodes.mkdir(parents=True, exist_ok=True)
    if layout.episodes.is_symlink():
        raise CommandError(f"{layout.episodes} is a link; nothing is recorded through it")
    fd = os.open(layout.episodes / ".lock", os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW, 0o666)
    with os.fdopen(fd, "w") as file:
        deadline = time.monotonic() + _PATIENCE
        while True:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
                break
            except BlockingIOError:
                if time.monotonic() > deadline:
                    raise CommandError(f"another program is recording into {layout.root}") from None
                time.sleep(0.05)
        yield


def sync(path: Path) -> None:
    """Wait until a file or a folder is on the disk."""
    fd = os.open(path, os.O_RDONLY)
    try:
        os.fsync(fd)
    finally:
        os.close(fd)


def read_json(path: Path) -> Any:
    """Return what a JSON file holds."""
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(path: Path, data: Any) -> None:
    """Write a JSON file, whole or not at all. Numbers that are not finite become null: JSON has no NaN."""
    beside = path.with_name(path.name + ".new")
    beside.unlink(missing_ok=True)
    with beside.open("x", encoding="utf-8") as file:
        file.write(json.dumps(_finite(data), indent=1, default=str, allow_nan=False) + "\n")
    sync(beside)
    beside.replace(path)
    sync(path.parent)


def _finite(data: Any) -> Any:
    if isinstance(data, float):
        return data if math.isfinite(data) else None
    if isinstance(data, dict):
        return {key: _finite(value) for key, value in data.items()}
    if isinstance(data, (list, tuple)):
        return [_finite(value) for value in data]
    return data
