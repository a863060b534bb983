"""The process that writes an episode: it encodes, compresses and appends, so that neither the app nor a servo waits.

When the app is gone it writes what still lies in the queue, closes the files and ends: nothing of what was recorded
before is lost. When the disk fails it says so, closes what it has, and writes no more.
"""

from __future__ import annotations

import contextlib
import os
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..errors import CommandError, HalError
from ..host.process import Channel, SharedMemory, serve
from ..host.scheduling import yield_to_others
from .codecs import choose_encoder
from .dataset import check_compatible
from .finish import CLOSING, finalise, recover_all
from .index import check_next, read_index
from .layout import CameraSetup, Layout, locked, require, write_json
from .live import RESERVE, LiveFolder
from .ring import RowRing

__all__ = ["free_bytes", "main"]

_NICE = 2
"""After the servo, before the renderer: a picture that is drawn late is late, a row that is not written is lost."""
_WAIT = 0.2
"""s without a word from the app after which the disk is looked at all the same."""
_LOOK = 1.0
"""s between two looks at the disk."""


class Writer:
    """Serves one recorder."""

    def __init__(self, channel: Channel, memory: SharedMemory, config: dict[str, Any]) -> None:
        self.channel = channel
        self.layout = Layout(config["out"])
        cameras = [CameraSetup(*camera) for camera in config["cameras"]]
        self.ring = RowRing(memory.buffer, config["width"], cameras, config["slots"])
        self.width: int = config["width"]
        self.stop_free: int = config["stop_free"]
        self.live: LiveFolder | None = None
        self.failed = False
        self._looked = 0.0
        self._lock = contextlib.ExitStack()

    def run(self) -> None:
        """Serve until the app closes this process or is gone, then write the rows that still wait."""
        methods: dict[str, Callable[..., Any]] = {
            "begin": self._do_begin,
            "save": self._do_save,
            "discard": self._do_discard,
            "row": lambda: None,  # only wakes this process
        }
        try:
            serve(self.channel, methods, self._drain_and_wait)
            self.drain()
        finally:
            if self.live is not None:
                self.live.close()
            self._lock.close()

    def _drain_and_wait(self) -> float:
        self.drain()
        return _WAIT

    # Rows.

    def drain(self) -> None:
        """Write every row that waits."""
        while (slot := self.ring.oldest()) is not None:
            if self.live is not None and not self.failed:
                try:
                    self.live.add(slot)
                except Exception as error:  # a disk that is full, and whatever an encoder makes of that
                    self._fail(f"{self.layout.root} does not take it any more: {error}")
            self.ring.used()
            self._look()
        self._look()

    def _look(self) -> None:
        """At the disk, now and then."""
        now = time.monotonic()
        if self.live is None or self.failed or now - self._looked < _LOOK:
            return
        self._looked = now
        if not self.live.in_place:
            kept = self.live.rescue()
            self._fail(f"{self.live.folder} is gone" + ("; what was recorded was written there anew" if kept else ""))
            return
        free = free_bytes(self.layout.root)
        self.ring.say(free_bytes=free)
        if free < self.stop_free:
            self._fail(f"only {free / 1e9:.2f} GB are free on the disk of {self.layout.root}; free some")

    def _fail(self, trouble: str) -> None:
        self.failed = True
        if self.live is not None:
            self.live.close()
        self.ring.say(trouble=trouble)

    # What the app asks for.

    def _do_begin(self, about: dict[str, Any]) -> dict[str, Any]:
        self.drain()
        if self.live is not None:  # the app gave up in the middle of a start
            self._closed()
        try:
            return self._begin(about)
        except Exception as error:
            self._lock.close()  # whoever mends it needs it
            if isinstance(error, OSError):
                raise CommandError(f"cannot record into {self.layout.root}: {error}") from error
            raise

    def _begin(self, about: dict[str, Any]) -> dict[str, Any]:
        layout = self.layout
        free = free_bytes(layout.root)
        if free < self.stop_free:
            raise CommandError(f"only {free / 1e9:.2f} GB are free on the disk of {layout.root}; free some")
        self._lock.close()  # the folder may have been deleted meanwhile, and the lock with it
        self._lock.enter_context(locked(layout))
        notes = recover_all(layout)
        cameras = [CameraSetup(*camera) for camera in about["cameras_kept"]]
        check_compatible(layout, about["features"], about["fps"], about["robot_type"], cameras)
        info = read_index(layout)
        check_next(layout, info)
        number = int(info["total_episodes"]) if info is not None else 0
        self.failed = False
        self.ring.say(free_bytes=free, trouble="")
        self.live = LiveFolder(layout.partial(number), about, self.width)
        return {"episode": number, "notes": notes}

    def _do_save(self, closing: dict[str, Any]) -> int | None:
        self.drain()
        live = self._closed()
        try:
            (live.folder / RESERVE).unlink(missing_ok=True)
            write_json(live.folder / CLOSING, closing)
            return finalise(self.layout, live.folder)
        except Exception as error:  # a disk that is full, and whatever a library makes of that
            stays = f"what was recorded stays in {live.folder}: mend that, then record on, or call recover()"
            raise HalError(f"the episode cannot be finished now: {error}; {stays}") from error

    def _do_discard(self) -> None:
        self.drain()
        live = self._closed()
        if live.folder.exists():
            self.layout.remove(live.folder)

    def _closed(self) -> LiveFolder:
        live, self.live = self.live, None
        if live is None:
            raise CommandError("no episode is open")
        live.close()
        return live


def free_bytes(path: Path) -> int:
    """Free space where ``path`` is, or will be."""
    while not path.exists() and path != path.parent:
        path = path.parent
    found = os.statvfs(path)
    return found.f_bavail * found.f_frsize


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process; the memory is that of the rows."""
    require()
    encoder = choose_encoder(config["codec"])
    import pyarrow.parquet  # noqa: F401  # before anything is recorded, not in the middle of it

    yield_to_others(_NICE)
    writer = Writer(channel, memories[0], config)
    channel.send({"ready": {"encoder": encoder, "free_bytes": free_bytes(writer.layout.root)}})
    writer.run()
