"""The thread that takes a camera's sets of frames, and puts the pictures of those that are captures in the ring."""

from __future__ import annotations

import threading
import time
import traceback
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple

import pyrealsense2 as rs

from hal.driver import CameraTally
from hal.images import Cropping
from hal.specs import CameraSpec

from .matching import Matcher, Numbering, Taken, Verdict, skew
from .modes import rates_of
from .pictures import Darkroom
from .ring import PictureRing
from .session import Session
from .stamps import GLOBAL, HARDWARE, SYSTEM, CaptureTimes

__all__ = ["First", "Streaming"]

_WAIT = 0.1
"""s that one wait for a set takes at most."""
_PERIODS = 3.0
"""A slow camera may be silent for so many of its periods."""
_PAUSE = 0.0005
"""s between two looks whether the reader has made room."""
_DOMAINS = {
    rs.timestamp_domain.hardware_clock: HARDWARE,
    rs.timestamp_domain.system_time: SYSTEM,
    rs.timestamp_domain.global_time: GLOBAL,
}


class First(NamedTuple):
    """What is known with the first set of pictures."""

    clock: str
    before: int
    """Number in the ring of the last picture that is not of this session."""


class _Capture(NamedTuple):
    """A set of frames that were taken together."""

    frames: Any
    single: Mapping[str, Any]
    taken: Mapping[str, Taken]
    arrival: float
    """When it came, on the monotonic clock, s, and the time of day then."""
    wall: float


class Streaming:
    """Runs from its making to :meth:`end`, or until the camera is lost, which it tells once."""

    def __init__(
        self,
        spec: CameraSpec,
        profiles: Mapping[str, Any],
        session: Session,
        ring: PictureRing,
        tell: Callable[[dict[str, Any]], None],
        *,
        stall: float,
        warm_up: float,
        every: bool,
    ) -> None:
        """``stall``: s without a new capture after which the camera is lost. ``warm_up``: s after the first capture
        in which none is handed out. ``every``: wait until there is room for each picture."""
        rates = rates_of(profiles)
        self._session = session
        self._ring = ring
        self._tell = tell
        self._stall = max(stall, _PERIODS / min(rates.values()))
        self._warm_up = warm_up
        self._every = every
        self._darkroom = Darkroom(spec, profiles)
        self._matcher = Matcher(rates)
        self._numbering = Numbering()
        self._times = CaptureTimes(played=not session.clock_is_live)
        self._repeated, self._mismatched = ring.tally
        self._before = ring.forget()
        self._first: First | None = None
        self._warm_since: float | None = None
        self._seen: dict[str, tuple[int, float]] = {}
        """Number of each stream's newest frame, and how long it has been silent when that came, s."""
        self._silent = 0.0
        self.why = ""
        """Why it ended by itself."""
        self._changed = threading.Condition()
        self._ending = False
        self._thread = threading.Thread(target=self._run, name="hal-realsense", daemon=True)
        self._thread.start()

    @property
    def cropping(self) -> Mapping[str, Cropping]:
        """What is cut and scaled, for each stream."""
        return self._darkroom.cropping

    def wait_for_first(self, timeout: float) -> First | None:
        """What the first capture tells; None when none came in ``timeout`` s, or when it ended before."""
        with self._changed:
            self._changed.wait_for(lambda: self._first is not None or bool(self.why), timeout)
            return self._first

    def end(self) -> None:
        """Take no more frames. Returns when the thread does not touch the library any more."""
        self._ending = True
        self._thread.join()

    def _run(self) -> None:
        try:
            why = self._take_all()
        except Exception as error:
            traceback.print_exc()  # the app quotes it, should the process end
            why = f"{type(error).__name__}: {error}"
        if why:
            with self._changed:
                self.why = why
                self._changed.notify_all()
            if self._first is not None:
                self._tell(
                    {"lost": why, "final": not self._session.clock_is_live and self._session.ended() is not None}
                )

    def _take_all(self) -> str:
        """Until it is to end (nothing comes back), or until no more will come (why that is)."""
        while not self._ending:
            began = time.monotonic()
            frames = self._session.wait(_WAIT)
            capture = self._newest(frames)
            if capture is not None:
                self._hand_out(capture)
                self._silent = 0.0
                continue
            # Only what was waited for counts: a process that was stopped for a minute has not lost its camera.
            self._silent += min(time.monotonic() - began, 2.0 * _WAIT)
            ended = self._session.ended() if frames is None else None
            if ended:
                return ended
            if self._silent > self._stall and self._first is not None:  # whoever started it waits for the first one
                return self._stalled()
        return ""

    def _newest(self, frames: Any | None) -> _Capture | None:
        """Of this set and those that wait behind it, the last one that is a capture."""
        newest = None
        while frames is not None:
            newest = self._judged(frames) or newest
            frames = self._session.more()
        return newest

    def _judged(self, frames: Any) -> _Capture | None:
        """The set, if it is a capture; else why not is noted."""
        arrival, wall = time.monotonic(), time.time()
        single = self._darkroom.frames_of(frames)
        if single is None:
            return None
        taken = {name: _taken(frame) for name, frame in single.items()}
        for name, picture in taken.items():
            if self._seen.get(name, (-1, 0.0))[0] != picture.number:
                self._seen[name] = (picture.number, self._silent)
        verdict = self._matcher.judge(taken)
        if verdict is Verdict.NEW:
            return _Capture(frames, single, taken, arrival, wall)
        self._repeated += verdict is Verdict.REPEATED
        self._mismatched += verdict is Verdict.MISMATCHED
        self._ring.count(CameraTally(self._repeated, self._mismatched))
        return None

    def _hand_out(self, capture: _Capture) -> None:
        first = capture.taken[self._matcher.lead]
        t, t_device = self._times(first.stamp, first.domain, capture.arrival, capture.wall)
        seq = self._numbering(first.number)
        written = 0
        if self._is_warm(capture.arrival) and self._has_room():
            self._darkroom.develop(capture.frames, capture.single, self._ring.begin())
            written = self._ring.end(t, t_device, seq, skew(capture.taken))
        self._tell({"frame": written})
        if self._first is None:
            with self._changed:
                self._first = First(first.domain, self._before)
                self._changed.notify_all()

    def _is_warm(self, now: float) -> bool:
        if self._warm_since is None:
            self._warm_since = now
        return now - self._warm_since >= self._warm_up

    def _has_room(self) -> bool:
        while self._every and self._ring.is_full:
            if self._ending:
                return False
            time.sleep(_PAUSE)
        return True

    def _stalled(self) -> str:
        """Which streams are silent, in words."""
        alive = [name for name, (_, silent) in self._seen.items() if silent > 0.5 * self._stall]
        dead = [name for name in self._seen if name not in alive]
        if not alive or not dead:
            what = "nothing that belongs together" if alive else "nothing"
            return f"it has stalled: {what} came for {self._silent:.1f} s"
        return f"it has stalled: {', '.join(dead)} sent nothing for {self._silent:.1f} s, {', '.join(alive)} did"


def _taken(frame: Any) -> Taken:
    domain = _DOMAINS[frame.get_frame_timestamp_domain()]
    return Taken(frame.get_frame_number(), frame.get_timestamp() / 1000.0, domain)
