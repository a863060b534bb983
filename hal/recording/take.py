"""One episode while it is recorded: every grid time becomes a row for the writer, or a gap with a reason."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

from ..errors import HalError, StaleStateError
from ..learning.episode import stands_in_world
from .cameras import CameraTrack
from .gaps import Gaps
from .grid import Grid, LockStepGrid, RealTimeGrid
from .pace import Pace

if TYPE_CHECKING:
    from ..host.process import Child
    from ..rig import Rig
    from .ring import RowRing
    from .sampling import Moment, Sampler

__all__ = ["Take"]

_HOPELESS = 1.0
"""s without a single row after which an episode takes no more."""
_PATIENCE = 30.0
"""s that a lock-step recording waits for a slow writer; time stands still meanwhile."""
_STEP = 0.001
_WORD = 1.0
"""s that the writer may take to hear of a row; it reads such words in between two rows."""


class Take:
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
