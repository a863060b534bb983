"""``rig.clock``: the same loop waits in real time and steps a lock-step simulation."""

from __future__ import annotations

import contextlib
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from typing import NamedTuple

from .arguments import number

__all__ = ["Clock", "LockStepClock", "RealClock", "Tick"]

_ROUNDING = 1e-9
_LONGEST = 1e9
"""s; nobody waits for 30 years."""


class Tick(NamedTuple):
    """One turn of a paced loop."""

    t: float
    """Time on the clock, s."""
    dt: float
    """Time since the turn before, s: a whole number of periods."""
    missed: int
    """Turns that were skipped because the loop's body took too long; they are never caught up."""
    elapsed: float = 0.0
    """Time since the loop's first turn, s: the same in real time and in lock-step."""


class Clock(ABC):
    """Seconds that only go forward."""

    @abstractmethod
    def now(self) -> float:
        """Seconds: the host's monotonic clock, or simulated time."""

    @abstractmethod
    def sleep_until(self, t: float) -> None:
        """Return when the clock shows ``t``. In lock-step this is what makes time go on."""

    def sleep(self, seconds: float) -> None:
        """Let ``seconds`` pass."""
        self.sleep_until(self.now() + number("seconds", seconds))

    def rate(self, hz: float) -> Iterator[Tick]:
        """Turn for ever, ``hz`` times a second. The first turn comes at once.

        Raises:
            CommandError: The rate is not positive, or not finite.
        """
        return self._turns(1.0 / number("a rate", hz, "Hz", least=0.0, above=True, most=1e9))

    def _turns(self, period: float) -> Iterator[Tick]:
        start = self.now()
        turn, missed = 0, 0
        while True:
            now = self.now()
            yield Tick(now, period * (1 + missed), missed, now - start)
            turn += 1
            late = int((self.now() - start) / period + 1e-9) - turn
            missed = max(0, late)
            turn += missed
            self.sleep_until(start + turn * period)


class RealClock(Clock):
    """The host's monotonic clock, the same in every process of this machine."""

    def now(self) -> float:
        return time.monotonic()

    def sleep_until(self, t: float) -> None:
        rest = t - time.monotonic()
        if rest > 0.0:
            time.sleep(rest if rest < _LONGEST else number("t", t, "s on this clock", most=_LONGEST))
        elif rest != rest:
            number("t", t, "s on this clock")


class LockStepClock(Clock):
    """Simulated time: it stands still until somebody waits, and then runs as fast as the machine can."""

    def __init__(self, now: Callable[[], float], advance_to: Callable[[float], None]) -> None:
        self._now = now
        self._advance_to = advance_to
        self._stops: list[_Stop] = []
        self._going = threading.RLock()
        """Time goes on in one thread only."""

    def now(self) -> float:
        return self._now()

    def sleep_until(self, t: float) -> None:
        if not abs(t) < _LONGEST:
            number("t", t, "s on this clock", most=_LONGEST)
        with self._going:
            while (stop := self._next(t)) is not None:
                self._advance_to(stop.due)
                stop.take(self._now())
            self._advance_to(t)

    def every(self, seconds: float, call: Callable[[], object]) -> Callable[[], None]:
        """Have time stop every ``seconds`` from now on, whoever waits for however long, and ``call`` called there.

        It is called by the thread that waits, and what it raises is raised there. The function that comes back ends
        this; any thread may call it, at any time, more than once. Raises CommandError for a time that is not positive.
        """
        number("seconds", seconds, least=0.0, above=True)
        stop = _Stop(self.now(), seconds, call)
        self._stops.append(stop)

        def detach() -> None:
            with contextlib.suppress(ValueError):  # it was ended before
                self._stops.remove(stop)

        return detach

    def _next(self, t: float) -> _Stop | None:
        """The first stop on the way to ``t``; of several at one time, the one that was there first."""
        ahead = [stop for stop in tuple(self._stops) if stop.due <= t + _ROUNDING]
        return min(ahead, key=lambda stop: stop.due, default=None)


class _Stop:
    """What is called at ``start`` and every ``period`` s from then on, but for the start itself."""

    def __init__(self, start: float, period: float, call: Callable[[], object]) -> None:
        self._start = start
        self._period = period
        self._call = call
        self._number = 1

    @property
    def due(self) -> float:
        """When it is called next, s."""
        return self._start + self._number * self._period

    def take(self, now: float) -> None:
        """Call it; what lies behind by now is not caught up."""
        self._number = 1 + max(self._number, int((now - self._start) / self._period + _ROUNDING))
        self._call()
