"""Joint torques: the one kind of command in which the arm's place is not a set-point but what comes of it.

The device carries the arm's own weight; the torques come on top of that. Nobody but the guards here bounds such an arm,
so it is looked at in every tick (:mod:`.torque_bounds`). Whatever ends the motion, the torques become a brake; once the
arm is measured to be at rest it is held where it is, by positions again.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

from ..commands import CommandRecord
from ..driver import Reading, Setpoint
from ..specs import LimitsSpec
from ..types import Limited
from .envelope import Envelope
from .motions import Motion
from .smoothing import JointSmoother
from .torque_bounds import RATE, ArmInMotion, Inertia, TorqueBounds
from .watchdog import SILENCE

__all__ = ["MassMatrix", "TorqueMotion"]

Floats = Sequence[float]

MassMatrix = Callable[[Floats], Any]
"""Joint-space inertia (n, n), kg m2, at joint positions (n,), rad: as numbers in rows, or an array."""

PATIENCE = 0.020
"""Longest silence of the device in which a torque is kept up, s: 20 cycles, after which a Franka gives up as well."""

_REST = 0.02
"""Measured speeds below this are no motion, rad/s: noise, or so slow that positions can take over without a jerk."""

_REST_TIME = 0.030
"""For so long, s."""

BRAKE_LIMIT = 0.5
"""Longest time of braking, s. A stop takes 0.1 to 0.25 s; an arm that still moves then has a load that nobody told it
of, or is being pushed. Positions brake it further."""


class TorqueMotion(Motion):
    """Follow torques, and brake by torques. ``active`` from the first command until the arm is at rest again.

    The servo tells it every reading (:meth:`see`), moves it by :meth:`step` or :meth:`brake`, and writes what
    :meth:`setpoint` says as long as it is active.
    """

    def __init__(
        self, smoother: JointSmoother, envelope: Envelope, limits: LimitsSpec, mass_matrix: MassMatrix | None
    ) -> None:
        """Without a ``mass_matrix``, or without limits of torque, no command is usable."""
        super().__init__(smoother, envelope)
        self.size = smoother.n
        self.active = False
        """Does the arm follow torques, or brake by them?"""
        self.patience = max(PATIENCE, 3.0 * smoother.dt)
        self._mass_matrix = mass_matrix
        self._bounds: TorqueBounds | None = None
        if mass_matrix is not None and limits.torque is not None:
            self._bounds = TorqueBounds(limits, smoother.dt, envelope)
        self.q: Floats = smoother.q
        """Where the arm was measured last, rad."""
        self.dq: Floats = smoother.dq
        """How fast, rad/s."""
        self._inertia: Inertia | None = None
        self._weighed_at: Floats | None = None
        """Where that is the arm's inertia."""
        self._arm: ArmInMotion | None = None
        """The arm as it is now; None while the device does not tell."""
        self._nothing = [0.0] * self.size
        self._tau = self._nothing
        """What drives the arm now, Nm."""
        self._commanded = self._nothing
        """Nm"""
        self._begun = False
        """Was the first set-point of the mode made?"""
        self._overran: Limited | None = None
        """What the arm would have run into in the last tick, had it not been braked."""
        self._share = 0.0
        """How much of the brake is on (0..1)."""
        self._given_up = False
        """Was the device left alone, because nothing was known of the arm?"""
        self._unseen = self._still = self._braking = 0.0
        """For how long, s: nothing known of the arm, no motion measured, braking."""

    # What the servo tells it.

    def open(self) -> None:
        """A session begins, at rest."""
        if self._bounds is not None:
            self._bounds.begin(self.smoother.q)

    def see(self, reading: Reading | None) -> None:
        """What the device reports in this tick; None when it does not, or when that makes no sense."""
        if not self.active:
            if reading is not None:  # where torques would begin
                self.q, self.dq = reading.q, reading.dq
            return
        dt = self.smoother.dt
        self._arm = None
        self._unseen += dt
        if reading is None:
            self._still = 0.0
            return
        self._weigh()  # where the arm was a tick ago: it is the same, and may be computed ahead
        self.q, self.dq = reading.q, reading.dq
        if reading.tau_commanded is not None:
            self._tau = list(reading.tau_commanded)  # what was lost on its way must not make the next step greater
        self._still = self._still + dt if max(map(abs, reading.dq)) < _REST else 0.0
        self._look()

    def prepare(self) -> None:
        if self.active:
            self._weigh()

    def _weigh(self) -> None:
        """The inertia of the arm where it was measured last; None when that cannot be."""
        if self._weighed_at is self.q:
            return
        assert self._mass_matrix is not None
        self._weighed_at = self.q
        try:
            self._inertia = Inertia(self._mass_matrix(self.q), self.size)
        except ValueError:
            self._inertia = None

    def _look(self) -> None:
        if self._inertia is not None:  # else it is as though the device were silent
            self._arm = ArmInMotion(self.q, self.dq, self._inertia)
            self._unseen = 0.0

    # What it says.

    @property
    def blind(self) -> bool:
        """Is nothing known of the arm for so long that nothing should be sent? The device then holds by itself."""
        return self._unseen > SILENCE

    @property
    def resting(self) -> bool:
        """Is the arm measured to be at rest, with no torque left but what one tick takes away?"""
        return self._still >= _REST_TIME and max(map(abs, self._tau)) <= RATE * self.smoother.dt

    def overrun(self, driven: bool) -> Limited | None:
        """What the arm runs into. ``driven``: it follows torques; else it brakes, which must not take too long."""
        if driven:
            return self._overran
        if self._bounds is None or self._arm is None:
            return None
        return Limited.SPEED if self._cannot_brake(self._bounds, self._arm) else None

    def _cannot_brake(self, bounds: TorqueBounds, arm: ArmInMotion) -> bool:
        return self._braking >= BRAKE_LIMIT or bounds.is_runaway(arm)

    def setpoint(self) -> Setpoint | None:
        """What to write; None while it is blind."""
        if self.blind:
            return None
        return Setpoint(self.q, self.dq, self._nothing, self._tau)

    # The motion.

    def usable(self, values: Floats) -> bool:
        return self._bounds is not None and super().usable(values)

    def too_far(self, values: Floats) -> bool:
        """Torques begin at rest."""
        return self.active or not self.smoother.at_rest()

    def start(self) -> None:
        super().start()
        self.active = True
        self._tau = self._commanded = self._nothing
        self._begun = self._given_up = False
        self._overran = None
        self._unseen = self._still = self._braking = self._share = 0.0
        self._arm = None
        self._weigh()
        self._look()

    def accept(self, command: CommandRecord) -> None:
        self._commanded = list(command.values)

    def step(self, now: float) -> None:
        """One tick towards the commanded torques. The first set-point has none: the device changes its mode with it."""
        assert self._bounds is not None
        self._braking = self._share = 0.0
        arm = self._arm
        if self._begun and arm is not None:
            before = self._tau
            tau = self._bounds.towards(before, self._bounds.allowed(self._commanded, arm))
            self._overran = self._bounds.overrun(tau, arm)
            self._tau = tau
            if self._overran is not None:
                self._tau, self._share = self._bounds.brake(before, arm, 0.0)
        self._begun = True

    def brake(self) -> bool:
        """One tick of braking. True, and nothing was done, when positions should take over from here."""
        bounds, arm = self._bounds, self._arm
        assert bounds is not None
        if arm is None:
            self._given_up = self._given_up or self.blind
            self._tau = bounds.release(self._tau)
            return False
        if self._given_up or self.resting or self._cannot_brake(bounds, arm):
            return True
        self._braking += self.smoother.dt
        self._tau, self._share = bounds.brake(self._tau, arm, self._share)
        return False

    def leave(self) -> None:
        """The end: the set-point is where the arm was measured, at its speed if it still moves."""
        self.active = False
        moves = max(map(abs, self.dq)) >= _REST
        self.smoother.anchor(self.q, self.dq if moves else None)
