"""Where a person has dragged the handle of an arm's tcp: a wish that lapses. Pure: no clock, no page, no arm.

Nothing here moves anything. An app may move towards a goal while its dead-man is held; this file only sees to it that
what is left of a drag does not surprise anybody later.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from math import hypot, inf, isfinite
from typing import NamedTuple

from hal.geometry import Pose

__all__ = ["FARTHEST", "REACHED_ANGLE", "REACHED_DISTANCE", "UNUSED", "Drag", "Goal", "checked_pose"]

REACHED_DISTANCE, REACHED_ANGLE = 0.002, 0.01
"""How near the tcp must be for a goal to count as reached, m and rad."""
UNUSED = 10.0
"""A goal that is neither dragged nor approached for so long lapses, s: also that of a page which froze in a drag."""
_APPROACH = 0.002
"""What counts as nearer, m; a radian counts as 0.2 m."""
FARTHEST = 5.0
"""Nothing that far from the base is a goal, m."""


class Goal(NamedTuple):
    """A pose of the tcp in the arm's base frame."""

    seq: int
    """Counts what was dragged; never the same twice."""
    position: tuple[float, ...]
    """(3,) m."""
    orientation: tuple[float, ...]
    """(4,) unit quaternion x, y, z, w."""


def checked_pose(position: Sequence[float], orientation: Sequence[float]) -> Pose | None:
    """A pose from numbers that came over a wire; None where they make no sense (not finite, or far away)."""
    numbers = [*position, *orientation]
    if len(position) != 3 or len(orientation) != 4 or not all(map(isfinite, numbers)):
        return None
    if hypot(*position) > FARTHEST or not 0.5 < hypot(*orientation) < 2.0:
        return None
    return Pose(position, orientation)


class Drag:
    """What happens to one handle. Thread-safe: pages and the loop that draws tell it from different threads.

    It belongs to the page that grabbed it, until that lets go.
    """

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._seq = 0
        self._goal: Goal | None = None
        self._owner: int | None = None
        self._grabbed = False
        self._used = 0.0
        self._nearest = inf
        self._tripped = False

    @property
    def goal(self) -> Goal | None:
        """The newest goal; None when there is none."""
        return self._goal

    @property
    def free(self) -> bool:
        """Does the handle follow the tcp?"""
        return self._goal is None and not self._grabbed

    def grab(self, page: int) -> None:
        """A page took hold of the handle; it counts unless another one holds it."""
        with self._lock:
            if not self._grabbed:
                self._owner, self._grabbed = page, True

    def move(self, page: int, position: Sequence[float], orientation: Sequence[float], now: float) -> bool:
        """It was dragged to there, in the base frame. False where that does not count."""
        pose = checked_pose(position, orientation)
        with self._lock:
            if pose is None or not self._grabbed or page != self._owner:
                return False
            self._seq += 1
            self._goal = Goal(self._seq, tuple(pose.position.tolist()), tuple(pose.orientation.tolist()))
            self._used, self._nearest = now, inf
            return True

    def release(self, page: int) -> None:
        """The page let go of the handle. Its goal stays."""
        with self._lock:
            if page == self._owner:
                self._grabbed = False

    def leave(self, page: int) -> None:
        """The page was closed, or its connection lost."""
        with self._lock:
            if page == self._owner:
                self._clear()

    def clear(self) -> None:
        """Forget the goal. What is still being dragged counts again only when it was let go of and grabbed anew."""
        with self._lock:
            self._clear()

    def _clear(self) -> None:
        self._goal, self._owner, self._grabbed = None, None, False

    def update(self, now: float, tcps: Sequence[Pose], *, tripped: bool) -> None:
        """Clear what is reached by one of the tcps (measured, set-point), unused, or older than a trip.

        So an arm that has tripped goes nowhere when it is released again.
        """
        with self._lock:
            if tripped and not self._tripped:
                self._clear()
            self._tripped = tripped
            if self._goal is None:
                return
            goal = Pose(self._goal.position, self._goal.orientation)
            distances = [tcp.distance(goal) for tcp in tcps]
            nearest = min(distance + 0.2 * angle for distance, angle in distances)
            if nearest < self._nearest - _APPROACH:
                self._used, self._nearest = now, nearest
            near = any(distance <= REACHED_DISTANCE and angle <= REACHED_ANGLE for distance, angle in distances)
            if (near and not self._grabbed) or now - self._used > UNUSED:
                self._clear()
