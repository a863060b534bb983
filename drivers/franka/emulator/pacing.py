"""When the next cycle begins: by the clock, or when the client has answered."""

from __future__ import annotations

import time
from dataclasses import dataclass

from .journal import Figures
from .samples import DT

__all__ = ["Pacer", "Pacing"]


@dataclass(frozen=True)
class Pacing:
    """How cycles follow each other.

    In real time a state leaves every millisecond, answered or not. In lock-step, while a motion runs, the emulator
    waits for the answer to each state, so nothing is lost however slow either side is: for tests, and for running
    faster than real time. While nothing moves both send a state every millisecond.
    """

    lockstep: bool = False
    paced: bool = True
    """Lock-step only: no cycle is shorter than a millisecond."""
    patience: float = 5.0
    """Lock-step only: an answer that takes longer, s, counts as lost."""

    def describe(self) -> str:
        """In words."""
        if not self.lockstep:
            return "real time"
        return "lock-step, paced" if self.paced else "lock-step"


class Pacer:
    """Absolute deadlines, a millisecond apart. A cycle that is more than one late moves all later ones: nothing is
    caught up, so the client always has its millisecond."""

    def __init__(self) -> None:
        self._due = time.monotonic()

    def wait(self, figures: Figures | None) -> None:
        """Sleep until the next deadline, and write down how late that became, unless somebody else was waited for."""
        self._due += DT
        left = self._due - time.monotonic()
        if left > 0.0:
            time.sleep(left)
        now = time.monotonic()
        late = now - self._due
        if figures is not None:
            figures.late(self._due, late)
        if late > DT:
            self._due = now

    def skip(self) -> None:
        """The next deadline is a millisecond from now."""
        self._due = time.monotonic()
