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

    @abstractmethod
    def start(self) -> None:
        """Begin with a row of the present."""

    @abstractmethod
    def end(self) -> None:
        """No further grid times, and nothing is looked at any more once this returns. Idempotent."""

    @abstractmethod
    def stop(self) -> None:
        """The same; returns when all rows are made."""


class RealTimeGrid(Grid):
    """A thread of its own, which nothing that moves ever waits for."""

    def __init__(self, clock: Clock, fps: int, look: Look, make: Make) -> None:
        super().__init__(clock, fps, look, make)
        self._number = 0
        """Of the next row."""
        self._waiting: deque[tuple[float, Moment | Exception]] = deque()
        self._ending = threading.Event()
        self._looking = threading.Lock()
        self._thread = threading.Thread(target=self._run, name="hal-recorder", daemon=True)

    def start(self) -> None:
        self._notice()  # here and now: whatever comes next, there is a first row
        self._thread.start()

    def end(self) -> None:
        self._ending.set()
        with self._looking:  # a look that is under way is let end
            pass

    def stop(self) -> None:
        self.end()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join()

    def _due(self) -> float:
        return self.start_time + self._number * self._period

    def _notice(self) -> None:
        """Look, where a row is due."""
        with self._looking:
            now = self._clock.now()
            if self._ending.is_set() or self._due() > now:
                return
            moment = self._look()
        while self._due() <= now:
            self.late += now - self._due() > _LATE * self._period
            self._waiting.append((self._due(), moment))
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


class LockStepGrid(Grid):
    """Rows exactly at their times: the clock stops there, whoever waits for however long."""

    def __init__(self, clock: Clock, fps: int, look: Look, make: Make) -> None:
        super().__init__(clock, fps, look, make)
        assert isinstance(clock, LockStepClock)
        self._stepped = clock
        self._wanted = True
        self._taking = threading.RLock()
        """Held while a row is made: another thread may end this meanwhile."""
        self._detach: Callable[[], None] = lambda: None

    def start(self) -> None:
        self._take()
        if self._wanted:
            self._detach = self._stepped.every(self._period, self._take)

    def end(self) -> None:
        self._wanted = False
        self._detach()
        with self._taking:  # a row that is under way is made
            pass

    def stop(self) -> None:
        self.end()

    def _take(self) -> None:
        with self._taking:
            if self._wanted and not self._make(self._clock.now(), self._look()):
                self._wanted = False
                self._detach()
