"""The bounds of joint torques, from the arm's inertia.

Torques limit neither speed nor position, so both are predicted from the arm's inertia. With M the joint-space inertia
where the arm is, torques tau that are removed from now on as fast as their rate R allows still add

    dv = M^-1 (tau T + tau |tau| / (2 R))

to the joint speeds; T is the time until a torque that was just computed can be followed by a lower one. The effect of
an obstacle or a push is not predicted; it shows in the measured speeds.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import cached_property
from math import dist, hypot, isfinite, sqrt
from operator import mul
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..kinematics.arm import Pose7
from ..specs import LimitsSpec
from ..types import Limited
from .envelope import UNLIMITED, Envelope

Array = NDArray[np.float64]
Floats = Sequence[float]

RATE = 990.0
"""Greatest rate of every torque, Nm/s: the 1000 of a Franka's interface, less a margin for rounding."""

_SHARE = 0.9
"""Share of the session's speeds that torques may lead to; a faster joint is braked. The rest is for what the prediction
leaves out: a load that the inertia does not include, torques that change before they are gone."""

_COUPLED = 0.95
"""The same for the effect of the joints on each other. It is more, so that a joint that coasts at its speed does not
take the torques of all others away."""

_SPRINGS = 0.87
"""The same for what a controller's springs add to the tcp's speed: little more than its set-point's."""

_FED = 0.92
"""The same for what the acceleration of its set-point adds."""

_LAG = 2.0
"""Ticks until a torque can be followed by a lower one: it acts for one, and its effect is measured after that."""

_DECAY = 40.0
"""The brake takes this share of each joint's speed away, 1/s. With a greater share, an arm whose inertia is stated much
too large would hardly brake."""

_STABLE = 0.25
"""The brake takes no more than this share per tick: the arm then comes to rest without turning back, also if the
measured speed is a tick older than the torque."""

_UNWIND = 1.6 * RATE
"""Twice the rate at which the brake may have to be released, Nm/s: less than possible, so that it is never late."""

_INSIDE = 1.0 - 1e-9
"""Share of the torque limits used for braking, so that rounding never shows as a violation."""

_SLACK = 5e-3
"""An arm that begins outside a limit may not move farther out than this, rad and m."""


_STRAY = 0.02
"""A joint that follows a set-point by a controller's torques may be this far beyond its range, rad."""

_RUNAWAY = 1.5
"""Share of its speed limit at which a braked arm counts as out of control: its inertia is very different from the
model's."""


def make_solver(n: int) -> Any:
    """Return memory for the Cholesky factors of an inertia (n, n)."""
    import eigenpy

    return eigenpy.LLT(np.eye(n))


class Inertia:
    """Joint-space inertia of an arm at one position.

    Args:
        mass_matrix: (n, n), kg m2.
        n: Number of joints.
        friction: What friction adds to the inertia that torques move (n, n), kg m2; None for nothing.
        solver: Memory for :meth:`solve`, from :func:`make_solver`: the Inertia made before with it is then no longer
            valid. None for its own.

    Raises:
        ValueError: It is not the inertia of an arm.
    """

    def __init__(self, mass_matrix: Any, n: int, friction: Array | None = None, solver: Any = None) -> None:
        self.mass: Array = np.array(mass_matrix, float)
        if not (self.mass.shape == (n, n) and isfinite(np.vdot(self.mass, self.mass))):
            raise ValueError(f"not the inertia of an arm with {n} joints: {self.mass.tolist()}")
        self.moved: Array = self.mass if friction is None else self.mass + friction
        """What torques move: the mass matrix, and the friction."""
        solver = make_solver(n) if solver is None else solver
        solver.compute(self.moved)
        if solver.info():  # 0: success
            raise ValueError(f"not positive definite, so not the inertia of an arm: {self.mass.tolist()}")
        self.solve: Callable[[Array], Array] = solver.solve
        """Return the accelerations, rad/s2, under torques (n,) or (n, m), Nm."""

    @cached_property
    def inverse(self) -> Array:
        """Inverse (n, n), 1/(kg m2)."""
        return self.solve(np.eye(len(self.mass)))

    @cached_property
    def alone(self) -> list[float]:
        """Inertia of each joint (n,) while the others are free, kg m2."""
        alone: list[float] = (1.0 / self.inverse.diagonal()).tolist()
        return alone

    def added(self, tau: Floats, lag: float) -> list[float]:
        """Return what torques (n,) still add to the joint speeds (n,), rad/s, although they are removed from now on."""
        added: list[float] = self.inverse.dot(self.impulses(tau, lag)).tolist()
        return added

    @staticmethod
    def impulses(tau: Floats, lag: float) -> list[float]:
        """Return the impulses (n,), Nms, of torques over the time that it takes to remove them."""
        return [x * (lag + abs(x) * (0.5 / RATE)) for x in tau]

    def momentum(self, dq: Floats) -> list[float]:
        """Return the momentum (n,) of joint speeds, kg m2/s."""
        momentum: list[float] = self.mass.dot(dq).tolist()
        return momentum


class ArmInMotion(NamedTuple):
    """Measured state of an arm."""

    q: Floats
    """Joint positions (n,), rad."""
    dq: Floats
    """Joint speeds (n,), rad/s."""
    inertia: Inertia


class TcpInMotion(NamedTuple):
    """Measured state of an arm's tcp."""

    pose: Pose7
    jacobian: Array
    """(6, n), along the base's axes."""
    velocity: Array
    """(3,), m/s."""
    speed: float
    """Its length, m/s."""
    q: Array
    """Joint positions (n,), rad."""
    dq: Array
    """Joint speeds (n,), rad/s."""


class TorqueBounds:
    """Bounds of one arm, under the terms of the session in the envelope."""

    def __init__(self, limits: LimitsSpec, dt: float, envelope: Envelope) -> None:
        assert limits.torque is not None
        self._limits = limits
        self._torque = limits.torque
        self._weakest = min(limits.torque)
        self._envelope = envelope
        self._kinematics = envelope.kinematics
        self._reach = self._kinematics.reach()
        self._slowest = min(limits.velocity)
        # Positions this near to the middle of their ranges are in them: one distance, not two comparisons a joint.
        self._middle = [0.5 * (low + high) for low, high in zip(limits.lower, limits.upper, strict=True)]
        self._radius = min(0.5 * (high - low) for low, high in zip(limits.lower, limits.upper, strict=True))
        self.velocity: Floats = envelope.velocity
        """Greatest joint speeds (n,) that torques may lead to, rad/s."""
        self.tcp_speed = envelope.tcp_speed
        """Greatest speed of the tcp that they may lead to, m/s."""
        self._step = RATE * dt
        self._lag = _LAG * dt
        self._decay = min(_DECAY, _STABLE / dt)
        self._ranges = list(zip(limits.lower, limits.upper, strict=True))
        """Ranges of the joints in this session, rad."""
        workspace = envelope.workspace
        self._box = [] if workspace is None else list(zip(workspace.lower, workspace.upper, strict=True))
        """Ranges of the tcp, m; empty if unlimited."""

    def open_session(self, q: Floats) -> None:
        """Open a session with the arm at ``q`` (n,), rad: outside a limit it may only come back in."""
        self.velocity, self.tcp_speed = self._envelope.velocity, self._envelope.tcp_speed
        self._ranges = _widen(self._limits.lower, self._limits.upper, q, self._ranges)
        workspace = self._envelope.workspace
        if workspace is not None:
            self._box = _widen(workspace.lower, workspace.upper, self._kinematics.fk(q)[:3], self._box)

    # Torques within the bounds.

    def allowed(self, commanded: list[float], arm: ArmInMotion) -> list[float]:
        """Return the torques (n,) to move towards, Nm, when ``commanded`` is commanded.

        They keep the torque limits, and can be removed before the arm is faster than the session allows. First each
        joint is bounded by itself, as though the others were free; for the effect of the joints on each other, and on
        the tcp, all torques are then scaled alike.
        """
        envelope = self._envelope
        tau = [max(-limit, min(limit, x)) for x, limit in zip(commanded, self._torque, strict=True)]
        if tau != commanded:
            envelope.limited |= Limited.TORQUE
        most, coupled = [_SHARE * v for v in self.velocity], [_COUPLED * v for v in self.velocity]
        slowed = list(map(self._slow_down, tau, arm.dq, arm.inertia.alone, most, self._torque))
        added = arm.inertia.added(slowed, self._lag)
        share = min(map(_share, arm.dq, added, coupled))
        if share < 1.0 or slowed != tau:
            envelope.limited |= Limited.SPEED
        tcp_share = self._tcp_share(arm, added)
        if tcp_share < 1.0:
            envelope.limited |= Limited.TCP_SPEED
        share = min(share, tcp_share)
        if share == 1.0:
            return slowed
        # What is scaled away may have braked a joint that Coriolis torques accelerate: all speeds are braked instead.
        excess = max(abs(v) / limit for v, limit in zip(arm.dq, most, strict=True)) - 1.0
        brake = (1.0 - share) * self._decay * max(0.0, excess)
        return [share * x - brake * p for x, p in zip(slowed, arm.inertia.momentum(arm.dq), strict=True)]

    def feeds(self, speed: float) -> float:
        """Return the share (0..1) of a set-point's acceleration that an arm whose tcp has this speed, m/s, gets.

        An arm that springs made faster than its set-point must not become faster still while the set-point catches up.
        """
        most = self.tcp_speed
        if most >= UNLIMITED:
            return 1.0
        return max(0.0, min(1.0, (_FED * most - speed) / ((_FED - _SPRINGS) * most)))

    def shared(
        self, tau: Array, gain: Callable[[], Array], most_gain: float, arm: ArmInMotion, tcp: TcpInMotion
    ) -> list[float]:
        """Return the torques (n,) to move towards, Nm: a controller's, with as much of the springs as keeps the speeds.

        Args:
            tau: Torques (2, n), Nm: those of all but its springs, which make the arm no faster than its set-point and
                are applied in full; and those of its springs.
            gain: Returns the velocity (3,) of the tcp, m/s, that the springs may still add.
            most_gain: An upper bound of its length, m/s.
            arm: Measured state.
            tcp: That of its tcp.
        """
        envelope = self._envelope
        slowed, more = (arm.inertia.solve(tau.T).T * self._lag).tolist()
        share = 1.0
        if hypot(*arm.dq) + hypot(*slowed) + hypot(*more) > _COUPLED * self._slowest:
            before = [v + dv for v, dv in zip(arm.dq, slowed, strict=True)]
            share = min(map(_share, before, more, [_COUPLED * v for v in self.velocity]))
            if share < 1.0:
                envelope.limited |= Limited.SPEED
        cap = _SPRINGS * self.tcp_speed
        if self.tcp_speed < UNLIMITED and not tcp.speed + most_gain <= cap:
            tcp_share = _greatest_share(tcp.velocity, gain(), cap)
            if tcp_share < 1.0:
                envelope.limited |= Limited.TCP_SPEED
                share = min(share, tcp_share)
        total: list[float] = (tau[0] + (tau[1] if share == 1.0 else share * tau[1])).tolist()
        size = hypot(*total)
        if size <= self._weakest:
            return total
        if not isfinite(size):  # never seen; cut below, it would be the greatest torque
            envelope.limited |= Limited.TORQUE
            return [0.0] * len(total)
        cut = [max(-limit, min(limit, x)) for x, limit in zip(total, self._torque, strict=True)]
        if cut != total:
            envelope.limited |= Limited.TORQUE
        return cut

    def _slow_down(self, tau: float, v: float, inertia: float, most: float, limit: float) -> float:
        """Return ``tau`` cut to what leaves this joint at ``most`` rad/s: inertia (most - v) = tau T + tau^2 / (2 R).

        A joint that is faster is braked at least.
        """
        if abs(v) > most:
            brake = min(limit, self._decay * inertia * (abs(v) - most))
            return min(tau, -brake) if v > 0.0 else max(tau, brake)
        lag = self._lag
        room = most - v if tau > 0.0 else most + v
        greatest = RATE * (sqrt(lag * lag + 2.0 / RATE * inertia * room) - lag)
        return max(-greatest, min(greatest, tau))

    def _tcp_share(self, arm: ArmInMotion, added: list[float]) -> float:
        """Return the greatest share (0..1) of what torques add that leaves the tcp below its speed, or slows it."""
        cap = _SHARE * self.tcp_speed
        if self._surely_slower([abs(v) + abs(dv) for v, dv in zip(arm.dq, added, strict=True)], cap):
            return 1.0
        jacobian = self._kinematics.jacobian(arm.q)[:3]
        return _greatest_share(jacobian.dot(arm.dq), jacobian.dot(added), cap)

    def _surely_slower(self, speeds: Floats, cap: float) -> bool:
        """Return whether the tcp provably stays below ``cap`` (m/s) at joint speeds up to ``speeds`` (n,) >= 0."""
        return cap >= UNLIMITED or sum(map(mul, self._reach, speeds)) <= cap

    def towards(self, tau: Floats, goal: Floats) -> list[float]:
        """Return ``tau`` (n,) moved by one tick towards ``goal``, each torque as fast as it may change, Nm."""
        step = self._step
        return [old + max(-step, min(step, new - old)) for old, new in zip(tau, goal, strict=True)]

    def together(self, tau: Floats, goal: Floats) -> list[float]:
        """Return ``tau`` (n,) moved by one tick towards ``goal``, all torques by the same share of the way, Nm.

        Joints whose axes are nearly in line turn against each other with next to no inertia. Torques that are late one
        by one accelerate them that way; torques that are late together only slow the motion down.
        """
        most = max([abs(new - old) for old, new in zip(tau, goal, strict=True)])
        if most <= self._step:
            return list(goal)
        share = self._step / most
        return [old + share * (new - old) for old, new in zip(tau, goal, strict=True)]

    # Braking.

    def brake(self, tau: Floats, arm: ArmInMotion, share: float) -> tuple[list[float], float]:
        """Return the torques (n,) after one more tick of braking, Nm, and the share of the brake that is applied now.

        The brake is -g M dq, which takes the same share g of every joint's speed away, so that the arm keeps its path
        until it rests. It never adds energy as long as its torques are not cut one by one, so g is cut instead, and all
        of them grow in proportion. The torques that drove the arm are removed first, each by itself: a rest that is
        small for a shoulder is large for a wrist. (Torques of -D dq with a D for each joint brake longer, since each
        joint is pushed by the others; and a D that suits the torque limits makes a wrist of little inertia swing.)

        Args:
            tau: Torques before (n,), Nm.
            arm: Measured state.
            share: Share of the brake that was applied before (0..1).
        """
        step = self._step
        goal, _ = self._braking(arm, arm.dq)
        more = 1.0 - share
        rests = []
        for x, brake in zip(tau, goal, strict=True):
            before = x - share * brake
            rest = before - max(-step, min(step, before))
            rests.append(rest)
            left = step - abs(before - rest)
            if left < more * abs(brake):
                more = left / abs(brake)
        share += more
        return [rest + share * brake for rest, brake in zip(rests, goal, strict=True)], share

    def release(self, tau: Floats) -> list[float]:
        """Return ``tau`` (n,) moved by one tick towards zero: the only option while the speeds are unknown."""
        return self.towards(tau, [0.0] * len(tau))

    def _braking(self, arm: ArmInMotion, dq: Floats) -> tuple[list[float], float]:
        """Return the torques that brake these speeds, Nm, and the share of the speed that they take away, 1/s."""
        momentum = arm.inertia.momentum(dq)
        share = self._decay
        for p, most in zip(map(abs, momentum), self._torque, strict=True):
            if share * p > _INSIDE * most:
                share = _INSIDE * most / p
            # A torque sqrt(2 r p) that takes away its own p falls at the rate r.
            if share * share * p > _UNWIND:
                share = sqrt(_UNWIND / p)
        return [-share * p for p in momentum], share

    # Limits that are exceeded.

    def overrun(self, tau: Floats, arm: ArmInMotion) -> Limited | None:
        """Return the limit that the arm exceeds while ``tau`` (n,), Nm, drives it; None if it keeps all.

        It does if its measured speed is above the session's, or if a stop that begins now would end beyond a limit of
        position or a face of the workspace, or too near to something.
        """
        envelope, dq = self._envelope, arm.dq
        speeds = [abs(v) for v in dq]
        if any(v > most for v, most in zip(speeds, envelope.velocity, strict=True)):
            return Limited.SPEED
        if not self._surely_slower(speeds, envelope.tcp_speed):
            velocity = self._kinematics.jacobian(arm.q)[:3].dot(dq).tolist()
            if hypot(*velocity) > envelope.tcp_speed:
                return Limited.TCP_SPEED
        fastest = [v + dv for v, dv in zip(dq, arm.inertia.added(tau, self._lag), strict=True)]
        goal, share = self._braking(arm, fastest)
        # The lag and the ramp at the full speed; then the speed dies away, at this share at first, later no slower.
        ramp = (max(map(abs, tau)) + max(map(abs, goal))) / RATE
        seconds = self._lag + ramp + 1.0 / share
        if not _stays_within(self._ranges, arm.q, dq, fastest, seconds):
            return Limited.POSITION
        if self._box:
            pose, jacobian = self._kinematics.fk_and_jacobian(arm.q)
            now, then = jacobian[:3].dot(dq).tolist(), jacobian[:3].dot(fastest).tolist()
            if not _stays_within(self._box, pose[:3], now, then, seconds):
                return Limited.WORKSPACE
        if envelope.collisions is not None:
            ends = [[x + seconds * v for x, v in zip(arm.q, speed, strict=True)] for speed in (dq, fastest)]
            if not envelope.collisions.measured.allows(arm.q, ends):
                return Limited.COLLISION
        return None

    def strays(self, arm: ArmInMotion, tcp_speed: float) -> Limited | None:
        """Return the limit that an arm exceeds whose set-point keeps all of them; None if it keeps all.

        That are its own joint speeds, half as much again as the session's tcp speed, and its ranges.

        Args:
            arm: Measured state.
            tcp_speed: That of its tcp, m/s.
        """
        limits = self._limits.velocity
        if hypot(*arm.dq) > self._slowest and any(abs(v) > most for v, most in zip(arm.dq, limits, strict=True)):
            return Limited.SPEED
        if tcp_speed > _RUNAWAY * self.tcp_speed:
            return Limited.TCP_SPEED
        if dist(arm.q, self._middle) > self._radius:
            for x, (low, high) in zip(arm.q, self._ranges, strict=True):
                if not low - _STRAY <= x <= high + _STRAY:
                    return Limited.POSITION
        return None

    def is_runaway(self, arm: ArmInMotion) -> bool:
        """Return whether a joint is so much faster than its limit that torques must not be used any longer."""
        return any(abs(v) > _RUNAWAY * most for v, most in zip(arm.dq, self._limits.velocity, strict=True))


def _share(v: float, added: float, most: float) -> float:
    """Return the greatest share (0..1) of ``added`` that leaves a joint at ``most`` rad/s or does not speed it up."""
    room = most - v if added > 0.0 else most + v
    return 1.0 if abs(added) <= max(0.0, room) else max(0.0, room / abs(added))


def _greatest_share(a: Any, b: Any, cap: float) -> float:
    """Return the greatest share s (0..1) for which a velocity a + s b (3,) is below ``cap`` m/s, or slower than a.

    It is the greater root of |a + s b| = cap.
    """
    bb, ab, rest = float(b.dot(b)), float(a.dot(b)), cap * cap - float(a.dot(a))
    if bb + 2.0 * ab <= rest or bb == 0.0:
        return 1.0
    return max(0.0, min(1.0, (sqrt(max(0.0, ab * ab + bb * rest)) - ab) / bb))


def _widen(
    lower: Floats, upper: Floats, at: Floats, before: Sequence[tuple[float, float]]
) -> list[tuple[float, float]]:
    """Return the ranges from ``lower`` to ``upper``, widened where ``at`` is outside or at their edge.

    ``before`` are the ranges of the session before.
    """
    each = zip(lower, upper, at, before, strict=True)
    return [(_least(low, x, least), -_least(-high, -x, -most)) for low, high, x, (least, most) in each]


def _least(low: float, x: float, before: float) -> float:
    """Return the lower end of a range that begins at ``low``, with an arm at ``x``.

    An arm that is where the session before it ended gets no more room, or it could creep out from session to session.
    """
    moved = before >= low or x < before - _SLACK  # the arm was inside, or something else has moved it since
    return min(low, x - _SLACK if moved else max(x - _SLACK, min(x, before)))


def _stays_within(ranges: Sequence[tuple[float, float]], at: Floats, v: Floats, w: Floats, seconds: float) -> bool:
    """Return whether a motion between the velocities ``v`` and ``w`` stays within these ranges for ``seconds``."""
    for (low, high), x, v0, v1 in zip(ranges, at, v, w, strict=True):
        if x + seconds * max(v0, v1, 0.0) > high or x + seconds * min(v0, v1, 0.0) < low:
            return False
    return True
