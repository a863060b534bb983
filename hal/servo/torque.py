"""Joint torques: the one kind of command whose result is measured instead of being a set-point of position.

The device compensates the arm's own weight; the torques come on top of that. Only :mod:`.torque_bounds` limits such an
arm, so it is checked in every tick. Whatever ends the motion, the torques become a brake; once the arm is measured to
be at rest it is held there by positions again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from math import sqrt
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..commands import CommandRecord
from ..driver import Reading, Setpoint
from ..specs import LimitsSpec
from ..types import Limited
from .envelope import Envelope
from .joint import ServoMotion
from .smoothing import JointSmoother
from .torque_bounds import RATE, ArmInMotion, Inertia, TcpInMotion, TorqueBounds, make_solver
from .watchdog import SILENCE

if TYPE_CHECKING:
    from .controllers import ControllerLaw

Array = NDArray[np.float64]
Floats = Sequence[float]

MassMatrix = Callable[[Floats], Any]
"""Returns the joint-space inertia (n, n), kg m2, at joint positions (n,), rad: rows of numbers or an array."""

PATIENCE = 0.020
"""Longest silence of the device for which a torque is kept, s: 20 cycles, after which a Franka gives up as well."""

_REST = 0.02
"""Measured speeds below this count as rest, rad/s: noise, or slow enough for positions to take over without a jerk."""

_REST_TIME = 0.030
"""Time for which the arm must be at rest before positions hold it, s."""

BRAKE_LIMIT = 0.5
"""Longest time of braking, s. A stop takes 0.1 to 0.25 s; an arm that still moves then carries an unknown load, or is
pushed. Positions brake it further."""


class TorqueMotion(ServoMotion):
    """Follows torques, and brakes by torques. ``active`` from the first command until the arm is at rest again.

    Before, the servo keeps :attr:`q` and :attr:`dq` up to date. While it is active, the servo passes every reading to
    :meth:`observe`, advances it by :meth:`step` or :meth:`brake`, and writes :meth:`setpoint`.
    """

    def __init__(
        self, smoother: JointSmoother, envelope: Envelope, limits: LimitsSpec, mass_matrix: MassMatrix | None
    ) -> None:
        """Make the motion. Without ``mass_matrix``, or without torque limits, no command is usable."""
        super().__init__(smoother, envelope)
        self.size = smoother.n
        self.active = False
        """Whether the arm follows torques, or brakes by them."""
        self.patience = max(PATIENCE, 3.0 * smoother.dt)
        self.by_controller = False
        """Whether the torques of this session are those of a controller."""
        self._mass_matrix = mass_matrix
        self.bounds: TorqueBounds | None = None
        if mass_matrix is not None and limits.torque is not None:
            self.bounds = TorqueBounds(limits, smoother.dt, envelope)
        self.q: Floats = smoother.q
        """Newest measured joint positions (n,), rad."""
        self.dq: Floats = smoother.dq
        """Newest measured joint speeds (n,), rad/s."""
        self._inertia: Inertia | None = None
        self.arm: ArmInMotion | None = None
        """Newest measured state of the arm; None while it is unknown."""
        self._tcp: TcpInMotion | None = None
        """Newest measured state of the tcp; None until it is asked for."""
        self._solver = make_solver(self.size)
        self.friction: Array | None = None
        """What friction adds to the inertia that a controller's torques move in one tick (n, n), kg m2."""
        self._nothing = [0.0] * self.size
        self.tau = self._nothing
        """Torques that drive the arm now (n,), Nm."""
        self._commanded = self._nothing
        """Commanded torques (n,), Nm."""
        self._begun = False
        """Whether the first set-point of the mode was made."""
        self._overran: Limited | None = None
        """The limit that the arm would have run into in the last tick without braking."""
        self._share = 0.0
        """Share of the brake that is applied (0..1)."""
        self.margin_share = 1.0
        """Share of the collision margins that the arm keeps while it follows torques."""
        self._given_up = False
        """Whether the device was left alone because the arm's state was unknown."""
        self._unseen = self._still = self._braking = 0.0
        """Durations, s: state unknown, no motion measured, braking."""

    # Input from the servo.

    def open(self) -> None:
        """Open a session, at rest."""
        self.margin_share = 1.0
        if self.bounds is not None:
            self.bounds.open_session(self.smoother.q)

    def observe(self, reading: Reading | None) -> None:
        """Note the reading of this tick; None if there is none or it is invalid."""
        dt = self.smoother.dt
        self.arm = None
        self._unseen += dt
        if reading is None:
            self._still = 0.0
            return
        self._update_inertia()  # where the arm was a tick ago: it is the same
        self.q, self.dq, self._tcp = reading.q, reading.dq, None
        if reading.tau_commanded is not None:
            self.tau = list(reading.tau_commanded)  # what was lost on its way must not make the next step greater
        self._still = self._still + dt if max(map(abs, reading.dq)) < _REST else 0.0
        self._update_arm()

    def tcp(self) -> TcpInMotion:
        """Return the state of the tcp where the arm was measured last."""
        if self._tcp is None:
            q, dq = np.array((self.q, self.dq))
            pose, jacobian = self.envelope.kinematics.fk_and_jacobian(q)
            velocity = jacobian[:3].dot(dq)
            self._tcp = TcpInMotion(pose, jacobian, velocity, sqrt(velocity.dot(velocity)), q, dq)
        return self._tcp

    def _update_inertia(self) -> None:
        """Compute the inertia where the arm was measured last; None if it is invalid."""
        assert self._mass_matrix is not None
        try:
            friction = self.friction if self.by_controller else None
            self._inertia = Inertia(self._mass_matrix(self.q), self.size, friction, self._solver)
        except ValueError:
            self._inertia = None

    def _update_arm(self) -> None:
        if self._inertia is not None:  # else it is as though the device were silent
            self.arm = ArmInMotion(self.q, self.dq, self._inertia)
            self._unseen = 0.0

    # Output to the servo.

    @property
    def blind(self) -> bool:
        """Whether the arm's state has been unknown for so long that the device should hold by itself."""
        return self._unseen > SILENCE

    @property
    def still(self) -> bool:
        """Whether the arm is measured to be at rest, whatever torques hold it there."""
        return self._still >= _REST_TIME

    @property
    def resting(self) -> bool:
        """Whether the arm is measured to be at rest, with no torque left but what one tick removes."""
        return self._still >= _REST_TIME and max(map(abs, self.tau)) <= RATE * self.smoother.dt

    def overrun(self, driven: bool) -> Limited | None:
        """Return the limit that the arm runs into; None if it keeps all.

        Args:
            driven: Whether it follows torques; else it brakes, which must not take too long.
        """
        if driven:
            return self._overran
        if self.bounds is None or self.arm is None:
            return None
        return Limited.SPEED if self._cannot_brake(self.bounds, self.arm) else None

    def _cannot_brake(self, bounds: TorqueBounds, arm: ArmInMotion) -> bool:
        return self._braking >= BRAKE_LIMIT or bounds.is_runaway(arm)

    def setpoint(self) -> Setpoint | None:
        """Return the set-point to be written; None while the arm's state is unknown."""
        if self.blind:
            return None
        return Setpoint(self.q, self.dq, self._nothing, self.tau)

    # The motion.

    def usable(self, values: Floats) -> bool:
        return self.bounds is not None and super().usable(values)

    def too_far(self, values: Floats) -> bool:
        """Return whether the arm moves: torques begin at rest."""
        return self.active or not self.smoother.at_rest()

    def start(self) -> None:
        super().start()
        self.active = True
        self.tau = self._commanded = self._nothing
        self._begun = self._given_up = False
        self._overran = None
        self._unseen = self._still = self._braking = self._share = 0.0
        self.arm = self._tcp = None
        if self.envelope.collisions is not None:
            self.envelope.collisions.measured.start(self.q, self.margin_share)
        self._update_inertia()
        self._update_arm()

    def accept(self, command: CommandRecord) -> None:
        self._commanded = list(command.values)

    def step(self, now: float) -> None:
        """Move the torques by one tick towards the command. The first set-point has none: it changes the mode."""
        assert self.bounds is not None
        self._braking = self._share = 0.0
        arm = self.arm
        if self._begun and arm is not None:
            before = self.tau
            tau = self.bounds.towards(before, self.bounds.allowed(self._commanded, arm))
            self._overran = self.bounds.overrun(tau, arm)
            self.tau = tau
            if self._overran is not None:
                self.tau, self._share = self.bounds.brake(before, arm, 0.0)
        self._begun = True

    def drive(self, law: ControllerLaw, tau: Array, arm: ArmInMotion, tcp: TcpInMotion) -> None:
        """Move the torques by one tick towards those of a controller (see :meth:`TorqueBounds.shared`).

        The first set-point has none: it changes the mode.
        """
        self._braking = self._share = 0.0
        if self._begun:
            assert self.bounds is not None
            goal = self.bounds.shared(tau, law.gain, law.most_gain, arm, tcp)
            self.tau = self.bounds.together(self.tau, goal)
        self._begun = True

    def brake(self) -> bool:
        """Brake by one tick. Returns True, and does nothing, if positions should take over from here."""
        bounds, arm = self.bounds, self.arm
        assert bounds is not None
        if arm is None:
            self._given_up = self._given_up or self.blind
            self.tau = bounds.release(self.tau)
            return False
        if self._given_up or self.resting or self._cannot_brake(bounds, arm):
            return True
        self._braking += self.smoother.dt
        self.tau, self._share = bounds.brake(self.tau, arm, self._share)
        return False

    def leave(self) -> None:
        """Leave the mode: the set-point is where the arm was measured, at its speed if it still moves."""
        self.active = False
        moves = max(map(abs, self.dq)) >= _REST
        self.smoother.anchor(self.q, self.dq if moves else None)
