"""Keep an arm off itself, off boxes and off other arms, by the servo's own rule: its stop from here keeps the margin.

A step is allowed if no pair of shapes gets nearer than its margin in it and in the time-optimal stop after it, wherever
the other arms are on their own stops. Every step that replaces one that is not allowed is part of a stop that was, so
the margin is kept whatever is commanded. A pair that is inside its margin (an arm that starts there, or one that
another arm has approached) may not come nearer: moving apart is always possible.

Most ticks cost one comparison: no pair can be too near within some distance of where the last one was computed.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import ceil, dist, hypot, inf, sqrt

import numpy as np
from numpy.typing import NDArray

from ..kinematics.collision_model import CollisionModel, PairBounds
from .smoothing import JointSmoother, speed_for, stop_displacement, stop_distance, stop_peak, stop_phases, stop_step

__all__ = ["CollisionGuard", "Neighbour"]

Array = NDArray[np.float64]
Floats = Sequence[float]

Neighbour = Callable[[], tuple[Floats, Floats]]
"""Returns the joint positions (n,), rad, of another arm, and where a stop that it begins now would end."""

_SPACING = 0.01
"""A stop is checked at positions between which no two shapes come this much nearer, m; at most so many:"""
_SAMPLES = 4
_TOLERANCE = 1e-5
"""Accuracy of distances that are compared, m."""
_NOWHERE = 1e-12
"""A step this short is none, rad."""
_BRAKE, _BRAKE_JERK = 0.8, 0.5
"""Shares of acceleration and jerk with which an approach slows down; the rest is for the stop that is always kept."""
_PROBE = 2e-3
"""Speeds of approach are measured over about this way, m."""
_SIDEWAYS = 0.005
"""A motion is sideways if shapes approach by less than this share of the greatest speed that its joints allow."""


class CollisionGuard:
    """Checks the steps of one arm, and slows down its goals.

    Args:
        model: Shapes of this arm, and of the others that it must not touch.
        smoother: Its set-point.
        others: The other arms of the model, in its order.
    """

    def __init__(self, model: CollisionModel, smoother: JointSmoother, others: Sequence[Neighbour] = ()) -> None:
        self._model = model
        self._margins: list[float] = model.margins.tolist()
        self._bounds = PairBounds(model)
        self._smoother = smoother
        self._own, *rest = model.slices
        self._others = list(zip(rest, others, strict=True))
        self._q: Array = np.zeros(model.n)
        self._ways: Array = np.zeros(model.n)
        self._at: list[Floats] = [[inf] * (part.stop - part.start) for part in model.slices]
        """Joint positions of this arm and of the others at which the room was computed, rad."""
        self._room = 0.0
        """Distance of the joints from there, all arms together, within which no pair gets under its margin, rad."""
        self._floors: dict[int, float] = {}
        """Smallest distance allowed for each pair that is inside its margin, m."""
        self._fastest = [0.0] * smoother.n
        self._slowest = 0.0
        self._per_speed = self._per_acceleration = self._per_goal = 0.0
        self.slowed = False
        """Whether the last goal was slowed down."""

    def open(self, velocity: Floats) -> None:
        """Open a session whose joints stay below ``velocity`` (n,), rad/s."""
        smoother = self._smoother
        self._floors.clear()
        self.slowed = False
        # Bounds on the way of a stop, linear in its first speed and acceleration: see TcpReference.open.
        steady, worst, braked = [], [], []
        self._fastest = []
        for cap, A, J in zip(velocity, smoother.acceleration, smoother.jerk, strict=True):
            u = cap + A * smoother.dt
            at_cap = stop_displacement(u, 0.0, A, J)
            steady.append(at_cap / u)
            worst.append((stop_displacement(u, A, A, J) - at_cap) / A)
            braked.append(self._braking_way(u, A, J) / u)
            self._fastest.append(u)
        self._slowest = min(self._fastest)
        self._per_speed, self._per_acceleration, self._per_goal = max(steady), max(worst), max(braked)

    def is_far(self, dq: Floats) -> bool:
        """Return whether the arm can surely follow the goal speeds ``dq`` (n,), rad/s, now, and brake gently later."""
        return self._is_clear(self._smoother.q, self._per_goal * hypot(*dq))

    def slow(self, dq: list[float]) -> list[float]:
        """Return the goal speeds ``dq`` (n,), rad/s, slowed down so far that the arm can brake before a margin.

        All joints keep their proportions, so that the arm keeps its direction.
        """
        self.slowed = False
        if self.is_far(dq):
            return dq
        smoother = self._smoother
        limits = zip(dq, smoother.acceleration, smoother.jerk, strict=True)
        near = self._near(smoother.q, [self._braking_way(abs(v), A, J) for v, A, J in limits])
        if not near:
            return dq
        model, own = self._model, self._own
        before = self._bounds.distances[near]
        levers = model.levers[near]
        fastest = levers[:, own] @ np.abs(dq)
        greatest = float(fastest.max())
        if greatest <= 0.0:
            return dq
        ahead = min(0.1, _PROBE / greatest)
        self._q[own] = [q + ahead * v for q, v in zip(smoother.q, dq, strict=True)]
        model.place(self._q)
        share = 1.0
        others = levers @ self._ways - levers[:, own] @ self._ways[own]
        ticks = 2.0 * smoother.dt * min(1.0, hypot(*smoother.dq) / hypot(*dq))
        slowest = _BRAKE * min([A / abs(v) for v, A in zip(dq, smoother.acceleration, strict=True) if v])
        smoothest = _BRAKE_JERK * min([J / abs(v) for v, J in zip(dq, smoother.jerk, strict=True) if v])
        for k, d, most, taken in zip(near, before.tolist(), fastest.tolist(), others.tolist(), strict=True):
            speed = (d - model.distance(k)) / ahead
            if speed <= _SIDEWAYS * most:
                continue
            left = d - self._margins[k] - taken - ticks * speed
            cap = speed_for(left, slowest * speed, smoothest * speed)
            share = min(share, cap / speed)
        if share >= 1.0:
            return dq
        self.slowed = True
        return [share * v for v in dq]

    def allows(self) -> bool:
        """Return whether the proposed step, and the stop after it, keep every margin, or come no nearer than now."""
        smoother = self._smoother
        q, dq, ddq = smoother.q_next, smoother.dq_next, smoother.ddq_next
        speed, acceleration = hypot(*dq), hypot(*ddq)
        if speed == acceleration == 0.0 and dist(q, smoother.q) < _NOWHERE:
            return True
        known = speed <= self._slowest or all(-u <= v <= u for v, u in zip(dq, self._fastest, strict=True))
        if known and self._is_clear(q, self._per_speed * speed + self._per_acceleration * acceleration):
            return True
        limits = list(zip(smoother.acceleration, smoother.jerk, strict=True))
        ways = [
            max(stop_peak(v, a, A, J), stop_peak(-v, -a, A, J)) for v, a, (A, J) in zip(dq, ddq, limits, strict=True)
        ]
        near = self._near(q, ways)
        if not near:
            self._floors.clear()
            return True
        lowest = self._lowest(near, q, dq, ddq, ways)
        tight = [(k, d) for k, d in zip(near, lowest, strict=True) if d < self._margins[k] - _TOLERANCE]
        if not tight:
            return True
        pairs = [k for k, _ in tight]
        v0, a0 = smoother.dq, smoother.ddq
        ways = [
            max(stop_peak(v, a, A, J), stop_peak(-v, -a, A, J)) for v, a, (A, J) in zip(v0, a0, limits, strict=True)
        ]
        self._near(smoother.q, ways)
        present = self._lowest(pairs, smoother.q, v0, a0, ways)
        floors = [self._floor(k, now) for k, now in zip(pairs, present, strict=True)]
        return all(d >= floor - _TOLERANCE for (_, d), floor in zip(tight, floors, strict=True))

    def _floor(self, k: int, now: float) -> float:
        """Return the smallest distance allowed for a pair that keeps ``now`` (m) in a stop from now.

        It never falls because of this arm's own motion, so that the arm cannot creep nearer.
        """
        margin = self._margins[k]
        floor = self._floors.get(k, margin)
        if now < floor - 10.0 * _TOLERANCE:
            floor = now
        elif now > floor:
            floor = min(margin, now)
        self._floors[k] = floor
        return floor

    def _braking_way(self, v: float, A: float, J: float) -> float:
        """Return the way (rad) in which a joint brakes gently from the speed ``v`` (rad/s), and of two ticks before."""
        return stop_distance(v, _BRAKE * A, _BRAKE_JERK * J) + 2.0 * self._smoother.dt * v

    def _is_clear(self, q: Floats, way: float) -> bool:
        """Return whether no pair can get under its margin within ``way`` (rad, all joints together) of ``q`` (n,)."""
        moved = dist(q, self._at[0]) + way
        if moved > self._room:
            return False
        for at, (_, neighbour) in zip(self._at[1:], self._others, strict=True):
            there, end = neighbour()
            moved = hypot(moved, max(dist(there, at), dist(end, at)))
        return moved <= self._room

    def _near(self, q: Floats, ways: Floats) -> list[int]:
        """Return the pairs that may get under their margin while the joints move this far (n,), rad, from ``q``."""
        self._q[self._own], self._ways[self._own] = q, ways
        self._at = [q]
        for part, neighbour in self._others:
            there, end = neighbour()
            self._q[part], self._ways[part] = there, np.abs(np.subtract(end, there))
            self._at.append(there)
        near = self._bounds.near(self._q, self._ways, self._model.margins)
        self._room = self._bounds.room
        return near

    def _lowest(self, pairs: Sequence[int], q: Floats, dq: Floats, ddq: Floats, ways: Floats) -> list[float]:
        """Return the smallest distance of each pair in the stop that begins at ``q``, ``dq``, ``ddq``, m."""
        model, smoother, own = self._model, self._smoother, self._own
        levers = model.levers[pairs]
        places = [q]
        count = min(_SAMPLES, ceil(float((levers[:, own] @ np.array(ways)).max()) / _SPACING - 0.02))
        if count > 0:
            state = list(zip(q, dq, ddq, smoother.acceleration, smoother.jerk, strict=True))
            duration = max([stop_phases(v, a, A, J)[3] for _, v, a, A, J in state])
            for k in range(1, count + 1):  # at equal ways, for braking that is constant
                t = duration * (1.0 - sqrt(1.0 - k / count))
                places.append([stop_step(x, v, a, A, J, t)[0] for x, v, a, A, J in state])
        others = [self._q.copy()]
        if self._others and float(np.abs(levers @ self._ways - levers[:, own] @ self._ways[own]).max()) > _TOLERANCE:
            others.append(self._q.copy())
            for part, neighbour in self._others:
                others[1][part] = neighbour()[1]
        lowest = [inf] * len(pairs)
        for there in others:
            for place in places:
                there[own] = place
                model.place(there)
                lowest = [min(d, model.distance(k)) for k, d in zip(pairs, lowest, strict=True)]
        return lowest
