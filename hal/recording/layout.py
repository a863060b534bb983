"""Where everything of a dataset lies, and how a file or a folder is brought there so that a crash leaves it whole."""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import shutil
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from ..errors import CommandError
from .columns import video_key

__all__ = ["Layout", "locked", "read_json", "sync", "write_json"]

CHUNK = 1000
"""Files in a folder."""
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
    with (layout.episodes / ".lock").open("w") as file:
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
    """What a JSON file holds."""
    return json.loads(path.read_text(encoding="utf-8"))


def write_json(path: Path, data: Any) -> None:
    """Write it whole or not at all."""
    beside = path.with_name(path.name + ".new")
    beside.write_text(json.dumps(data, indent=1, default=str) + "\n", encoding="utf-8")
    sync(beside)
    beside.replace(path)
    sync(path.parent)
