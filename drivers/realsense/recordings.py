"""The files that a camera records to, each of which one camera at a time may write."""

from __future__ import annotations

import hashlib
import os
import socket
from contextlib import suppress
from pathlib import Path

from hal.errors import ControlTaken, NotSupported
from hal.lock import DeviceLock

__all__ = ["Recordings"]

_NAMES = "/proc/net/unix"
_LONGEST = 48
"""Letters of a camera's name that fit into a socket's."""


class Recordings:
    """``wanted`` for the first recording of a program, and the next free number after it for those that follow.

    Every file is claimed before anything is done to it, and until :meth:`end` or the end of the process: two cameras
    with one file would otherwise delete what the other one writes.
    """

    def __init__(self, wanted: str, camera: str, overwrite: bool) -> None:
        self._wanted = Path(wanted)
        self._camera = camera
        self._overwrite = overwrite
        self._claims: dict[Path, _Writing] = {}

    def next(self, first: bool) -> str:
        """The file for the recording that begins now. ``first``: it is the first one of the program.

        Raises NotSupported where the first one is there and must not be overwritten, or where its folder is missing,
        and ControlTaken while another camera writes it.
        """
        path = self._wanted
        if not path.parent.is_dir():
            raise NotSupported(f"there is no folder {path.parent} for the recording")
        self._claim(path)
        if first and self._overwrite:
            path.unlink(missing_ok=True)
        elif first and path.exists():
            raise NotSupported(f"{path} is there already: move it away, or say real: {{overwrite: true}}")
        number = 2
        while path.exists():
            path = self._wanted.with_name(f"{self._wanted.stem}-{number}{self._wanted.suffix}")
            number += 1
        self._claim(path)
        return str(path)

    def _claim(self, path: Path) -> None:
        if path not in self._claims:
            self._claims[path] = _Writing(path, self._camera)

    def end(self) -> None:
        """Let go of all of them. Idempotent."""
        for claim in self._claims.values():
            claim.release()
        self._claims.clear()


class _Writing:
    """One file, held for one camera: a claim on it, and beside that a socket whose name says which camera it is."""

    def __init__(self, path: Path, camera: str) -> None:
        """Raises ControlTaken, which names both cameras."""
        key = "recording-" + hashlib.sha256(os.path.realpath(path).encode()).hexdigest()[:32]
        try:
            self._claim = DeviceLock(key, str(path))
        except ControlTaken:
            both = f"camera {camera} is to record to {path}, and {_writer(key)} does so already"
            raise ControlTaken(f"{both}: give each a file of its own") from None
        self._name = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
        with suppress(OSError):  # it is only for the error's words
            self._name.bind(f"\0hal-{key}-{camera[:_LONGEST]}")

    def release(self) -> None:
        """Let go. Idempotent."""
        self._name.close()
        self._claim.release()


def _writer(key: str) -> str:
    """The camera that holds the file, in words."""
    mark = f"@hal-{key}-"
    with suppress(OSError), open(_NAMES, encoding="utf-8", errors="replace") as names:
        for line in names:
            _, found, camera = line.rstrip("\n").partition(mark)
            if found:
                return f"camera {camera}"
    return "another camera"
