"""Target trajectory of an emulated UR arm, and the arm that follows it, in steps of the controller's cycle.

UR does not publish how ``servoj`` filters its targets. Here two lags in a row, together as long as ``lookahead_time``,
stand for it; ``gain`` has no effect, and the arm follows its trajectory with a lag of 4 ms.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pinocchio

__all__ = ["ROBOTS", "TargetMotion", "forward", "parameters"]

Floats = list[float]
Vector = np.ndarray[Any, np.dtype[np.float64]]

ROBOTS = {
    "ur3": ((-0.24365, -0.21325), (0.1519, 0.11235, 0.08535, 0.0819), 125),
    "ur5": ((-0.425, -0.39225), (0.089159, 0.10915, 0.09465, 0.0823), 125),
    "ur10": ((-0.612, -0.5723), (0.1273, 0.163941, 0.1157, 0.0922), 125),
    "ur3e": ((-0.24355, -0.2132), (0.15185, 0.13105, 0.08535, 0.0921), 500),
    "ur5e": ((-0.425, -0.3922), (0.1625, 0.1333, 0.0997, 0.0996), 500),
    "ur10e": ((-0.6127, -0.57155), (0.1807, 0.17415, 0.11985, 0.11655), 500),
    "ur16e": ((-0.4784, -0.36), (0.1807, 0.17415, 0.11985, 0.11655), 500),
    "ur20": ((-0.862, -0.7287), (0.2363, 0.2010, 0.1593, 0.1543), 500),
}
"""Arm -> lengths a2 and a3; d1, d4, d5 and d6, m; rate, Hz (125: a CB3). From UR's article "DH Parameters for
calculations of kinematics and dynamics"."""

TOP_SPEED = 3.35
"""Speed above which the arm stops, rad/s: 191 degrees/s, the joints' limit in the safety configuration."""
TOP_ACCELERATION = 60.0
"""Acceleration of the target above which the arm stops with C153, rad/s2: chosen; UR does not publish it."""
_FOLLOWING = 0.004
"""Lag of the arm behind its target, s."""


def parameters(robot: str) -> Vector:
    """Return the nominal DH parameters (4, 6) of a key of :data:`ROBOTS`: theta, rad; a and d, m; alpha, rad."""
    (a2, a3), (d1, d4, d5, d6), _ = ROBOTS[robot]
    right = math.pi / 2
    return np.array([[0.0] * 6, [0, a2, a3, 0, 0, 0], [d1, 0, 0, d4, d5, d6], [right, 0, 0, right, -right, 0]])


def forward(dh: Vector, q: Sequence[float], tcp: Sequence[float]) -> Floats:
    """Return the pose of the tcp in the controller's base frame: m, and a rotation vector, rad.

    The tcp is given so in the frame of the flange; ``dh`` is as from :func:`parameters`.
    """
    model, data, flange = _chain(dh.tobytes())
    pinocchio.forwardKinematics(model, data, np.asarray(q, float))
    tool = pinocchio.SE3(pinocchio.exp3(np.asarray(tcp[3:], float)), np.asarray(tcp[:3], float))
    pose = data.oMi[model.njoints - 1] * flange * tool
    return [*pose.translation.tolist(), *pinocchio.log3(pose.rotation).tolist()]


@functools.lru_cache(maxsize=4)
def _chain(dh: bytes) -> tuple[Any, Any, Any]:
    """Return the model of the chain, data for it, and the flange in the frame of the last joint."""
    model, after = pinocchio.Model(), pinocchio.SE3.Identity()
    for k, (offset, a, d, alpha) in enumerate(np.frombuffer(dh).reshape(4, -1).T):
        turn = pinocchio.SE3(pinocchio.utils.rotate("z", offset), np.zeros(3))
        model.addJoint(k, pinocchio.JointModelRZ(), after * turn, f"joint{k}")
        after = pinocchio.SE3(pinocchio.utils.rotate("x", alpha), np.array([a, 0.0, d]))
    return model, model.createData(), after


class TargetMotion:
    """The target of the controller and the joints that follow it. All lists are (6,), rad, rad/s, rad/s2."""

    def __init__(self, q: Sequence[float], dt: float) -> None:
        self.dt = dt
        self.scale = 1.0
        """Share of the speed that the slider allows."""
        self.limit = 1.0
        """Share of that to which the controller scales the speed, as near a safety limit."""
        self.place(q)

    def place(self, q: Sequence[float]) -> None:
        self.q, self.dq, self.ddq = list(q), [0.0] * 6, [0.0] * 6
        self.actual_q, self.actual_dq = list(q), [0.0] * 6
        self.hold()

    def hold(self) -> None:
        self._kind = "hold"
        self._between = list(self.q)

    def servo(self, q: Sequence[float], lookahead: float) -> None:
        """Follow a target position, like ``servoj``."""
        if self._kind != "servo":
            self._kind, self._between = "servo", list(self.q)
        self._goal, self._lookahead = list(q), max(lookahead, 0.03)

    def speed(self, dq: Sequence[float], acceleration: float) -> None:
        """Accelerate to a speed and keep it, like ``speedj``."""
        self._kind, self._goal, self._most = "speed", list(dq), acceleration

    def stop(self, deceleration: float) -> None:
        """Come to rest, like ``stopj``."""
        self._kind, self._goal, self._most = "stop", [0.0] * 6, max(deceleration, 0.1)

    def move(self, q: Sequence[float], speed: float, acceleration: float) -> None:
        """Move to a position with a trapezoid of speed, all joints together, like ``movej``."""
        self._kind, self._from, self._goal = "move", list(self.q), list(q)
        self._way = max(abs(b - a) for a, b in zip(self.q, q, strict=True))
        self._done, self._pace = 0.0, 0.0
        self._top, self._most = max(speed, 1e-3), max(acceleration, 1e-3)

    @property
    def at_rest(self) -> bool:
        return self._kind in ("hold", "servo")

    def step(self) -> str | None:
        """Let a cycle pass. Returns why the arm must stop (``C153``), or None."""
        dt, before, dq_before = self.dt, self.q, self.dq
        q = self._next()
        dq = [(b - a) / dt for a, b in zip(before, q, strict=True)]
        ddq = [(b - a) / dt for a, b in zip(dq_before, dq, strict=True)]
        if self._kind == "servo" and (max(map(abs, ddq)) > TOP_ACCELERATION or max(map(abs, dq)) > TOP_SPEED):
            return "C153"  # the target that jumped is not followed
        self.q, self.dq, self.ddq = q, dq, ddq
        share = 1.0 - math.exp(-dt / _FOLLOWING)
        actual = [a + share * (b - a) for a, b in zip(self.actual_q, q, strict=True)]
        self.actual_dq = [(b - a) / dt for a, b in zip(self.actual_q, actual, strict=True)]
        self.actual_q = actual
        return None

    def _next(self) -> Floats:
        dt = self.dt * self.scale * self.limit
        if self._kind == "servo":
            share = 1.0 - math.exp(-2.0 * dt / self._lookahead)
            self._between = [a + share * (b - a) for a, b in zip(self._between, self._goal, strict=True)]
            return [a + share * (b - a) for a, b in zip(self.q, self._between, strict=True)]
        if self._kind in ("speed", "stop"):
            most = max(abs(b - a) for a, b in zip(self.dq, self._goal, strict=True))
            share = min(1.0, self._most * self.dt / most) if most > 0.0 else 1.0
            dq = [a + share * (b - a) for a, b in zip(self.dq, self._goal, strict=True)]
            if self._kind == "stop" and not any(dq):
                self.hold()
            return [a + v * self.dt for a, v in zip(self.q, dq, strict=True)]
        if self._kind == "move":
            brake = math.sqrt(max(0.0, 2.0 * self._most * (self._way - self._done)))
            self._pace = min(self._pace + self._most * dt, self._top, brake)
            self._done += max(self._pace, 1e-4) * dt
            if self._done >= self._way:
                goal = self._goal
                self.q = list(goal)
                self.hold()
                return list(goal)
            share = self._done / self._way
            return [a + share * (b - a) for a, b in zip(self._from, self._goal, strict=True)]
        return list(self.q)
