"""From the library's frame sets to captures in the ring: capture times, matching, conversion and the thread.

:class:`FrameStreamer` is the thread. :class:`CaptureTimes`, :class:`FrameMatcher` and :class:`CaptureNumbers` are pure;
:class:`FrameConverter` writes the images.
"""

from __future__ import annotations

import threading
import time
import traceback
from collections import deque
from collections.abc import Callable, Mapping
from enum import Enum
from typing import Any, NamedTuple

import numpy as np
import pyrealsense2 as rs
from numpy.typing import NDArray

from hal.driver import CameraTally
from hal.errors import ConnectionLost
from hal.host.process import pack_error
from hal.host.ring import FrameRing, Images
from hal.images import Cropping
from hal.specs import CameraSpec

from .pipeline import FramePipeline

# Capture times.
#
# A stamp is on one of three clocks (rs2_timestamp_domain). For the first two the host's time of day is available, and
# one subtraction converts it to the monotonic clock. The zero of the camera's own clock is unknown; what is known is
# when each frame arrived, which is always too late, by at least the shortest transfer time. So the smallest difference
# between arrival and stamp over the last seconds is added to the stamp. The result is late by that shortest transfer
# time (exposure, readout, USB: about one period), and steady to the drift of a quartz (at most 50 us/s) over those
# seconds. No time is later than the arrival.

GLOBAL, SYSTEM, HARDWARE = "global", "system", "hardware"
_DOMAINS = {
    rs.timestamp_domain.hardware_clock: HARDWARE,
    rs.timestamp_domain.system_time: SYSTEM,
    rs.timestamp_domain.global_time: GLOBAL,
}
_WRAP = 2**32 * 1e-6
"""s; the camera counts microseconds in 32 bits, and the library passes this clock on as it is (it corrects the wrap
only when it converts to global time: ``src/global_timestamp_reader.cpp``)."""
_WINDOW, _BIN = 10.0, 1.0
"""s over which the smallest difference counts, and the step in which old ones are dropped."""
_CREDIBLE = 1.0
"""s; a time of day that gives an older or a younger capture was set in between."""
_JUMP = 1.0
"""s by which stamps and arrivals may drift apart before the camera's clock must have restarted. It has also restarted
whenever a stamp is older than the one before, by however little: a recording shorter than this may repeat."""


class ClockUnwrapper:
    """Stamps of the camera's own clock that continue where its counter wraps (after 71.6 min)."""

    def __init__(self) -> None:
        self._turns = 0
        self._last: float | None = None

    def __call__(self, stamp: float) -> float:
        if self._last is not None and self._last - stamp > _WRAP / 2.0:
            self._turns += 1
        self._last = stamp
        return stamp + self._turns * _WRAP


class _Offset:
    """The smallest difference between arrival and stamp over the last seconds."""

    def __init__(self) -> None:
        self._bins: deque[tuple[float, float]] = deque()
        """(arrival that began it, its smallest difference)"""
        self._last: tuple[float, float] | None = None
        """Stamp, and difference."""

    def __call__(self, stamp: float, arrival: float) -> float:
        difference = arrival - stamp
        if self._last is not None and (stamp < self._last[0] or abs(difference - self._last[1]) > _JUMP):
            self._bins.clear()  # another clock: the camera was reset, or a recording repeats
        self._last = stamp, difference
        if not self._bins or arrival - self._bins[-1][0] >= _BIN:
            self._bins.append((arrival, difference))
        elif difference < self._bins[-1][1]:
            self._bins[-1] = (self._bins[-1][0], difference)
        while arrival - self._bins[0][0] > _WINDOW:
            self._bins.popleft()
        return min(smallest for _, smallest in self._bins)


class CaptureTimes:
    """Times of captures on the host's monotonic clock, each later than the one before.

    Args:
        played: The frames come from a recording, whose time of day is not the present one.
    """

    def __init__(self, played: bool = False) -> None:
        self._played = played
        self._unwrap = ClockUnwrapper()
        self._offset = _Offset()
        self._last = float("-inf")

    def __call__(self, stamp: float, domain: str, arrival: float, wall: float) -> tuple[float, float]:
        """Return the time of a capture on the monotonic clock, and its stamp without the clock's wrap, s.

        ``arrival`` (monotonic clock, s) and ``wall`` (time of day, s) are when the frame arrived; ``domain`` is the
        clock of the stamp: ``hardware``, ``global`` or ``system``.
        """
        if domain == HARDWARE:
            stamp = self._unwrap(stamp)
        t = stamp + self._offset(stamp, arrival)
        if domain in (GLOBAL, SYSTEM) and not self._played and 0.0 <= wall - stamp <= _CREDIBLE:
            t = arrival - (wall - stamp)
        t = min(arrival, max(t, self._last + 1e-6))
        self._last = max(t, self._last)
        return t, stamp


# Matching.
#
# The library hands out frame sets in which it fills in the last frame of a stream that sent none (its aggregator does,
# src/pipeline/aggregator.cpp), so a set may contain old frames, or frames of two moments.

_ORDER = ("depth", "color", "infrared", "infrared_right")


class FrameStamp(NamedTuple):
    number: int
    """By the camera's own count."""
    stamp: float
    """On the clock ``domain``, s."""
    domain: str


class FrameMatch(Enum):
    NEW = "new"
    REPEATED = "repeated"
    """Its leading frame was handed out before."""
    MISMATCHED = "mismatched"
    """Its frames were taken at different times, or one of them was handed out before."""


class FrameMatcher:
    """Decides which frame sets are captures.

    The leading stream is the slowest one: each of its frames is at most one capture. The other frames belong to it if
    their stamps differ by no more than half a period of the fastest stream; stamps of different clocks are not
    compared. Frames without metadata (a kernel without RealSense's patches) are stamped at their arrival, each stream
    after a delay of its own: these may differ by a period of the slowest stream.

    Args:
        rates: Stream name -> frame rate, Hz.
    """

    def __init__(self, rates: Mapping[str, float]) -> None:
        self.lead = min(rates, key=lambda name: (rates[name], _ORDER.index(name)))
        self.tolerance = 0.5 / max(rates.values())
        """Of capture times, s."""
        self.arrival_tolerance = 1.0 / min(rates.values())
        """Of arrival times, s."""
        self._handed_out: dict[str, int] = {}

    def classify(self, frames: Mapping[str, FrameStamp]) -> FrameMatch:
        """Classify a set with a frame of every stream. A NEW one counts as handed out from then on."""
        first = frames[self.lead]
        if self._handed_out.get(self.lead) == first.number:
            return FrameMatch.REPEATED
        for name, frame in frames.items():
            if self._handed_out.get(name) == frame.number:
                return FrameMatch.MISMATCHED
            tolerance = self.arrival_tolerance if frame.domain == SYSTEM else self.tolerance
            if frame.domain == first.domain and abs(frame.stamp - first.stamp) > tolerance:
                return FrameMatch.MISMATCHED
        self._handed_out = {name: frame.number for name, frame in frames.items()}
        return FrameMatch.NEW


def measure_skew(frames: Mapping[str, FrameStamp]) -> float | None:
    """Return by how much colour was taken later than depth, s; None if the stamps do not show it."""
    color, depth = frames.get("color"), frames.get("depth")
    if color is None or depth is None or color.domain != depth.domain or color.domain == SYSTEM:
        return None
    return color.stamp - depth.stamp


class CaptureNumbers:
    """Capture numbers that continue where the camera's restart (a recording that repeats)."""

    def __init__(self) -> None:
        self._offset = 0
        self._last: int | None = None

    def __call__(self, number: int) -> int:
        """Return the number of a capture from that of its leading frame; gaps are kept."""
        if self._last is not None and number <= self._last:
            self._offset += self._last + 1 - number
        self._last = number
        return number + self._offset


# Conversion.

_DECODERS = {"yuyv": rs.yuy_decoder, "uyvy": lambda: rs.uyvy_converter(rs.format.rgb8)}
_BGR = ("bgr8", "bgra8")


class FrameConverter:
    """Converts frame sets to aligned, cropped and scaled images: colour as RGB, depth in metres.

    Copies, for each stream: alignment makes an image of its own (in the library, of depth or of colour), and the result
    is written once, into the memory in which it travels. A crop that scales makes one more, of the smaller image.
    """

    def __init__(self, spec: CameraSpec, profiles: Mapping[str, Any]) -> None:
        self._profiles = profiles
        self._near, self._far = spec.depth_min, spec.depth_max
        self._format = profiles["color"].format().name if "color" in profiles else ""
        self._decoder = _DECODERS[self._format]() if self._format in _DECODERS else None
        self._align = None
        if "color" in profiles and "depth" in profiles:
            self._align = rs.align(rs.stream.depth if spec.align == "depth" else rs.stream.color)
        self._to_depth = spec.align == "depth"
        self._metres: NDArray[np.float32] | None = None
        self._unit = 0.0
        self.cropping = {
            name: Cropping(target.width(), target.height(), spec.width, spec.height)
            for name in profiles
            for target in (profiles[self._view_of(name)],)
        }

    def _view_of(self, stream: str) -> str:
        """Return the stream whose view the images of ``stream`` are handed out in."""
        if self._align is None or stream not in ("color", "depth"):
            return stream
        return "depth" if self._to_depth else "color"

    def split(self, frames: Any) -> dict[str, Any] | None:
        """Return the frame of each stream, as the camera sent it; None if one is missing."""
        found: dict[str, Any] = {}
        for name, profile in self._profiles.items():
            if name == "color":
                frame = frames.get_color_frame()
            elif name == "depth":
                frame = frames.get_depth_frame()
            else:
                frame = frames.get_infrared_frame(profile.stream_index())
            if not frame:
                return None
            found[name] = frame
        return found

    def convert(self, frames: Any, single: Mapping[str, Any], into: Images) -> None:
        """Write the images of a frame set; ``single`` are its frames, as :meth:`split` returned them."""
        found = dict(single)
        if self._decoder is not None and self._to_depth:
            frames = self._decoder.process(frames).as_frameset()  # only RGB can be aligned
        if self._align is not None:
            aligned = self._align.process(frames)
            if self._to_depth:
                found["color"] = aligned.get_color_frame()
            else:
                found["depth"] = aligned.get_depth_frame()
        for name, image in into.items():
            if name == "depth":
                self._write_depth(found[name], image)
            elif name == "color":
                self._write_color(found[name], image)
            else:
                raw, crop = np.asanyarray(found[name].get_data()), self.cropping[name]
                np.copyto(image, raw if crop.is_identity else crop.color(raw))

    def _write_depth(self, frame: Any, into: NDArray[np.float32]) -> None:
        """Write metres, and 0 outside the range: both by one table."""
        raw = np.asanyarray(frame.get_data())
        crop = self.cropping["depth"]
        table = self._depth_table(frame.get_units())
        np.take(table, raw if crop.is_identity else crop.depth(raw), out=into, mode="clip")  # clip: without a buffer

    def _depth_table(self, unit: float) -> NDArray[np.float32]:
        """Return the metres of each raw value."""
        if self._metres is None or unit != self._unit:
            metres = np.arange(1 << 16) * unit
            metres[(metres < self._near) | (metres > self._far)] = 0.0
            self._metres, self._unit = metres.astype(np.float32), unit
        return self._metres

    def _write_color(self, frame: Any, into: NDArray[np.uint8]) -> None:
        if self._decoder is not None and not self._to_depth:
            frame = self._decoder.process(frame)
        image = np.asanyarray(frame.get_data())
        if image.shape[2] == 4:
            image = image[..., :3]
        crop = self.cropping["color"]
        if not crop.is_identity:
            image = crop.color(np.ascontiguousarray(image))
        if self._format in _BGR:
            for k in range(3):  # one channel at a time: a third of the time that a view with a negative step takes
                into[..., k] = image[..., 2 - k]
        else:
            np.copyto(into, image)


# The thread.

_WAIT = 0.1
"""s that one wait for a frame set takes at most."""
_PERIODS = 3.0
"""Periods for which a slow camera may be silent."""
_PAUSE = 0.0005
"""s between two checks whether the reader has made room."""


class StreamStart(NamedTuple):
    """What is known with the first capture of a session."""

    clock: str
    before: int
    """Number in the ring of the last frame of an earlier session."""


class _Capture(NamedTuple):
    """A set of frames that were taken together."""

    frames: Any
    single: Mapping[str, Any]
    stamps: Mapping[str, FrameStamp]
    arrival: float
    """When it arrived, on the monotonic clock, s."""
    wall: float
    """The time of day then, s."""


class FrameStreamer:
    """The thread that writes the captures of one session to the ring.

    Runs from its creation to :meth:`stop`, or until the camera is lost, which it reports once.
    """

    def __init__(
        self,
        spec: CameraSpec,
        profiles: Mapping[str, Any],
        pipeline: FramePipeline,
        ring: FrameRing,
        notify: Callable[[dict[str, Any]], None],
        *,
        stall: float,
        warm_up: float,
        every: bool,
    ) -> None:
        """Start the thread.

        Args:
            notify: Called from the thread with news: ``frame`` (number of the newest capture in the ring; 0 for none)
                and ``lost`` (the packed ConnectionLost).
            stall: Time without a new capture after which the camera is lost, s.
            warm_up: Time after the first capture in which none is handed out, s.
            every: Wait until there is room for each capture, instead of overwriting unread ones.
        """
        rates = {name: float(profile.fps()) for name, profile in profiles.items()}
        self._pipeline = pipeline
        self._ring = ring
        self._notify = notify
        self._stall = max(stall, _PERIODS / min(rates.values()))
        self._warm_up = warm_up
        self._every = every
        self._converter = FrameConverter(spec, profiles)
        self._matcher = FrameMatcher(rates)
        self._numbers = CaptureNumbers()
        self._times = CaptureTimes(played=not pipeline.is_live)
        self._repeated, self._mismatched = ring.tally
        self._before = ring.release_all()
        self._started: StreamStart | None = None
        self._warm_since: float | None = None
        self._seen: dict[str, tuple[int, float]] = {}
        """Stream -> number of its newest frame, and ``_silence`` when that arrived, s."""
        self._silence = 0.0
        """Time waited since the last capture, s."""
        self.lost: ConnectionLost | None = None
        """Why it ended by itself; None while it runs, and after :meth:`stop`."""
        self._changed = threading.Condition()
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="hal-realsense", daemon=True)
        self._thread.start()

    @property
    def cropping(self) -> Mapping[str, Cropping]:
        return self._converter.cropping

    def wait_for_start(self, timeout: float) -> StreamStart | None:
        """Block until the first capture; None if none came within ``timeout`` s, or if the thread ended before."""
        with self._changed:
            self._changed.wait_for(lambda: self._started is not None or self.lost is not None, timeout)
            return self._started

    def stop(self) -> None:
        """End the thread. Returns when it does not use the library any more."""
        self._stopping = True
        self._thread.join()

    def _run(self) -> None:
        try:
            lost = self._stream()
        except Exception as error:
            traceback.print_exc()  # the app quotes it if the process ends
            lost = ConnectionLost(f"{type(error).__name__}: {error}")
        if lost is not None:
            with self._changed:
                self.lost = lost
                self._changed.notify_all()
            if self._started is not None:
                self._notify({"lost": pack_error(lost)})

    def _stream(self) -> ConnectionLost | None:
        """Write captures until :meth:`stop` (returns None) or until no more will come (returns why)."""
        while not self._stopping:
            began = time.monotonic()
            frames = self._pipeline.wait(_WAIT)
            capture = self._newest_capture(frames)
            if capture is not None:
                self._write(capture)
                self._silence = 0.0
                continue
            # Only time spent waiting counts: a process that was stopped for a minute has not lost its camera.
            self._silence += min(time.monotonic() - began, 2.0 * _WAIT)
            ended = self._pipeline.end_reason() if frames is None else None
            if ended is not None:
                return ended
            if self._silence > self._stall and self._started is not None:  # wait_for_start bounds the first capture
                return ConnectionLost(self._describe_stall(), code="stalled")
        return None

    def _newest_capture(self, frames: Any | None) -> _Capture | None:
        """Return the last capture among this frame set and those that wait behind it."""
        newest = None
        while frames is not None:
            newest = self._match(frames) or newest
            frames = self._pipeline.poll()
        return newest

    def _match(self, frames: Any) -> _Capture | None:
        arrival, wall = time.monotonic(), time.time()
        single = self._converter.split(frames)
        if single is None:
            return None
        stamps = {name: _read_stamp(frame) for name, frame in single.items()}
        for name, stamp in stamps.items():
            if self._seen.get(name, (-1, 0.0))[0] != stamp.number:
                self._seen[name] = (stamp.number, self._silence)
        match = self._matcher.classify(stamps)
        if match is FrameMatch.NEW:
            return _Capture(frames, single, stamps, arrival, wall)
        self._repeated += match is FrameMatch.REPEATED
        self._mismatched += match is FrameMatch.MISMATCHED
        self._ring.tally = CameraTally(self._repeated, self._mismatched)
        return None

    def _write(self, capture: _Capture) -> None:
        first = capture.stamps[self._matcher.lead]
        t, t_device = self._times(first.stamp, first.domain, capture.arrival, capture.wall)
        seq = self._numbers(first.number)
        written = 0
        self._warm_since = capture.arrival if self._warm_since is None else self._warm_since
        if capture.arrival - self._warm_since >= self._warm_up and self._wait_for_room():
            self._converter.convert(capture.frames, capture.single, self._ring.open_slot())
            written = self._ring.publish(t, t_device, seq, measure_skew(capture.stamps))
        self._notify({"frame": written})
        if self._started is None:
            with self._changed:
                self._started = StreamStart(first.domain, self._before)
                self._changed.notify_all()

    def _wait_for_room(self) -> bool:
        """Wait, where every capture counts, until the ring has room; False if the thread is to end."""
        while self._every and self._ring.is_full:
            if self._stopping:
                return False
            time.sleep(_PAUSE)
        return True

    def _describe_stall(self) -> str:
        """Return a text that names the silent streams."""
        alive = [name for name, (_, silence) in self._seen.items() if silence > 0.5 * self._stall]
        silent = [name for name in self._seen if name not in alive]
        if not alive or not silent:
            what = "no frames that match" if alive else "no frames"
            return f"it has stalled: {what} for {self._silence:.1f} s"
        return f"it has stalled: no frames of {', '.join(silent)} for {self._silence:.1f} s, {', '.join(alive)} arrived"


def _read_stamp(frame: Any) -> FrameStamp:
    domain = _DOMAINS[frame.get_frame_timestamp_domain()]
    return FrameStamp(frame.get_frame_number(), frame.get_timestamp() / 1000.0, domain)
