"""Does the time of an arm's own clock pass as fast as that of the rig? A simulation that cannot keep up is slower."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any

from .columns import TIMES

__all__ = ["SLOW", "Pace", "simulated_pace"]

SLOW = 0.97
"""Of real time: below it, speeds in a recording are noticeably too low."""
_ENOUGH = 2.0
"""s of an episode before anything is said."""
_CHANGED = 0.02
"""By less the number that a person was told is not corrected."""
_ROBOT = f"{TIMES}robot."


class Pace:
    """That of each arm, over the rows of one episode so far."""

    def __init__(self, columns: Iterable[Sequence[Any]], simulated: Collection[str] = ()) -> None:
        """``columns`` (key, type, names) are those of a row; ``simulated`` are the arms in a simulated world."""
        self._places: dict[str, int] = {}
        self._simulated = simulated
        self._told = 1.0
        place = 0
        for key, _, names in columns:
            if key.startswith(_ROBOT):
                self._places[key.removeprefix(_ROBOT)] = place
            place += len(names)
        self._last: dict[str, tuple[float, float]] = {}
        self._passed: dict[str, tuple[float, float]] = {}
        """s on the rig's clock, and on the arm's own, while both went on."""

    def add(self, row: Sequence[float]) -> None:
        """One more row. An arm whose clock is not known, or begins anew, is left out as long as that is so."""
        for name, place in self._places.items():
            now = float(row[place]), float(row[place + 1])
            before, self._last[name] = self._last.get(name, now), now
            t, own = now[0] - before[0], now[1] - before[1]
            if t > 0.0 and own >= 0.0:  # false for NaN, too
                sums = self._passed.get(name, (0.0, 0.0))
                self._passed[name] = sums[0] + t, sums[1] + own

    def as_json(self) -> dict[str, float]:
        """By the arms' names; those are missing whose own clock is not known."""
        return {name: round(own / t, 4) for name, (t, own) in self._passed.items() if math.isfinite(own)}

    @property
    def trouble(self) -> str:
        """What a person should know of a simulation that is too slow; empty where it keeps up."""
        found = [
            own / t
            for name, (t, own) in self._passed.items()
            if name in self._simulated and t >= _ENOUGH and own < t * SLOW
        ]
        if not found:
            self._told = 1.0
            return ""
        if self._told == 1.0 or abs(min(found) - self._told) >= _CHANGED:
            self._told = min(found)
        return (
            f"the simulation runs at {self._told:.2f} of real time: speeds in this recording are too low; fewer or "
            "smaller cameras help"
        )


def simulated_pace(info: Mapping[str, Any]) -> float | None:
    """The slowest arm of a simulated world in an episode's own file; None where there is none, or it is not known."""
    resolved = info.get("rig", {}).get("resolved", {})
    driver = (resolved.get("world") or {}).get("driver")
    simulated = {robot["name"] for robot in resolved.get("robots", ()) if driver and robot["driver"] == driver}
    found = [float(pace) for name, pace in (info.get("pace") or {}).items() if name in simulated]
    return min(found, default=None)
