"""From a camera's stamps to the host's monotonic clock.

A stamp is on one of three clocks (``rs2_timestamp_domain``). On the first two the host's time of day is at hand, and
one subtraction brings it to the monotonic clock. On the camera's own clock nobody knows when its zero was. What is
known is when each frame arrived: always too late, by at least the shortest way that a frame takes. So of the
differences between arrival and stamp the smallest of the last seconds is taken, and a capture's time is its stamp plus
that. It is late by that shortest way (exposure, readout, USB: about one period), and steady to the drift
of a quartz, 50 us/s at most, over those seconds. No time is later than the arrival.
"""

from __future__ import annotations

from collections import deque

__all__ = ["CaptureTimes", "Unwrapped"]

GLOBAL, SYSTEM, HARDWARE = "global", "system", "hardware"
_WRAP = 2**32 * 1e-6
"""s; the camera counts microseconds in 32 bits, and the library hands its own clock on as it is (it mends the wrap only
on its way to global time: ``src/global_timestamp_reader.cpp``)."""
_WINDOW, _BIN = 10.0, 1.0
"""s; over how long the smallest difference counts, and the step in which it is forgotten."""
_CREDIBLE = 1.0
"""s; a time of day that gives an older or a younger capture was set in between."""
_JUMP = 1.0
"""s by which stamps and arrivals may drift apart before the camera's clock must have begun anew. So it has whenever a
stamp is older than the one before, by however little: a recording of less than this repeats."""


class Unwrapped:
    """Stamps of the camera's own clock, s, that go on where its counter starts at zero again (after 71.6 min)."""

    def __init__(self) -> None:
        self._turns = 0
        self._last: float | None = None

    def __call__(self, stamp: float) -> float:
        if self._last is not None and self._last - stamp > _WRAP / 2.0:
            self._turns += 1
        self._last = stamp
        return stamp + self._turns * _WRAP


class _Offset:
    """The smallest difference between arrival and stamp in the last seconds."""

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
    """When captures were taken, on the host's monotonic clock; each is later than the one before."""

    def __init__(self, played: bool = False) -> None:
        self._played = played
        """A recording's time of day is that of another day."""
        self._unwrap = Unwrapped()
        self._offset = _Offset()
        self._last = float("-inf")

    def __call__(self, stamp: float, domain: str, arrival: float, wall: float) -> tuple[float, float]:
        """Time of capture, and the device's own stamp made steady, s.

        ``arrival`` is on the monotonic clock, ``wall`` the time of day at that same moment, both in s.
        """
        if domain == HARDWARE:
            stamp = self._unwrap(stamp)
        t = stamp + self._offset(stamp, arrival)
        if domain in (GLOBAL, SYSTEM) and not self._played and 0.0 <= wall - stamp <= _CREDIBLE:
            t = arrival - (wall - stamp)
        t = min(arrival, max(t, self._last + 1e-6))
        self._last = max(t, self._last)
        return t, stamp
