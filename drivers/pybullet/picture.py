"""Where everything is, as one list of numbers: taken from one world, shown by another with the same bodies."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from .body import Body
from .library import Client

__all__ = ["Picture"]


class Picture:
    """The order of the numbers, for one set of bodies.

    First the poses (7) of all bodies whose base stands still, then of each other body, in order, the pose (7) of its
    base if that moves freely or is carried, and its joint positions. Poses are PyBullet's own, of the centre of mass.

    Bases that stand still are read once, here: make a new picture when one was moved by hand.
    """

    def __init__(self, client: Client, bodies: Iterable[Body]) -> None:
        everything = list(bodies)
        self._client = client
        self._still = [body.id for body in everything if not body.roams]
        self._still_values: list[float] = []
        for number in self._still:
            position, orientation = client.getBasePositionAndOrientation(number)
            self._still_values += [*position, *orientation]
        self._moving = [(body.id, body.roams, body.movable) for body in everything if body.moves]
        self.size = len(self._still_values) + sum(7 * roams + len(joints) for _, roams, joints in self._moving)

    def take(self) -> list[float]:
        """Where everything is now."""
        values = self._still_values.copy()
        pose_of, joints_of = self._client.getBasePositionAndOrientation, self._client.getJointStates
        for number, roams, movable in self._moving:
            if roams:
                position, orientation = pose_of(number)
                values += position
                values += orientation
            if movable:
                values += [state[0] for state in joints_of(number, movable)]
        return values

    def show(self, picture: Sequence[float]) -> None:
        """Put everything where a picture says. Raises ValueError when it is one of other bodies."""
        values = list(picture)
        if len(values) != self.size:
            raise ValueError(f"a snapshot of {len(values)} numbers does not fit a world of {self.size}")
        put, put_joints = self._client.resetBasePositionAndOrientation, self._client.resetJointStatesMultiDof
        place = len(self._still_values)
        if values[:place] != self._still_values:
            for k, number in enumerate(self._still):
                put(number, values[7 * k : 7 * k + 3], values[7 * k + 3 : 7 * k + 7])
            self._still_values = values[:place]
        for number, roams, movable in self._moving:
            if roams:
                put(number, values[place : place + 3], values[place + 3 : place + 7])
                place += 7
            if movable:
                put_joints(number, movable, [[value] for value in values[place : place + len(movable)]])
                place += len(movable)
