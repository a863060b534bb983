"""A file or folder that appears when it is whole, and takes nobody's place unasked."""

from __future__ import annotations

import contextlib
import os
import re
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

from ...errors import CommandError

__all__ = ["fresh"]


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
