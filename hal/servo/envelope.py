"""The room that a session leaves the arm: joint speeds, the tcp's speed, the workspace."""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot
from typing import TYPE_CHECKING

import numpy as np

from ..commands import Session
from ..kinematics.arm import Kinematics, Pose7
from ..specs import WorkspaceSpec
from ..types import Limited
from .limits import speed_for
from .smoothing import Guard, JointSmoother
from .tcp import TcpReference

if TYPE_CHECKING:
    from numpy.typing import NDArray

__all__ = ["Envelope"]

Floats = Sequence[float]

_TCP_SHARE = 0.97
"""Share of the tcp speed that goals use, for what the stale Jacobian and joints that change speed one by one add."""

_UNLIMITED = 100.0
"""From this tcp speed on nothing is looked at, m/s."""

_FACE_GAIN = 4.0
"""Speed towards a face of the workspace per distance to it, 1/s: 0.25 m/s slows down from 6 cm, at 1 m/s2."""

_CHANGE = 0.9
"""Share of the acceleration with which goals change speed in proportion; the rest lets the joints catch up."""

_BRAKE = 0.8
_BRAKE_JERK = 0.5
"""Shares of acceleration and jerk that goals count on for braking; what is left makes the braking smooth."""


class Envelope:
    """Cuts goals to a session's terms; ``limited`` collects what was held back since it was last cleared."""

    def __init__(self, smoother: JointSmoother, kinematics: Kinematics, workspace: WorkspaceSpec | None) -> None:
        self.smoother = smoother
        self.kinematics = kinematics
        self.workspace = workspace
        self.velocity = list(smoother.velocity)
        """Greatest joint speeds of the session (n,), rad/s."""
        self._slowest = smoother.slowest
        """A vector of joint speeds no longer than this is within every joint's, rad/s."""
        self.tcp_speed = float("inf")
        """Greatest speed of the tcp, m/s."""
        self.goal_tcp_speed = float("inf")
        """The same for goals: a little less, for what the smoothing adds."""
        self.limited = Limited.NONE
        self.guard: Guard | None = None if workspace is None else self.stays_inside
        """What a proposed step must satisfy beyond joint limits."""
        self._refused = Limited.NONE
        """Why the guard refused a step last."""
        self._tcp = TcpReference(smoother, kinematics, workspace)

    def open(self, session: Session) -> None:
        """Take over the terms of a session."""
        self.velocity = [session.speed * v for v in self.smoother.velocity]
        self._slowest = min(self.velocity)
        self._tcp.open(self.velocity)
        self.tcp_speed = session.tcp_speed
        self.goal_tcp_speed = _TCP_SHARE * session.tcp_speed
        self.guard = None if self.workspace is None and self.tcp_speed >= _UNLIMITED else self.allows

    # Goals: smooth caps, so that the hard checks below seldom have to act.

    def lets_pass(self, dq: list[float]) -> bool:
        """Is this goal velocity surely within every cap below? False: not proven."""
        smoother = self.smoother
        speed = hypot(*dq)
        if not (speed <= self._slowest and smoother.is_free(smoother.q)):
            return False
        if self.tcp_speed < _UNLIMITED and not self._tcp.surely_slower(dq, self.goal_tcp_speed):
            return False
        return self.far_from_faces()

    def cap_joints(self, dq: list[float]) -> list[float]:
        """Each joint by itself: the session's speed, and what can still brake before a position limit."""
        if hypot(*dq) <= self._slowest and self.smoother.is_free(self.smoother.q):
            return dq
        state = zip(dq, self.velocity, self.smoother.q, self.smoother.free, strict=True)
        return [
            v if low <= q <= high and -cap <= v <= cap else self._clip(i, v)
            for i, (v, cap, q, (low, high, _)) in enumerate(state)
        ]

    def cap_together(self, dq: list[float]) -> list[float]:
        """The same caps, but the whole vector is scaled, so that the tcp keeps its direction."""
        each = self.cap_joints(dq)
        if each is dq:
            return dq
        scale = 1.0
        for v, capped in zip(dq, each, strict=True):
            if capped != v:
                scale = min(scale, capped / v)
        return dq if scale == 1.0 else [scale * v for v in dq]

    def cap_tcp(self, dq: list[float]) -> tuple[list[float], bool]:
        """Scale a goal velocity so that the tcp keeps its speed limit, also in a stop from there, and slows down before
        the workspace's faces.

        Returns:
            The goal, and whether the joints must change their speeds in proportion on the way there: each by itself,
            they might move the tcp too fast in between.
        """
        if self.tcp_speed >= _UNLIMITED and self.workspace is None:
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
        """From the goal velocity of the last tick towards ``dq``, no faster than the slowest joint can, all alike."""
        smoother = self.smoother
        share = 1.0
        for v, v0, A in zip(dq, before, smoother.acceleration, strict=True):
            step = _CHANGE * A * smoother.dt
            if abs(v - v0) > step:
                share = min(share, step / abs(v - v0))
        return dq if share == 1.0 else [v0 + share * (v - v0) for v, v0 in zip(dq, before, strict=True)]

    def face_speeds(self, tcp_velocity: Floats) -> list[float]:
        """Greatest speed (3,) in m/s along each base axis, given which way the tcp goes."""
        if self.workspace is None:
            return [float("inf")] * 3
        at, _ = self.here()
        faces = zip(at, tcp_velocity, self.workspace.lower, self.workspace.upper, strict=False)
        return [_FACE_GAIN * max(0.0, (high - x) if v > 0.0 else (x - low)) for x, v, low, high in faces]

    def here(self) -> tuple[Pose7, NDArray[np.float64]]:
        """Pose of the tcp and its Jacobian (6, n) at the set-point; computed once a tick, whoever asks."""
        return self._tcp.here()

    def stop_speed(self, dq: list[float], places: Sequence[Floats]) -> float:
        """Greatest speed (m/s) of the tcp that moves with joint speeds ``dq`` at any of these joint positions, or stops
        from there."""
        return self._tcp.stop_speed(dq, np.array([self.kinematics.jacobian(q)[:3].T for q in places]))

    def far_from_faces(self) -> bool:
        """Is the tcp surely where no face of the workspace slows it down?"""
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
        """Would a stop after the proposed step end inside the workspace, or no farther outside than one from now?"""
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
        if self.tcp_speed >= _UNLIMITED or self._tcp.surely_stops_slower(self.tcp_speed):
            return True
        self._refused = Limited.TCP_SPEED
        return False

    def allows(self, smoother: JointSmoother) -> bool:
        """`keeps_tcp_speed` and `stays_inside`."""
        return self.keeps_tcp_speed(smoother) and self.stays_inside(smoother)

    def note(self, smoother: JointSmoother) -> None:
        """Collect what the last step held back."""
        if smoother.held_back:
            self.limited |= Limited.POSITION
        if smoother.guarded:
            self.limited |= self._refused
