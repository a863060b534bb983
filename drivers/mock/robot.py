"""An ideal arm: it is where the newest set-point says, unless a knob is turned. Torques drive it like seven wheels."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from typing import ClassVar

from hal.driver import Reading, RobotDriver, Setpoint
from hal.errors import CommandError, ConnectionLost
from hal.specs import RobotSpec
from hal.types import Fault

from .knobs import RobotKnobs, turned

__all__ = ["FRICTION", "INERTIA", "LOG_LENGTH", "MockRobot"]

LOG_LENGTH = 100_000
"""How many set-points ``MockRobot.log`` keeps: 100 s of the fastest arm."""
INERTIA = 1.0
"""Of every joint that is driven by torques, kg m2."""
FRICTION = 1.0
"""Of the same, Nm per rad/s."""
KEEP_UP = 0.020
"""For how long the last torques are kept up without new ones, s: as long as a Franka does."""


class MockRobot(RobotDriver):
    """An arm in memory. A set-point written after ``read(t)`` is where the arm is at the next ``read``.

    Set-points with torques drive every joint by itself: a wheel of ``INERTIA`` with ``FRICTION``, and no weight.
    Without new ones for ``KEEP_UP`` seconds it stands still.

    Time is only the ``now`` of ``read``; the device's own clock starts with the first reading. Closing and opening
    again keeps the position, as a real arm's joints do. Faults: :class:`~hal.drivers.mock.knobs.RobotKnobs`.
    """

    modes: ClassVar[frozenset[str]] = frozenset({"position", "torque"})
    simulated: ClassVar[bool] = True
    repeats: ClassVar[bool] = True

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.knobs = RobotKnobs()
        self.log: deque[Setpoint] = deque(maxlen=LOG_LENGTH)
        """Every set-point written, oldest first, also those that a knob made the arm ignore."""
        self.is_open = False
        zeros = (0.0,) * len(spec.joints)
        self._follows = Setpoint(spec.initial, zeros, zeros)  # where the arm is
        self._commanded = self._follows  # what it took last
        self._pending: deque[tuple[float, Setpoint]] = deque()  # what it took and does not follow yet, with its time
        self._written = 0
        self._now = -math.inf
        self._t_driven = -math.inf
        """When the torques came that drive it."""
        self._t_first: float | None = None
        self._reading: Reading | None = None
        self._seq = 0

    def open(self) -> None:
        self._answer()
        self.is_open = True

    def read(self, now: float) -> Reading:
        self._expect_open()
        if self._t_first is None:
            self._t_first = now
        moved = self._follow(now, now - self._now)
        self._now = now
        if self.knobs.freeze and self._reading is not None:
            return self._reading
        self._seq += 1
        self._reading = self._report(now, now - self._t_first, moved)
        return self._reading

    def _follow(self, now: float, dt: float) -> bool:
        """Go to the newest set-point that is due; False when there was none, so that it stands still."""
        due = None
        while self._pending and self._pending[0][0] <= now:
            self._t_driven, due = self._pending.popleft()
        tau = self._follows.tau if due is None else due.tau
        if tau is not None:
            kept_up = now - self._t_driven <= KEEP_UP + dt
            if kept_up:
                self._follows = self._driven(tau, dt)
            else:
                self._hold()
            return kept_up
        if due is not None:
            self._follows = due
        return due is not None

    def _driven(self, tau: Sequence[float], dt: float) -> Setpoint:
        """Where torques bring it in ``dt`` seconds, and how fast it is then."""
        dq = [(INERTIA * v + dt * x) / (INERTIA + dt * FRICTION) for v, x in zip(self._follows.dq, tau, strict=True)]
        q = [x + dt * v for x, v in zip(self._follows.q, dq, strict=True)]
        return Setpoint(q, dq, (0.0,) * len(q), tau)

    def mass_matrix(self, q: Sequence[float]) -> list[list[float]]:
        """Joint-space inertia (n, n), kg m2."""
        return [[INERTIA * float(i == k) for k in range(len(q))] for i in range(len(q))]

    def _report(self, t: float, t_device: float, moved: bool) -> Reading:
        knobs, n = self.knobs, len(self.spec.joints)
        q = tuple(position + error for position, error in zip(self._follows.q, self._following_error(), strict=True))
        # An arm that got no new set-point is at rest at the last one.
        dq = tuple(self._follows.dq) if moved else (0.0,) * n
        if knobs.garbage == "short":
            q, dq = q[:-1], dq[:-1]
        elif knobs.garbage is not None:
            q = (float(knobs.garbage), *q[1:])
        fault = None if knobs.fault is None else Fault("mock", knobs.fault, "call recover() on the arm")
        return Reading(
            t,
            t_device,
            self._seq,
            q,
            dq,
            q_commanded=self._commanded.q,
            dq_commanded=self._commanded.dq,
            tau_ext=knobs.tau_ext,
            wrench_ext=knobs.wrench_ext,
            fault=fault,
            tau_commanded=self._commanded.tau,
        )

    def write(self, setpoint: Setpoint) -> None:
        self._expect_open()
        self.log.append(setpoint)
        self._written += 1
        dropped = self.knobs.drop and self._written % self.knobs.drop == 0
        if dropped or self.knobs.fault is not None:
            return
        self._commanded = setpoint
        self._pending.append((self._now + self.knobs.delay_s, setpoint))

    def halt(self) -> None:
        self._expect_open()
        self._hold()

    def _hold(self) -> None:
        """Stay here, whatever was still to be followed."""
        zeros = (0.0,) * len(self.spec.joints)
        self._pending.clear()
        self._follows = self._commanded = Setpoint(self._follows.q, zeros, zeros)

    def recover(self) -> None:
        self._expect_open()
        self.inject(fault=None)

    def inject(self, **knobs: object) -> None:
        """Turn knobs (:class:`~hal.drivers.mock.knobs.RobotKnobs`); those not named stay as they are.

        Raises CommandError for a knob that does not exist, or a value that it cannot have.
        """
        sizes = {"following_error": len(self.spec.joints), "tau_ext": len(self.spec.joints), "wrench_ext": 6}
        for name, value in knobs.items():
            if name in sizes and isinstance(value, Iterable):
                knobs[name] = numbers = tuple(float(number) for number in value)
                if len(numbers) != sizes[name]:
                    raise CommandError(f"{name} must have {sizes[name]} numbers, not {len(numbers)}")
        new = turned(self.knobs, knobs)
        if "drop" in knobs:
            self._written = 0
        if (new.fault is not None and self.knobs.fault is None) or (new.disconnect and not self.knobs.disconnect):
            self._hold()
        self.knobs = new

    def clear(self) -> None:
        """Turn every knob back to harmless."""
        self.knobs = RobotKnobs()

    def close(self) -> None:
        if self.is_open:
            self._hold()
        self.is_open = False

    def _following_error(self) -> Sequence[float]:
        error = self.knobs.following_error
        return error if isinstance(error, Sequence) else (error,) * len(self.spec.joints)

    def _answer(self) -> None:
        if self.knobs.disconnect:
            raise ConnectionLost(f"arm {self.spec.name!r} does not answer (the mock's knob 'disconnect')")

    def _expect_open(self) -> None:
        self._answer()
        if not self.is_open:
            raise ConnectionLost(f"arm {self.spec.name!r} is not open")
