"""Joints that do not follow their set-points: the same fault for arms on a bus and in simulation."""

from __future__ import annotations

from collections.abc import Sequence
from math import dist, inf

from .errors import Fault

Floats = Sequence[float]


class Following:
    """The distances of an arm's joints from their set-points, and how long they have been too large.

    Args:
        joints: The joints in words, from base to tip.
        limits: Largest distance of each joint, rad.
        lag: How much larger it may be for each rad/s of the set-point, s.
        patience: Time for which it may be larger still, s.
    """

    def __init__(self, joints: Sequence[str], limits: Floats, lag: float = 0.0, patience: float = 0.0) -> None:
        self._joints, self.limits = tuple(joints), tuple(limits)
        self._lag, self._patience = lag, patience
        self._least = min(limits)
        self._since = inf

    def forget(self) -> None:
        """Forget for how long a joint has been too far away."""
        self._since = inf

    def check(self, now: float, q: Floats, target: Floats, speed: Floats) -> Fault | None:
        """Return a fault that names the first joint which has been too far from its set-point for too long.

        Args:
            now: Time, s.
            q: Joint positions (n,), rad.
            target: Set-point (n,), rad.
            speed: Its speed (n,), rad/s.
        """
        if dist(q, target) <= self._least:
            self._since = inf
            return None
        for k, limit in enumerate(self.limits):
            away = abs(target[k] - q[k])
            if away > limit + self._lag * abs(speed[k]):
                self._since = min(self._since, now)
                if now - self._since < self._patience:
                    return None
                self._since = inf
                return Fault(
                    "not_following",
                    f"{self._joints[k]} is {away:.2f} rad away from its set-point",
                    "check what the arm touches, and its load (`payload` in the rig)",
                )
        self._since = inf
        return None
