"""What sets the pace of a group's cycle in its own process: time, a device, or the app that steps it."""

from __future__ import annotations

import time
from abc import ABC, abstractmethod
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..histogram import Histogram
from .records import AppRecord

if TYPE_CHECKING:
    from .cycle import Cycle

__all__ = ["DevicePace", "Pace", "Steps", "Suspension"]

_ASLEEP = 0.1
"""A computer that slept for longer than this, s, was suspended."""


class Pace(ABC):
    """When the next cycle begins."""

    def __init__(self) -> None:
        self.periods = Histogram(2e-5, 5000)
        """Time between two cycles, s."""
        self._last = 0.0

    @property
    def missed(self) -> int:
        """Cycles that were skipped."""
        return 0

    @property
    def pausing(self) -> bool:
        """Does time stand still until somebody asks for more?"""
        return False

    @abstractmethod
    def wait(self) -> float:
        """Block until the next cycle; returns its time on the group's clock, s."""

    def now(self) -> float:
        """The group's clock, s."""
        return time.monotonic()

    def heard(self, app: AppRecord) -> AppRecord:
        """The app's newest word, with its heartbeat on the group's clock."""
        return app

    def run_free(self) -> None:  # noqa: B027  # most do not wait for the app
        """The app is done: go on without it."""

    def restart(self) -> None:
        """Go on from now, counting nothing as missed: after work for which the group's time was paused."""
        self._last = 0.0

    def reset_statistics(self) -> None:
        """Count from zero."""
        self.periods = Histogram(2e-5, 5000)

    def _note(self, now: float) -> None:
        if self._last:
            self.periods.add(now - self._last)
        self._last = now


class DevicePace(Pace):
    """A device's own cycle (a Franka's state packets)."""

    def __init__(self, cycle: Cycle) -> None:
        super().__init__()
        self._cycle = cycle

    @property
    def missed(self) -> int:
        """Cycles of the device of which nothing was seen."""
        return self._cycle.lost_cycles

    def wait(self) -> float:
        self._cycle.wait()
        now = time.monotonic()
        self._note(now)
        return now

    def restart(self) -> None:
        """A device does not pause."""


class Steps(Pace):
    """Lock-step: so many cycles as the app asks for, then time stands still."""

    def __init__(self, cycle: Cycle, attend: Callable[[float], None]) -> None:
        """``attend(timeout)`` serves a request of the app, if one comes."""
        super().__init__()
        self._cycle = cycle
        self._attend = attend
        self._granted = 0
        self._free = False

    def grant(self, cycles: int) -> None:
        """The app asks for so many."""
        self._granted += cycles

    @property
    def pausing(self) -> bool:
        return self._granted <= 0 and not self._free

    def now(self) -> float:
        return self._cycle.ticks * self._cycle.dt

    def wait(self) -> float:
        while self.pausing:
            self._attend(0.05)
        self._granted -= 1
        if self._cycle.paces_itself:
            self._cycle.wait()
        return (self._cycle.ticks + 1) * self._cycle.dt

    def heard(self, app: AppRecord) -> AppRecord:
        """An app that steps is there by definition."""
        return AppRecord((self._cycle.ticks + 1) * self._cycle.dt, app.stops)

    def run_free(self) -> None:
        self._free = True


class Suspension:
    """Notices that the computer was suspended, in which its monotonic clock stands still."""

    def __init__(self) -> None:
        self._clock = getattr(time, "CLOCK_BOOTTIME", None)
        self._asleep = self._slept()

    def _slept(self) -> float:
        """How long it was suspended since it was started, s; 0 where the system cannot say."""
        return time.clock_gettime(self._clock) - time.monotonic() if self._clock is not None else 0.0

    def ended(self) -> bool:
        """Was it suspended since the last call?"""
        before, self._asleep = self._asleep, self._slept()
        return self._asleep - before > _ASLEEP
