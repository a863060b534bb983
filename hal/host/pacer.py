"""A periodic loop against absolute deadlines: what came too late is skipped and counted, never caught up."""

from __future__ import annotations

import time

from .pace import Pace

__all__ = ["Pacer"]


class Pacer(Pace):
    """Wakes its caller every ``period`` s."""

    def __init__(self, period: float) -> None:
        super().__init__()
        self.period = period
        self._missed = 0
        self._next = time.monotonic() + period

    @property
    def missed(self) -> int:
        """Periods that were skipped."""
        return self._missed

    def wait(self) -> float:
        """Sleep until the next deadline; returns the time of waking, s."""
        now = time.monotonic()
        if now < self._next:
            time.sleep(self._next - now)
            now = time.monotonic()
        late = int((now - self._next) / self.period)
        if late > 0:
            self._missed += late
            self._next += late * self.period
        self._next += self.period
        self._note(now)
        return now

    def restart(self) -> None:
        """What took less than a period was no pause: many of those would slow time down, and no count would show it."""
        paused = int((time.monotonic() - self._next) / self.period)
        if paused > 0:
            super().restart()
            self._next += paused * self.period

    def reset_statistics(self) -> None:
        super().reset_statistics()
        self._missed = 0
