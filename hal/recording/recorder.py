"""The recorder: looks on while somebody drives, and keeps what it sees."""

from __future__ import annotations

import threading
from collections.abc import Collection, Mapping
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import CommandError, ConnectionLost
from ..host.process import Child, SharedMemory
from .about import about_call, about_rig, about_start
from .columns import features_of
from .compatible import check_compatible
from .devices import check_rate, chosen
from .finalise import keep_mark
from .index import read_index
from .layout import Layout, locked
from .library import require
from .ring import RowRing
from .saving import Saving
from .take import Take
from .video import Encoder

if TYPE_CHECKING:
    from ..rig import Rig

__all__ = ["Recorder", "RecorderStatus"]

_QUEUE = 0.6
"""s of rows that may wait for the writer."""
_SAVING = 600.0
"""s that finishing an episode may take."""
_FASTEST = 240


class RecorderStatus(NamedTuple):
    """How it goes."""

    state: str
    """``idle``, ``recording`` or ``saving``."""
    episode: int
    """Number of the present episode, or of the last one; -1 before the first."""
    frames: int
    """Its rows so far."""
    seconds: float
    """Time from its first row to its newest one."""
    dropped: int
    """Grid times of which there is no row; the episode's file says when and why."""
    late: int
    """Grid times that were noticed late. Nothing is missing in those rows."""
    free_bytes: int
    """Free space on the disk."""
    trouble: str
    """What a person should look at; empty where all is well. An episode that cannot go on takes no more rows, and can
    be saved, or discarded, with those that it has."""


class Recorder:
    """Records episodes of ``rig`` into the dataset in the folder ``out``, ``fps`` rows a second.

    ``cameras`` are the names of those that are kept, else all. ``streams`` are those that are kept of each camera that
    has them: some of ``color``, ``depth``, ``infrared``, ``infrared_right``, ``segmentation``; ``depth=False`` leaves
    depth out. ``codec`` is ``h264``, ``av1`` or ``auto``. Below ``warn_free`` bytes of free disk :meth:`status` says
    so, below ``stop_free`` an episode ends. Nothing is written before :meth:`start`. Use it in a ``with`` statement,
    inside that of the rig.

    Raises DriverMissing, CommandError for whatever would not work later, StaleStateError, ConnectionLost.
    """

    def __init__(
        self,
        rig: Rig,
        out: str | Path,
        fps: int = 30,
        task: str = "",
        depth: bool = True,
        *,
        cameras: Collection[str] | None = None,
        streams: Collection[str] = ("color", "depth"),
        codec: str = "auto",
        warn_free: int = 5_000_000_000,
        stop_free: int = 1_000_000_000,
    ) -> None:
        require()
        if not (1 <= fps <= _FASTEST and int(fps) == fps):
            raise CommandError(f"fps must be a whole number from 1 to {_FASTEST}, not {fps!r}")
        check_rate(rig, fps)
        self.rig = rig
        self.fps = fps = int(fps)
        self.task = task
        """Of the episodes to come."""
        self.root = Layout(out).root
        self._sampler, self._tracks, self.notes = chosen(
            rig, cameras, [stream for stream in streams if depth or stream != "depth"]
        )
        """``notes``: what a person should know. What is not kept, what was recovered."""
        self._warn_free = warn_free
        setups = [track.setup for track in self._tracks]
        width, slots = self._sampler.width, max(4, round(_QUEUE * fps))
        self._memory = SharedMemory(RowRing.size(width, setups, slots))
        self._ring = RowRing(self._memory.buffer, width, setups, slots)
        self._config = {
            "out": str(self.root),
            "cameras": setups,
            "width": width,
            "slots": slots,
            "codec": codec,
            "stop_free": stop_free,
        }
        try:
            self._child = self._start_child()
        except BaseException:
            self._memory.close()
            raise
        try:
            encoder = Encoder(*self._child.ready["encoder"])
            self._about = {
                "fps": fps,
                "robot_type": "+".join(robot.spec.model for robot in rig.robots.values()),
                "features": features_of(self._sampler.columns, setups, fps, encoder.feature),
                "columns": self._sampler.columns,
                "cameras_kept": setups,
                "encoder": encoder,
                **about_rig(rig),
            }
            check_compatible(Layout(out), self._about["features"], fps, self._about["robot_type"], setups)
        except BaseException:
            self._child.close()
            self._memory.close()
            raise
        self._lock = threading.RLock()
        self._take: Take | None = None
        """The present episode, or the last one."""
        self._open = False
        """Is it being recorded?"""
        self._saving: Saving | None = None
        """Of the last episode that was saved."""
        self._episode = -1
        self._closed = False

    def _start_child(self) -> Child:
        child = Child("recorder", "hal.recording.writer:main", self._config, [self._memory])
        try:
            child.wait_ready()
        except BaseException:
            child.close()
            raise
        return child

    @property
    def episodes(self) -> int:
        """How many are in the dataset by now, those that are being saved left out."""
        info = read_index(Layout(self.root))
        return int(info["total_episodes"]) if info is not None else 0

    # An episode.

    def start(self, seed: int | None = None, info: Mapping[str, Any] | None = None) -> None:
        """Begin an episode. ``seed`` and ``info`` (plain numbers, texts, lists, dicts) are kept with it.

        Waits for one that is still being saved; where that failed, :attr:`notes` say why. What was left unfinished in
        the folder is recovered first, see there, too.

        Raises CommandError (the folder, the disk, what is to be kept), StaleStateError and ConnectionLost (a camera).
        """
        said = about_call(self.task, seed, info)
        with self._lock:
            if self._closed:
                raise CommandError("the recorder is closed")
            if self._open:
                raise CommandError(f"episode {self._episode} is still being recorded: save or discard it first")
            if self._saving is not None:
                self._saving.wait()
                if self._saving.error is not None:
                    self.notes.append(str(self._saving.error))
            self._saving = None
            if self._child.process.poll() is not None:
                self._child.close()
                self._child = self._start_child()
            take = None
            try:
                for track in self._tracks:
                    track.begin()
                about = said | about_start(self.rig, self._tracks) | self._about
                begun = self._child.request("begin", {"about": about}, _SAVING)
                self.notes.extend(begun["notes"])
                self._episode = begun["episode"]
                take = Take(self.rig, self.fps, self._sampler, self._tracks, self._ring, self._child)
                take.start()
            except BaseException:
                if take is not None:
                    take.stop()
                self._end_tracks()
                raise
            self._take, self._open = take, True

    def status(self) -> RecorderStatus:
        """How it goes; never waits."""
        take, saving = self._take, self._saving
        busy = saving is not None and not saving.done
        state = "saving" if busy else "recording" if self._open else "idle"
        free = self._ring.free_bytes or int(self._child.ready["free_bytes"])
        failure = saving.error if saving is not None else None
        trouble = str(failure or (take.trouble if take is not None else ""))
        if not trouble and free < self._warn_free:
            trouble = f"only {free / 1e9:.1f} GB are free on the disk of {self.root}"
        if not trouble and take is not None:
            trouble = take.pace.trouble
        if take is None:
            return RecorderStatus(state, self._episode, 0, 0.0, 0, 0, free, trouble)
        counts = take.frames, take.seconds, take.gaps.rows, take.grid.late
        return RecorderStatus(state, self._episode, *counts, free, trouble)

    def save(self, success: bool | None = None, wait: bool = False) -> None:
        """End the episode with the rows until now and make it part of the dataset, in the background unless ``wait``.

        ``success`` is the mark that it gets; it is written at once and stays where the writer is killed. Until the
        episode is saved ``status().state`` is ``saving``; where that fails, ``status().trouble`` says why,
        :meth:`wait_saved` raises it, and the next :meth:`start`, or :func:`~hal.recording.recover`, tries it again.
        """
        with self._lock:
            take, partial = self._end(), Layout(self.root).partial(self._episode)
            saving = self._saving = Saving(lambda: self._save(take, partial, success))
        if wait:
            saving.result()

    def wait_saved(self) -> None:
        """Wait until the last episode is saved; raises what kept it from that."""
        saving = self._saving
        if saving is not None:
            saving.result()

    def _save(self, take: Take, partial: Path, success: bool | None) -> None:
        if success is not None:
            keep_mark(partial, success)
        take.stop()
        self._end_tracks()
        if self._child.request("save", {"closing": take.closing(success)}, _SAVING) is None:
            why = take.gaps.why or "it ended at once"
            raise CommandError(f"nothing was recorded, so there is nothing to save: {why}")

    def discard(self) -> None:
        """End the episode and remove it."""
        with self._lock:
            self._end().stop()
            self._end_tracks()
            try:
                self._child.request("discard", {}, _SAVING)
            except ConnectionLost:  # the writer is gone, and its lock with it
                layout = Layout(self.root)
                with locked(layout):
                    if (partial := layout.partial(self._episode)).exists():
                        layout.remove(partial)

    def _end(self) -> Take:
        """The episode that is open ends here and now, whatever is still to be done with it."""
        if self._take is None or not self._open:
            raise CommandError("no episode is being recorded: call start first")
        self._open = False
        self._take.end()
        return self._take

    def _end_tracks(self) -> None:
        for track in self._tracks:
            track.end()

    def close(self) -> None:
        """End the writer. An episode that is still open is kept, unmarked. Idempotent."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            if self._open:
                self.save()
            if self._saving is not None:
                self._saving.wait()
            self._child.close()
            self._memory.close()

    def __enter__(self) -> Recorder:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()
