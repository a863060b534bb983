"""An ideal arm and gripper in memory.

The arm is where the newest set-point is, and torques drive each of its joints like a wheel with friction. The gripper
moves at its speed, and may have an object between its fingers.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Iterable, Sequence
from typing import Any, ClassVar

from hal.driver import GripperDriver, GripperReading, Reading, RobotDriver, Setpoint
from hal.errors import CommandError, Fault
from hal.specs import GripperSpec, RobotSpec
from hal.types import GripperOutcome

from .faults import MockDevice, MockGripperFaults, MockRobotFaults

LOG_LENGTH = 100_000
"""Number of set-points that ``MockRobot.log`` keeps: 100 s of the fastest arm."""
INERTIA = 1.0
"""Inertia of every joint that is driven by torques, kg m2."""
FRICTION = 1.0
"""Friction of the same, Nm per rad/s."""
KEEP_UP = 0.020
"""How long the last torques act without new ones, s: as on a Franka."""


class MockRobot(MockDevice[MockRobotFaults], RobotDriver):
    """An arm in memory. A set-point written after ``read(t)`` is where the arm is at the next ``read``.

    Set-points with torques drive each joint separately: a wheel of ``INERTIA`` with ``FRICTION``, without gravity.
    Without new ones for ``KEEP_UP`` seconds the arm stands still.

    Time is only the ``now`` of ``read``; the device's own clock starts with the first reading. Closing and opening
    again keeps the position, as a real arm's joints do. Faults: :class:`~hal.drivers.mock.faults.MockRobotFaults`.
    """

    kind: ClassVar[str] = "arm"
    modes: ClassVar[frozenset[str]] = frozenset({"position", "torque"})
    simulated: ClassVar[bool] = True

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.faults = MockRobotFaults()
        self.log: deque[Setpoint] = deque(maxlen=LOG_LENGTH)
        """Every set-point written, oldest first, also those that the arm ignored because of a fault."""
        zeros = (0.0,) * len(spec.joints)
        self._follows = Setpoint(spec.initial, zeros, zeros)  # present position
        self._commanded = self._follows  # newest accepted set-point
        self._pending: deque[tuple[float, Setpoint]] = deque()  # accepted, with the time from which on each is followed
        self._written = 0
        self._now = -math.inf
        self._t_driven = -math.inf
        """Time of the torques that drive the arm, s."""
        self._t_first: float | None = None
        self._reading: Reading | None = None
        self._seq = 0

    def open(self) -> None:
        self._expect_connected()
        self.is_open = True

    def read(self, now: float) -> Reading:
        self._expect_open()
        if self._t_first is None:
            self._t_first = now
        moved = self._follow(now, now - self._now)
        self._now = now
        if self.faults.freeze and self._reading is not None:
            return self._reading
        self._seq += 1
        self._reading = self._report(now, now - self._t_first, moved)
        return self._reading

    def _follow(self, now: float, dt: float) -> bool:
        """Move to the newest set-point that is due; False when there was none, so that the arm stands still."""
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
        dq = [(INERTIA * v + dt * x) / (INERTIA + dt * FRICTION) for v, x in zip(self._follows.dq, tau, strict=True)]
        q = [x + dt * v for x, v in zip(self._follows.q, dq, strict=True)]
        return Setpoint(q, dq, (0.0,) * len(q), tau)

    def mass_matrix(self, q: Sequence[float]) -> list[list[float]]:
        """Return the joint-space inertia (n, n), kg m2. See :meth:`RobotDriver.mass_matrix`."""
        return [[INERTIA * float(i == k) for k in range(len(q))] for i in range(len(q))]

    def _report(self, t: float, t_device: float, moved: bool) -> Reading:
        faults, n = self.faults, len(self.spec.joints)
        q = tuple(position + error for position, error in zip(self._follows.q, self._following_error(), strict=True))
        # Without a new set-point the arm is at rest at the last one.
        dq = tuple(self._follows.dq) if moved else (0.0,) * n
        if faults.garbage == "short":
            q, dq = q[:-1], dq[:-1]
        fault = None if faults.fault is None else Fault("mock", faults.fault, "nothing to repair: a simulated fault")
        reading = Reading(
            t,
            t_device,
            self._seq,
            q,
            dq,
            q_commanded=self._commanded.q,
            dq_commanded=self._commanded.dq,
            tau_ext=faults.tau_ext,
            wrench_ext=faults.wrench_ext,
            fault=fault,
            tau_commanded=self._commanded.tau,
        )
        if faults.garbage in (None, "short"):
            return reading
        size = 6 if faults.garbage_in == "wrench_ext" else n
        spoilt: dict[str, Any] = {faults.garbage_in: (float(faults.garbage), *(0.0,) * (size - 1))}
        return reading._replace(**spoilt)

    def write(self, setpoint: Setpoint) -> None:
        self._expect_open()
        self.log.append(setpoint)
        self._written += 1
        dropped = self.faults.drop and self._written % self.faults.drop == 0
        if dropped or self.faults.fault is not None:
            return
        self._commanded = setpoint
        self._pending.append((self._now + self.faults.delay_s, setpoint))

    def halt(self) -> None:
        self._expect_open()
        self._hold()

    def _hold(self) -> None:
        """Stop here, and drop the set-points that are not followed yet."""
        zeros = (0.0,) * len(self.spec.joints)
        self._pending.clear()
        self._follows = self._commanded = Setpoint(self._follows.q, zeros, zeros)

    def recover(self) -> None:
        self._expect_open()
        self.inject(fault=None)

    def inject(self, **faults: object) -> None:
        """Set faults: see :meth:`MockDevice.inject`. The arm stops at a fault, and where it is unplugged."""
        sizes = {"following_error": len(self.spec.joints), "tau_ext": len(self.spec.joints), "wrench_ext": 6}
        for name, value in faults.items():
            if name in sizes and isinstance(value, Iterable):
                faults[name] = numbers = tuple(float(number) for number in value)
                if len(numbers) != sizes[name]:
                    raise CommandError(
                        f"{name} must have {sizes[name]} numbers, not {len(numbers)}", code="bad_fault_value"
                    )
        before = self.faults
        super().inject(**faults)
        if "drop" in faults:
            self._written = 0
        new = self.faults
        if (new.fault is not None and before.fault is None) or (new.disconnect and not before.disconnect):
            self._hold()

    def close(self) -> None:
        if self.is_open:
            self._hold()
        self.is_open = False

    def _following_error(self) -> Sequence[float]:
        error = self.faults.following_error
        return error if isinstance(error, Sequence) else (error,) * len(self.spec.joints)


class MockGripper(MockDevice[MockGripperFaults], GripperDriver):
    """A gripper in memory, open at the start. Time is only the ``now`` of ``read``.

    Widths and speeds are clamped to the gripper's range, as by a gripper's own controller. Faults, and an object to
    hold: :class:`~hal.drivers.mock.faults.MockGripperFaults`.
    """

    kind: ClassVar[str] = "gripper"
    simulated: ClassVar[bool] = True

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.faults = MockGripperFaults()
        self.log: list[tuple[float, float, float]] = []
        """Every ``move`` and ``grasp``: width in m, speed in m/s, force in N."""
        self.homed = 0
        """Number of calls of ``home``."""
        self._width = self._target = spec.width_max
        self._speed = 0.0
        self._force = 0.0
        self._stopped = True
        self._fault: Fault | None = None
        self._t: float | None = None
        self._t_first: float | None = None
        self._reading: GripperReading | None = None
        self._seq = 0

    def open(self) -> None:
        self._expect_connected()
        self.is_open = True

    def read(self, now: float) -> GripperReading:
        self._expect_open()
        if self._t is None or self._t_first is None:
            self._t = self._t_first = now
        self._advance(now - self._t)
        self._t = now
        if self.faults.freeze and self._reading is not None:
            return self._reading
        self._seq += 1
        grasped = self._pressing()
        self._reading = GripperReading(
            t=now,
            t_device=now - self._t_first,
            seq=self._seq,
            width=self._width if self.faults.garbage is None else float(self.faults.garbage),
            width_target=self._target,
            moving=not self._stopped and self._width != self._goal() and not self.faults.stuck,
            grasped=grasped,
            force=self._force if grasped else 0.0,
            outcome=None if self._fault is None else GripperOutcome.FAILED,
            fault=self._fault,
        )
        return self._reading

    def _goal(self) -> float:
        """Return the width at which the motion ends: the commanded one, or that of an object in between."""
        block = self.faults.object_width
        return max(self._target, block) if block is not None and self._width >= block else self._target

    def _pressing(self) -> bool:
        return self.faults.object_width is not None and self._target < self.faults.object_width == self._width

    def _advance(self, dt: float) -> None:
        if self._stopped or self.faults.stuck:
            return
        rest = self._goal() - self._width
        step = self._speed * dt
        self._width = self._goal() if abs(rest) <= step else self._width + (step if rest > 0 else -step)

    def move(self, width: float, speed: float, force: float) -> None:
        self._expect_open()
        self.log.append((width, speed, force))
        self._start(min(max(width, self.spec.width_min), self.spec.width_max), speed, force)

    def grasp(self, width: float, speed: float, force: float, inner: float, outer: float) -> None:
        """Close until an object, or the other finger, stops the fingers."""
        self._expect_open()
        self.log.append((width, speed, force))
        self._start(0.0, speed, force)

    def home(self) -> None:
        self._expect_open()
        self.homed += 1
        self._start(self.spec.width_max, self.spec.speed, self.spec.force)

    def _start(self, target: float, speed: float, force: float) -> None:
        failure = self.faults.fail
        self._fault = None if failure is None else Fault("mock", failure, "set the fault 'fail' back to None")
        if failure is not None:
            self._stopped = True
            return
        self._target = target
        self._speed = min(speed, self.spec.speed)
        self._force = force
        self._stopped = False

    def stop(self) -> None:
        self._expect_open()
        self._stopped = True

    def close(self) -> None:
        self._stopped = True
        self.is_open = False
