"""A path in joint space, and how fast each part of it may be passed.

A path is a chain of smooth sections, at whose ends the arm rests. A section is a cubic spline through its knots
(:class:`JointPath`), with continuous second derivatives. With s its parameter, v = ds/dt, a = dv/dt and j = da/dt, and
derivatives by s written q', q'' and q''', a joint moves at

    dq = q' v,    ddq = q' a + q'' v^2,    dddq = q' j + 3 q'' v a + q''' v^3.

Between two knots each of q', q'' and q''' has bounds, from which :func:`zones_of` computes limits of v, a and j that
together keep every limit of every joint, and the speed of the tcp. Speeding up and slowing down have limits of their
own: where a joint gets faster although v does not, as on the way into a singularity, only slowing down helps it.
Neighbours with similar limits make up a :class:`Zone`: there Ruckig plans v with constant limits, from one zone's
border to the next, where a is 0. So wherever the arm stops on the path, a plan from there is a matter of microseconds.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable, Sequence
from math import sqrt
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from ruckig import ControlInterface, InputParameter, Result, Ruckig, RuckigError, Trajectory

from ..commands import PathSection
from ..kinematics.arm import Kinematics
from ..specs import LimitsSpec
from .smoothing import stop_distance

Array = NDArray[np.float64]
Floats = Sequence[float]

_CURVE_ACCELERATION = 0.8
"""Greatest share of the acceleration that q'' v^2 may use; the rest is left to stop there, and to start again."""

_CURVE_JERK = 0.3
"""Share of the jerk limit that q''' v^3 may use."""

_MIXED_JERK = 0.3
"""Share of the jerk limit that 3 q'' v a may use."""

_ALIKE = (1.05, 1.2, 1.2, 2.0)
"""Greatest ratios of the limits of v, a (speeding up and slowing down) and j within a zone."""

_TINY = 1e-12


class JointPath:
    """A smooth section of a path: the natural cubic spline through its knots.

    Args:
        section: Its knots: at least two, with increasing parameters.
    """

    def __init__(self, section: PathSection) -> None:
        self.s = s = np.array(section.s, float)
        self.q = q = np.array(section.q, float)
        self.length = float(s[-1])
        """The parameter at the end; it is 0 at the start."""
        widths = np.diff(s)
        second = _second_derivatives(widths, q)
        h = widths[:, None]
        linear = np.diff(q, axis=0) / h - h * (2.0 * second[:-1] + second[1:]) / 6.0
        cubic = np.diff(second, axis=0) / (6.0 * h)
        self._coefficients = np.stack((q[:-1], linear, 0.5 * second[:-1], cubic), axis=-1)
        """(k - 1, n, 4): position at a knot, and the coefficients of the powers of the way from there."""
        self._rows: list[list[list[float]]] = self._coefficients.tolist()
        rates = self.bounds()[0].max(axis=0)
        self._rates: list[list[float]] = rates.tolist()
        """Bounds of |q'| (k - 1, n), and the ways of the joints from the start to each knot that follow (k, n), rad."""
        self._gone: list[list[float]] = np.cumsum(np.vstack((0.0 * rates[:1], rates * h)), axis=0).tolist()
        self._knots: list[float] = s.tolist()

    def at(self, s: float) -> tuple[list[float], list[float], list[float]]:
        """Return q, q' and q'' (n,) at the parameter ``s``."""
        k = min(max(bisect_right(self._knots, s) - 1, 0), len(self._rows) - 1)
        t = s - self._knots[k]
        q, first, second = [], [], []
        for x, b, c, d in self._rows[k]:
            q.append(x + t * (b + t * (c + t * d)))
            first.append(b + t * (2.0 * c + 3.0 * t * d))
            second.append(2.0 * c + 6.0 * t * d)
        return q, first, second

    def samples(self, count: int) -> Array:
        """Return joint positions ((k - 1) count + 1, n), rad: at every knot, and evenly between two."""
        t = (np.arange(count) / count)[:, None, None] * np.diff(self.s)[:, None]  # (count, k - 1, 1)
        x, b, c, d = np.moveaxis(self._coefficients, -1, 0)
        between: Array = x + t * (b + t * (c + t * d))
        return np.concatenate((np.swapaxes(between, 0, 1).reshape(-1, self.q.shape[1]), self.q[-1:]))

    def bounds(self) -> tuple[Array, Array, Array]:
        """Return bounds between two knots: of q' and -q' (2, k - 1, n), of q'' and -q'', and of |q'''| (k - 1, n).

        q' is a parabola there, which is in the hull of its three control points; q'' is a line.
        """
        h = np.diff(self.s)[:, None]
        _, b, c, d = np.moveaxis(self._coefficients, -1, 0)
        first = np.stack((b, b + h * c, b + h * (2.0 * c + 3.0 * h * d)))
        second = np.stack((2.0 * c, 2.0 * c + 6.0 * h * d))
        rates, curves = (np.stack((x.max(axis=0), -x.min(axis=0))) for x in (first, second))
        return rates, curves, np.abs(6.0 * d)

    def gone(self, s: float) -> list[float]:
        """Return a bound of each joint's way (n,), rad, from the start to ``s``; differences are bounds, too."""
        k = min(max(bisect_right(self._knots, s) - 1, 0), len(self._rows) - 1)
        t = s - self._knots[k]
        return [x + t * rate for x, rate in zip(self._gone[k], self._rates[k], strict=True)]

    def nearest(self, q: Floats, s: float) -> float:
        """Return the parameter near ``s`` at which the path is nearest to ``q`` (n,), rad (Newton's method)."""
        for _ in range(8):
            at, first, _ = self.at(s)
            square = sum(x * x for x in first)
            if square <= _TINY:
                break
            step = sum((x - y) * v for x, y, v in zip(q, at, first, strict=True)) / square
            s = min(max(s + step, 0.0), self.length)
        return s


def _second_derivatives(widths: Array, q: Array) -> Array:
    """Return q'' (k, n) at the knots of the natural cubic spline: a tridiagonal system, by Thomas' algorithm."""
    count = len(q)
    second = np.zeros_like(q)
    if count < 3:
        return second
    slopes = np.diff(q, axis=0) / widths[:, None]
    right = 6.0 * np.diff(slopes, axis=0)
    h: list[float] = widths.tolist()
    shares = [0.0]
    for k in range(count - 2):
        pivot = 2.0 * (h[k] + h[k + 1]) - h[k] * shares[-1]
        shares.append(h[k + 1] / pivot)
        right[k] = (right[k] - h[k] * (right[k - 1] if k else 0.0)) / pivot
    for k in range(count - 2, 0, -1):
        second[k] = right[k - 1] - shares[k] * second[k + 1]
    return second


class Zone(NamedTuple):
    """A part of a section with constant limits along the path."""

    start: float
    """Parameter s at the start."""
    end: float
    speed: float
    """Greatest v, 1/s in units of s; the same unit for the others."""
    acceleration: float
    """Greatest a."""
    braking: float
    """Greatest -a."""
    jerk: float
    leave: float
    """Greatest v at the end from which the rest of the section can be passed within its limits."""
    stop_end: float
    """Parameter at which a stop that begins with the zone ends at most."""


def zones_of(
    path: JointPath,
    limits: LimitsSpec,
    velocity: Floats,
    tcp_speed: float,
    arm: Kinematics,
    pause: Callable[[], None] = lambda: None,
) -> list[Zone]:
    """Return the zones of a section, from its start to its end.

    Args:
        path: The section.
        limits: The joints' accelerations and jerks.
        velocity: Greatest speeds of the joints (n,), rad/s.
        tcp_speed: Greatest speed of the tcp, m/s; infinite for none.
        arm: The arm's kinematics.
        pause: Called again and again during the computation.
    """
    rates, curves, third = (np.maximum(bound, _TINY) for bound in path.bounds())
    first, second = rates.max(axis=0), curves.max(axis=0)
    A, J = np.array(limits.acceleration), np.array(limits.jerk)
    bends = np.sqrt(_CURVE_ACCELERATION * A / second)
    most = np.minimum(np.minimum(np.asarray(velocity) / first, np.cbrt(_CURVE_JERK * J / third)), bends).min(axis=1)
    if tcp_speed < np.inf:
        most = np.minimum(most, tcp_speed / np.maximum(_tcp_rates(path, arm, pause), _TINY))
    squares = _fastest(np.square(most), rates / (2.0 * np.diff(path.s)[:, None]), curves, A, pause)
    v = np.sqrt(squares)
    left = A - curves * squares[:, None]
    mixed = (_MIXED_JERK * J / (3.0 * second)).min(axis=1) / v
    up, down = (np.minimum((left / rate).min(axis=(0, 2)), mixed) for rate in (rates, rates[::-1]))
    used = third * (v**3)[:, None] + 3.0 * second * (v * np.maximum(up, down))[:, None]
    j = ((J - used) / first).min(axis=1)
    rows: list[list[float]] = np.stack((v, up, down, j), axis=1).tolist()
    parts = _merge(path.s.tolist(), rows)
    zones: list[Zone] = []
    leave, stop_end = 0.0, path.length  # backwards: no faster than allows to slow down for what follows
    for start, end, (speed, acceleration, braking, jerk) in reversed(parts):
        leave = min(leave, speed)
        enter = _reachable(leave, end - start, speed, braking, jerk)
        way = stop_distance(enter, braking, jerk)
        stop_end = start + way if start + way <= end else stop_end  # at most that from the next zone's start
        zones.append(Zone(start, end, speed, acceleration, braking, jerk, leave, stop_end))
        leave = enter
    return zones[::-1]


def _fastest(most: Array, rates: Array, curves: Array, A: Array, pause: Callable[[], None]) -> Array:
    """Return the greatest v^2 between two knots (k - 1,) from rest to rest, without a limit of jerk.

    With x = v^2, a is the change of x over twice the way (as in Pham and Pham, "A New Approach to Time-Optimal Path
    Parameterization Based on Reachability Analysis", IEEE T-RO 34(3), 2018).

    Args:
        most: Greatest x (k - 1,).
        rates: Bounds of q' and -q' over twice the way between two knots (2, k - 1, n).
        curves: Bounds of q'' and -q'' (2, k - 1, n).
        A: Greatest accelerations (n,).
        pause: Called again and again.
    """
    forward = _from_rest(most, rates, curves, A, pause)
    backward = _from_rest(most[::-1], rates[::-1, ::-1], curves[:, ::-1], A, pause)[::-1]
    ends = np.minimum(forward, backward)
    # Between two knots x rises from both until the two lines meet, above their mean.
    rates = 2.0 * rates.max(axis=0)
    inside = ((A + rates * 0.5 * (ends[1:] + ends[:-1])[:, None]) / (rates + curves)).min(axis=(0, 2))
    greatest: Array = np.minimum(most, np.maximum(np.maximum(ends[1:], ends[:-1]), inside))
    return greatest


def _from_rest(most: Array, rates: Array, curves: Array, A: Array, pause: Callable[[], None]) -> Array:
    """Return the greatest x at knots (k,), 0 at the first: rates (y - x) + curves y <= A from each x to the next, y."""
    free, share = A / (rates + curves), rates / (rates + curves)
    x = [0.0]
    for k, limit in enumerate(most.tolist()):
        x.append(min(limit, float((free[:, k] + share[:, k] * x[k]).min())))
        pause()
    return np.array(x)


def _tcp_rates(path: JointPath, arm: Kinematics, pause: Callable[[], None]) -> Array:
    """Return the greatest way of the tcp for each unit of s (k - 1,), m, between two knots."""
    s = path.s
    middles = 0.5 * (s[1:] + s[:-1])
    found = []
    for x in (*s.tolist(), *middles.tolist()):
        q, first, _ = path.at(x)
        found.append(np.linalg.norm(arm.jacobian(q)[:3].dot(first)))
        pause()
    rates = np.array(found)
    ends, inside = rates[: len(s)], rates[len(s) :]
    greatest = np.maximum(np.maximum(ends[1:], ends[:-1]), inside)
    # A parabola through three values is no higher than this.
    bound: Array = greatest + np.abs(ends[1:] + ends[:-1] - 2.0 * inside)
    return bound


def _merge(knots: list[float], rows: list[list[float]]) -> list[tuple[float, float, list[float]]]:
    """Return start, end and limits of zones of neighbours whose limits (``rows``, see :data:`_ALIKE`) are alike."""
    parts = []
    start = 0
    least, most = list(rows[0]), list(rows[0])
    for k, row in enumerate(rows):
        lower = [min(x, y) for x, y in zip(least, row, strict=True)]
        upper = [max(x, y) for x, y in zip(most, row, strict=True)]
        if any(y > ratio * x for x, y, ratio in zip(lower, upper, _ALIKE, strict=True)):
            parts.append((knots[start], knots[k], least))
            start, lower, upper = k, list(row), list(row)
        least, most = lower, upper
    parts.append((knots[start], knots[-1], least))
    return parts


def _way(v0: float, v1: float, A: float, J: float) -> float:
    """Return the way of the fastest change of speed from ``v0`` to ``v1``, without acceleration before and after.

    It is symmetric in time, so the mean speed times its duration.
    """
    change = abs(v1 - v0)
    duration = 2.0 * sqrt(change / J) if change * J <= A * A else change / A + A / J
    return 0.5 * (v0 + v1) * duration


def _reachable(v0: float, way: float, most: float, A: float, J: float) -> float:
    """Return the greatest speed up to ``most`` that is reached from ``v0`` on ``way``, or brakes to ``v0`` on it."""
    if v0 >= most or _way(v0, most, A, J) <= way:
        return most
    low, high = v0, most
    for _ in range(40):
        middle = 0.5 * (low + high)
        if _way(v0, middle, A, J) <= way:
            low = middle
        else:
            high = middle
    return low


_LESS = 1.0 - 1e-7
"""Speeds at borders are this much less than the greatest: Ruckig plans with room for rounding."""

_ABOVE = 1.0 + 1e-9
"""For the same reason it may be this much faster than the limit in between."""


class Leg(NamedTuple):
    """A planned part of the way through one zone: Ruckig's trajectory, then constant speed up to the end."""

    start: float
    """Parameter s at the start."""
    end: float
    trajectory: Trajectory
    planned: float
    """Duration of the trajectory, s."""
    duration: float
    """Duration of all, s."""
    speed: float
    """v at the end."""

    def at(self, t: float) -> tuple[float, float, float]:
        """Return s, v and a, ``t`` seconds after the start."""
        if t < self.planned:
            (s,), (v,), (a,) = self.trajectory.at_time(t)
            return self.start + s, v, a
        return self.end - self.speed * (self.duration - t), self.speed, 0.0


class ZonePlanner:
    """Plans the way through a zone, and stops in it, with Ruckig."""

    def __init__(self) -> None:
        self._ruckig = Ruckig(1)
        self._input = InputParameter(1)

    def through(self, zone: Zone, s: float, v: float, share: float) -> Leg | None:
        """Plan the time-optimal way from ``s`` to the zone's end.

        Args:
            zone: The zone.
            s: Parameter to begin at.
            v: Speed there, at no acceleration.
            share: Share of the greatest speed.

        Returns:
            The leg; None if Ruckig cannot plan it.
        """
        way = zone.end - s
        leave = _reachable(v, way, share * zone.speed, zone.acceleration, zone.jerk)
        leave = min(leave, share * zone.leave) * _LESS
        if way <= _TINY:
            return Leg(s, zone.end, Trajectory(1), 0.0, 0.0, leave)
        inputs = self._input
        inputs.control_interface = ControlInterface.Position
        inputs.target_position = [way]
        trajectory = self._plan(zone, v, 0.0, leave, max(v, share * zone.speed) * _ABOVE)
        if trajectory is None:
            return None
        return Leg(s, zone.end, trajectory, trajectory.duration, trajectory.duration, leave)

    def stop(self, zone: Zone, s: float, v: float, a: float) -> Leg | None:
        """Plan the shortest stop from ``s``, or how to leave the zone as slowly as possible where it is too short.

        Args:
            zone: The zone.
            s: Parameter to begin at.
            v: Speed there.
            a: Acceleration there.

        Returns:
            The leg, whose :attr:`Leg.speed` is 0 for a stop; None if the zone is too short for less than its own
            speed at the end: then the way through it that was planned is the slowest one.
        """
        left = zone.end - s
        found = self._slow_down(zone, v, a, 0.0)
        if found is not None and found[0] <= left:
            return Leg(s, s + found[0], found[1], found[1].duration, found[1].duration, 0.0)
        low, high = 0.0, min(v, zone.leave)
        found = self._slow_down(zone, v, a, high)
        if found is None or found[0] > left:
            return None
        for _ in range(20):
            middle = 0.5 * (low + high)
            slower = self._slow_down(zone, v, a, middle)
            if slower is None or slower[0] > left:
                low = middle
            else:
                high, found = middle, slower
        planned = found[1].duration
        return Leg(s, zone.end, found[1], planned, planned + (left - found[0]) / high, high)

    def _slow_down(self, zone: Zone, v: float, a: float, to: float) -> tuple[float, Trajectory] | None:
        """Return way and trajectory of the shortest change of speed; None if Ruckig has none."""
        self._input.control_interface = ControlInterface.Velocity
        trajectory = self._plan(zone, v, a, to, zone.speed)
        if trajectory is None:
            return None
        (way,), _, _ = trajectory.at_time(trajectory.duration)
        return way, trajectory

    def _plan(self, zone: Zone, v: float, a: float, to: float, most: float) -> Trajectory | None:
        inputs = self._input
        inputs.current_position, inputs.current_velocity, inputs.current_acceleration = [0.0], [v], [a]
        inputs.target_velocity, inputs.target_acceleration = [to], [0.0]
        inputs.max_velocity, inputs.max_acceleration, inputs.max_jerk = [most], [zone.acceleration], [zone.jerk]
        inputs.min_acceleration = [-zone.braking]
        trajectory = Trajectory(1)
        try:
            result = self._ruckig.calculate(inputs, trajectory)
        except RuckigError:
            return None
        return trajectory if result in (Result.Working, Result.Finished) else None
