"""A copy of the world that follows the world that is stepped: in the process that draws, or beside it in lock-step."""

from __future__ import annotations

import re
from collections import deque
from typing import Any

from hal.host.memory import SeriesBox

from .drawn import DrawnWorld
from .world import SimulatedWorld


class WorldMirror:
    """Poses a copy of the world by the snapshots and the edits of the world that is stepped in another process."""

    def __init__(self, world: DrawnWorld, snapshots: SeriesBox) -> None:
        self._world = world
        self._snapshots = snapshots
        self._edits: dict[int, tuple[str, dict[str, Any]]] = {}
        self._number = 0
        self._t: float | None = None

    def note_edit(self, method: str, params: dict[str, Any], revision: int) -> None:
        """Note an edit; it is made before the first snapshot of its revision is shown. They may come in any order."""
        self._edits[revision] = (method, params)

    def update(self) -> float | None:
        """Show the newest snapshot, and return its time, s.

        Returns None before the first one, and while an edit that it includes has not arrived: snapshots come through
        memory and may overtake edits, which come through a socket.
        """
        record = self._snapshots.read()
        if record is None:
            return None
        number, t, revision, values = record
        if number == self._number:
            return self._t
        world = self._world
        while world.revision < revision:
            edit = self._edits.pop(world.revision + 1, None)
            if edit is None:
                return None
            world.request(*edit)
        world.show(values)
        self._number, self._t = number, t
        return t


class LocalMirror:
    """What is drawn of a world that is stepped in this process, which has not been edited yet."""

    def __init__(self, world: SimulatedWorld[Any]) -> None:
        self.world = world
        self.drawn = DrawnWorld(world.spec)
        self._shown: tuple[tuple[int, int], int] | None = None
        """Version of the world, and the step of it that is shown."""
        self._past: deque[tuple[int, list[float]]] = deque(maxlen=0)
        """Step and snapshot of past states; empty if no camera has a latency."""
        world.on_edit(self._repeat)

    def _repeat(self, method: str, params: dict[str, Any], revision: int) -> None:
        self.drawn.request(method, params)
        if method == "randomize":
            latest = [value for key, value in params["values"].items() if _LATENCY.fullmatch(key)]
            steps = round(max(latest, default=0.0) / self.world.dt)
            self._past = deque(maxlen=steps + 1 if steps else 0)
            self.world.before_steps("pictures", self._note_state if steps else None)

    def _note_state(self) -> None:
        self._past.append((self.world.steps, self.world.snapshot()))

    def update(self, latency: float = 0.0) -> float:
        """Show the state that the world had ``latency`` s ago, but none before a reset; return its time, s."""
        world = self.world
        wanted = max(world.steps - round(latency / world.dt), world.began_at)
        snapshot: list[float] | None = None
        if wanted < world.steps:  # else the present, which may have been edited since the step
            kept = ((step, state) for step, state in self._past if step >= wanted)
            wanted, snapshot = next(kept, (world.steps, None))
        if self._shown != (world.version, wanted):
            self.drawn.show(world.snapshot() if snapshot is None else snapshot)
            self._shown = world.version, wanted
        return wanted * world.dt


_LATENCY = re.compile(r"cameras\.[^.]+\.latency_s")
