"""The recorder: looks on while somebody drives, and keeps what it sees."""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Collection, Mapping, Sequence
from pathlib import Path
from types import TracebackType
from typing import TYPE_CHECKING, Any, NamedTuple

from ..errors import CommandError, ConnectionLost, HalError, StaleStateError
from ..host.hosts import groups_of
from ..host.process import Child, SharedMemory
from ..learning.episode import stands_in_world
from .codecs import Encoder
from .dataset import check_compatible
from .finish import keep_mark
from .index import read_index
from .layout import MORE_STREAMS, TIMES, Layout, Pace, features_of, locked, require
from .ring import RowRing
from .sampling import (
    CameraTrack,
    Grid,
    LockStepGrid,
    RealTimeGrid,
    Sampler,
    about_call,
    about_rig,
    about_start,
    movable,
)

if TYPE_CHECKING:
    from ..rig import Rig
    from .sampling import Moment

__all__ = [
    "EpisodeRecorder",
    "Gaps",
    "Recorder",
    "RecorderStatus",
    "Saving",
    "check_rate",
    "chosen",
]

# [saving.py] An episode that is being finished in the background.

_LOG = logging.getLogger("hal.recording")


class Saving:
    """Runs ``work`` in a thread of its own, which a program that ends waits for; a failure is kept, and logged."""

    def __init__(self, work: Callable[[], None]) -> None:
        self.error: Exception | None = None
        self._work = work
        self._thread = threading.Thread(target=self._run, name="hal-recorder-save")
        self._thread.start()

    def _run(self) -> None:
        try:
            self._work()
        except Exception as error:
            self.error = error
            _LOG.warning("%s", error)

    @property
    def done(self) -> bool:
        """Is it over, well or not?"""
        return not self._thread.is_alive()

    def wait(self) -> None:
        """Return when it is over."""
        self._thread.join()

    def result(self) -> None:
        """The same; raises what went wrong."""
        self.wait()
        if self.error is not None:
            raise self.error


# [gaps.py] Grid times of which there is no row, and why.


class Gaps:
    """Those of one episode; neighbours with one reason are one gap."""

    def __init__(self, fps: int) -> None:
        self.rows = 0
        """Rows that are missing."""
        self.lasting = 0.0
        """How long there has been no row now, s."""
        self.why = ""
        """The newest reason."""
        self._fps = fps
        self._found: list[dict[str, Any]] = []
        self._open = False

    def add(self, t: float, why: str) -> None:
        """No row at ``t``, s since the episode's first one."""
        self.rows += 1
        self.lasting += 1.0 / self._fps
        self.why = why
        if not self._open:
            self._found.append({"from_s": round(t, 6), "rows": 0, "why": why})
            self._open = True
        self._found[-1]["rows"] += 1
        self._found[-1]["to_s"] = round(t, 6)

    def over(self) -> None:
        """There is a row again."""
        self._open = False
        self.lasting = 0.0

    def as_json(self) -> list[dict[str, Any]]:
        """As the episode's file lists them."""
        return self._found


# [take.py] One episode while it is recorded: every grid time becomes a row for the writer, or a gap with a
# reason.

_HOPELESS = 1.0
"""s without a single row after which an episode takes no more."""
_PATIENCE = 30.0
"""s that a lock-step recording waits for a slow writer; time stands still meanwhile."""
_STEP = 0.001
_WORD = 1.0
"""s that the writer may take to hear of a row; it reads such words in between two rows."""


class EpisodeRecorder:
    """Looks on from :meth:`start` to :meth:`end`."""

    def __init__(
        self, rig: Rig, fps: int, sampler: Sampler, tracks: Sequence[CameraTrack], ring: RowRing, child: Child
    ) -> None:
        self.frames = 0
        """Rows so far."""
        self.seconds = 0.0
        """From the first row to the newest one."""
        self.trouble = ""
        """Why there are no more rows; empty while there are."""
        self.gaps = Gaps(fps)
        in_world = {robot.name for robot in rig.robots.values() if stands_in_world(rig, robot)}
        self.pace = Pace(() if rig.lock_step else sampler.columns, in_world)
        self._lock_step = rig.lock_step
        self._sampler = sampler
        self._tracks = tracks
        self._ring = ring
        self._child = child
        kind = LockStepGrid if rig.lock_step else RealTimeGrid
        self.grid: Grid = kind(rig.clock, fps, self._look, self._make)

    def start(self) -> None:
        """The first row is one of the present."""
        self.grid.start()

    def end(self) -> None:
        """No rows of later times, and nothing is looked at any more; those that are due are still made. Idempotent."""
        self.grid.end()

    def stop(self) -> None:
        """The same; returns when the writer has been handed every row."""
        self.grid.stop()

    def closing(self, success: bool | None) -> dict[str, Any]:
        """What is known of the episode at its end."""
        return {
            "success": success,
            "recovered": False,
            "dropped": self.gaps.rows,
            "late": self.grid.late,
            "gaps": self.gaps.as_json(),
            "repeated": {track.camera.name: track.repeated for track in self._tracks},
            "trouble": self.trouble,
        }

    def _look(self) -> Moment | Exception:
        try:
            return self._sampler.look()
        except Exception as error:  # the row, when it is made, says so
            return error

    def _make(self, t: float, moment: Moment | Exception) -> bool:
        """The row of one grid time. False where the episode cannot go on."""
        try:
            if isinstance(moment, Exception):
                raise moment
            self._child.check()
            self.trouble = self._ring.trouble
            why = self.trouble or self._put(t, moment)
        except (HalError, ValueError) as error:
            why = self.trouble = str(error)
        except Exception as error:  # nothing of a recording may be lost without a word
            why = self.trouble = f"{type(error).__name__}: {error}"
        if why:
            self.gaps.add(t - self.grid.start_time, why)
            if self.gaps.lasting > _HOPELESS:
                self.trouble = why
        return not self.trouble

    def _put(self, t: float, moment: Moment) -> str:
        """Hand a row to the writer; why that cannot be, or nothing."""
        try:
            frames = {track.camera.name: track.frame(t) for track in self._tracks}
            values = self._sampler.row(t, moment, frames)
        except StaleStateError as error:
            return str(error)
        if self._ring.full and not (self._lock_step and self._wait_for_slot()):
            return "the writer cannot keep up: the processor or the disk is too slow"
        slot = self._ring.next()
        slot.values[:] = values
        self.pace.add(values)
        for track, images in zip(self._tracks, slot.images, strict=True):
            track.fill(frames[track.camera.name], images)
        self._ring.announce()
        self._child.notify("row", timeout=_WORD)
        self.frames += 1
        self.seconds = t - self.grid.start_time
        self.gaps.over()
        return ""

    def _wait_for_slot(self) -> bool:
        pause = threading.Event()
        for _ in range(round(_PATIENCE / _STEP)):
            if not self._ring.full or self._ring.trouble:
                break
            self._child.check()
            pause.wait(_STEP)
        return not self._ring.full


# [devices.py] Which devices of a rig are recorded, and whether they can be.


def check_rate(rig: Rig, fps: int) -> None:
    """Raise CommandError where a simulation in lock-step makes fewer steps than rows are wanted."""
    if rig.lock_step and fps > (steps := groups_of(rig.plan)[0].rate_hz):
        raise CommandError(f"fps must be at most {steps:g}, the steps of this simulation in a second, not {fps}")


def chosen(
    rig: Rig, cameras: Collection[str] | None, streams: Collection[str]
) -> tuple[Sampler, list[CameraTrack], list[str]]:
    """Return the sampler of every arm and pad, a track per camera of these names, else of all, and notes for a person.

    Raises CommandError for what cannot be recorded, DeviceNotFound, StaleStateError, ConnectionLost.
    """
    if unknown := [stream for stream in streams if stream not in ("color", "depth", *MORE_STREAMS)]:
        known = ", ".join(("color", "depth", *MORE_STREAMS))
        raise CommandError(f"there is no stream {unknown[0]!r}; streams: {known}")
    if not rig.robots:
        raise CommandError("this rig has no arm to record")
    if odd := [name for name in movable(rig) if "/" in name]:
        raise CommandError(f"an object's name becomes that of a column, which has no slash: {odd[0]!r}")
    names = tuple(rig.cameras) if cameras is None else tuple(dict.fromkeys(cameras))
    tracks, notes = [], []
    for name in names:
        track = CameraTrack(rig.cameras[name], streams=streams, lock_step=rig.lock_step)
        setup = track.setup
        if setup.videos and (setup.width % 2 or setup.height % 2):
            size = f"{setup.width}x{setup.height}"
            raise CommandError(f"a video has even sizes: change cameras.{name}.output, which is {size}")
        if setup.videos or setup.depths:
            tracks.append(track)
        own = rig.cameras[name].spec.streams
        if left := [stream for stream in own if stream in MORE_STREAMS and stream not in streams]:
            notes.append(f"camera {name}: {', '.join(left)} not recorded")
        if missing := [stream for stream in streams if stream in MORE_STREAMS and stream not in own]:
            notes.append(f"camera {name} has no {', '.join(missing)}")
    for files in ([track.setup.videos for track in tracks], [track.setup.depths for track in tracks]):
        file_names = [name for each in files for name in each]
        if double := [name for name in file_names if file_names.count(name) > 1]:
            raise CommandError(f"two streams would be called {double[0]}: rename a camera")
    sampler = Sampler(rig, [track.camera.name for track in tracks])
    for track in tracks:
        seq = sampler.place_of(f"{TIMES}camera.{track.camera.name}") + 2
        track.setup = track.setup._replace(seq=seq)
    return sampler, tracks, notes


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
        self._take: EpisodeRecorder | None = None
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
                take = EpisodeRecorder(self.rig, self.fps, self._sampler, self._tracks, self._ring, self._child)
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

    def _save(self, take: EpisodeRecorder, partial: Path, success: bool | None) -> None:
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

    def _end(self) -> EpisodeRecorder:
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
