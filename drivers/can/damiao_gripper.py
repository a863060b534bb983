"""Driver of a gripper with one Damiao motor: fingers that the motor opens and closes through a linkage.

A table gives the distance between the fingers at each angle of the motor; its slope turns forces into torques. The
motor follows a ramp at the commanded speed. It presses with no more than the commanded force, also in the moment of
contact: its target never is farther ahead of the fingers than the force divided by the stiffness, and it has no target
of the speed, since the damping would press with that. So with a small force the fingers are soft in motion, and slower
than commanded where friction takes much of it. How hard their inertia hits an object depends on the speed alone.

``home`` finds the closed position: the fingers close slowly, with little force, until something stops them. From then
on the table begins there, wherever the motor's zero is; the ``offset`` in the rig makes it last.

The motor is switched on by the first command. When the program ends, it holds for its TIMEOUT (0.4 s), and then damps:
a held object that pushes the fingers open comes loose.
"""

from __future__ import annotations

import math
from bisect import bisect_right
from typing import Any

from hal.driver import GripperDriver, GripperReading
from hal.errors import Fault, RobotFault
from hal.specs import GripperSpec
from hal.types import GripperOutcome

from .damiao_chain import SWITCHING, DamiaoChain
from .damiao_motor import MILD_FAULTS
from .damiao_protocol import KP_MAX
from .settings import DamiaoGripperSettings

_STILL = 0.003
"""Largest speed of the width at rest, m/s."""
_REST = 0.06
"""Time at rest after which a motion has ended, s."""
_PRESSING = 0.5
"""Share of the commanded force from which fingers at rest hold an object."""
_LEAD = 0.05
"""Time by which the motor's target is ahead of fingers that press, at the commanded speed, s. It is long against the
age of a state, two cycles, and short, because fingers whose program was killed move for so long."""
_PLAY = 3e-4
"""Way of the fingers that counts as a motion, m."""
_STIFFNESS_STEP = KP_MAX / 4095.0
"""Resolution of the stiffness in a command, Nm/rad."""
_LONGEST_STEP = 0.05
"""Longest time that the ramp advances in one cycle, s."""
_FRESH = 0.02
"""Greatest age of the state at which the motor is switched on, s: it may have been turned by hand since."""
_ATTEMPTS = 3
"""How often the motor is switched on until it counts as broken."""
_HOMING_SPEED, _HOMING_FORCE = 0.02, 10.0
"""Greatest speed of the width, m/s, and greatest force, N, with which the closed position is looked for."""
_HOMING_PRESSED, _HOMING_SHARE = 0.3, 0.8
"""Time, s, for which the fingers press with that share of the force, at rest, where they are closed."""
_HOMING_WAY = 1.1
"""Greatest way on which they must meet something, as a multiple of the table's."""


class FingerTable:
    """Width between the fingers as a function of the motor's angle, linear between the rows of a table.

    Args:
        rows: Angle, rad, and width, m, in rising order of the angle; the width rises or falls all along.
    """

    def __init__(self, rows: tuple[tuple[float, float], ...]) -> None:
        self._angles = [angle for angle, _ in rows]
        self._widths = [width for _, width in rows]
        self._slopes = [
            (self._widths[k + 1] - self._widths[k]) / (self._angles[k + 1] - self._angles[k])
            for k in range(len(rows) - 1)
        ]
        self.opening = 1.0 if self._slopes[0] > 0.0 else -1.0
        """Direction of the angle that opens the fingers."""

    @property
    def closed(self) -> float:
        """Angle of the narrowest width, rad."""
        return self._angles[0 if self.opening > 0.0 else -1]

    @property
    def range(self) -> float:
        """Angle from one end to the other, rad."""
        return self._angles[-1] - self._angles[0]

    def _part(self, angle: float) -> int:
        return min(max(bisect_right(self._angles, angle) - 1, 0), len(self._slopes) - 1)

    def width(self, angle: float) -> float:
        """Return the width, m, at an angle, rad; beyond the table it continues in a straight line."""
        k = self._part(angle)
        return self._widths[k] + (angle - self._angles[k]) * self._slopes[k]

    def slope(self, angle: float) -> float:
        """Return the change of the width for each rad at an angle, m/rad, without its sign."""
        return abs(self._slopes[self._part(angle)])

    def angle(self, width: float) -> float:
        """Return the angle, rad, at a width, m, that is clamped to the table's."""
        ends = self._widths[0], self._widths[-1]
        width = min(max(width, min(ends)), max(ends))
        for k, slope in enumerate(self._slopes):
            if min(self._widths[k : k + 2]) <= width <= max(self._widths[k : k + 2]):
                return self._angles[k] + (width - self._widths[k]) / slope
        raise AssertionError("a table without gaps has every width between its ends")


class DamiaoGripper(GripperDriver):
    """A gripper with one Damiao motor, as its settings describe it (:class:`~.settings.DamiaoGripperSettings`)."""

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = settings = DamiaoGripperSettings.of(spec)
        self.table = FingerTable(settings.widths)
        self.chain = DamiaoChain(
            spec.name, f"{spec.name}.real.motor", settings, [settings.motor], ["fingers"], settings.mosfet_limit
        )
        self._motor = self.chain.motors[0]
        self._start_over()

    def _start_over(self) -> None:
        self._active = False
        """Whether there was a command, so that the motor has to be on."""
        self._fault: Fault | None = None
        self._attempts = 0
        self._target: float | None = None
        """Width of the newest command, m; None before the first."""
        self._goal = self._ramp = 0.0
        """Angle at the end of the ramp and at present, rad."""
        self._speed = 0.0
        """Speed of the width, m/s."""
        self._force = 0.0
        """Greatest force, N."""
        self._resting = 0.0
        """Time for which the fingers have been at rest, s."""
        self._closed = False
        """Whether the last motion of the fingers closed them."""
        self._turn = 0.0
        """The narrowest width since then, or else the widest, m."""
        self._held = False
        """Whether they held an object at the last reading."""
        self._homing = False
        """Whether the closed position is being looked for."""
        self._pressed = self._pressed_at = 0.0
        """Time for which the fingers have pressed, s, and the angle there, rad; a stop in between does not end it."""
        self._offset: float | None = None
        """The motor's offset for which the closed position that was found is the table's, rad."""
        self._now: float | None = None
        self._seq = 0
        self._t = -1.0

    def open(self) -> None:
        """Connect, and compare the motor's registers with the rig. Nothing moves or is switched on."""
        self.close()
        self._start_over()
        self.chain.open()

    def close(self) -> None:
        """Disconnect. The motor holds for its TIMEOUT, and damps afterwards. Idempotent."""
        self._active = False
        self.chain.close()

    # Every cycle.

    def read(self, now: float) -> GripperReading:
        chain, motor = self.chain, self._motor
        dt = min(max(now - self._now, 0.0), _LONGEST_STEP) if self._now is not None else 0.0
        self._now = now
        was_on = motor.on and motor.status == 1
        chain.update(now)
        if chain.lost is not None:
            self._active = False
        elif self._fault is None:
            self._note_fault(was_on, now)
        if chain.bus is not None and chain.bus.fault is None:
            self._drive(now, dt)
        if chain.lost is not None:
            raise chain.lost
        chain.usable  # noqa: B018  # raises if it is not open
        return self._report(now)

    def _note_fault(self, was_on: bool, now: float) -> None:
        """Note a fault of the motor, which ends the motion; only a new command moves the fingers again."""
        motor = self._motor
        if self._active and (not was_on or now - motor.switched_at <= SWITCHING):
            return  # it is about to be switched on, which clears its errors
        fault = self.chain.fault(engaged=was_on)
        if fault is None and was_on and not motor.on:
            cause = f"{motor.label} went off: what it held may be loose"
            fault = Fault("switched_off", cause, "check its power supply, and send the command again")
        if fault is not None:
            self._fault, self._active, self._homing, self._goal = fault, False, False, self._ramp

    def _drive(self, now: float, dt: float) -> None:
        """Send the motor's command of this cycle, or a request for its state."""
        chain, motor = self.chain, self._motor
        fresh = motor.t >= 0.0 and now - motor.t <= _FRESH
        if self._active and not motor.on and fresh and not chain.ask_registers():
            self._switch_on()
        elif not motor.on:
            chain.ask_state(motor)
        elif motor.status != 1:  # it is being switched on
            chain.send(motor, motor.command(self._ramp, 0.0, motor.kp, motor.kd, 0.0))
        else:
            self._attempts = 0
            stiffness, damping = self._advance(dt)
            chain.send(motor, motor.command(self._ramp, 0.0, stiffness, damping, 0.0))
            self._note_motion(dt)

    def _advance(self, dt: float) -> tuple[float, float]:
        """Advance the ramp, and return the motor's stiffness, Nm/rad, and damping, Nm s/rad.

        In motion, and while the fingers press, both are so small that the greatest torque needs a lead of
        :data:`_LEAD`. Near the goal they grow to the rig's.
        """
        motor, table = self._motor, self.table
        speed = self._speed / table.slope(self._ramp)
        step, way = speed * dt, self._goal - self._ramp
        ramp = self._goal if abs(way) <= step else self._ramp + (step if way > 0.0 else -step)
        torque = self._greatest_torque()
        lead = max(min(abs(self._goal - motor.q), speed * _LEAD), 1e-6)
        steps = math.ceil(torque / lead / _STIFFNESS_STEP)
        stiffness = max(min(steps * _STIFFNESS_STEP, motor.kp), _STIFFNESS_STEP)
        ahead = torque / stiffness
        self._ramp = min(max(ramp, motor.q - ahead), motor.q + ahead)
        damping = min(motor.kd, 0.5 * torque * _LEAD / lead)
        return stiffness + 0.1 * _STIFFNESS_STEP, damping  # the encoding truncates

    def _greatest_torque(self) -> float:
        """Return the torque that presses with the commanded force, Nm."""
        motor = self._motor
        torque = self._force * self.table.slope(motor.q) + motor.settings.friction
        return min(torque, motor.settings.limits.torque)

    def _note_motion(self, dt: float) -> None:
        """Note for how long the fingers have been at rest, and whether they came by closing."""
        width, slope = self.table.width(self._motor.q), self.table.slope(self._motor.q)
        self._resting = self._resting + dt if abs(self._motor.dq) * slope < _STILL else 0.0
        opened = width - self._turn
        if (opened > _PLAY) if self._closed else (opened < -_PLAY):
            self._closed, self._turn = not self._closed, width
        else:
            self._turn = min(self._turn, width) if self._closed else max(self._turn, width)
        if self._homing:
            self._note_contact(dt)

    def _note_contact(self, dt: float) -> None:
        """Find the closed position: something stops the fingers, or the end of the table does not."""
        motor, table = self._motor, self.table
        if abs(motor.q - self._pressed_at) * table.slope(motor.q) > _PLAY:
            self._pressed, self._pressed_at = 0.0, motor.q
        elif self._grip_force() >= _HOMING_SHARE * self._force:
            self._pressed += dt
        if self._pressed >= _HOMING_PRESSED:
            settings = self.settings
            shift = motor.q - FingerTable(settings.widths).closed
            self.table = FingerTable(tuple((angle + shift, width) for angle, width in settings.widths))
            self._offset = settings.motor.offset - shift
            self._homing, self._pressed = False, 0.0
            self._goal = self._ramp = motor.q  # press no longer
            self._target = self.table.width(motor.q)
        elif self._ramp == self._goal:
            self._homing = False
            cause = f"{motor.label}: the fingers closed by {_HOMING_WAY:g} times their way, and nothing stopped them"
            remedy = "check that the motor moves the fingers, and the `widths` in the rig"
            self._fault = Fault("not_closed", cause, remedy)

    def _grip_force(self) -> float:
        """Return the force with which the motor closes the fingers, less the friction in the rig, N."""
        motor, table = self._motor, self.table
        return max(0.0, -table.opening * motor.tau - motor.settings.friction) / table.slope(motor.q)

    def _switch_on(self) -> None:
        motor = self._motor
        fault = self.chain.register_fault()
        if fault is not None:
            self._fault, self._active = fault, False
            return
        self._attempts += 1
        if self._attempts > _ATTEMPTS:
            self._active = False
            cause = f"{motor.label} does not switch on (status {motor.status:x})"
            self._fault = Fault("not_switched_on", cause, "check its power supply, and send the command again")
            return
        self._ramp = motor.q
        self._closed, self._turn = False, self.table.width(motor.q)
        hold = motor.command(self._ramp, 0.0, motor.kp, motor.kd, 0.0)
        self.chain.switch_on(motor, hold, self._attempts == 1)

    def _report(self, now: float) -> GripperReading:
        motor, table = self._motor, self.table
        t = motor.t if motor.t >= 0.0 else now
        if t > self._t:
            self._seq += 1
        self._t = t
        width = table.width(motor.q)
        if self._target is None:
            self._target = width
        force = self._grip_force() if motor.on else 0.0
        resting = self._resting >= _REST
        grasped = self._grasps(width, force) if resting else False
        self._held = grasped is True
        return GripperReading(
            t=t,
            t_device=t,
            seq=self._seq,
            width=width,
            width_target=self._target,
            moving=self._active and (self._homing or not resting),
            grasped=grasped if motor.on else None,
            force=force,
            outcome=None if self._fault is None else GripperOutcome.FAILED,
            fault=self._fault,
        )

    def _grasps(self, width: float, force: float) -> bool | None:
        """Return whether fingers at rest hold an object; None if they press, but did not close before.

        Such fingers may be held by an object, or by their own friction: the force cannot tell.
        """
        assert self._target is not None
        short = width > max(self.settings.tolerance, self._target + _PLAY)
        if not short or not force >= _PRESSING * self._force > 0.0:
            return False
        return True if self._closed else None

    # Commands.

    def move(self, width: float, speed: float, force: float) -> None:
        self._homing = False
        self._start(self.table.angle(width), min(speed, self.spec.speed), force)
        self._target = width

    def home(self) -> None:
        table, speed, force = self.table, min(_HOMING_SPEED, self.spec.speed), min(_HOMING_FORCE, self.spec.force)
        self._start(self._motor.q - table.opening * _HOMING_WAY * table.range, speed, force)
        self._homing = True

    def _start(self, goal: float, speed: float, force: float) -> None:
        """Start a motion to an angle, rad, at a speed of the width, m/s."""
        chain, motor = self.chain, self._motor
        chain.usable  # noqa: B018  # raises if it is not open, or lost
        fault = chain.fault(engaged=False)
        if fault is not None and fault.code in MILD_FAULTS:
            raise RobotFault(fault.cause, fault.remedy, code=fault.code)
        self._fault = None  # an error of the motor is cleared when it is switched on
        self._attempts = 0
        if self._resting >= _REST and not self._held:
            self._closed, self._turn = False, self.table.width(motor.q)
        self._goal, self._speed, self._force = goal, speed, force
        self._resting = 0.0
        if not motor.on:
            self._ramp = motor.q
        self._active = True

    def stop(self) -> None:
        """Keep the fingers where they are; those that press on an object keep their force."""
        self.chain.usable  # noqa: B018  # raises if it is not open, or lost
        self._homing = False
        motor = self._motor
        at = motor.q + (motor.dq * (self._now - motor.t) if self._now is not None and motor.t >= 0.0 else 0.0)
        ahead = self._greatest_torque() / motor.kp
        self._goal = min(max(self._ramp, at - ahead), at + ahead)

    def statistics(self) -> dict[str, Any]:
        """Return figures about the connection, as those of the arm, and the ``offset`` that :meth:`home` found, rad."""
        return {**self.chain.statistics(), "offset": self._offset}
