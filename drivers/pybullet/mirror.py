"""A copy of the world that follows the one which is stepped, in whatever process."""

from __future__ import annotations

from typing import Any

from hal.host.memory import SeriesBox

from .world import World

__all__ = ["Mirror"]


class Mirror:
    """Poses ``world``, made with ``mirror=True``, by the snapshots that the stepped world's process publishes."""

    def __init__(self, world: World, snapshots: SeriesBox) -> None:
        self.world = world
        self._snapshots = snapshots
        self._edits: dict[int, tuple[str, dict[str, Any]]] = {}
        self._number = 0
        self._t: float | None = None

    def edited(self, method: str, params: dict[str, Any], revision: int) -> None:
        """Note an edit; it is done before the first snapshot of its revision is shown. Any order will do."""
        self._edits[revision] = (method, params)

    def update(self) -> float | None:
        """Show the newest snapshot; returns its time, s.

        None before the first one, and while an edit that it includes is still on its way: snapshots come through
        memory and may overtake edits, which come through a socket.
        """
        record = self._snapshots.read()
        if record is None:
            return None
        number, t, revision, values = record
        if number == self._number:
            return self._t
        world = self.world
        while world.revision < revision:
            edit = self._edits.pop(world.revision + 1, None)
            if edit is None:
                return None
            world.request(*edit)
        world.show(values)
        self._number, self._t = number, t
        return t
