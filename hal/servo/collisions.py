"""Keep an arm off itself, off boxes and off other arms, by the servo's own rule: its stop from here keeps the margin.

A step is allowed if no pair of shapes gets nearer than its margin in it and in the stop after it (the time-optimal one
of each joint, or one on the path of a motion), wherever the other arms are on their own stops. Every step that replaces
one that is not allowed is part of a stop that was, so the margin is kept whatever is commanded. A pair that is inside
its margin (an arm that starts there, or one that another arm has approached) may not come nearer: moving apart is
always possible.

An arm that follows torques may be elsewhere than its set-point. It is checked where it is measured
(:class:`MeasuredGuard`).

Most ticks cost a few multiplications: from the last distances follows how far the joints can turn, and how far their
stop can go, before any pair can be too near.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from functools import cached_property
from itertools import compress
from math import ceil, dist, hypot, inf, sqrt
from operator import mul, sub

import numpy as np
from numpy.typing import NDArray

from ..kinematics.collision_model import CollisionModel, PairBounds
from .smoothing import JointSmoother, speed_for, stop_at, stop_displacement, stop_distance, stop_peak, stop_pieces

Array = NDArray[np.float64]
Floats = Sequence[float]

Neighbour = Callable[[], tuple[Floats, Floats]]
"""Returns the joint positions (n,), rad, of another arm, and where a stop that it begins now would end."""

_SPACING = 0.01
"""A way is sampled at positions between which no two shapes come this much nearer, m; at most so many:"""
_SAMPLES = 4
_CUTS = 16
"""A stop is cut at so many times at most to prove that it keeps a margin; a step whose stop needs more is refused."""
RESERVE = 3e-4
"""Goals stay so much farther away than the margin, m, that a few cuts suffice for a proof."""
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
_NOISE = 1e-3
"""A measured arm that begins inside a margin, or at it, may come so much nearer, m: its position is not exact."""


class Stop(ABC):
    """A stop after a step. Its places have numbers, from 0 where it begins to 1 where it ends."""

    ways: Floats
    """How far each joint goes at most (n,), rad."""

    @abstractmethod
    def at(self, u: float) -> Floats:
        """Return the joint positions (n,), rad, at place ``u``."""

    @abstractmethod
    def ways_between(self, u: float, v: float) -> Floats:
        """Return how far each joint goes at most (n,), rad, between two places."""


class _JointStop(Stop):
    """The time-optimal stop of each joint by itself."""

    def __init__(self, q: Floats, dq: Floats, ddq: Floats, smoother: JointSmoother) -> None:
        self._state = list(zip(q, dq, ddq, smoother.acceleration, smoother.jerk, strict=True))
        self.ways = [max(stop_peak(v, a, A, J), stop_peak(-v, -a, A, J)) for _, v, a, A, J in self._state]
        self._places: dict[float, Floats] = {0.0: q}

    @cached_property
    def _pieces(self) -> list[list[tuple[float, ...]]]:
        return [stop_pieces(*joint) for joint in self._state]

    @cached_property
    def _duration(self) -> float:
        return max([pieces[-1][1] for pieces in self._pieces])

    @cached_property
    def _turned(self) -> Floats:
        """How much farther each joint goes than two positions differ (n,), rad: there and back, where it turns back."""
        state = zip(self._state, self.ways, strict=True)
        return [2.0 * way if v * (v + 0.5 * a * abs(a) / J) < 0.0 else 0.0 for (_, v, a, _, J), way in state]

    def at(self, u: float) -> Floats:
        place = self._places.get(u)
        if place is None:
            t = self._duration * (1.0 - sqrt(1.0 - u))  # equal ways, where the braking is constant
            place = self._places[u] = [stop_at(pieces, t)[0] for pieces in self._pieces]
        return place

    def ways_between(self, u: float, v: float) -> Floats:
        return [abs(x - y) + more for x, y, more in zip(self.at(u), self.at(v), self._turned, strict=True)]


class CollisionGuard:
    """Checks the steps of one arm, and slows down its goals."""

    def __init__(self, model: CollisionModel, smoother: JointSmoother, others: Sequence[Neighbour] = ()) -> None:
        self._margins: list[float] = model.margins.tolist()
        self._around = _Surroundings(model, others, model.margins)
        self._smoother = smoother
        self._floors: dict[int, float] = {}
        """Smallest distance allowed for each pair that is inside its margin, m."""
        self._presents: tuple[Floats, dict[int, float]] = (), {}
        """Set-point (n,), rad, and what :meth:`_present` returned there."""
        self._fastest = [0.0] * smoother.n
        self._slowest = 0.0
        self._per_speed = self._per_acceleration = 0.0
        self.measured = MeasuredGuard(model, others)
        """Checks the arm itself while it follows torques."""

    def open(self, velocity: Floats) -> None:
        """Open a session whose joints stay below ``velocity`` (n,), rad/s."""
        smoother = self._smoother
        self._floors.clear()
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
        self._per_speed, self._per_acceleration = max(steady), max(worst)
        self._around.measure_ways(braked, steady, worst)

    def is_far(self, speed: float) -> bool:
        """Return whether the arm can surely follow goal speeds of this length, rad/s, now, and brake gently later."""
        q, around = self._smoother.q, self._around
        taken = around.shares[0] * speed
        return taken <= around.left if q is around.last else around.is_clear(q, taken)

    def slow(self, dq: list[float]) -> list[float]:
        """Return the goal speeds ``dq`` (n,), rad/s, slowed down so far that the arm can brake before a margin.

        All joints keep their proportions, so that the arm keeps its direction.
        """
        smoother, around = self._smoother, self._around
        limits = zip(dq, smoother.acceleration, smoother.jerk, strict=True)
        ways = [self._braking_way(abs(v), A, J) for v, A, J in limits]
        if around.stays_clear(smoother.q, ways):
            return dq
        near = around.near(smoother.q, ways)
        if not near:
            return dq
        before = around.bounds.distances[near]
        fastest = around.model.levers[near][:, around.own].dot(np.abs(dq))
        greatest = float(fastest.max())
        if greatest <= 0.0:
            return dq
        ahead = min(0.1, _PROBE / greatest)
        after = around.distances(near, [q + ahead * v for q, v in zip(smoother.q, dq, strict=True)])
        others = around.approach_of_others(near)
        share = 1.0
        ticks = 2.0 * smoother.dt * min(1.0, hypot(*smoother.dq) / hypot(*dq))
        slowest = _BRAKE * min([A / abs(v) for v, A in zip(dq, smoother.acceleration, strict=True) if v])
        smoothest = _BRAKE_JERK * min([J / abs(v) for v, J in zip(dq, smoother.jerk, strict=True) if v])
        for k, d, d_ahead, most, taken in zip(
            near, before.tolist(), after, fastest.tolist(), others.tolist(), strict=True
        ):
            speed = (d - d_ahead) / ahead
            left = d - self._margins[k] - RESERVE - taken
            if most > 0.0:  # the stop has to be proven, whatever its direction
                share = min(share, speed_for(_CUTS * max(left, RESERVE), slowest * most, smoothest * most) / most)
            if speed <= _SIDEWAYS * most:
                continue
            left -= ticks * speed
            cap = speed_for(left, slowest * speed, smoothest * speed)
            share = min(share, cap / speed)
        if share >= 1.0:
            return dq
        return [share * v for v in dq]

    def allows(self, stop: Stop | None = None) -> bool:
        """Return whether the proposed step, and the stop after it, keep every margin, or come no nearer than now.

        Without a ``stop`` along a path each joint stops by itself.
        """
        if stop is None and self._is_far_next():
            return True
        smoother, around = self._smoother, self._around
        q = smoother.q_next
        on_path = stop is not None
        stop = stop or _JointStop(q, smoother.dq_next, smoother.ddq_next, smoother)
        near = [] if around.stays_clear(q, stop.ways) else around.near(q, stop.ways)
        tight, present = [], []
        for k in self._find_unproven(near, stop):
            now = self._present(k, on_path)
            # What is at its margin counts as in it: from there hardly a way out could be proven.
            if k not in self._floors and now > self._margins[k] + _TOLERANCE:
                return False
            tight.append(k)
            present.append(now)
        self._floors = {k: floor for k, floor in self._floors.items() if k in tight}
        if not tight:
            return True
        ahead = self._lowest(tight, stop)
        nearest = [min(self._floor(k, now) - _TOLERANCE, now) for k, now in zip(tight, present, strict=True)]
        return all(d >= least for d, least in zip(ahead, nearest, strict=True))

    def _is_far_next(self) -> bool:
        """Return whether no stop of the joints after the proposed step comes near anything, or nothing moves."""
        smoother, around = self._smoother, self._around
        q, dq = smoother.q_next, smoother.dq_next
        speed, acceleration = hypot(*dq), hypot(*smoother.ddq_next)
        if speed <= self._slowest or all(-u <= v <= u for v, u in zip(dq, self._fastest, strict=True)):
            _, per_speed, per_acceleration = around.shares
            if around.is_clear(q, per_speed * speed + per_acceleration * acceleration):
                return True
        return speed == acceleration == 0.0 and dist(q, smoother.q) < _NOWHERE

    def allows_arm(self, q: Floats, dq: Floats, seconds: float) -> bool:
        """Return whether an arm that follows the set-point by a controller's torques keeps apart.

        It is taken to follow a stop of the set-point that begins now, as far off as it is, and to lose the rest of its
        speed over ``seconds``.

        Args:
            q: Measured joint positions (n,), rad.
            dq: Measured joint speeds (n,), rad/s.
            seconds: s.
        """
        smoother, measured = self._smoother, self.measured
        speed = hypot(*smoother.dq)
        if speed <= self._slowest:
            stop = self._per_speed * speed + self._per_acceleration * hypot(*smoother.ddq)
            if measured.is_clear(q, stop + seconds * dist(dq, smoother.dq)):
                return True
        followed = zip(q, dq, smoother.stop_end(), smoother.q, smoother.dq, strict=True)
        return measured.allows(q, [[x + end - goal + seconds * (v - w) for x, v, end, goal, w in followed]])

    def _present(self, k: int, on_path: bool) -> float:
        """Return the smallest distance (m) of a pair now, and, unless the arm is on a path, in a stop of its joints."""
        smoother, (q, found) = self._smoother, self._presents
        if q is not smoother.q:
            found = {}
            self._presents = smoother.q, found
        if k not in found:
            now = _JointStop(smoother.q, smoother.dq, smoother.ddq, smoother)
            found[k] = self._around.lowest([k], [smoother.q])[0] if on_path else self._lowest([k], now)[0]
        return found[k]

    def _floor(self, k: int, now: float) -> float:
        """Return the smallest distance allowed for a pair that keeps ``now`` (m) in a stop from now.

        It never falls because of this arm's own motion, so that the arm cannot creep nearer.
        """
        margin = self._margins[k]
        floor = self._floors.get(k, min(margin, now))
        if now < floor - 10.0 * _TOLERANCE:
            floor = now
        else:
            floor = max(floor, min(margin, now - 5.0 * _TOLERANCE))
        self._floors[k] = floor
        return floor

    def _braking_way(self, v: float, A: float, J: float) -> float:
        """Return the way (rad) in which a joint brakes gently from the speed ``v`` (rad/s), and of two ticks before."""
        return stop_distance(v, _BRAKE * A, _BRAKE_JERK * J) + 2.0 * self._smoother.dt * v

    def _find_unproven(self, pairs: Sequence[int], stop: Stop) -> Iterator[int]:
        """Yield the pairs for which it is not proven that a stop keeps their margins.

        Between two places at which shapes have the distances d and e, while they come at most w nearer, they are
        nowhere nearer than (d + e - w) / 2. Where that is too little, the distance is computed in between.
        """
        if not pairs:
            return
        around = self._around
        taken = around.approach_of_others(pairs)
        least = around.model.margins[pairs] - _TOLERANCE
        own = around.model.levers[pairs][:, around.own]

        def look(u: float) -> tuple[float, Array]:
            return u, np.array(around.lowest(pairs, [stop.at(u)]))

        ends = look(0.0), look(1.0)
        failed = np.minimum(ends[0][1], ends[1][1]) < least
        good = ~failed
        yield from compress(pairs, failed)
        parts = [ends]
        cuts = 0
        while parts and good.any():
            (u, d), (v, e) = parts.pop()
            failed = 0.5 * (d + e - own @ np.array(stop.ways_between(u, v)) - taken) < least
            if (good & failed).any() and cuts < _CUTS:
                cuts += 1
                middle = look(0.5 * (u + v))
                parts += [(middle, (v, e)), ((u, d), middle)]
                failed = middle[1] < least
            yield from compress(pairs, good & failed)
            good &= ~failed

    def _lowest(self, pairs: Sequence[int], stop: Stop) -> list[float]:
        """Return the smallest distance of each pair in a stop, m."""
        around = self._around
        count = around.count(pairs, stop.ways)
        return around.lowest(pairs, [stop.at(k / max(1, count)) for k in range(count + 1)])


class _Surroundings:
    """The distances of one arm from everything around it, computed only where it may be too near.

    A pair is near below ``least`` (pairs,), m.
    """

    def __init__(self, model: CollisionModel, others: Sequence[Neighbour], least: Array) -> None:
        self.model = model
        self.least = least
        self.bounds = PairBounds(model)
        self.own, *rest = model.slices
        self._others = list(zip(rest, others, strict=True))
        self._q: Array = np.zeros(model.n)
        self._ways: Array = np.zeros(model.n)
        n = self.own.stop - self.own.start
        self._squared_scales: Array = np.ones((1, n))
        self.last: Floats = ()
        """Joint positions (n,), rad, of the newest call of :meth:`is_clear` that returned true, and the share of the
        room that was left there."""
        self.left = 0.0
        self.shares: list[float] = []
        """The share of any pair's room that the length of each vector of :meth:`measure_ways` takes at most."""
        self._weights, self._turned, self._per_turn = [inf] * n, inf, inf
        """The share of any pair's room that each rad of each joint takes at most (n,); that the turns from the computed
        positions to some later ones have taken; and that each rad of the joints together takes."""
        self._at: Floats = (0.0,) * n
        self._later: Floats = self._at
        self._others_at: list[tuple[Neighbour, Floats, float]] = []
        """The other arms, where they were, and the share of the room that each rad of their joints takes."""
        self.measure_ways([1.0] * n)

    def measure_ways(self, *scales: Floats) -> None:
        """Measure the joints' ways by vectors: joint j goes at most ``scale[j] * vector[j]``, in rad, for each."""
        self._squared_scales = np.square(scales)
        self.shares = [inf] * len(scales)
        self._weights, self._turned, self._per_turn = [inf] * len(self._at), inf, inf
        self.left = -inf

    def is_clear(self, q: Floats, taken: float) -> bool:
        """Return whether no pair can get near from ``q`` (n,) on ways that take this share of the room."""
        room = 1.0
        for neighbour, at, per_turn in self._others_at:
            there, end = neighbour()
            room -= per_turn * (dist(at, there) + dist(there, end))
        left = room - self._turned - self._per_turn * dist(q, self._later)
        if not taken <= left:
            if self._per_turn == inf:
                return False
            turned = float(np.abs(np.subtract(q, self._at)).dot(self.bounds.shares[self.own]).max(initial=0.0))
            left = room - turned
            if not taken <= left:  # NaN too
                return False
            self._later, self._turned = tuple(q), turned
        self.last, self.left = q, left
        return True

    def stays_clear(self, q: Floats, ways: Floats) -> bool:
        """Return whether no pair can get near on these ways of the joints (n,), rad, from ``q`` (n,)."""
        return self.is_clear(q, sum(map(mul, self._weights, ways)))

    def near(self, q: Floats, ways: Floats) -> list[int]:
        """Return the pairs that may get near while the joints move this far (n,), rad, from ``q``."""
        self._q[self.own], self._ways[self.own] = q, ways
        for part, neighbour in self._others:
            there, end = neighbour()
            self._q[part], self._ways[part] = there, np.abs(np.subtract(end, there))
        near = self.bounds.near(self._q, self._ways, self.least)
        weights, own = self.bounds.weights, self.own
        self._weights, self._turned = weights[own].tolist(), 0.0
        squares = np.square(self.bounds.shares[own])
        self._per_turn = sqrt(squares.sum(axis=0).max(initial=0.0))
        self.shares = np.sqrt(self._squared_scales.dot(squares).max(axis=1, initial=0.0)).tolist()
        self._at = self._later = tuple(q)
        self.last = ()
        self._others_at = [
            (neighbour, self._q[part].tolist(), sqrt(weights[part].dot(weights[part])))
            for part, neighbour in self._others
        ]
        return near

    def approach_of_others(self, pairs: Sequence[int]) -> Array:
        """Return how much nearer (pairs,), m, the shapes come at most while the other arms stop."""
        if not self._others:
            return np.zeros(len(pairs))
        levers, own = self.model.levers[pairs], self.own
        taken: Array = levers @ self._ways - levers[:, own] @ self._ways[own]
        return taken

    def count(self, pairs: Sequence[int], ways: Floats) -> int:
        """Return the number of positions at which to check a motion of the joints by ``ways`` (n,), rad."""
        farthest = float((self.model.levers[pairs, self.own] @ np.array(ways)).max())
        return min(_SAMPLES, ceil(farthest / _SPACING - 0.02))

    def distances(self, pairs: Sequence[int], q: Floats) -> list[float]:
        """Return the distances of pairs, m, with this arm at ``q`` (n,), rad, and the others where they are now."""
        self._q[self.own] = q
        self.model.place(self._q)
        return [self.model.distance(k) for k in pairs]

    def lowest(self, pairs: Sequence[int], places: Sequence[Floats]) -> list[float]:
        """Return the smallest distance of each pair, m, with this arm in any of ``places``, each (n,) rad.

        The other arms are where they were in the last call of :meth:`near`, or where their stops end.
        """
        model = self.model
        others = [self._q.copy()]
        if self._others and float(np.abs(self.approach_of_others(pairs)).max()) > _TOLERANCE:
            others.append(self._q.copy())
            for part, neighbour in self._others:
                others[1][part] = neighbour()[1]
        lowest = [inf] * len(pairs)
        for there in others:
            for place in places:
                there[self.own] = place
                model.place(there)
                lowest = [min(d, model.distance(k)) for k, d in zip(pairs, lowest, strict=True)]
        return lowest


class MeasuredGuard:
    """Checks where an arm is that follows torques, and so may not be where its set-point is.

    Its stop is predicted. A pair that is inside its margin when the torques begin, or at it, may come no nearer than
    :data:`_NOISE`, and no nearer by each begin until it has parted.
    """

    def __init__(self, model: CollisionModel, others: Sequence[Neighbour]) -> None:
        self._around = _Surroundings(model, others, model.margins)
        self._least: list[float] = model.margins.tolist()
        """Smallest distance allowed for each other pair, m."""
        self._floors: dict[int, float] = {}
        """Smallest distance allowed for each pair that began inside its margin, or at it, m."""

    def start(self, q: Floats, share: float) -> None:
        """Start to check an arm that is at ``q`` (n,), rad, with this share of the margins."""
        around = self._around
        self._least = (share * around.model.margins).tolist()
        around.least = share * around.model.margins + _NOISE
        before, self._floors = self._floors, {}
        near = around.near(q, [0.0] * len(q))
        for k, now in zip(near, around.lowest(near, [q]), strict=True):
            self._floors[k] = min(self._least[k], max(now - _NOISE, min(now, before.get(k, -inf))))

    def is_clear(self, q: Floats, way: float) -> bool:
        """Return whether no pair can get near within ``way`` (rad, all joints together) of ``q`` (n,)."""
        return self._around.is_clear(q, self._around.shares[0] * way)

    def allows(self, q: Floats, ends: Sequence[Floats]) -> bool:
        """Return whether no shapes get too near on straight ways from ``q`` (n,) to ``ends``, each (n,), rad."""
        around = self._around
        if self.is_clear(q, max([dist(q, end) for end in ends])):
            return True
        ways = [max(map(abs, turns)) for turns in zip(*[map(sub, end, q) for end in ends], strict=True)]
        near = around.near(q, ways)
        if not near:
            self._floors.clear()
            return True
        count = around.count(near, ways)
        places = [
            [a + k / count * (b - a) for a, b in zip(q, end, strict=True)] for end in ends for k in range(1, count + 1)
        ]
        present, ahead = around.lowest(near, [q]), around.lowest(near, places)
        allowed = True
        for k, now, then in zip(near, present, ahead, strict=True):
            least = self._least[k]
            floor = self._floors.get(k, least)
            if floor < least and now - _NOISE > floor:
                self._floors[k] = floor = min(least, now - _NOISE)
            allowed = allowed and min(now, then) >= floor
        return allowed
