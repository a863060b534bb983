"""From a wanted motion to set-points that keep every limit: Ruckig, and a check that the arm could still stop.

The free Ruckig has no position limits, and clipping a position breaks the limits of acceleration and jerk. So the
smoother keeps an invariant instead: **after every tick the time-optimal stop still ends inside every limit**. A step
that would break it is replaced by the first tick of that stop, which keeps it by construction. An arm that starts
outside a limit may only come back in: what counts is max(limit, where the stop would end now).

The functions first compute the jerk-limited stop of one joint. ``v`` is a speed in rad/s, ``a`` an acceleration in
rad/s2, ``A`` and ``J`` the limits of acceleration and jerk (rad/s2, rad/s3, both > 0). "Stop" always means the
time-optimal stop: jerk J until the braking reaches A (or until it must be released), constant braking A, jerk J until
rest. Every formula follows from integrating that profile; the tests compare each with Ruckig, which computes the same
profiles numerically.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import dist, hypot, inf, isfinite, sqrt

from ruckig import (
    ControlInterface,
    InputParameter,
    OutputParameter,
    Ruckig,
    RuckigError,
    Synchronization,
)

from ..specs import LimitsSpec


def stop_distance(v: float, A: float, J: float) -> float:
    """Return the distance (rad) of a stop from speed ``v >= 0`` and no acceleration.

    The profile is symmetric in time, so the distance is the mean speed v/2 times its duration: 2 sqrt(v/J) when the
    braking never reaches A (v J <= A^2), else v/A + A/J.
    """
    if v * J <= A * A:
        return v * sqrt(v / J)
    return 0.5 * v * (v / A + A / J)


def speed_for(d: float, A: float, J: float) -> float:
    """Return the greatest speed (rad/s) at no acceleration that can stop within ``d`` rad: inverts `stop_distance`."""
    if d <= 0.0:
        return 0.0
    if d * J * J <= A * A * A:
        return float((d * d * J) ** (1.0 / 3.0))
    c = 0.5 * A * A / J
    return sqrt(c * c + 2.0 * A * d) - c


def stop_displacement(v: float, a: float, A: float, J: float) -> float:
    """Return the end of a stop from speed ``v`` and acceleration ``a``, relative to its start, rad.

    Releasing ``a`` at jerk J leaves the speed s = v + a |a| / (2 J), against whose sign the stop must brake. For s > 0
    the profile is part of the one that brakes from v1 = v + a^2 / (2 J) with no acceleration: that began t = a/J from
    now (in the past when a < 0) and t (v + a t / 3) away. For s < 0 the same holds mirrored.
    """
    if v + 0.5 * a * abs(a) / J < 0.0:
        return -stop_displacement(-v, -a, A, J)
    t = a / J
    return t * (v + a * t / 3.0) + stop_distance(max(0.0, v + 0.5 * a * t), A, J)


def stop_peak(v: float, a: float, A: float, J: float) -> float:
    """Return the greatest way (>= 0, rad) in the positive direction of a stop from speed ``v`` and acceleration ``a``.

    Mirror with (-v, -a) for the negative direction. A joint that is braked harder than its speed needs
    (s = v + a |a| / (2 J) < 0) turns back while it releases the brake, at the first root of v + a s + J s^2 / 2 = 0.
    """
    if v <= 0.0 and a <= 0.0:
        return 0.0
    if a < 0.0 and v * J < 0.5 * a * a:
        s = (-a - sqrt(a * a - 2.0 * J * v)) / J
        return s * (v + s * (0.5 * a + s * J / 6.0))
    if v + 0.5 * a * abs(a) / J <= 0.0:  # a > 0, and the joint still continues backwards
        return 0.0
    return max(0.0, stop_displacement(v, a, A, J))


def stop_phases(v: float, a: float, A: float, J: float) -> tuple[float, float, float, float]:
    """Return the first jerk of the stop from speed ``v`` and acceleration ``a``, and the ends of its phases.

    Returns:
        The first phase's jerk, rad/s3 (the second phase has none, the third the opposite one), and the times after
        which the first, the second and the third phase are over, s.
    """
    jerk = -J
    if v + 0.5 * a * abs(a) / J < 0.0:
        v, a, jerk = -v, -a, J
    build, constant, release = _phases(v, a, A, J)
    return jerk, build, build + constant, build + constant + release


def stop_pieces(q: float, v: float, a: float, A: float, J: float) -> list[tuple[float, ...]]:
    """Return the phases of the stop from (q, v, a), and the rest after it, for :func:`stop_at`; |a| <= A.

    Each is the time at which it ends, the one at which it begins, s, and position, speed, acceleration and jerk there.
    """
    jerk, *ends = stop_phases(v, a, A, J)
    pieces, begin = [], 0.0
    for end, j in zip(ends, (jerk, 0.0, -jerk), strict=True):
        pieces.append((end, begin, q, v, a, j))
        q, v, a = _advance(q, v, a, j, end - begin)
        begin = end
    return [*pieces, (inf, begin, q, 0.0, 0.0, 0.0)]


def stop_at(pieces: list[tuple[float, ...]], t: float) -> tuple[float, float, float]:
    """Return position, speed and acceleration ``t`` seconds into a stop."""
    begin, q, v, a, j = next(state for end, *state in pieces if t < end)
    return _advance(q, v, a, j, t - begin)


def stop_step(q: float, v: float, a: float, A: float, J: float, dt: float) -> tuple[float, float, float]:
    """Return position, speed and acceleration ``dt`` seconds into the stop from (q, v, a); |a| <= A.

    The same as Ruckig's velocity interface with target 0, for the case that Ruckig fails.
    """
    return stop_at(stop_pieces(q, v, a, A, J), dt)


def _advance(q: float, v: float, a: float, j: float, t: float) -> tuple[float, float, float]:
    return q + t * (v + t * (0.5 * a + t * j / 6.0)), v + t * (a + 0.5 * t * j), a + t * j


def _phases(v: float, a: float, A: float, J: float) -> tuple[float, float, float]:
    """Return the durations (s) of the three phases of a stop that brakes against the positive direction."""
    brake = min(A, sqrt(max(0.0, v * J + 0.5 * a * a)))
    brake = max(brake, -a)
    release = brake / J
    # What the two ramps do not take away is braked at the constant rate; rounding must not make that time negative.
    constant = max(0.0, (v + 0.5 * a * a / J) / brake - release) if brake > 0.0 else 0.0
    return (a + brake) / J, constant, release


Floats = Sequence[float]

# Members of an enumeration that every tick uses: looking one up takes longer than passing it.
_VELOCITY, _POSITION = ControlInterface.Velocity, ControlInterface.Position

Guard = Callable[["JointSmoother"], bool]
"""Returns whether a proposed step (``q_next``, ``dq_next``, ``ddq_next``) may be taken."""

_INSIDE = 1.0 - 1e-5
"""Share of the limits used, so that rounding in third differences of positions never shows as a violation."""

_ABOVE = 1.0 + 1e-6
"""Ruckig's position interface gets this much more speed: from exactly its greatest speed it may plan to brake all the
way (seen: 20 s instead of 13)."""

_EDGE = 1e-9
"""The same for positions, rad."""

_PARTS = (0.5, 0.125, 0.03)
"""A change of speed that the guard refuses is tried again with these shares of it."""

_STILL = 1e-12
"""Speeds and accelerations below this are rounding errors, rad/s and rad/s2."""

_ROUNDING = 1e-12
"""Largest apparent distance between two stops along the same profile, rad."""


class JointSmoother:
    """The set-point of all joints, and the only thing that moves it. ``n`` joints, SI units, plain floats.

    Each of :meth:`follow`, :meth:`reach` and :meth:`stop` advances the set-point by exactly one tick.
    """

    def __init__(self, limits: LimitsSpec, dt: float) -> None:
        self.n = n = len(limits.lower)
        self.dt = dt
        self.lower = [x + 2.0 * _EDGE for x in limits.lower]
        """Limits of goals, rad: a little inside of where the check begins, or rounding would make it refuse them."""
        self.upper = [x - 2.0 * _EDGE for x in limits.upper]
        self._lower = [x + _EDGE for x in limits.lower]
        self._upper = [x - _EDGE for x in limits.upper]
        self.velocity = [x * _INSIDE for x in limits.velocity]
        self.acceleration = [x * _INSIDE for x in limits.acceleration]
        self._jerk = [x * _INSIDE for x in limits.jerk]
        self.slowest = min(self.velocity)
        """A vector of joint speeds no longer than this is within every joint's limit, rad/s."""
        # Where all joints were free last, and how far around it they stay so, rad.
        self._free_at: Floats = [inf] * n
        self._free_room = 0.0
        self._zeros = [0.0] * n
        self.q = list(self._zeros)
        """Set-point, rad."""
        self.dq = list(self._zeros)
        self.ddq = list(self._zeros)
        self.q_next = self.q
        """The proposed step."""
        self.dq_next = self.dq
        self.ddq_next = self.ddq
        self._none: frozenset[int] = frozenset()
        self._all = frozenset(range(n))
        self.held_back = self._none
        """Joints that the last step stopped because a position limit was near."""
        self.guarded = False
        """Whether the guard refused the last step as it was first proposed."""
        self._ruckig = Ruckig(n, dt)
        self._output = OutputParameter(n)
        self._input = InputParameter(n)
        # Each joint by itself: synchronised stops are longer than the shortest one, on which the check relies.
        self._input.synchronization = Synchronization.No
        self._input.max_acceleration = self.acceleration
        self._speeds: Floats = ()
        """The speeds that Ruckig's position interface keeps, rad/s; its velocity interface needs none."""
        self.limit_jerk()

    def limit_jerk(self, most: Floats | None = None) -> None:
        """Limit the joints' jerk to the arm's limits, and to ``most`` (n,), rad/s3, if given.

        To be lowered at rest only: a stop that is under way would become longer.
        """
        self.jerk = self._jerk if most is None else [min(x, y) for x, y in zip(self._jerk, most, strict=True)]
        # No stop from within the limits is longer than the one from full speed at full acceleration.
        room = [
            stop_displacement(v, a, a, j) for v, a, j in zip(self.velocity, self.acceleration, self.jerk, strict=True)
        ]
        self.free = [
            (low + r, high - r, v) for low, high, r, v in zip(self.lower, self.upper, room, self.velocity, strict=True)
        ]
        """Per joint: no faster than the third number (rad/s) and between the first two (rad), no limit can matter."""
        self._free_at = [inf] * self.n
        self._input.max_jerk = self.jerk

    def anchor(self, q: Floats, dq: Floats | None = None, ddq: Floats | None = None) -> None:
        """Set the set-point. Accelerations beyond the limits are cut, since no stop could be computed from them."""
        self.q = list(q)
        self.dq = list(self._zeros if dq is None else dq)
        self.ddq = [
            max(-limit, min(limit, a))
            for a, limit in zip(self._zeros if ddq is None else ddq, self.acceleration, strict=True)
        ]
        self.held_back = self._none
        self.guarded = False

    def adopt(self, q: Floats, dq: Floats, ddq: Floats, guard: Guard | None = None) -> bool:
        """Move to a set-point that was computed elsewhere inside the limits (a planned path).

        False, and nothing has moved, when the guard refuses.
        """
        self.q_next, self.dq_next, self.ddq_next = list(q), list(dq), list(ddq)
        self.held_back = self._none
        self.guarded = guard is not None and not guard(self)
        if not self.guarded:
            self._commit()
        return not self.guarded

    def at_rest(self) -> bool:
        """Return whether nothing moves (1e-6 rad/s, 1e-4 rad/s2: Ruckig's numbers at the end of a profile)."""
        return hypot(*self.dq) < 1e-6 and hypot(*self.ddq) < 1e-4

    def follow(self, dq: Floats, guard: Guard | None = None, together: bool = False) -> None:
        """One tick towards the velocities ``dq``, which are cut to the limits.

        A joint that would break the invariant is stopped; with ``together`` all are. Where the guard refuses a step,
        smaller changes of speed are tried; if it refuses all of them, the step becomes a stop of all joints. Without
        the smaller ones an arm at rest whose first step is refused would never move.
        """
        if not hypot(*dq) <= self.slowest:
            dq = self._clip_speed(dq)
        self.guarded = False
        self._propose_velocity(dq)
        self.held_back = self._violations()
        if self.held_back:
            stopped = self._all if together else self.held_back
            dq = [0.0 if i in stopped else v for i, v in enumerate(dq)]
            self._propose_velocity(dq)
        if guard is not None and not guard(self):
            self.guarded = True
            if not self._follows_slower(dq, guard):
                self._propose_velocity(self._zeros)
        self._commit()

    def _follows_slower(self, dq: Floats, guard: Guard) -> bool:
        """Propose a step that changes the speeds by a part of the way to ``dq``; False when none may be taken."""
        for part in _PARTS:
            self._propose_velocity([v0 + part * (v - v0) for v, v0 in zip(dq, self.dq, strict=True)])
            if not self._violations() and guard(self):
                return True
        return False

    def reach(self, q: Floats, velocity: Floats, guard: Guard | None = None) -> bool:
        """One tick of the time-optimal motion to rest at ``q``, no faster than ``velocity`` (each > 0).

        False, and nothing has moved, when that would break the invariant, when the guard refuses, or when Ruckig
        cannot plan it.
        """
        inputs = self._input
        inputs.control_interface = _POSITION
        if velocity is not self._speeds:
            self._speeds = velocity
            inputs.max_velocity = [v * _ABOVE for v in velocity]
        inputs.target_position = q
        inputs.target_velocity = self._zeros
        if not self._propose() or self._violations() or (guard is not None and not guard(self)):
            return False
        self.held_back = self._none
        self.guarded = False
        self._commit()
        return True

    def settle(self, guard: Guard | None = None) -> None:
        """One tick towards rest in which the joints keep their proportions, so that the tcp stays on its way.

        It takes as long as the joint that needs longest; where a limit is near each joint stops by itself.
        """
        self._input.synchronization = Synchronization.Phase
        self._propose_velocity(self._zeros)
        self._input.synchronization = Synchronization.No
        self.guarded = False
        self.held_back = self._violations()
        if self.held_back or (guard is not None and not guard(self)):
            self._propose_velocity(self._zeros)
        self._commit()

    def stop(self) -> None:
        """Advance the time-optimal stop by one tick."""
        self.held_back = self._none
        self.guarded = False
        self._propose_velocity(self._zeros)
        self._commit()
        if hypot(*self.dq) < _STILL and hypot(*self.ddq) < _STILL:
            self.dq, self.ddq = list(self._zeros), list(self._zeros)  # Ruckig leaves 1e-17 here and there

    def stop_end(self) -> list[float]:
        """Return where a stop that begins now ends (n,), rad."""
        return self._ends(self.q, self.dq, self.ddq)

    def stop_end_next(self) -> list[float]:
        """Return where a stop after the proposed step would end (n,), rad."""
        return self._ends(self.q_next, self.dq_next, self.ddq_next)

    def _propose_velocity(self, dq: Floats) -> None:
        inputs = self._input
        inputs.control_interface = _VELOCITY
        inputs.target_velocity = dq
        if not self._propose():  # never seen, but an arm that moves must not depend on it: stop without Ruckig
            state = zip(self.q, self.dq, self.ddq, self.acceleration, self.jerk, strict=True)
            steps = [stop_step(q, v, a, A, J, self.dt) for q, v, a, A, J in state]
            self.q_next, self.dq_next, self.ddq_next = (list(column) for column in zip(*steps, strict=True))

    def _propose(self) -> bool:
        inputs, output = self._input, self._output
        inputs.current_position = self.q
        inputs.current_velocity = self.dq
        inputs.current_acceleration = self.ddq
        try:
            self._ruckig.update(inputs, output)
        except RuckigError:
            self._ruckig.reset()
            return False
        self.q_next = output.new_position
        self.dq_next = output.new_velocity
        self.ddq_next = output.new_acceleration
        return isfinite(hypot(*self.q_next, *self.dq_next, *self.ddq_next))

    def _clip_speed(self, dq: Floats) -> Floats:
        if not isfinite(sum(dq)):  # a goal that is no number is no goal
            return self._zeros
        return [v if -cap <= v <= cap else (cap if v > 0.0 else -cap) for v, cap in zip(dq, self.velocity, strict=True)]

    def is_free(self, q: Floats) -> bool:
        """Return whether no limit matters at these positions (n,), rad, to joints within their speed limits.

        One distance instead of two comparisons a joint: none has moved farther than all of them together.
        """
        return dist(q, self._free_at) <= self._free_room

    def _violations(self) -> frozenset[int]:
        """Return the joints whose stop after the proposed step would end beyond a limit, and farther than from now."""
        q_next, dq_next = self.q_next, self.dq_next
        if hypot(*dq_next) <= self.slowest and self.is_free(q_next):
            return self._none
        found = self._none
        room = inf
        for i, (q, v, (low, high, speed)) in enumerate(zip(q_next, dq_next, self.free, strict=True)):
            room = min(room, q - low, high - q)
            if not (low <= q <= high and -speed <= v <= speed) and self._violates(i):
                found |= {i}
        self._free_at, self._free_room = q_next, room  # negative: not free here
        return found

    def _violates(self, i: int) -> bool:
        A, J, lower, upper = self.acceleration[i], self.jerk[i], self._lower[i], self._upper[i]
        q, v, a = self.q_next[i], self.dq_next[i], self.ddq_next[i]
        peak = q + stop_peak(v, a, A, J)
        trough = q - stop_peak(-v, -a, A, J)
        if peak <= upper and trough >= lower:
            return False
        q, v, a = self.q[i], self.dq[i], self.ddq[i]
        over = peak > upper and peak > q + stop_peak(v, a, A, J) + _ROUNDING
        return over or (trough < lower and trough < q - stop_peak(-v, -a, A, J) - _ROUNDING)

    def _commit(self) -> None:
        self.q, self.dq, self.ddq = self.q_next, self.dq_next, self.ddq_next

    def _ends(self, q: Floats, dq: Floats, ddq: Floats) -> list[float]:
        return [
            x + (stop_displacement(v, a, A, J) if v or a else 0.0)
            for x, v, a, A, J in zip(q, dq, ddq, self.acceleration, self.jerk, strict=True)
        ]
