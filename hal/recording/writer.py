"""The process that writes episodes: it encodes, compresses and appends, so that neither the app nor a servo waits.

If the app ends unexpectedly, the process writes the rows that are left in the queue, closes the files and exits:
nothing recorded before is lost. If the disk fails, it reports that, closes what it has, and writes no more.
"""

from __future__ import annotations

import contextlib
import shutil
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from ..errors import CommandError, HalError
from ..host.process import Channel, SharedMemory, serve
from ..host.scheduling import yield_to_others
from .checking import check_compatible
from .finish import CLOSING, finalise, recover_all
from .index import check_next_episode, read_index
from .layout import CameraSetup, DatasetLayout, lock_dataset, require_libraries, write_json
from .live import RESERVE, LiveFolder, RowQueue
from .videos import choose_encoder

_NICE = 2
"""Niceness, between the servo's and the renderer's: a late picture is late, a row that is not written is lost."""
_IDLE_TIMEOUT = 0.2
"""Time without a message from the app after which the disk is checked, s."""
_CHECK_PERIOD = 1.0
"""Time between two checks of the disk, s."""


class EpisodeWriter:
    """Serves one recorder."""

    def __init__(self, channel: Channel, memory: SharedMemory, config: dict[str, Any]) -> None:
        self.channel = channel
        self.layout = DatasetLayout(config["out"])
        cameras = [CameraSetup(*camera) for camera in config["cameras"]]
        self.queue = RowQueue(memory.buffer, config["width"], cameras, config["slots"])
        self.width: int = config["width"]
        self.stop_free: int = config["stop_free"]
        self.live: LiveFolder | None = None
        self.failed = False
        self._checked_at = 0.0
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
        return _IDLE_TIMEOUT

    # Rows.

    def drain(self) -> None:
        """Write every row in the queue."""
        while (slot := self.queue.oldest()) is not None:
            if self.live is not None and not self.failed:
                try:
                    self.live.add(slot)
                except Exception as error:  # a full disk, in any form in which an encoder reports it
                    self._fail(f"{self.layout.root} cannot be written any more: {error}")
            self.queue.release_oldest()
            self._check_disk()
        self._check_disk()

    def _check_disk(self) -> None:
        """Check the folder and the free space, at most once per :data:`_CHECK_PERIOD`."""
        now = time.monotonic()
        if self.live is None or self.failed or now - self._checked_at < _CHECK_PERIOD:
            return
        self._checked_at = now
        if not self.live.in_place:
            self._fail(f"{self.live.folder} is gone")
            return
        free = free_bytes(self.layout.root)
        self.queue.report(free_bytes=free)
        if free < self.stop_free:
            self._fail(f"only {free / 1e9:.2f} GB are free on the disk of {self.layout.root}; free some")

    def _fail(self, trouble: str) -> None:
        self.failed = True
        if self.live is not None:
            self.live.close()
        self.queue.report(trouble=trouble)

    # Requests of the app.

    def _do_begin(self, about: dict[str, Any]) -> dict[str, Any]:
        self.drain()
        if self.live is not None:  # the app was interrupted during a start
            self._close_live()
        try:
            return self._begin(about)
        except Exception as error:
            self._lock.close()  # so that another process can repair the dataset
            if isinstance(error, OSError):
                raise CommandError(f"cannot record into {self.layout.root}: {error}", code="cannot_write") from error
            raise

    def _begin(self, about: dict[str, Any]) -> dict[str, Any]:
        layout = self.layout
        free = free_bytes(layout.root)
        if free < self.stop_free:
            raise CommandError(
                f"only {free / 1e9:.2f} GB are free on the disk of {layout.root}; free some", code="disk_full"
            )
        self._lock.close()  # the folder may have been deleted meanwhile, and the lock with it
        self._lock.enter_context(lock_dataset(layout))
        notes = recover_all(layout)
        cameras = [CameraSetup(*camera) for camera in about["cameras_kept"]]
        check_compatible(layout, about, cameras)
        info = read_index(layout)
        check_next_episode(layout, info)
        number = int(info["total_episodes"]) if info is not None else 0
        self.failed = False
        self.queue.report(free_bytes=free, trouble="")
        self.live = LiveFolder(layout.partial(number), about, self.width)
        return {"episode": number, "notes": notes}

    def _do_save(self, closing: dict[str, Any]) -> int | None:
        self.drain()
        live = self._close_live()
        try:
            (live.folder / RESERVE).unlink(missing_ok=True)
            write_json(live.folder / CLOSING, closing)
            return finalise(self.layout, live.folder)
        except Exception as error:  # a full disk, in any form in which a library reports it
            stays = f"its rows stay in {live.folder}: fix the cause, then start the next episode or call recover()"
            raise HalError(f"the episode cannot be finished now: {error}; {stays}", code="save_failed") from error

    def _do_discard(self) -> None:
        self.drain()
        live = self._close_live()
        if live.folder.exists():
            self.layout.remove(live.folder)

    def _close_live(self) -> LiveFolder:
        live, self.live = self.live, None
        if live is None:
            raise CommandError("no episode is open", code="no_episode")
        live.close()
        return live


def free_bytes(path: Path) -> int:
    """Return the free space of the file system that holds ``path``, or will hold it, bytes."""
    while not path.exists() and path != path.parent:
        path = path.parent
    return shutil.disk_usage(path).free


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Run the child process; ``memories`` has one block, that of the queue."""
    require_libraries()
    encoder = choose_encoder(config["codec"])
    import pyarrow.parquet  # noqa: F401  # slow: import it before anything is recorded

    yield_to_others(_NICE)
    writer = EpisodeWriter(channel, memories[0], config)
    channel.send({"ready": {"encoder": encoder, "free_bytes": free_bytes(writer.layout.root)}})
    writer.run()
