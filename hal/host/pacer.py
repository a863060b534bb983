"""A periodic loop against absolute deadlines: what came too late is skipped and counted, never caught up."""

from __future__ import annotations

import contextlib
import ctypes
import gc
import os
import sys
import time

from .pace import Pace

__all__ = ["Pacer", "prepare_process"]

_PR_SET_TIMERSLACK = 29


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


def prepare_process(realtime: bool = False) -> str:
    """Make this process wake up on time; returns what was done, in words.

    Needs no privilege: a timer slack of 1 ns (prctl), and no garbage collection. With ``realtime``: SCHED_FIFO and
    locked memory as well, where the user may; without them it goes on all the same.
    """
    gc.collect()
    gc.freeze()
    gc.disable()
    if not sys.platform.startswith("linux"):
        return "default scheduling"
    libc = ctypes.CDLL(None, use_errno=True)
    libc.prctl(_PR_SET_TIMERSLACK, 1, 0, 0, 0)
    if not realtime:
        return "default scheduling"
    try:
        os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(50))
    except OSError:
        return "default scheduling (no right to SCHED_FIFO: see 'ulimit -r')"
    locked = libc.mlockall(3) == 0
    return "SCHED_FIFO, memory locked" if locked else "SCHED_FIFO"


def yield_to_others(nice: int) -> None:
    """What draws comes after the servo: a lower priority, no claim to run at once, and one processor left alone.

    The last of these matters most: a servo at 1 kHz beside two cameras on two cores missed 6 to 10 % of its ticks
    without it, 0.3 to 0.4 % with it (benchmarks/real_time.py).
    """
    os.nice(nice)
    with contextlib.suppress(AttributeError, OSError):  # Linux only
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))
        processors = sorted(os.sched_getaffinity(0))
        if len(processors) > 1:
            os.sched_setaffinity(0, processors[1:])
