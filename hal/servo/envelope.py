"""The room that a session leaves the arm: joint speeds, the tcp's speed, the workspace, what it must not touch."""

from __future__ import annotations

from collections.abc import Sequence
from math import dist, hypot, inf, sqrt
from operator import mul
from typing import TYPE_CHECKING, Any

import numpy as np

from ..commands import Session
from ..kinematics.arm import Kinematics, Pose7
from ..specs import WorkspaceSpec
from ..types import Limited
from .collisions import CollisionGuard, Stop
from .smoothing import Guard, JointSmoother, speed_for, stop_displacement, stop_phases

if TYPE_CHECKING:
    from numpy.typing import NDArray

Floats = Sequence[float]

_SAME = 2e-3
"""The Jacobian is computed again once the tcp may have moved this far, m: it errs by 2 mm/s per rad/s."""

_PARTS = np.linspace(0.0, 1.0, 9)
"""A stop is checked at the ends of at least these parts of its duration."""


class TcpReference:
    """The tcp at a reference position nearby, and bounds on its position, its speed and that of its stops.

    Forward kinematics and a Jacobian in every tick would cost more than all the rest of it. Most ticks need neither:
    the tcp is nowhere near a face of the workspace or its greatest speed, and a bound that costs a few multiplications
    proves it. They are only computed if the bound does not.

    Every bound rests on `Kinematics.reach`, r: joint i at 1 rad/s moves the tcp at r_i m/s at most, wherever the arm
    is, and turning joint j by x rad changes each column of the linear Jacobian J by r_j |x| at most. With dq the joint
    speeds, and d = q - q_reference the distance of the joints from where the tcp was computed:

    * |tcp(q) - tcp(q_reference)| <= m, where m = sum r_i |d_i| <= |r| |d|;
    * |J(q) dq| <= sum r_i |dq_i|;
    * |J(q) dq| <= |J(q_reference) dq| + m sum |dq_i| <= (|J(q_reference)| + |r| |d| sqrt(n)) |dq|.

    The looser forms are products of lengths, which cost one call each; the sharper ones are tried if those fail.
    """

    def __init__(self, smoother: JointSmoother, kinematics: Kinematics, workspace: WorkspaceSpec | None) -> None:
        self._smoother = smoother
        self._kinematics = kinematics
        self._workspace = workspace
        self._reach = kinematics.reach()
        self._reach_length = hypot(*self._reach)
        self._root = sqrt(smoother.n)
        self._spread = self._reach_length * self._root
        self._overrun = self._overrun_tcp = inf
        """What a joint's acceleration adds to its speed until it is taken back, at most: rad/s for each rad/s2. The
        same for the tcp: m/s for each (rad/s2)^2."""
        self._reach_array = np.array(self._reach)
        self._accelerations = np.array(smoother.acceleration)
        self._bend = sum(map(mul, self._reach, smoother.acceleration)) / 8.0
        self._at: Floats = [inf] * smoother.n
        """Joint positions of the reference (n,), rad; infinite before the first one."""
        self._pose: Pose7 = (inf,) * 7
        self._jacobian: Any = None
        self._curvature: Any = None
        """Their derivatives by each joint, (n, 3 n); None until they are needed."""
        self._centre: Floats = (0.0,) * smoother.n
        self._centre_speed = self._centre_length = 0.0
        """Joint speeds, rad/s, and the greatest speed of the tcp there, m/s, for any shares from 0 to 1 of them;
        the length of these speeds."""
        self._stretch = inf
        """The tcp's speed there for joint speeds of length 1 is no greater (it is the Jacobian's Frobenius norm)."""
        self._clearance = inf
        """Distance of the tcp there from the nearest face of the workspace, m; negative outside."""
        self._stops: list[tuple[float, float, float]] = []
        """Per joint, its greatest speed, rad/s, and how far its stop moves the tcp at most: so many m for each rad/s
        and each rad/s2 that it begins with."""
        self._per_speed = self._per_acceleration = 0.0
        """Lengths of the columns of these."""
        self._fastest = [0.0] * smoother.n
        """Joint speeds (n,), rad/s, up to which these hold."""
        self._slowest = 0.0
        self._step = 0.0
        """Farthest that one tick can move the tcp and the end of its stop, together, m."""
        still = [0.0] * smoother.n
        self._proven: tuple[float, Floats, Floats, Floats, Floats] = (inf, still, still, still, still)
        """Bound of the tcp's speed in the stop that was proven last, m/s; where that stop begins (joint positions,
        speeds and accelerations), and the mean speeds of the step before it, each (n,)."""
        self._ramps = still
        """What a joint's acceleration changes of the speeds in its stop at most, rad/s for each rad/s2 (n,)."""
        self._longest = 0.0
        """Longest duration of a stop, s."""
        self._proof: Floats = ()
        """The set-point from which the next step was proven to be inside, with this margin, m."""
        self._margin = 0.0

    def open(self, velocity: Floats) -> None:
        """Open a session whose joints stay below ``velocity`` (n,), rad/s."""
        smoother = self._smoother
        dt = smoother.dt
        limits = list(zip(smoother.acceleration, smoother.jerk, strict=True))
        self._overrun = max([0.5 * A / J for A, J in limits])
        self._overrun_tcp = max([0.5 * r / J for r, (_, J) in zip(self._reach, limits, strict=True)])
        self._stops = []
        self._fastest = []
        self._slowest = min(velocity)
        self._step = 0.0
        self._proof = ()
        self._proven = inf, *self._proven[1:]
        self._ramps = [2.0 * A / J for A, J in limits]
        self._longest = 0.0
        # The way f(v, a) of a stop grows with the speed v and the acceleration a that it begins with, and is convex in
        # each, so f(v, a) <= f(v, 0) + (f(v, A) - f(v, 0)) a / A, where f(v, 0) <= f(u, 0) v / u for any u >= v, and
        # the difference grows with v. Here u lies a tick's acceleration beyond the session's speed, so that the bound
        # holds for the next tick's state as well.
        for reach, cap, A, J in zip(self._reach, velocity, smoother.acceleration, smoother.jerk, strict=True):
            u = cap + A * dt
            steady, worst = stop_displacement(u, 0.0, A, J), stop_displacement(u, A, A, J)
            per_v, per_a = reach * steady / u, reach * (worst - steady) / A
            self._stops.append((cap, per_v, per_a))
            self._fastest.append(u)
            self._longest = max(self._longest, stop_phases(u, A, A, J)[3])
            self._step += reach * u * dt + per_v * A * dt + per_a * min(A, J * dt)
        self._per_speed = hypot(*[per_v for _, per_v, _ in self._stops])
        self._per_acceleration = hypot(*[per_a for _, _, per_a in self._stops])

    def pose_and_jacobian(self) -> tuple[Pose7, NDArray[np.float64]]:
        """Return pose of the tcp and its Jacobian (6, n) at the set-point, which becomes the reference."""
        if self._at is not self._smoother.q:
            self._move_reference()
        return self._pose, self._jacobian

    def _move_reference(self) -> None:
        q = self._smoother.q
        if self._centre_length:
            self._centre_speed += self._spread * dist(q, self._at) * self._centre_length
        pose, jacobian = self._kinematics.fk_and_jacobian(q)
        self._at, self._pose, self._jacobian = q, pose, jacobian
        linear = jacobian[:3]
        self._curvature = None
        self._stretch = sqrt(np.vdot(linear, linear))
        if self._workspace is not None:
            (a, b, c), (d, e, f) = self._workspace.lower, self._workspace.upper
            x, y, z, *_ = pose
            self._clearance = min(x - a, y - b, z - c, d - x, e - y, f - z)

    def velocity(self, dq: Floats) -> list[float]:
        """Return the linear velocity (3,) of the tcp for joint speeds ``dq`` (n,) at the set-point, base axes, m/s."""
        self._refresh()
        return [sum(map(mul, row, dq)) for row in self._jacobian[:3].tolist()]

    def surely_slower(self, dq: Floats, cap: float) -> bool:
        """Return whether the tcp provably stays below ``cap`` (m/s) while the joints change their speeds.

        Each changes by itself, in any order, between its present speed, ``dq`` (rad/s) and rest. False: not proven.
        """
        smoother = self._smoother
        now = smoother.dq
        speed = self._root * hypot(*dq, *now)
        # Each joint moves at any share of its speed at the centre, plus what it may be away from there.
        near = self._centre_speed + self._stretch * hypot(dist(dq, self._centre), dist(now, self._centre))
        if near + speed * self._reach_length * dist(smoother.q, self._at) <= cap:
            return True
        self._put_centre(dq)
        return self._centre_speed + self._stretch * dist(now, dq) + speed * self._bound_distance() <= cap

    def _put_centre(self, dq: Floats) -> None:
        """Compute the tcp's greatest speed for all shares of the joint speeds ``dq`` (n,), rad/s."""
        self._refresh()
        axes = []
        for row in self._jacobian[:3].tolist():
            parts = list(map(mul, row, dq))
            axes.append(0.5 * (sum(map(abs, parts)) + abs(sum(parts))))  # the greater of the axis' two directions
        self._centre, self._centre_speed, self._centre_length = dq, hypot(*axes), hypot(*dq)

    def stop_speed(self, dq: Floats, linear: NDArray[np.float64] | None = None) -> float:
        """Greatest speed of the tcp (m/s) in a stop from these steady joint speeds, the ramps of braking left out.

        Each joint slows down evenly, so that the tcp is fastest at the start or when one of the joints comes to rest.
        ``linear`` holds transposed linear Jacobians (..., n, 3); without it, that of the set-point counts.
        """
        if linear is None:
            self._refresh()
            linear = self._jacobian[:3].T
        speeds = np.abs(dq)
        ends = np.append(speeds / self._accelerations, 0.0)
        slowed = np.copysign(np.maximum(speeds - ends[:, None] * self._accelerations, 0.0), dq)
        return sqrt(np.square(slowed @ linear).sum(axis=-1).max())

    def surely_stops_slower(self, cap: float) -> bool:
        """Return whether the tcp surely keeps below ``cap`` (m/s) in the proposed step and in the stop after it."""
        smoother = self._smoother
        q, dq, dt = smoother.q, smoother.dq_next, smoother.dt
        speed, acceleration = hypot(*dq), hypot(*smoother.ddq_next)
        if speed <= self._slowest or all(-u <= v <= u for v, u in zip(dq, self._fastest, strict=True)):
            mean = [(x - x0) / dt for x, x0 in zip(smoother.q_next, q, strict=True)]
            step = hypot(*mean)
            # In its stop no joint gets faster than its speed and what its acceleration adds until it is taken back.
            fastest = self._root * max(speed + self._overrun * acceleration, step)
            way = self._reach_length * step * dt + self._per_speed * speed + self._per_acceleration * acceleration
            ramps = self._overrun_tcp * acceleration * acceleration + fastest * way
            near = self._centre_speed + self._stretch * max(dist(dq, self._centre), dist(mean, self._centre))
            if near + ramps + fastest * self._reach_length * dist(q, self._at) <= cap:
                return True
            if self._like_proven_stop(mean, fastest) <= cap:
                return True
            self._put_centre(dq)
            if self._centre_speed + self._stretch * dist(mean, dq) + ramps + fastest * self._bound_distance() <= cap:
                return True
        self._refresh()
        bound = self._fastest_in_stop(cap)
        if bound <= cap:
            mean = [(x - x0) / dt for x, x0 in zip(smoother.q_next, q, strict=True)]
            self._proven = bound, smoother.q_next, dq, smoother.ddq_next, mean
        return bound <= cap

    def _like_proven_stop(self, mean: Floats, fastest: float) -> float:
        """Return a bound of the tcp's speed in the proposed step and its stop, m/s, from the stop that was proven last.

        From the speed v and the acceleration a > 0 a stop is the stop from v + a^2 / (2 J) and no acceleration, entered
        a / J later. Two stops without acceleration differ in speed at most by what they begin with, and at two times
        by A for each second. So a joint's speeds in two stops never differ by more than |dv| + 2 A / J |da|.

        Args:
            mean: Mean joint speeds (n,) of the proposed step, rad/s.
            fastest: Sum of the joints' speeds, which is never greater, rad/s.
        """
        smoother = self._smoother
        bound, *proven = self._proven
        off = in_step = moved = 0.0
        for r, per_a, q, q0, v, v0, a, a0, m, m0 in zip(
            self._reach, self._ramps, smoother.q_next, proven[0], smoother.dq_next, proven[1], smoother.ddq_next,
            proven[2], mean, proven[3], strict=True,
        ):  # fmt: skip
            off += r * (abs(v - v0) + per_a * abs(a - a0))
            in_step += r * abs(m - m0)
            moved += r * abs(q - q0)
        return bound + max(off, in_step) + fastest * (moved + smoother.dt * in_step + self._longest * off)

    def _fastest_in_stop(self, cap: float) -> float:
        """Return a bound of the tcp's speed in the proposed step and in the stop after it, m/s, exact enough for a cap.

        Between any two of the times below each joint's speed is a parabola, which lies in the triangle of its control
        points (both ends, and where their tangents meet). With the Jacobian of the reference the tcp's velocity is one,
        too, and nowhere greater than the greatest of its control points, but for what the joints' way d from there
        changes: m for each rad/s, as above.

        Where that is too coarse, the Jacobian changes with the way to first order. The way is all but straight between
        two of the times, and so the tcp's velocity is a cubic, in the hull of four control points. What this leaves out
        is (sum r_i |d_i|) (sum |d_i|) / 2 for each rad/s, and the bend of the way, at most A t^2 / 8 for each joint.
        """
        smoother = self._smoother
        q, dq, ddq, dt = smoother.q_next, smoother.dq_next, smoother.ddq_next, smoother.dt
        limits = zip(dq, ddq, smoother.acceleration, smoother.jerk, strict=True)
        phases = np.array([stop_phases(v, a, A, J) for v, a, A, J in limits])
        jerk, first, second, third = phases.T
        times = np.concatenate((_PARTS * phases[:, 3].max(), phases[:, 1:].ravel()))
        times.sort()
        t = times[:, None]
        built = np.minimum(t, first)
        braked = np.minimum(t, third)
        released = np.maximum(braked - second, 0.0)
        slopes = ddq + jerk * (built - released)
        slopes[t >= third] = 0.0
        ramps = built * (ddq + 0.5 * jerk * built) - 0.5 * jerk * released**2
        speeds = dq + ramps + (braked - built) * (ddq + jerk * first)
        widths = (times[1:] - times[:-1])[:, None]
        control = np.empty((3, len(widths), smoother.n))
        control[0], control[1], control[2] = speeds[:-1], speeds[:-1] + (0.5 * widths) * slopes[:-1], speeds[1:]
        greatest = np.abs(control).max(axis=0)
        total = greatest.sum(axis=1)
        linear = self._jacobian[:3].T
        here = np.subtract(q, self._at)
        way = np.abs(here) + np.cumsum(greatest * widths, axis=0)
        reached = way @ self._reach_array

        mean = np.subtract(q, smoother.q) / dt  # of the step: what shows when positions are compared
        mean_total = float(np.abs(mean).sum())

        fastest = np.sqrt(np.square(control @ linear).sum(axis=2).max(axis=0))
        in_step = hypot(*(mean @ linear).tolist()) + float(reached[0]) * mean_total
        bound = max(float((fastest + reached * total).max()), in_step)
        if bound <= cap:
            return bound

        if self._curvature is None:
            self._curvature = self._kinematics.curvature(self._jacobian).reshape(smoother.n, -1)
        places = np.empty_like(speeds)
        places[0] = here
        places[1:] = here + np.cumsum(control.sum(axis=0) * (widths / 3.0), axis=0)
        nodes = linear + (places @ self._curvature).reshape(-1, smoother.n, 3)
        begun = control[:, :, None] @ nodes[:-1]
        ended = control[:, :, None] @ nodes[1:]
        velocities = np.stack((3.0 * begun[0], ended[0] + 2.0 * begun[1], 2.0 * ended[1] + begun[2])) / 3.0
        fastest = np.sqrt(np.square(velocities[:, :, 0]).sum(axis=2).max(axis=0))
        left_out = 0.5 * reached * way.sum(axis=1) + self._bend * widths[:, 0] ** 2
        middle = linear + ((here - 0.5 * dt * mean) @ self._curvature).reshape(smoother.n, 3)
        in_step = hypot(*(mean @ middle).tolist()) + float(left_out[0]) * mean_total
        return max(float((fastest + left_out * total).max()), in_step)

    def surely_inside(self, margin: float) -> bool:
        """Return whether the tcp, stopped now, surely stays ``margin`` (m) off every face of the workspace."""
        margin = max(margin, self._step)
        if self._proof is self._smoother.q and margin <= self._margin:
            return True
        proven = self._proves_inside(margin) or (self._refresh() and self._proves_inside(margin))
        self._proof, self._margin = (self._smoother.q, margin) if proven else ((), 0.0)
        return proven

    def surely_stays_inside(self) -> bool:
        """Return whether a stop after the proposed step surely ends inside the workspace."""
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
        return self._bound_distance() < left

    def _bound_distance(self) -> float:
        """Return the greatest distance between the tcp at the set-point and that of the reference, m."""
        if self._at is self._smoother.q:
            return 0.0
        total = 0.0
        for reach, x, at in zip(self._reach, self._smoother.q, self._at, strict=True):
            total += reach * abs(x - at)
        return total

    def _refresh(self) -> bool:
        """Move the reference to the set-point unless it is as good as there; returns whether it moved."""
        if self._bound_distance() <= _SAME:
            return False
        self._move_reference()
        return True


_TCP_SHARE = 0.97
"""Share of the tcp speed that goals use, for what the stale Jacobian and joints that change speed one by one add."""

UNLIMITED = 100.0
"""From this tcp speed on nothing is checked, m/s."""

_FACE_GAIN = 4.0
"""Speed towards a face of the workspace per distance to it, 1/s: 0.25 m/s slows down from 6 cm, at 1 m/s2."""

_CHANGE = 0.9
"""Share of the acceleration with which goals change speed in proportion; the rest lets the joints catch up."""

_BRAKE = 0.8
_BRAKE_JERK = 0.5
"""Shares of acceleration and jerk that goals count on for braking; what is left makes the braking smooth."""


class Envelope:
    """Cuts goals to a session's terms; ``limited`` collects what was held back since it was cleared."""

    def __init__(self, smoother: JointSmoother, kinematics: Kinematics, workspace: WorkspaceSpec | None) -> None:
        self.smoother = smoother
        self.kinematics = kinematics
        self.workspace = workspace
        self.velocity = list(smoother.velocity)
        """Greatest joint speeds of the session (n,), rad/s."""
        self._slowest = smoother.slowest
        """A vector of joint speeds no longer than this is within every joint's limit, rad/s."""
        self.tcp_speed = float("inf")
        """Greatest speed of the tcp, m/s."""
        self.goal_tcp_speed = float("inf")
        """The same for goals: a little less, for what the smoothing adds."""
        self.limited = Limited.NONE
        self.guard: Guard | None = None if workspace is None else self.stays_inside
        """Check that a proposed step must pass beyond joint limits; None if there is none."""
        self._refused = Limited.NONE
        """Why the guard refused the last step."""
        self.collisions: CollisionGuard | None = None
        """Keeps the arm off itself, off boxes and off other arms; None if nothing is checked."""
        self._tcp = TcpReference(smoother, kinematics, workspace)
        self.pose_and_jacobian = self._tcp.pose_and_jacobian
        """Returns pose of the tcp and its Jacobian (6, n) at the set-point; computed once a tick."""

    def open(self, session: Session) -> None:
        """Set the terms of a session."""
        self.velocity = [session.speed * v for v in self.smoother.velocity]
        self._slowest = min(self.velocity)
        self._tcp.open(self.velocity)
        self.tcp_speed = session.tcp_speed
        self.goal_tcp_speed = _TCP_SHARE * session.tcp_speed
        if self.collisions is not None:
            self.collisions.open(self.velocity)
        free = self.workspace is None and self.tcp_speed >= UNLIMITED and self.collisions is None
        self.guard = None if free else self.allows

    # Goals: smooth caps, so that the hard checks below seldom have to act.

    def lets_pass(self, dq: list[float]) -> bool:
        """Return whether this goal velocity (n,), rad/s, is surely within every cap below. False: not proven."""
        smoother = self.smoother
        speed = hypot(*dq)
        if not (speed <= self._slowest and smoother.is_free(smoother.q)):
            return False
        if self.tcp_speed < UNLIMITED and not self._tcp.surely_slower(dq, self.goal_tcp_speed):
            return False
        return self.far_from_faces() and (self.collisions is None or self.collisions.is_far(speed))

    def cap_joints(self, dq: list[float]) -> list[float]:
        """Return goal velocities (n,), rad/s, cut to the session's speed and to braking before a limit."""
        if hypot(*dq) <= self._slowest and self.smoother.is_free(self.smoother.q):
            return dq
        state = zip(dq, self.velocity, self.smoother.q, self.smoother.free, strict=True)
        return [
            v if low <= q <= high and -cap <= v <= cap else self._clip(i, v)
            for i, (v, cap, q, (low, high, _)) in enumerate(state)
        ]

    def cap_together(self, dq: list[float]) -> list[float]:
        """Return the same, but with the whole vector scaled, so that the tcp keeps its direction."""
        each = self.cap_joints(dq)
        if each is dq:
            return dq
        scale = 1.0
        for v, capped in zip(dq, each, strict=True):
            if capped != v:
                scale = min(scale, capped / v)
        return dq if scale == 1.0 else [scale * v for v in dq]

    def cap_tcp(self, dq: list[float]) -> tuple[list[float], bool]:
        """Scale a goal velocity to the limits of the tcp's speed, of the workspace and of what is near.

        They are kept in a stop from there as well.

        Returns:
            The goal, and whether the joints must change their speeds in proportion on the way there: each by itself,
            they might move the tcp too fast in between.
        """
        if self.collisions is not None and not self.collisions.is_far(hypot(*dq)):
            slower = self.collisions.slow(dq)
            if slower is not dq:
                self.limited |= Limited.COLLISION
                dq = slower
        if self.tcp_speed >= UNLIMITED and self.workspace is None:
            return dq, False
        fast = not self._tcp.surely_slower(dq, self.goal_tcp_speed)
        if not fast and self.far_from_faces():
            return dq, False
        scale = 1.0
        if fast:
            speed = self._tcp.stop_speed(dq)
            if speed > self.goal_tcp_speed:
                scale = self.goal_tcp_speed / speed
                self.limited |= Limited.TCP_SPEED
        if self.workspace is not None:
            tcp = self._tcp.velocity(dq)
            for v, cap in zip(tcp, self.face_speeds(tcp), strict=True):
                if abs(v) * scale > cap:
                    scale = cap / abs(v)
                    self.limited |= Limited.WORKSPACE
        return (dq if scale == 1.0 else [scale * v for v in dq]), fast

    def in_proportion(self, dq: list[float], before: Floats) -> list[float]:
        """Return the next goal velocity (n,) from ``before`` towards ``dq``, all joints in proportion, rad/s."""
        smoother = self.smoother
        share = 1.0
        for v, v0, A in zip(dq, before, smoother.acceleration, strict=True):
            step = _CHANGE * A * smoother.dt
            if abs(v - v0) > step:
                share = min(share, step / abs(v - v0))
        return dq if share == 1.0 else [v0 + share * (v - v0) for v, v0 in zip(dq, before, strict=True)]

    def face_speeds(self, tcp_velocity: Floats) -> list[float]:
        """Return the greatest speed (3,) along each base axis in the direction of ``tcp_velocity`` (3,), m/s."""
        if self.workspace is None:
            return [float("inf")] * 3
        at, _ = self.pose_and_jacobian()
        faces = zip(at, tcp_velocity, self.workspace.lower, self.workspace.upper, strict=False)
        return [_FACE_GAIN * max(0.0, (high - x) if v > 0.0 else (x - low)) for x, v, low, high in faces]

    def stop_speed(self, dq: list[float], places: Sequence[Floats]) -> float:
        """Return the tcp's greatest speed, m/s, with joint speeds ``dq`` at any of these positions or in a stop."""
        return self._tcp.stop_speed(dq, np.array([self.kinematics.jacobian(q)[:3].T for q in places]))

    def far_from_faces(self) -> bool:
        """Return whether the tcp is surely where no face of the workspace slows it down."""
        return self.workspace is None or self._tcp.surely_inside(self.goal_tcp_speed / _FACE_GAIN)

    def _clip(self, i: int, v: float) -> float:
        cap = self.velocity[i]
        if not -cap <= v <= cap:
            self.limited |= Limited.SPEED
            v = cap if v > 0.0 else -cap
        smoother = self.smoother
        q, lower, upper = smoother.q[i], smoother.lower[i], smoother.upper[i]
        # Two ticks ahead: the cap must not fall faster than the joint can brake.
        ahead = 2.0 * smoother.dt * smoother.dq[i]
        left = upper - q - max(0.0, ahead) if v > 0.0 else q - lower + min(0.0, ahead)
        cap = speed_for(left, _BRAKE * smoother.acceleration[i], _BRAKE_JERK * smoother.jerk[i])
        if abs(v) > cap:
            self.limited |= Limited.POSITION
            return cap if v > 0.0 else -cap
        return v

    # Hard checks of a proposed step.

    def stays_inside(self, smoother: JointSmoother) -> bool:
        """Return whether a stop after the proposed step ends in the workspace, or no farther outside than from now."""
        box = self.workspace
        if box is None or self._tcp.surely_stays_inside():
            return True
        end = self.kinematics.fk(smoother.stop_end_next())
        if all(low <= x <= high for x, low, high in zip(end, box.lower, box.upper, strict=False)):
            return True
        now = self.kinematics.fk(smoother.stop_end())
        for x, x_now, low, high in zip(end, now, box.lower, box.upper, strict=False):
            if x > max(high, x_now) + 1e-9 or x < min(low, x_now) - 1e-9:
                self._refused = Limited.WORKSPACE
                return False
        return True

    def keeps_tcp_speed(self, smoother: JointSmoother) -> bool:
        """Return whether the tcp keeps its speed limit in the proposed step and in a stop after it."""
        if self.tcp_speed >= UNLIMITED or self._tcp.surely_stops_slower(self.tcp_speed):
            return True
        self.note_tcp_speed()
        return False

    def note_tcp_speed(self) -> None:
        """Note that a step was refused because the tcp would be too fast."""
        self._refused = Limited.TCP_SPEED

    def keeps_apart(self, stop: Stop | None = None) -> bool:
        """Return whether the arm touches nothing in the proposed step and in its stop (None: that of the joints)."""
        if self.collisions is None or self.collisions.allows(stop):
            return True
        self._refused = Limited.COLLISION
        return False

    @property
    def blocked(self) -> bool:
        """Whether the last step that was refused would have touched something."""
        return self._refused is Limited.COLLISION

    def allows(self, smoother: JointSmoother) -> bool:
        """Return whether a step passes :meth:`keeps_tcp_speed`, :meth:`stays_inside` and :meth:`keeps_apart`."""
        return self.keeps_tcp_speed(smoother) and self.stays_inside(smoother) and self.keeps_apart()

    def note(self, smoother: JointSmoother) -> None:
        """Collect what the last step held back."""
        if smoother.held_back:
            self.limited |= Limited.POSITION
        if smoother.guarded:
            self.limited |= self._refused
