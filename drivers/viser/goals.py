"""The goal of a dragged handle, and when it ends. Pure: no clock, no page, no arm.

A goal moves nothing by itself: an app may move the arm towards it while its dead-man is held. Goals end by themselves,
so that an old one does not move the arm unexpectedly.
"""

from __future__ import annotations

import threading
from collections.abc import Sequence
from math import hypot, inf, isfinite
from typing import NamedTuple

from hal.geometry import Pose

REACHED_DISTANCE, REACHED_ANGLE = 0.002, 0.01
"""Distances of the tcp at which a goal counts as reached, m and rad."""
UNUSED = 10.0
"""Time after which a goal that is neither dragged nor approached ends, s: also that of a page that froze in a drag."""
_APPROACH = 0.002
"""Decrease of the distance that counts as an approach, m; a radian counts as 0.2 m."""
FARTHEST = 5.0
"""Greatest distance of a goal from the base, m."""


class DraggedGoal(NamedTuple):
    """A pose of the tcp in the arm's base frame."""

    seq: int
    """Number of the drag event; never the same twice."""
    page: int
    """Number of the page that drags it."""
    pose: Pose


def checked_pose(position: Sequence[float], orientation: Sequence[float]) -> Pose | None:
    """Return a pose from received numbers; None where they are not finite, of a wrong count, or too far away."""
    numbers = [*position, *orientation]
    if len(position) != 3 or len(orientation) != 4 or not all(map(isfinite, numbers)):
        return None
    if hypot(*position) > FARTHEST or not 0.5 < hypot(*orientation) < 2.0:
        return None
    return Pose(position, orientation)


class HandleDrag:
    """The state of one handle. Thread-safe: pages and the drawing loop use it from different threads.

    The handle belongs to the page that grabbed it, until that releases it.
    """

    def __init__(self) -> None:
        self._lock = threading.RLock()
        self._seq = 0
        self.goal: DraggedGoal | None = None
        """The newest goal; None when there is none."""
        self._owner = 0
        self._grabbed = False
        self._used = 0.0
        self._nearest = inf
        self._tripped = False

    @property
    def free(self) -> bool:
        """Whether the handle follows the tcp."""
        return self.goal is None and not self._grabbed

    def grab(self, page: int) -> None:
        """Grab the handle for a page; no effect while another page holds it."""
        with self._lock:
            if not self._grabbed:
                self._owner, self._grabbed = page, True

    def move(self, page: int, position: Sequence[float], orientation: Sequence[float], now: float) -> bool:
        """Set the goal, in the base frame; False where the pose is invalid or the page does not hold the handle."""
        pose = checked_pose(position, orientation)
        with self._lock:
            if pose is None or not self._grabbed or page != self._owner:
                return False
            self._seq += 1
            self.goal = DraggedGoal(self._seq, page, pose)
            self._used, self._nearest = now, inf
            return True

    def release(self, page: int) -> None:
        """Release the handle. Its goal stays."""
        with self._lock:
            if page == self._owner:
                self._grabbed = False

    def leave(self, page: int) -> None:
        """Clear the goal of a page that was closed, or whose connection is lost."""
        with self._lock:
            if page == self._owner:
                self.clear()

    def clear(self) -> None:
        """Clear the goal. A drag under way counts again only after the handle is released and grabbed."""
        with self._lock:
            self.goal, self._owner, self._grabbed = None, 0, False

    def update(self, now: float, tcps: Sequence[Pose], *, tripped: bool) -> None:
        """Clear the goal where it is reached, unused, or older than a trip.

        So an arm that has tripped does not continue to an old goal after it is rearmed.

        Args:
            now: Monotonic time, s.
            tcps: The measured tcp and that of the set-point, in the base frame; one of them must reach the goal.
            tripped: Whether a stop of the arm is latched.
        """
        with self._lock:
            if tripped and not self._tripped:
                self.clear()
            self._tripped = tripped
            if self.goal is None:
                return
            distances = [tcp.distance(self.goal.pose) for tcp in tcps]
            nearest = min(distance + 0.2 * angle for distance, angle in distances)
            if nearest < self._nearest - _APPROACH:
                self._used, self._nearest = now, nearest
            near = any(distance <= REACHED_DISTANCE and angle <= REACHED_ANGLE for distance, angle in distances)
            if (near and not self._grabbed) or now - self._used > UNUSED:
                self.clear()
