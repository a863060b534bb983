"""Inverse kinematics of a pose: bounded damped least squares from several starts."""

from __future__ import annotations

import math
import random
from collections.abc import Iterator
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from ..errors import Unreachable
from ..geometry import Pose

Array = NDArray[np.float64]

ITERATIONS = 80
"""Steps from one start; a start that converges needs about ten."""
RADIAN_IN_METRES = 0.3
"""Weight of orientation, m/rad, when two positions that both miss the pose are compared."""
STEP_MAX = 0.5
"""Longest step of a joint, rad: the Jacobian is not valid farther away."""
CANDIDATES = 4
"""Solutions to choose the nearest from, when the search from the seed finds none."""


class IkModel(Protocol):
    """An arm with n joints, as the search needs it; see :class:`~hal.kinematics.arm.Kinematics`."""

    lower: Array
    """(n,) rad."""
    upper: Array
    """(n,) rad."""
    home: Array
    """(n,) rad."""

    def pose_error(self, q: Array, pose: Array) -> Array:
        """Return the constant twist (6,) that takes the tcp from ``q`` to ``pose`` (7,) in 1 s."""

    def jacobian(self, q: Array) -> Array:
        """Return the Jacobian (6, n) of the tcp at ``q``."""


def solve(
    arm: IkModel, pose: Pose, seed: Array, position_tolerance: float, rotation_tolerance: float, starts: int
) -> Array:
    """Return joint positions (n,) inside the limits that bring the tcp to ``pose``.

    Args:
        arm: The arm.
        pose: Pose of the tcp in the arm's base frame.
        seed: (n,) joint positions to start from; a solution near them is preferred.
        position_tolerance: m.
        rotation_tolerance: rad.
        starts: Most points to search from; they are the same in every call.

    Raises:
        Unreachable: No start led to the pose.
    """
    target = np.concatenate([pose.position, pose.orientation])
    closest: _Result | None = None
    found: list[Array] = []
    for number, start in enumerate(_starts(arm, seed, starts)):
        result = _descend(arm, target, start, position_tolerance, rotation_tolerance)
        if result.position_error <= position_tolerance and result.rotation_error <= rotation_tolerance:
            if number == 0:
                return result.q
            found.append(result.q)
            if len(found) == CANDIDATES:
                break
        elif closest is None or result.miss() < closest.miss():
            closest = result
    if found:
        return min(found, key=lambda q: float(np.abs(q - seed).max()))
    assert closest is not None
    position_error, rotation_error = _errors(arm.pose_error(closest.q, target))
    few = f"; with {len(seed)} joints the tcp cannot take every orientation" if len(seed) < 6 else ""
    raise Unreachable(
        f"no joint position inside the limits brings the tcp to {pose!r}{few}",
        position_error=position_error,
        rotation_error=rotation_error,
        q=tuple(closest.q.tolist()),
    )


def _starts(arm: IkModel, seed: Array, count: int) -> Iterator[Array]:
    """Yield the seed, home, then points between the seed and random ones, ever farther from the seed."""
    lower, upper = _search_range(arm, seed)
    yield np.clip(seed, lower, upper)
    if count > 1:
        yield np.clip(arm.home, lower, upper)
    numbers = random.Random(0)  # the same starts in every call
    for k in range(2, count):
        anywhere = np.array([numbers.uniform(a, b) for a, b in zip(lower, upper, strict=True)])
        share = min(1.0, 2.0 * k / count)
        yield np.clip((1.0 - share) * seed + share * anywhere, lower, upper)


def _search_range(arm: IkModel, seed: Array) -> tuple[Array, Array]:
    """Return the limits; for a joint without an end, one turn either way of the seed."""
    return np.maximum(arm.lower, seed - 2 * math.pi), np.minimum(arm.upper, seed + 2 * math.pi)


def _descend(
    arm: IkModel, target: Array, start: Array, position_tolerance: float, rotation_tolerance: float
) -> _Result:
    """Search from one start by Levenberg-Marquardt.

    The damping is that of Sugihara (IEEE T-RO 27(5), 2011) for unreachable targets: half the squared error and a small
    bias. Joints that press against a limit are left out of the step.
    """
    q = start.copy()
    lower, upper = arm.lower, arm.upper
    error = arm.pose_error(q, target)
    best = _Result(q, *_errors(error))
    stalled = 0
    for _ in range(ITERATIONS):
        if best.position_error <= 0.1 * position_tolerance and best.rotation_error <= 0.1 * rotation_tolerance:
            break
        jacobian = arm.jacobian(q)
        gradient = error @ jacobian
        free = ~(((q <= lower) & (gradient < 0.0)) | ((q >= upper) & (gradient > 0.0)))
        if not free.any():
            break
        columns = jacobian[:, free]
        normal = columns.T @ columns
        normal.flat[:: len(normal) + 1] += 0.5 * float(error @ error) + 1e-9
        step = np.zeros_like(q)
        step[free] = np.linalg.solve(normal, gradient[free])
        longest = float(np.abs(step).max())
        if longest > STEP_MAX:
            step *= STEP_MAX / longest
        q = np.clip(q + step, lower, upper)
        error = arm.pose_error(q, target)
        result = _Result(q, *_errors(error))
        stalled = 0 if result.miss() < 0.999 * best.miss() else stalled + 1
        if result.miss() < best.miss():
            best = result
        if stalled == 8:
            break
    return best


class _Result(NamedTuple):
    q: Array
    position_error: float
    rotation_error: float

    def miss(self) -> float:
        return self.position_error + RADIAN_IN_METRES * self.rotation_error


def _errors(twist: Array) -> tuple[float, float]:
    return math.sqrt(float(twist[:3] @ twist[:3])), math.sqrt(float(twist[3:] @ twist[3:]))
