"""When the rows of a recording are due: in real time by a thread, in lock-step by the clock that the rig steps."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING, TypeAlias

from ..clock import LockStepClock

if TYPE_CHECKING:
    from ..clock import Clock
    from .sampling import RowSnapshot

LAG = 0.1
"""Delay after its due time at which a row is made in real time, s: by then the picture of that time has arrived."""
_LATE = 1.0
"""A due time noticed later than this many periods counts as late. No data is missing in such a row: states have a
history."""

Read: TypeAlias = "Callable[[], RowSnapshot | Exception]"
"""Reads the values without a history. An error is returned, and raised when the row is made."""
Make: TypeAlias = "Callable[[float, RowSnapshot | Exception], bool]"
"""Makes the row that was due at a time; returns False if no further row is wanted."""


class SampleClock(ABC):
    """Calls ``read`` at each due time of a row, and ``make`` once everything that belongs to that time is available.

    Subclasses differ in who calls: a thread in real time, the clock itself in lock-step.
    """

    def __init__(self, clock: Clock, fps: int, read: Read, make: Make) -> None:
        self._clock = clock
        self._period = 1.0 / fps
        self._read = read
        self._make = make
        self.start_time = clock.now()
        """Time of the first row, s on the clock."""
        self.late = 0
        """Number of due times that were noticed more than a period late."""

    @abstractmethod
    def start(self) -> None:
        """Start with a row of the present time."""

    @abstractmethod
    def end(self) -> None:
        """Stop reading: no further due times. Rows that are due are still made. Idempotent."""

    def stop(self) -> None:
        """Stop reading, and block until all rows are made."""
        self.end()


class RealTimeSampleClock(SampleClock):
    """Makes the rows in a thread of its own, so that no control loop waits for them."""

    def __init__(self, clock: Clock, fps: int, read: Read, make: Make) -> None:
        super().__init__(clock, fps, read, make)
        self._number = 0
        """Number of the next row."""
        self._waiting: deque[tuple[float, RowSnapshot | Exception]] = deque()
        self._ending = threading.Event()
        self._reading = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="hal-recorder", daemon=True)

    def start(self) -> None:
        self._notice()  # at once, so that there is always a first row
        self._thread.start()

    def end(self) -> None:
        self._ending.set()
        with self._reading:  # let a read in progress finish
            pass

    def stop(self) -> None:
        self.end()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def _due(self) -> float:
        return self.start_time + self._number * self._period

    def _notice(self) -> None:
        with self._reading:
            now = self._clock.now()
            if self._ending.is_set() or self._due() > now:
                return
            snapshot = self._read()
        while self._due() <= now:
            self.late += now - self._due() > _LATE * self._period
            self._waiting.append((self._due(), snapshot))
            self._number += 1

    def _run(self) -> None:
        waiting = self._waiting
        while True:
            self._notice()
            while waiting and waiting[0][0] + LAG <= self._clock.now():
                if not self._make(*waiting.popleft()):
                    return
            if self._ending.is_set():
                if not waiting:
                    return
                self._clock.sleep_until(waiting[0][0] + LAG)
            else:
                next_row = waiting[0][0] + LAG if waiting else self._due()
                self._ending.wait(max(0.0, min(next_row, self._due()) - self._clock.now()))


class LockStepSampleClock(SampleClock):
    """Makes each row exactly at its time: the lock-step clock stops there until the row is made."""

    def __init__(self, clock: Clock, fps: int, read: Read, make: Make) -> None:
        super().__init__(clock, fps, read, make)
        assert isinstance(clock, LockStepClock)
        self._stepped = clock
        self._wanted = True
        self._making = threading.RLock()
        """Held while a row is made: another thread may call :meth:`end` meanwhile."""
        self._detach: Callable[[], None] = lambda: None

    def start(self) -> None:
        self._make_row()
        if self._wanted:
            self._detach = self._stepped.call_every(self._period, self._make_row)

    def end(self) -> None:
        self._wanted = False
        self._detach()
        with self._making:  # wait for a row in progress
            pass

    def _make_row(self) -> None:
        with self._making:
            if self._wanted and not self._make(self._clock.now(), self._read()):
                self._wanted = False
