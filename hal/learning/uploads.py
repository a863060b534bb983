"""Episodes of ``hal generate`` at an address, for workers that share no folder with the program.

A worker records into a temporary folder of its own computer. After each episode it uploads what is new or has changed
there as one ZIP file, which appears when it is complete; unpacked in their order, those of a worker are its dataset.
The address is one that fsspec_ opens: ``s3://bucket/run``, ``gs://bucket/run``, ``file:///shared/run`` ...

.. _fsspec: https://filesystem-spec.readthedocs.io
"""

from __future__ import annotations

import contextlib
import fcntl
import json
import os
import re
import shutil
import tempfile
import uuid
import zipfile
from collections import defaultdict
from collections.abc import Iterator, Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import CommandError, ConnectionLost, DriverMissing, import_library
from ..recording.layout import GROUP, file_version

_RECIPE = "recipe.json"
_NAME = re.compile(r"(?P<part>[0-9a-f]+)/\d{6}\.(?P<number>\d+)\.(?P<mark>none|false|true)\.zip")
"""Name of an uploaded file: its worker's part, its place there, the number of its episode, and the mark of that."""
_MARKS = {"none": None, "false": False, "true": True}
_SCRATCH = "hal-generate-"
_DOWNLOADS = 8
"""Parts that are downloaded at the same time."""


def is_address(folder: str) -> bool:
    """Return whether a text is an address of fsspec, and not a folder of this computer."""
    return "://" in folder


def _open_address(address: str) -> tuple[Any, str]:
    """Return the file system of an address, and the path there.

    Raises:
        DriverMissing: fsspec, or its package for this kind of address, is not installed.
        CommandError: The address is wrong (code ``bad_address``).
    """
    fsspec = import_library("fsspec", address, "robot-hal[ray]")
    try:
        system, path = fsspec.core.url_to_fs(address)
    except ImportError as error:  # such as "Install s3fs to access S3"
        raise DriverMissing(f"{address}: {error}", name=error.name) from error
    except ValueError as error:
        raise CommandError(f"{address}: {error}", code="bad_address") from error
    return system, path.rstrip("/")


class _Uploaded(NamedTuple):
    """One uploaded episode."""

    path: str
    part: str
    number: int
    mark: bool | None


class UploadedEpisodes:
    """The episodes at an address, as the program sees them.

    Raises as :func:`_open_address`, and ConnectionLost if the address cannot be used (code ``upload_failed``); so may
    all methods.
    """

    def __init__(self, address: str, recipe: Mapping[str, Any]) -> None:
        self.address = address
        self._system, self._root = _open_address(address)
        place = f"{self._root}/{_RECIPE}"
        with _lost(address):
            if not self._system.exists(place):
                self._system.makedirs(self._root, exist_ok=True)
                self._system.pipe_file(place, json.dumps(recipe).encode())
            self.recipe: Any = json.loads(self._system.cat_file(place))
            """That of the episodes there."""

    def marks(self) -> dict[int, bool | None]:
        """Return the number of each episode that is there, with its mark."""
        with _lost(self.address):
            return {one.number: one.mark for one in self._find()}

    def download(self, folder: Path) -> list[Path]:
        """Download all episodes into new folders in ``folder``, and return these: the workers' datasets."""
        parts: dict[str, list[str]] = defaultdict(list)
        with _lost(self.address), ThreadPoolExecutor(_DOWNLOADS) as pool:
            for one in sorted(self._find()):
                parts[one.part].append(one.path)
            return list(pool.map(lambda part: self._download_part(folder / part, parts[part]), parts))

    def remove(self) -> None:
        """Remove the episodes and the recipe."""
        with _lost(self.address):
            for path in (*(one.path for one in self._find()), f"{self._root}/{_RECIPE}"):
                self._system.rm_file(path)

    def _find(self) -> list[_Uploaded]:
        self._system.invalidate_cache()
        found = []
        for path in self._system.find(self._root):
            if name := _NAME.fullmatch("/".join(path.split("/")[-2:])):
                found.append(_Uploaded(path, name["part"], int(name["number"]), _MARKS[name["mark"]]))
        return found

    def _download_part(self, folder: Path, paths: list[str]) -> Path:
        folder.mkdir(parents=True)
        with tempfile.TemporaryDirectory(dir=folder.parent) as beside:
            packed = Path(beside, "episode.zip")
            for path in paths:
                self._system.get_file(path, str(packed))
                with zipfile.ZipFile(packed) as file:
                    file.extractall(folder)
        return folder


class EpisodeUploader:
    """A worker's dataset in a temporary folder, and its uploads.

    What workers that were killed left in the temporary folder of this computer is removed. Raises as
    :func:`_open_address`.
    """

    def __init__(self, address: str) -> None:
        self._system, self._root = _open_address(address)
        _remove_scratch_of_the_dead()
        new = Path(tempfile.mkdtemp(prefix="hal-new-"))
        self._lock = _lock(new)
        self._scratch = new.rename(new.with_name(f"{_SCRATCH}{uuid.uuid4().hex}"))  # only now others may look at it
        self.begin()

    def begin(self) -> None:
        """Begin a new dataset in place of the present one, which nothing may be writing."""
        self._part = uuid.uuid4().hex
        self.folder = self._scratch / self._part
        """The dataset."""
        self._seen: dict[Path, tuple[int, int] | None] = {}
        self._count = 0
        for path in self._scratch.iterdir():
            if path.is_dir():
                shutil.rmtree(path)

    @property
    def is_full(self) -> bool:
        """Whether the dataset should be followed by a new one, so that the temporary folder does not grow."""
        return self._count >= GROUP

    def upload(self, number: int, mark: bool | None) -> None:
        """Upload the last episode of the dataset. Raises ConnectionLost if it cannot be (code ``upload_failed``)."""
        files = [path for path in self.folder.rglob("*") if path.is_file() and path.name != ".lock"]
        new = {path: file_version(path) for path in files}
        mark_name = next(name for name, value in _MARKS.items() if value is mark)
        place = f"{self._root}/{self._part}/{self._count:06d}.{number}.{mark_name}.zip"
        packed = self._scratch / "episode.zip"
        with _lost(f"episode {number} was not uploaded"):
            with zipfile.ZipFile(packed, "w") as file:  # not compressed: the files are
                for path in files:
                    if self._seen.get(path) != new[path]:
                        file.write(path, path.relative_to(self.folder))
            self._system.makedirs(f"{self._root}/{self._part}", exist_ok=True)
            self._system.put_file(str(packed), f"{place}.part")
            self._system.mv(f"{place}.part", place)
        packed.unlink()
        self._seen, self._count = new, self._count + 1

    def close(self) -> None:
        """Remove the temporary folder, into which nothing may be writing."""
        shutil.rmtree(self._scratch, ignore_errors=True)
        os.close(self._lock)


@contextlib.contextmanager
def _lost(what: str) -> Iterator[None]:
    """Raise the errors of a file system, each of which has its own, as ConnectionLost (code ``upload_failed``)."""
    try:
        yield
    except Exception as error:
        raise ConnectionLost(f"{what}: {type(error).__name__}: {error}", code="upload_failed") from error


def _lock(folder: Path) -> int:
    """Lock a folder until this process ends; return the lock's descriptor. Raises OSError if another process has it."""
    lock = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        os.close(lock)
        raise
    return lock


def _remove_scratch_of_the_dead() -> None:
    for folder in Path(tempfile.gettempdir()).glob(f"{_SCRATCH}*"):
        try:
            lock = _lock(folder)
        except OSError:  # a worker is alive, or it is another user's
            continue
        shutil.rmtree(folder, ignore_errors=True)
        os.close(lock)
