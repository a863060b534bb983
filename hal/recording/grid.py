"""When rows are due, and who makes them: a thread in real time, the clock itself in lock-step."""

from __future__ import annotations

import threading
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable
from typing import TYPE_CHECKING

from ..clock import LockStepClock

if TYPE_CHECKING:
    from ..clock import Clock
    from .sampling import Moment

__all__ = ["LAG", "Grid", "LockStepGrid", "RealTimeGrid"]

LAG = 0.1
"""s after its time that a row is made in real time: by then the picture that was taken at that time has arrived."""
_LATE = 1.0
"""A row that came later than so many periods counts as late. Nothing is missing in it: states have a history."""

Look = Callable[[], "Moment | Exception"]
"""Looks at what has no history; an error is one more thing that was seen."""
Make = Callable[[float, "Moment | Exception"], bool]
"""Makes the row of a time; False where no more are wanted."""


class Grid(ABC):
    """Calls ``look`` at each grid time, and ``make`` once what belongs to that time is known."""

    def __init__(self, clock: Clock, fps: int, look: Look, make: Make) -> None:
        self._clock = clock
        self._period = 1.0 / fps
        self._look = look
        self._make = make
        self.start_time = clock.now()
        """Of the first row, s on the clock."""
        self.late = 0
        """Grid times that were noticed more than a period late."""
        self._number = 0

    def _due(self) -> float:
        return self.start_time + self._number * self._period

    @abstractmethod
    def start(self) -> None:
        """Begin with a row of the present."""

    @abstractmethod
    def stop(self) -> None:
        """No further grid times; returns when all rows are made. Idempotent."""


class RealTimeGrid(Grid):
    """A thread of its own, which nothing that moves ever waits for."""

    def __init__(self, clock: Clock, fps: int, look: Look, make: Make) -> None:
        super().__init__(clock, fps, look, make)
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._run, name="hal-recorder", daemon=True)

    def start(self) -> None:
        self._thread.start()

    def stop(self) -> None:
        self._stopping.set()
        if self._thread is not threading.current_thread():
            self._thread.join()

    def _run(self) -> None:
        waiting: deque[tuple[float, Moment | Exception]] = deque()
        while True:
            now = self._clock.now()
            if not self._stopping.is_set() and self._due() <= now:
                moment = self._look()
                while self._due() <= now:
                    self.late += now - self._due() > _LATE * self._period
                    waiting.append((self._due(), moment))
                    self._number += 1
            while waiting and waiting[0][0] + LAG <= self._clock.now():
                if not self._make(*waiting.popleft()):
                    return
            if self._stopping.is_set():
                if not waiting:
                    return
                self._clock.sleep_until(waiting[0][0] + LAG)
            else:
                next_row = waiting[0][0] + LAG if waiting else self._due()
                self._stopping.wait(max(0.0, min(next_row, self._due()) - self._clock.now()))


class LockStepGrid(Grid):
    """Rows exactly at their times: the clock stops there, whoever waits for however long."""

    def __init__(self, clock: Clock, fps: int, look: Look, make: Make) -> None:
        super().__init__(clock, fps, look, make)
        assert isinstance(clock, LockStepClock)
        self._stepped = clock
        self._advance = clock._advance_to
        self._wanted = True

    def start(self) -> None:
        self._stepped._advance_to = self._advance_by_rows
        self._take()

    def stop(self) -> None:
        self._wanted = False
        if self._stepped._advance_to == self._advance_by_rows:
            self._stepped._advance_to = self._advance

    def _advance_by_rows(self, t: float) -> None:
        while self._wanted and self._due() <= t + 1e-9:
            self._advance(self._due())
            self._take()
        self._advance(t)

    def _take(self) -> None:
        self._number += 1
        self._wanted = self._wanted and self._make(self._clock.now(), self._look())
