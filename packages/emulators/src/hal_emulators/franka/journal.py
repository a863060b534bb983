"""Record of the emulator: events with their times, and counters over a run."""

from __future__ import annotations

import sys
import time
from collections import deque
from typing import Any

from hal.histogram import Histogram

STALL = 0.02
"""Lateness of a cycle above which its time and length are recorded, s."""
_KEPT = 1000


class Journal:
    """The last thousand events; each is also printed as a line."""

    def __init__(self, quiet: bool = False) -> None:
        self._quiet = quiet
        self._events: deque[dict[str, Any]] = deque(maxlen=_KEPT)
        self._number = 0

    def record(self, kind: str, text: str, **details: object) -> None:
        """Record an event: its kind and further values for programs, a line for people."""
        self._number += 1
        self._events.append({"n": self._number, "t": time.monotonic(), "kind": kind, "text": text, **details})
        if not self._quiet:
            self.print(text)

    def print(self, text: str) -> None:
        """Print a line with the time of day; print nothing once standard output is closed."""
        now = time.time()
        clock = time.strftime("%H:%M:%S", time.localtime(now))
        try:
            print(f"{clock}.{int(now % 1 * 1000):03d}  {text}", flush=True)
        except (OSError, ValueError):
            self._quiet = True
            sys.stdout = open("/dev/null", "w")  # noqa: SIM115  # prevents an error at the interpreter's exit

    def events(self, last: int = _KEPT) -> list[dict[str, Any]]:
        """Return the last events: n, t (monotonic clock, s), kind, text, and details."""
        return list(self._events)[-last:]


class Counters:
    """Counters and times since the start or the last reset."""

    def __init__(self) -> None:
        self.since = time.monotonic()
        self.cycles = 0
        self.states = 0
        """States that were sent."""
        self.states_lost = 0
        """States that were lost by fault commands."""
        self.commands = 0
        """Commands received, of any kind."""
        self.accepted = 0
        self.lost = 0
        """Cycles of a motion without their command."""
        self.lost_in_row = 0
        """Largest number of consecutive ones."""
        self.thrown_away = 0
        """Commands lost by the fault commands."""
        self.stale = 0
        """Commands that answered an older state than the last one sent."""
        self.malformed = 0
        self.motions = 0
        self.reflexes = 0
        self.lateness = Histogram(2e-5, 2000)
        self.answers = Histogram(5e-6, 4000)
        """From a state sent to its command received."""
        self.stalls: deque[tuple[float, float]] = deque(maxlen=_KEPT)
        """Due time of a cycle (monotonic clock, s) and its lateness, s."""

    def late(self, due: float, by: float) -> None:
        """Record a cycle that was ``due`` (monotonic clock, s) and ran ``by`` s later."""
        self.lateness.add(by)
        if by >= STALL:
            self.stalls.append((due, by))

    def report(self) -> dict[str, Any]:
        values: dict[str, Any] = {}
        for name, value in vars(self).items():
            if isinstance(value, Histogram):
                values[name] = value.summary()
            elif isinstance(value, deque):
                values[name] = [{"t": t, "length": length} for t, length in value]
            else:
                values[name] = value
        return values
