"""Record the episodes of a rig into a dataset: the public :class:`Recorder`, and what it does during one episode.

A :class:`~hal.recording.sample_clock.SampleClock` calls :class:`EpisodeRecorder` at every due time; each becomes a row
in the queue to the writer's process (writer.py), or a dropped row with its reason.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import CommandError, ConnectionLost, HalError, StaleStateError
from ..host.hosts import make_groups
from ..host.process import Child, SharedMemory
from ..learning.episode import stands_in_world
from .checking import check_compatible, known_columns
from .finish import write_mark
from .index import read_index
from .layout import DatasetLayout, features_of, lock_dataset, make_plain, require_libraries
from .live import VALUES, RowQueue
from .merging import pack_if_loose
from .metadata import ClockPace, caller_metadata, rig_metadata, start_metadata
from .sample_clock import LockStepSampleClock, RealTimeSampleClock, SampleClock
from .sampling import CameraBuffer, RowSampler, select_devices
from .videos import VideoEncoder

if TYPE_CHECKING:
    from ..rig import Rig
    from .sampling import RowSnapshot

_LOG = logging.getLogger("hal.recording")
_GIVE_UP = 1.0
"""Time without a single row after which an episode records no more, s."""
_WRITER_PATIENCE = 30.0
"""Time that a lock-step recording waits for a slow writer, s; simulated time stands still meanwhile."""
_STEP = 0.001
"""Pause between two checks of the queue, s."""
_NOTIFY_TIMEOUT = 1.0
"""Time that the writer may take to receive a notification, s; it reads them between two rows."""
_QUEUE = 0.6
"""Span of rows that may wait for the writer, s."""
_SAVING = 600.0
"""Longest time that finishing an episode may take, s."""
_FASTEST = 240
"""Highest rate, rows per second."""


class RecorderStatus(NamedTuple):
    """State of a recorder."""

    state: str
    """``idle``, ``recording``, ``ended`` (by itself: save or discard what it has) or ``saving``."""
    episode: int
    """Number of the current episode, or of the last one; -1 before the first."""
    frames: int
    """Rows recorded in it."""
    seconds: float
    """Time from its first row to its newest one, s."""
    dropped: int
    """Rows that are missing; the episode's file lists when and why."""
    late: int
    """Rows whose due time was noticed late. No data is missing in them."""
    free_bytes: int
    """Free space on the disk, bytes."""
    trouble: str
    """Problem that needs the operator's attention; empty if there is none."""


class Recorder:
    """Records episodes of a rig into a dataset. Nothing is written before :meth:`start`.

    Use it in a ``with`` statement, inside that of the rig.

    Args:
        rig: An open rig.
        out: Folder of the dataset; episodes are added to one that exists.
        fps: Rows per second, 1 to 240; in lock-step at most the simulation's steps per second.
        task: Description of the task, stored with each episode.
        depth: False leaves depth out.
        cameras: Names of the cameras to record; None for all.
        streams: Streams to record of each camera that has them: some of :data:`hal.types.STREAMS`; with ``objects``,
            the poses of a simulation's movable objects are recorded as ``observation.environment_state``, for policies
            without pictures.
        codec: ``h264``, ``av1``, or ``auto`` for the first that is available.
        warn_free: Free disk space below which :meth:`status` warns, bytes.
        stop_free: Free disk space below which an episode ends, bytes.

    Raises:
        DriverMissing: A library is not installed.
        CommandError: An argument is wrong, or the folder holds another kind of dataset (code ``other_dataset``).
        DatasetError: The dataset in the folder is damaged.
        NotSupported: The video library cannot encode ``codec``.
        StaleStateError: An arm or an object has no current state.
        ConnectionLost: A device is lost.
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
        require_libraries()
        if not (1 <= fps <= _FASTEST and int(fps) == fps):
            raise CommandError(f"fps must be a whole number from 1 to {_FASTEST}, not {fps!r}", code="bad_fps")
        check_rate(rig, fps)
        self.rig = rig
        self.fps = fps = int(fps)
        self.task = task
        """Task of the next episodes."""
        self.source: Callable[[], str] = str
        """Returns who drives when a row is due: ``person``, ``policy``, ``program``; empty if that is unknown."""
        self.root = DatasetLayout(out).root
        self._selected = cameras, [stream for stream in streams if depth or stream != "depth"]
        self._sampler, self._buffers, self.notes = select_devices(
            rig, *self._selected, known_columns(DatasetLayout(out))
        )
        """Messages for the operator: streams that are not recorded, episodes that were recovered."""
        self._warn_free = warn_free
        setups = [buffer.setup for buffer in self._buffers]
        width, slots = self._sampler.width, max(4, round(_QUEUE * fps))
        self._config = {
            "out": str(self.root),
            "cameras": setups,
            "width": width,
            "slots": slots,
            "codec": codec,
            "stop_free": stop_free,
        }
        with ExitStack() as undo:
            self._memory = SharedMemory(RowQueue.size(width, setups, slots))
            undo.callback(self._memory.close)
            self._queue = RowQueue(self._memory.buffer, width, setups, slots)
            self._child = self._start_child()
            undo.callback(self._child.close)
            encoder = VideoEncoder(*self._child.ready["encoder"])
            self._about = {
                "fps": fps,
                "robot_type": "+".join(robot.spec.model for robot in rig.robots.values()),
                "features": features_of(self._sampler.columns, setups, fps, encoder.feature),
                "columns": self._sampler.columns,
                "cameras_kept": setups,
                "encoder": encoder,
                **rig_metadata(rig),
            }
            check_compatible(DatasetLayout(out), self._about, setups)
            undo.pop_all()  # nothing failed
        self._lock = threading.RLock()
        self._current: EpisodeRecorder | None = None
        """The current episode, or the last one."""
        self._is_open = False
        """Whether it is being recorded."""
        self._saver = ThreadPoolExecutor(1, "hal-recorder-save")
        self._saving: Future[None] | None = None
        """Background saving of the last episode that was saved."""
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
        """Number of finished episodes in the dataset."""
        info = read_index(DatasetLayout(self.root))
        return int(info["total_episodes"]) if info is not None else 0

    def switch_rig(self, rig: Rig) -> None:
        """Record another rig of the same configuration from the next episode on, with the same writer's process.

        Args:
            rig: An open rig. The one before may be closed.

        Raises:
            CommandError: An episode is open (code ``episode_open``), or the rig has other columns or cameras
                (``other_rig``).
            StaleStateError: An arm or an object has no current state.
            ConnectionLost: A device is lost.
        """
        with self._lock:
            if self._is_open:
                raise CommandError("save or discard the episode before switching rigs", code="episode_open")
            self.wait_saved()
            sampler, buffers, _ = select_devices(rig, *self._selected, known_columns(DatasetLayout(self.root)))
            setups = [[buffer.setup for buffer in each] for each in (buffers, self._buffers)]
            if sampler.columns != self._sampler.columns or setups[0] != setups[1]:
                raise CommandError("this rig has other columns or cameras than the recorder's", code="other_rig")
            self.rig, self._sampler, self._buffers = rig, sampler, buffers

    def start(self, seed: int | None = None, info: Mapping[str, Any] | None = None) -> None:
        """Start an episode. Blocks while the previous one is still being saved.

        If that failed, :attr:`notes` has the reason. Unfinished episodes in the folder are recovered first, which
        :attr:`notes` lists too.

        Args:
            seed: Random seed, stored with the episode.
            info: Further metadata, stored with the episode: plain numbers, texts, lists and dicts.

        Raises:
            CommandError: An episode is open (code ``episode_open``), the recorder is closed (``recorder_closed``),
                metadata cannot be stored (``bad_metadata``), the disk is full (``disk_full``) or the folder cannot be
                used.
            DatasetError: The dataset in the folder is damaged.
            StaleStateError: A camera has no picture for 2 s.
            ConnectionLost: A camera, or the writer's process, is lost.
        """
        given = caller_metadata(self.task, seed, info)
        with self._lock:
            if self._closed:
                raise CommandError("the recorder is closed", code="recorder_closed")
            if self._is_open:
                raise CommandError(f"save or discard episode {self._episode} first", code="episode_open")
            if self._saving is not None and (error := self._saving.exception()) is not None:
                self.notes.append(str(error))
            self._saving = None
            if self._child.process.poll() is not None:
                self._child.close()
                self._child = self._start_child()
            episode = None
            try:
                for buffer in self._buffers:
                    buffer.start()
                about = given | start_metadata(self.rig, self._buffers) | self._about
                begun = self._child.request("begin", {"about": about}, _SAVING)
                self.notes.extend(begun["notes"])
                self._episode = begun["episode"]
                self._sampler.source = self.source
                episode = EpisodeRecorder(self.rig, self.fps, self._sampler, self._buffers, self._queue, self._child)
                episode.clock.start()
            except BaseException:
                if episode is not None:
                    episode.clock.stop()
                self._stop_cameras()
                raise
            self._current, self._is_open = episode, True
            self._sampler.mark_arms(True)

    def status(self) -> RecorderStatus:
        """Return the current state. Never blocks."""
        episode, saving = self._current, self._saving
        busy = saving is not None and not saving.done()
        has_ended = episode is not None and bool(episode.trouble)
        state = "saving" if busy else "idle" if not self._is_open else "ended" if has_ended else "recording"
        free = self._queue.free_bytes or int(self._child.ready["free_bytes"])
        failure = saving.exception() if saving is not None and not busy else None
        trouble = str(failure or (episode.trouble if episode is not None else ""))
        if not trouble and free < self._warn_free:
            trouble = f"only {free / 1e9:.1f} GB are free on the disk of {self.root}"
        if not trouble and episode is not None:
            trouble = episode.pace.trouble
        if episode is None:
            return RecorderStatus(state, self._episode, 0, 0.0, 0, 0, free, trouble)
        counts = episode.frames, episode.seconds, episode.dropped.rows, episode.clock.late
        return RecorderStatus(state, self._episode, *counts, free, trouble)

    def save(self, success: bool | None = None, wait: bool = False, result: Mapping[str, Any] | None = None) -> None:
        """End the episode now and make it part of the dataset.

        Until it is saved ``status().state`` is ``saving``. If saving fails in the background, ``status().trouble`` has
        the reason, :meth:`wait_saved` raises it, and the next :meth:`start`, or :func:`~hal.recording.recover`, tries
        again.

        Args:
            success: Mark of the episode; written at once, so that it survives if the writer is killed. An episode that
                ended by itself, perhaps before the task, is not marked a success.
            wait: Block until the episode is saved.
            result: What else is known at the end, for the episode's metadata: as JSON, arrays as lists.

        Raises:
            CommandError: No episode is open (code ``no_episode``); with ``wait``, no row was recorded (``no_rows``).
            HalError: With ``wait``: it cannot be saved now (code ``save_failed``).
        """
        with self._lock:
            episode, partial = self._end(), DatasetLayout(self.root).partial(self._episode)
            saving = self._saving = self._saver.submit(self._save, episode, partial, success, result)
        if wait:
            saving.result()

    def wait_saved(self) -> None:
        """Block until the last episode is saved. Raises the error that prevented it."""
        saving = self._saving
        if saving is not None:
            saving.result()

    def _save(
        self, episode: EpisodeRecorder, partial: Path, success: bool | None, result: Mapping[str, Any] | None
    ) -> None:
        try:
            if success and episode.trouble:
                _LOG.warning("not marked a success: the recording ended before it was saved: %s", episode.trouble)
                success = None
            if success is not None:
                write_mark(partial, success)
            episode.clock.stop()
            self._stop_cameras()
            if self._child.request("save", {"closing": episode.final_metadata(success, result)}, _SAVING) is None:
                why = episode.dropped.why or "it ended at once"
                raise CommandError(f"no row was recorded, so there is nothing to save: {why}", code="no_rows")
        except Exception as error:
            _LOG.warning("%s", error)
            raise

    def discard(self) -> None:
        """End the episode and delete it. Raises CommandError if none is open (code ``no_episode``)."""
        with self._lock:
            self._end().clock.stop()
            self._stop_cameras()
            try:
                self._child.request("discard", {}, _SAVING)
            except ConnectionLost:  # the writer has ended, and released its lock
                layout = DatasetLayout(self.root)
                with lock_dataset(layout):
                    if (partial := layout.partial(self._episode)).exists():
                        layout.remove(partial)

    def _end(self) -> EpisodeRecorder:
        """End the open episode now, and return it to be saved or discarded."""
        if self._current is None or not self._is_open:
            raise CommandError("no episode is being recorded: call start first", code="no_episode")
        self._is_open = False
        self._sampler.mark_arms(False)
        self._current.clock.end()
        return self._current

    def _stop_cameras(self) -> None:
        for buffer in self._buffers:
            buffer.stop()

    def close(self) -> None:
        """End the writer's process. An episode that is still open is saved without a mark. Idempotent."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
            if self._is_open:
                self.save()
            self._saver.shutdown()
            self._child.close()
            self._memory.close()
            pack_if_loose(self.root)

    def __enter__(self) -> Recorder:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


class EpisodeRecorder:
    """Makes the rows of one episode, while :attr:`clock` asks for them."""

    def __init__(
        self, rig: Rig, fps: int, sampler: RowSampler, buffers: Sequence[CameraBuffer], queue: RowQueue, child: Child
    ) -> None:
        self.frames = 0
        """Rows recorded."""
        self.seconds = 0.0
        """Time from the first row to the newest one, s."""
        self.trouble = ""
        """Why no more rows are recorded; empty while they are."""
        self.dropped = DroppedRows(fps)
        in_world = {robot.name for robot in rig.robots.values() if stands_in_world(rig, robot)}
        self.pace = ClockPace(() if rig.lock_step else sampler.columns, in_world)
        self._lock_step = rig.lock_step
        self._sampler = sampler
        self._buffers = buffers
        self._queue = queue
        self._child = child
        clock = LockStepSampleClock if rig.lock_step else RealTimeSampleClock
        self.clock: SampleClock = clock(rig.clock, fps, self._read, self._make)

    def final_metadata(self, success: bool | None, result: Mapping[str, Any] | None) -> dict[str, Any]:
        """Return the metadata that is known at the end of the episode."""
        return {
            "success": success,
            "recovered": False,
            "dropped": self.dropped.rows,
            "late": self.clock.late,
            "gaps": self.dropped.gaps,
            "repeated": {buffer.camera.name: buffer.repeated for buffer in self._buffers},
            "trouble": self.trouble,
            "result": make_plain(dict(result or {})),
        }

    def _read(self) -> RowSnapshot | Exception:
        try:
            return self._sampler.read_snapshot()
        except Exception as error:  # raised when the row is made
            return error

    def _make(self, t: float, snapshot: RowSnapshot | Exception) -> bool:
        """Make the row that was due at ``t``, or count it as dropped. Return False if the episode cannot continue."""
        try:
            if isinstance(snapshot, Exception):
                raise snapshot
            self._child.check()
            self.trouble = self._queue.trouble
            why = self.trouble or self._send(t, snapshot)
        except (HalError, ValueError) as error:
            why = self.trouble = str(error)
        except Exception as error:  # no row may be lost without a reason
            why = self.trouble = f"{type(error).__name__}: {error}"
        if why:
            self.dropped.add(t - self.clock.start_time, why)
            if self.dropped.lasting > _GIVE_UP:
                self.trouble = why
        return not self.trouble

    def _send(self, t: float, snapshot: RowSnapshot) -> str:
        """Send a row to the writer. Return the reason if that is impossible, or an empty text."""
        try:
            frames = {buffer.camera.name: buffer.frame(t) for buffer in self._buffers}
            values = self._sampler.row(t, snapshot, frames)
        except StaleStateError as error:
            return str(error)
        if self._queue.is_full and not (self._lock_step and self._wait_for_slot()):
            return "the writer cannot keep up: the processor or the disk is too slow"
        slot = self._queue.open_slot()
        slot[VALUES][:] = values
        self.pace.add(values)
        for k, buffer in enumerate(self._buffers):
            images = {stream: image for (camera, stream), image in slot.items() if camera == k}
            buffer.copy_into(frames[buffer.camera.name], images)
        self._queue.publish()
        if not self._lock_step or self._queue.is_half_full:  # in lock-step rows come fast: wake the writer for several
            self._child.notify("row", timeout=_NOTIFY_TIMEOUT)
        self.frames += 1
        self.seconds = t - self.clock.start_time
        self.dropped.row_made()
        return ""

    def _wait_for_slot(self) -> bool:
        pause = threading.Event()
        for _ in range(round(_WRITER_PATIENCE / _STEP)):
            if not self._queue.is_full or self._queue.trouble:
                break
            self._child.check()
            pause.wait(_STEP)
        return not self._queue.is_full


class DroppedRows:
    """Rows of one episode that could not be made; neighbours with the same cause form one gap."""

    def __init__(self, fps: int) -> None:
        self.rows = 0
        """Number of missing rows."""
        self.lasting = 0.0
        """Time since the last row that could be made, s."""
        self.why = ""
        """The newest reason."""
        self.gaps: list[dict[str, Any]] = []
        """The gaps, as the episode's file lists them."""
        self._fps = fps
        self._is_open = False

    def add(self, t: float, why: str) -> None:
        """Count the row at ``t``, s since the episode's first one, as dropped."""
        self.rows += 1
        self.lasting += 1.0 / self._fps
        self.why = why
        if not self._is_open:
            self.gaps.append({"from_s": round(t, 6), "rows": 0, "why": why})
            self._is_open = True
        self.gaps[-1]["rows"] += 1
        self.gaps[-1]["to_s"] = round(t, 6)

    def row_made(self) -> None:
        """End the current gap."""
        self._is_open = False
        self.lasting = 0.0


def check_rate(rig: Rig, fps: int) -> None:
    """Raise CommandError if a lock-step simulation makes fewer steps per second than ``fps``."""
    if rig.lock_step and fps > (steps := make_groups(rig.plan)[0].rate_hz):
        raise CommandError(
            f"fps must be at most {steps:g}, the steps of this simulation per second, not {fps}", code="bad_fps"
        )
