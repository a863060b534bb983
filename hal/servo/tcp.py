"""What can be said about the tcp without computing it anew: where it was a moment ago, and how far it can have got.

Forward kinematics and a Jacobian in every tick would cost more than all the rest of it. Most ticks need neither: the
tcp is nowhere near a face of the workspace or its greatest speed, and a bound that costs a few multiplications proves
it. Only where the bound does not are they computed.

Every bound rests on `Kinematics.reach`, r: joint i at 1 rad/s moves the tcp at r_i m/s at most, wherever the arm is,
and turning joint j by x rad changes each column of the linear Jacobian J by r_j |x| at most. With dq the joint speeds,
and d = q - q_reference the way of the joints from where the tcp was looked at:

* |tcp(q) - tcp(q_reference)| <= m, where m = sum r_i |d_i| <= |r| |d|;
* |J(q) dq| <= sum r_i |dq_i|;
* |J(q) dq| <= |J(q_reference) dq| + m sum |dq_i| <= (|J(q_reference)| + |r| |d| sqrt(n)) |dq|.

The looser forms are products of lengths, which cost one call each; the sharper ones are tried where those fail.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import chain
from math import dist, hypot, inf, sqrt
from operator import mul
from typing import TYPE_CHECKING, Any

from ..kinematics import Kinematics, Pose7
from ..specs import WorkspaceSpec
from .limits import stop_displacement
from .smoothing import JointSmoother

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

__all__ = ["TcpReference"]

Floats = Sequence[float]

_SAME = 2e-3
"""The Jacobian is computed anew when the tcp may have moved this far, m: it errs by 2 mm/s per rad/s."""


class TcpReference:
    """The tcp at a joint position nearby."""

    def __init__(self, smoother: JointSmoother, kinematics: Kinematics, workspace: WorkspaceSpec | None) -> None:
        self._smoother = smoother
        self._kinematics = kinematics
        self._workspace = workspace
        self._reach = kinematics.reach()
        self._reach_length = hypot(*self._reach)
        self._spread = self._reach_length * sqrt(smoother.n)
        self._at: Floats = [inf] * smoother.n
        """Joint positions of the reference; infinitely far before the first look."""
        self._pose: Pose7 = (inf,) * 7
        self._jacobian: Any = None
        self._rows: list[list[float]] = []
        """The linear Jacobian there, (3, n)."""
        self._stretch = inf
        """The tcp's speed there for joint speeds of length 1 is no greater (it is the Jacobian's Frobenius norm)."""
        self._clearance = inf
        """Distance of the tcp there from the nearest face of the workspace, m; negative outside."""
        self._stops: list[tuple[float, float, float]] = []
        """Per joint, its greatest speed, rad/s, and how far its stop moves the tcp at most: so many m for each rad/s
        and each rad/s2 that it begins with."""
        self._per_speed = self._per_acceleration = 0.0
        """Lengths of the columns of these."""
        self._slowest = 0.0
        self._step = 0.0
        """Farthest that one tick can move the tcp and the end of its stop, together, m."""
        self._proof: Floats = ()
        """The set-point from which the next step was proven to be inside, with this margin, m."""
        self._margin = 0.0

    def open(self, velocity: Floats) -> None:
        """A session begins whose joints keep below ``velocity`` (n,), rad/s."""
        smoother = self._smoother
        dt = smoother.dt
        self._stops = []
        self._slowest = min(velocity)
        self._step = 0.0
        self._proof = ()
        # The way f(v, a) of a stop grows with the speed v and the acceleration a that it begins with, and is convex in
        # each, so f(v, a) <= f(v, 0) + (f(v, A) - f(v, 0)) a / A, where f(v, 0) <= f(u, 0) v / u for any u >= v, and
        # the difference grows with v. Here u lies a tick's acceleration beyond the session's speed, so that the bound
        # holds for the next tick's state as well.
        for reach, cap, A, J in zip(self._reach, velocity, smoother.acceleration, smoother.jerk, strict=True):
            u = cap + A * dt
            steady, worst = stop_displacement(u, 0.0, A, J), stop_displacement(u, A, A, J)
            per_v, per_a = reach * steady / u, reach * (worst - steady) / A
            self._stops.append((cap, per_v, per_a))
            self._step += reach * u * dt + per_v * A * dt + per_a * min(A, J * dt)
        self._per_speed = hypot(*[per_v for _, per_v, _ in self._stops])
        self._per_acceleration = hypot(*[per_a for _, _, per_a in self._stops])

    def here(self) -> tuple[Pose7, NDArray[np.float64]]:
        """Pose of the tcp and its Jacobian (6, n) at the set-point, which becomes the reference."""
        if self._at is not self._smoother.q:
            self._look()
        return self._pose, self._jacobian

    def _look(self) -> None:
        q = self._smoother.q
        pose, jacobian = self._kinematics.fk_and_jacobian(q)
        self._at, self._pose, self._jacobian = q, pose, jacobian
        self._rows = jacobian[:3].tolist()
        self._stretch = hypot(*chain.from_iterable(self._rows))
        box = self._workspace
        if box is not None:
            sides = zip(pose, box.lower, box.upper, strict=False)
            self._clearance = min([min(x - low, high - x) for x, low, high in sides])

    def velocity(self, dq: Floats) -> list[float]:
        """Linear velocity (3,) in m/s of the tcp when the joints of the set-point move so, along the base's axes."""
        self._refresh()
        return [sum(map(mul, row, dq)) for row in self._rows]

    def lets_pass(self, speed: float, cap: float) -> bool:
        """`surely_slower` for any joint speeds of this length (rad/s)."""
        return speed * (self._stretch + self._spread * dist(self._smoother.q, self._at)) <= cap

    def surely_slower(self, dq: Floats, cap: float) -> bool:
        """Does the tcp keep below ``cap`` (m/s) when the joints move so? False: not proven."""
        if self.lets_pass(hypot(*dq), cap) or self._proves_slower(dq, cap):
            return True
        return self._refresh() and self._proves_slower(dq, cap)

    def _proves_slower(self, dq: Floats, cap: float) -> bool:
        rest = cap - self._moved() * sum(map(abs, dq))
        return hypot(*[sum(map(mul, row, dq)) for row in self._rows]) <= rest

    def surely_inside(self, margin: float) -> bool:
        """Would the tcp, stopped now, stay ``margin`` (m) off every face of the workspace? False: not proven."""
        margin = max(margin, self._step)
        if self._proof is self._smoother.q and margin <= self._margin:
            return True
        proven = self._proves_inside(margin) or (self._refresh() and self._proves_inside(margin))
        self._proof, self._margin = (self._smoother.q, margin) if proven else ((), 0.0)
        return proven

    def surely_stays_inside(self) -> bool:
        """Does a stop after the step that is proposed end inside the workspace? False: not proven."""
        return self.surely_inside(0.0)

    def _proves_inside(self, margin: float) -> bool:
        # Clearance where the reference is, less the way from there and that of the stop.
        left = self._clearance - margin
        if not left > 0.0:
            return False
        smoother = self._smoother
        speed = hypot(*smoother.dq)
        if speed <= self._slowest:
            stop = self._per_speed * speed + self._per_acceleration * hypot(*smoother.ddq)
            if self._reach_length * dist(smoother.q, self._at) + stop < left:
                return True
        for v, a, (cap, per_v, per_a) in zip(smoother.dq, smoother.ddq, self._stops, strict=True):
            if not -cap <= v <= cap:
                return False
            left -= per_v * abs(v) + per_a * abs(a)
        return self._moved() < left

    def _moved(self) -> float:
        """Greatest distance in m between the tcp at the set-point and that of the reference."""
        if self._at is self._smoother.q:
            return 0.0
        total = 0.0
        for reach, x, at in zip(self._reach, self._smoother.q, self._at, strict=True):
            total += reach * abs(x - at)
        return total

    def _refresh(self) -> bool:
        """Look again where the set-point is, unless the reference is as good as there; True when it did."""
        if self._moved() <= _SAME:
            return False
        self._look()
        return True
