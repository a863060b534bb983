"""Going to a pose by speeds: for a goal that a person drags about, and that a limit or a released dead-man holds up."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot

from .commands import Twist
from .pose import Pose
from .quaternion import difference

__all__ = ["towards"]

_GAIN = 4.0
"""1/s: the share of what is left that is covered per second near the goal. Far slower than the servo brakes, so it
arrives without overshoot."""


def towards(goal: Pose, tcp: Pose, linear: float, angular: float) -> Twist:
    """The speeds that bring ``tcp`` to ``goal``, both in the base frame: at most ``linear`` m/s and ``angular`` rad/s.

    Straight, and turning about one axis; both slow down towards the end.
    """
    left = difference((*tcp.position, *tcp.orientation), (*goal.position, *goal.orientation))
    return Twist(_capped(left[:3], linear), _capped(left[3:], angular))


def _capped(left: Sequence[float], most: float) -> list[float]:
    distance = hypot(*left)
    return [min(_GAIN, most / distance) * part for part in left] if distance > 0.0 else [0.0, 0.0, 0.0]
