"""An arm that follows the servo's set-point by the torques of a controller, instead of by its own position controller.

The set-point is made as ever. Its tcp goes a little slower than the session allows, so that an arm that lags can catch
up without being faster than that, and its acceleration changes only as fast as torques can. It never leads an arm that
is held back by more than :data:`LEAD`, so that nothing springs when the arm is let go; :mod:`.torque_bounds` keeps the
arm below the session's tcp speed besides.
"""

from __future__ import annotations

from collections.abc import Sequence
from contextlib import suppress
from math import hypot

import numpy as np
from numpy.typing import NDArray

from ..commands import Session
from ..dynamics import Dynamics
from ..errors import NotSupported
from ..geometry import difference
from ..specs import RobotSpec
from ..types import ControlMode, Limited
from .controllers import Controller, ControllerLaw, Position, controller_of
from .envelope import Envelope
from .torque import TorqueMotion
from .torque_bounds import RATE

Floats = Sequence[float]

LEAD = (0.05, 0.2)
"""How far a set-point may be from the measured tcp, m and rad, or from a measured joint with joint springs, rad."""
RESUME = 0.8
"""Share of :data:`LEAD` below which a motion that was held back continues."""
MARGIN_SHARE = 0.5
"""Share of the collision margins that the arm itself keeps; the set-point keeps all of them. The rest is how far an arm
that follows well is behind its set-point, or beyond it."""
_PUSHED = 0.06
"""Time in which an arm loses a speed that its set-point does not have, s."""
SPEED_SHARE, TCP_SHARE = 0.8, 0.85
"""A set-point takes at most these shares of the joints' greatest speeds and of the session's tcp speed."""


JERK_SHARE = 0.5
"""Share of the greatest rate of a torque that a set-point's jerk may need. With more, an arm lags behind each change of
acceleration, and catches up as slowly as its springs are."""


def followable_jerk(mass: NDArray[np.float64]) -> list[float]:
    """Return the greatest jerks (n,), rad/s3, of a set-point that torques follow at an inertia (n, n), kg m2."""
    return [JERK_SHARE * RATE / heavy for heavy in mass.diagonal().tolist()]


class Compliance:
    """Drives one arm by a controller; ``active`` from the first command until positions hold the arm again.

    A ``simulated`` arm has the joint damping of its URDF, which the controller of a real one compensates.
    """

    def __init__(self, torque: TorqueMotion, envelope: Envelope, spec: RobotSpec, simulated: bool) -> None:
        self._torque = torque
        self._envelope = envelope
        self._dynamics: Dynamics | None = None
        if torque.bounds is not None:
            with suppress(NotSupported):  # no session gets a controller then
                self._dynamics = Dynamics.of(spec)
        self._friction: Floats | None = None
        if simulated and self._dynamics is not None and any(self._dynamics.damping):
            self._friction = self._dynamics.damping
            # It acts on the speed after the step, so a torque moves M + friction dt.
            torque.friction = np.diag(self._friction) * torque.smoother.dt
        self._law: ControllerLaw | None = None
        """The law of this session; None if the arm's own position controller follows the set-point."""
        self._jerk: Floats | None = None
        """Jerks (n,) that the torques of this session can follow, rad/s3."""
        self.active = False
        """Whether the controller drives the arm."""
        self._due = np.zeros((2, torque.size))
        """Set-point of the last tick: positions, rad, and speeds (2, n), rad/s, that are due now."""
        self._error: list[float] = []
        """Twist (6,) from the measured pose of the tcp to the set-point's within 1 s."""
        self.held_back = False
        """Whether the set-point is as far ahead of the arm as it may be."""

    @property
    def chosen(self) -> bool:
        """Whether the session has a controller."""
        return self._law is not None

    @property
    def mode(self) -> ControlMode:
        """What makes the arm follow its set-point at present."""
        if self._law is not None and self.active:
            return self._law.mode
        return ControlMode.TORQUE if self._torque.active else ControlMode.POSITION

    def open_session(self, session: Session) -> None:
        """Open a session: set the envelope of its set-point, and the bounds of its torques."""
        controller = controller_of(session.controller)
        torque, bounds = self._torque, self._torque.bounds
        self.active = self.held_back = False
        self._law = self._jerk = None
        torque.by_controller = not isinstance(controller, Position) and bounds is not None
        smoother = torque.smoother
        smoother.limit_jerk()
        if not torque.by_controller or bounds is None:
            self._envelope.open(session)
            torque.open()
            return
        if self._dynamics is not None:
            self._jerk = followable_jerk(self._dynamics.mass_matrix(smoother.q))
            smoother.limit_jerk(self._jerk)
        self._law = ControllerLaw(
            controller, smoother.n, smoother.dt, smoother.velocity, self._dynamics, self._friction,
            hypot(*self._envelope.kinematics.reach()),
        )  # fmt: skip
        slower = session._replace(speed=min(session.speed, SPEED_SHARE), tcp_speed=TCP_SHARE * session.tcp_speed)
        self._envelope.open(slower)
        torque.open()
        torque.margin_share = MARGIN_SHARE
        bounds.velocity, bounds.tcp_speed = smoother.velocity, session.tcp_speed

    def set_gains(self, controller: Controller) -> None:
        """Change the gains of the session's controller within 0.2 s."""
        if self._law is not None and type(controller) is type(self._law.controller):
            self._law.set_gains(controller)

    def begin(self) -> None:
        """Begin to drive the arm, whose set-point is at rest."""
        self._torque.start()
        self._torque.smoother.limit_jerk(self._jerk)
        self.active, self.held_back = True, False

    def end(self) -> None:
        """End to drive the arm: positions hold it, or stop it as hard as the arm itself can."""
        self.active = False
        self._torque.smoother.limit_jerk()

    def hold_back(self, cartesian: bool) -> bool:
        """Bring a set-point that is too far ahead of the arm back to :data:`LEAD`; returns whether it was.

        To be called once per tick, before the set-point moves on; ``cartesian``: with the Jacobian, which is then
        computed here.
        """
        law, smoother, torque = self._law, self._torque.smoother, self._torque
        assert law is not None
        q, goal = torque.q, smoother.q
        most, turn = LEAD
        if law.in_joints and max([abs(a - b) for a, b in zip(goal, q, strict=True)]) > turn:
            goal = [b + max(-turn, min(turn, a - b)) for a, b in zip(goal, q, strict=True)]
        kinematics, pose = self._envelope.kinematics, torque.tcp().pose
        at_goal = cartesian and goal is smoother.q
        error = difference(pose, self._envelope.pose_and_jacobian()[0] if at_goal else kinematics.fk(goal))
        share = hypot(*error[:3]) / most
        if not law.in_joints and not law.position_only:
            share = max(share, hypot(*error[3:]) / turn)
        if share > 1.0:
            goal = [b + (a - b) / share for a, b in zip(goal, q, strict=True)]
        self.held_back = share > RESUME if self.held_back and goal is smoother.q else goal is not smoother.q
        moved = goal is not smoother.q
        if moved:
            # It continues at the arm's speed, at most at its own: its stop then ends no farther away than before.
            dq, square = smoother.dq, sum(v * v for v in smoother.dq)
            along = sum(v * w for v, w in zip(dq, torque.dq, strict=True))
            rate = max(0.0, min(1.0, along / square)) if square > 0.0 else 0.0
            smoother.anchor(goal, [rate * v for v in dq], [rate * a for a in smoother.ddq])
            error = difference(pose, kinematics.fk(goal))
            self._envelope.limited |= Limited.LEAD
        self._due = np.array((smoother.q, smoother.dq))
        self._error = error
        return moved

    def drive(self) -> None:
        """Advance the torques by one tick towards those of the controller."""
        torque, law, smoother = self._torque, self._law, self._torque.smoother
        assert law is not None
        assert torque.bounds is not None
        arm = torque.arm
        if arm is None:  # the last ones are kept, for a bounded time
            return
        (q_due, dq_due), tcp = self._due, torque.tcp()
        acceleration = np.array(smoother.dq)
        acceleration -= dq_due
        acceleration *= torque.bounds.feeds(tcp.speed) / smoother.dt
        torque.drive(law, law.torques(arm, tcp, (q_due, dq_due, acceleration), self._error), arm, tcp)

    def strays(self) -> Limited | None:
        """Return the limit that the arm exceeds, although its set-point keeps all of them; None if it keeps all."""
        torque, collisions = self._torque, self._envelope.collisions
        bounds, arm = torque.bounds, torque.arm
        if bounds is None or arm is None:
            return None
        limit = bounds.strays(arm, torque.tcp().speed)
        if limit is None and collisions is not None and not collisions.allows_arm(arm.q, arm.dq, _PUSHED):
            limit = Limited.COLLISION
        return limit
