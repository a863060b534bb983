"""A copy of the world, in the process that draws it, that follows the world that is stepped."""

from __future__ import annotations

from typing import Any

from hal.host.memory import SeriesBox

from .world import PyBulletWorld

__all__ = ["WorldMirror"]


class WorldMirror:
    """Poses a world by the snapshots and the edits of the world that is stepped.

    Args:
        world: The copy, made with ``mirror=True``.
        snapshots: Where the stepped world's process publishes its snapshots.
    """

    def __init__(self, world: PyBulletWorld, snapshots: SeriesBox) -> None:
        self.world = world
        self._snapshots = snapshots
        self._edits: dict[int, tuple[str, dict[str, Any]]] = {}
        self._number = 0
        self._t: float | None = None

    def edited(self, method: str, params: dict[str, Any], revision: int) -> None:
        """Note an edit; it is made before the first snapshot of its revision is shown. They may come in any order."""
        self._edits[revision] = (method, params)

    def update(self) -> float | None:
        """Show the newest snapshot.

        Returns:
            Its time, s. None before the first one, and while an edit that it includes has not arrived: snapshots come
            through memory and may overtake edits, which come through a socket.
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
