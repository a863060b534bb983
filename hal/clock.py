"""``rig.clock``: a paced loop waits in real time, and advances the simulation in lock-step."""

from __future__ import annotations

import contextlib
import os
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import NamedTuple

from .arguments import number

_ROUNDING = 1e-9
_LONGEST = 1e9
"""Greatest time of a sleep, s."""
_BETWEEN = 0.004
"""Least time between two ticks of a loop that an event wakes, s."""
_STEP = 0.001
"""Time after which the simulation, which takes whole steps of its own, is looked at for such an event again, s."""


class Tick(NamedTuple):
    """One iteration of a paced loop."""

    t: float
    """Time on the clock, s."""
    dt: float
    """Time since the last iteration, s: a whole number of periods, but for a loop that an event wakes."""
    missed: int
    """Iterations that were skipped because the loop's body took too long; they are never made up for."""
    elapsed: float = 0.0
    """Time since the loop's first iteration, s; the same in real time and in lock-step."""


class Clock(ABC):
    """A clock that only moves forward, in s."""

    @abstractmethod
    def now(self) -> float:
        """Return the time, s: of the host's monotonic clock, or of the simulation."""

    @abstractmethod
    def sleep_until(self, t: float) -> None:
        """Wait until the clock shows ``t``, s. In lock-step this advances the simulation."""

    def sleep(self, seconds: float) -> None:
        """Wait for a duration, s. In lock-step this advances the simulation."""
        self.sleep_until(self.now() + number("seconds", seconds))

    def rate(self, hz: float, wake: threading.Event | None = None) -> Iterator[Tick]:
        """Yield a :class:`Tick` ``hz`` times a second, for ever; the first at once.

        Args:
            hz: Rate, Hz.
            wake: Also yield a tick as soon as this event is set, 4 ms after the last tick at the earliest, and clear
                it (see :meth:`hal.Gamepad.wake`).

        Raises:
            CommandError: The rate is not positive, or not finite.
        """
        return self._turns(1.0 / number("a rate", hz, "Hz", least=0.0, above=True, most=1e9), wake)

    def _turns(self, period: float, wake: threading.Event | None) -> Iterator[Tick]:
        start = self.now()
        turn, missed = 0, 0
        dt = period
        while True:
            now = self.now()
            yield Tick(now, dt, missed, now - start)
            turn += 1
            late = int((self.now() - start) / period + 1e-9) - turn
            missed = max(0, late)
            turn += missed
            dt = period * (1 + missed)
            while wake is not None and self._is_woken(wake, start + turn * period):
                before, now = now, self.now()
                yield Tick(now, now - before, 0, now - start)
                dt = start + turn * period - now
            self.sleep_until(start + turn * period)

    @abstractmethod
    def _is_woken(self, wake: threading.Event, t: float) -> bool:
        """Wait until the event is set, which clears it, or until the time ``t``; return whether it was set."""


class RealClock(Clock):
    """The host's monotonic clock, the same in every process of this computer."""

    def now(self) -> float:
        """Return the time of the host's monotonic clock, s."""
        return time.monotonic()

    def sleep_until(self, t: float) -> None:
        """Wait until the clock shows ``t``, s."""
        rest = t - time.monotonic()
        if rest > 0.0:
            time.sleep(rest if rest < _LONGEST else number("t", t, "s on this clock", most=_LONGEST))
        elif rest != rest:
            number("t", t, "s on this clock")

    def _is_woken(self, wake: threading.Event, t: float) -> bool:
        self.sleep_until(min(t, self.now() + _BETWEEN))
        woken = wake.wait(max(0.0, t - self.now())) and self.now() < t
        wake.clear()
        return woken


class LockStepClock(Clock):
    """Simulated time: it stands still until the program waits, and then runs as fast as the computer can.

    Args:
        now: Returns the simulated time, s.
        advance_to: Advances the simulation to a time, s.
    """

    def __init__(self, now: Callable[[], float], advance_to: Callable[[float], None]) -> None:
        self._now = now
        self._advance_to = advance_to
        self._stops: list[_Stop] = []
        self._going = threading.RLock()
        """Only one thread at a time advances the simulation."""

    def now(self) -> float:
        """Return the simulated time, s."""
        return self._now()

    def sleep_until(self, t: float) -> None:
        """Advance the simulation to ``t``, s."""
        if not abs(t) < _LONGEST:
            number("t", t, "s on this clock", most=_LONGEST)
        with self._going:
            while (stop := self._find_next(t)) is not None:
                self._advance_to(stop.due)
                stop.run(self._now())
            self._advance_to(t)

    def _is_woken(self, wake: threading.Event, t: float) -> bool:
        self.sleep_until(min(t, self.now() + _BETWEEN))
        while not wake.is_set() and self.now() < t - _ROUNDING:
            self.sleep_until(min(t, self.now() + _STEP))
        woken = wake.is_set() and self.now() < t - _ROUNDING
        wake.clear()
        return woken

    def call_every(self, seconds: float, call: Callable[[], object]) -> Callable[[], None]:
        """Call a function at regular simulated times, from the thread that waits then.

        An exception of the function is raised by that wait.

        Args:
            seconds: Period, s, counted from now.
            call: The function.

        Returns:
            A function that ends the calls; any thread may call it, more than once.

        Raises:
            CommandError: The period is not positive.
        """
        number("seconds", seconds, least=0.0, above=True)
        stop = _Stop(self.now(), seconds, call)
        self._stops.append(stop)

        def detach() -> None:
            with contextlib.suppress(ValueError):  # already removed
                self._stops.remove(stop)

        return detach

    def _find_next(self, t: float) -> _Stop | None:
        """Return the first stop up to ``t``; of several at the same time, the one that was added first."""
        ahead = [stop for stop in tuple(self._stops) if stop.due <= t + _ROUNDING]
        return min(ahead, key=lambda stop: stop.due, default=None)


class _Stop:
    """A function that is called every ``period`` s after ``start``."""

    def __init__(self, start: float, period: float, call: Callable[[], object]) -> None:
        self._start = start
        self._period = period
        self._call = call
        self._number = 1

    @property
    def due(self) -> float:
        """Time of the next call, s."""
        return self._start + self._number * self._period

    def run(self, now: float) -> None:
        """Call the function; calls that are overdue are skipped."""
        self._number = 1 + max(self._number, int((now - self._start) / self._period + _ROUNDING))
        self._call()


def describe_load() -> str:
    """Return words for a message if more programs want to run than there are processors; else nothing."""
    load, count = os.getloadavg()[0] if hasattr(os, "getloadavg") else 0.0, os.cpu_count() or 1
    return f" (this computer is busy: a load of {load:.1f} on {count} processors)" if load > count else ""
