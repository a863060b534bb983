"""Driver of an arm made of Damiao motors on a CAN bus: OpenArm, I2RT YAM, and home-built chains.

* ``engage`` switches the motors on one after the other; each holds its measured position from its first frame on.
* ``write`` sends position, velocity, gains and the torque that the motion needs (gravity, inertia); in torque mode
  torque only. Nothing waits: the replies are taken by the next ``read``.
* ``read`` keeps the arm: a motor that is on gets the last set-point again in a cycle without a new one, and a motor
  that is off is asked for its state.
* A fault of one motor stops the arm; the others hold. A motor that is about to be too hot still follows, so that the
  servo brakes the arm. The arm has no brakes: where nothing is sent any more, it sinks,
  damped by its motors.
"""

from __future__ import annotations

import time
from collections.abc import Sequence
from math import inf, isfinite
from typing import Any, ClassVar

from hal.driver import Reading, RobotDriver, Setpoint
from hal.dynamics import Dynamics
from hal.errors import ConnectionLost, Fault, RobotFault
from hal.following import Following
from hal.histogram import Histogram
from hal.specs import RobotSpec

from .damiao_chain import SWITCHING, DamiaoChain
from .damiao_motor import MILD_FAULTS, ChainMotor, find_turned, motor_fault
from .settings import DamiaoArmSettings

_STICKING = 0.02
"""Speed below which the friction that a command adds falls to zero, rad/s: it would make a joint at rest tremble."""
_PUSHING = 0.5
"""An arm is blocked if a joint's distance from its set-point lets the motor push with this share of its torque."""
_YIELDING = 0.4
"""Speed at which a joint that a fault stopped gives way to where it is, rad/s."""
_BRAKE = 0.3
"""Share of a motor's damping in torque mode: it bounds the speed where the torques are no longer renewed."""
_ATTEMPTS = 3
"""How often a motor is switched on until it counts as broken."""


class DamiaoArm(RobotDriver):
    """A chain of Damiao motors, as its settings describe it (:class:`~.settings.DamiaoArmSettings`)."""

    modes: ClassVar[frozenset[str]] = frozenset({"position", "torque"})

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = settings = DamiaoArmSettings.of(spec)
        self.dynamics = Dynamics.of(spec)
        self.chain = DamiaoChain(
            spec.name,
            f"robots.{spec.name}.real.motors",
            settings,
            settings.motors,
            spec.joints,
            settings.mosfet_limit,
            spec.source,
        )
        self._motors = self.chain.motors
        self.engaged = False
        self._fault: Fault | None = None
        """Fault of a motor; kept until recover()."""
        torques = spec.limits.torque or [motor.limits.torque for motor in settings.motors]
        limits = [
            min(settings.following_limit, _PUSHING * torque / motor.kp) if motor.kp > 0.0 else inf
            for motor, torque in zip(settings.motors, torques, strict=True)
        ]
        self._following = Following([motor.label for motor in self._motors], limits)
        friction = [motor.friction for motor in settings.motors]
        self._friction = friction if any(friction) else None
        zeros = (0.0,) * len(self._motors)
        self._zeros: Sequence[float] = zeros
        self._target: list[float] = list(zeros)
        """Position of the last set-point of each joint, rad; of no meaning for a motor that is off."""
        self._dq_sent: Sequence[float] = zeros
        self._tau_sent: Sequence[float] | None = None
        """Torques of the last set-point; None in position mode."""
        self._goal: list[float] | None = None
        """Position that was measured since a fault or a loss, to which the target goes slowly, rad; None otherwise."""
        self._holds: list[bytes] | None = None
        """Commands that hold the target at rest; None until they are computed for it."""
        self._written = False
        """Whether a set-point was sent since the last reading."""
        self._switching: ChainMotor | None = None
        """The motor that is being switched on."""
        self._attempts = 0
        self._limp: list[ChainMotor] = []
        """Motors that did not switch on."""
        self._t_switched = 0.0
        self._now = 0.0
        self._seq = 0
        self._reading: Reading | None = None
        self._reading_took = 0.0
        """Time that the last reading took, s."""
        self.reset_statistics()

    # Connection.

    def open(self) -> None:
        """Connect, and compare the motors' registers and positions with the rig. Nothing moves or is switched on.

        Raises:
            RobotFault: A motor is full turns away from its joint's range; names it.
        """
        self.close()
        self._fault = None
        self._reading = None
        self._written = False
        self._limp.clear()
        self.chain.open()
        turned = find_turned(self._motors, self.spec.limits)
        if turned is not None:
            self.chain.close()
            raise RobotFault(turned.cause, turned.remedy, code=turned.code)

    def close(self) -> None:
        """Let an arm that is engaged sink slowly until it rests; switch it off and disconnect.

        An arm that does not rest within 6 s is left to the damping of its motors (see ``DamiaoChain.lower``).
        """
        self.engaged = False
        self._switching = None
        self.chain.lower(self._weight)
        self.chain.close()

    def lower(self) -> bool:
        self.engaged = False
        self._switching = None
        return self.chain.lower_further(self._weight)

    # Every cycle.

    def read(self, now: float) -> Reading:
        began = time.perf_counter()
        chain = self.chain
        self._now = now
        chain.update(now)
        self._note_state()
        if not self._written:
            self._send_idle()
        self._written = False
        if chain.lost is not None:
            raise chain.lost
        chain.usable  # noqa: B018  # raises if it is not open
        reading = self._report()
        self._reading_took = time.perf_counter() - began
        return reading

    def _report(self) -> Reading:
        motors = self._motors
        t = min([motor.t for motor in motors])
        if t < 0.0:
            t = self._now if self._reading is None else self._reading.t  # the state from the opening
        last = self._reading
        if last is None or t > last.t:
            self._seq += 1
        engaged = self.engaged
        self._reading = reading = Reading(
            t,
            t,
            self._seq,
            [motor.q for motor in motors],
            [motor.dq for motor in motors],
            [motor.tau for motor in motors],
            self._target.copy() if engaged else None,
            self._dq_sent if engaged else None,
            fault=self._fault,
            tau_commanded=self._tau_sent if engaged else None,
        )
        return reading

    def _note_state(self) -> None:
        """Follow what the motors report: which are on, and their faults."""
        chain = self.chain
        in_use = self.engaged or self._switching is not None
        on = True
        for motor in self._motors:
            on = on and motor.on
        if chain.lost is None and not self._stopped:
            self._fault = self._find_fault(on) or self._fault
        if chain.lost is not None or self._stopped:
            self._yield()
        if in_use and (chain.lost is not None or (self.engaged and not on)):
            self.engaged = False
            self._switching = None

    @property
    def _stopped(self) -> bool:
        """Whether a fault stops the arm at once, so that no set-point is passed on."""
        return self._fault is not None and self._fault.code not in MILD_FAULTS

    def _yield(self) -> None:
        """Let the arm hold where it is measured, so that no joint pushes on; again where one is pushed far away."""
        q = [motor.q for motor in self._motors]
        goal = self._goal = self._goal or q
        for k, limit in enumerate(self._following.limits):
            if abs(goal[k] - q[k]) > limit:
                goal[k] = q[k]

    def _find_fault(self, on: bool) -> Fault | None:
        """Return the gravest fault; ``on`` is whether all motors are on."""
        fault = self.chain.fault(engaged=self.engaged)
        if fault is not None and fault.code not in MILD_FAULTS:
            return fault
        grave = self._check_following() if self.engaged else find_turned(self._motors, self.spec.limits)
        if grave is None and self.engaged and not on:
            off = next(motor for motor in self._motors if not motor.on)
            grave = Fault(
                "switched_off",
                f"{off.label} is off, though nothing here switched it off: this joint falls",
                "support the arm; check its power supply, and whether another program drives it; compare the "
                "joint with its picture, because a restart may shift a motor's zero",
            )
        return grave or fault

    def _check_following(self) -> Fault | None:
        """Return a fault if a joint is too far from its set-point."""
        if self._tau_sent is not None:
            return None
        return self._following.check(self._now, [motor.q for motor in self._motors], self._target, self._dq_sent)

    def _send_idle(self) -> None:
        """Send what keeps the arm as it is: the hold to motors that are on, a request for its state to each other."""
        chain = self.chain
        if chain.bus is None or chain.bus.fault is not None:
            return
        try:
            if self._tau_sent is not None:
                self._stop_torque()
            self._dq_sent = self._zeros
            holds = self._hold_commands() if any(motor.on for motor in self._motors) else ()
            for k, motor in enumerate(self._motors):
                if motor.on:
                    chain.send(motor, holds[k])
                else:
                    chain.ask_state(motor)
        except ConnectionLost as error:
            chain.lost = error

    def _hold_commands(self) -> list[bytes]:
        """Return the commands that hold the target at rest, with the torques that carry the arm's weight there."""
        goal = self._target if self._goal is None else self._goal
        if self._holds is not None and self.engaged and self._target == goal:
            return self._holds
        motors, step = self._motors, _YIELDING / self.spec.rate_hz
        self._target = [q + min(max(end - q, -step), step) for q, end in zip(self._target, goal, strict=True)]
        for k, motor in enumerate(motors):
            if not motor.on:
                self._target[k] = goal[k] = motor.q
        tau = self._weight(self._target)
        self._holds = [
            motor.command(self._target[k], 0.0, motor.kp, motor.kd, tau[k]) for k, motor in enumerate(motors)
        ]
        return self._holds

    def _stop_torque(self) -> None:
        self._tau_sent = None
        self._target = [motor.q for motor in self._motors]
        self._holds = None

    def write(self, setpoint: Setpoint) -> bool:
        began = time.perf_counter()
        chain, motors = self.chain, self._motors
        if chain.lost is not None or chain.bus is None:
            raise chain.lost or ConnectionLost(f"{self.spec.name} is not open", code="closed")
        if not self.engaged or self._stopped:
            return False
        q, dq = setpoint.q, setpoint.dq
        if setpoint.tau is None:
            tau = self.dynamics.inverse(q, dq, setpoint.ddq).tolist()
            if self._friction is not None:
                tau = [
                    t + f * min(max(v / _STICKING, -1.0), 1.0) for t, f, v in zip(tau, self._friction, dq, strict=True)
                ]
        else:
            weight = self._weight([motor.q for motor in motors])
            tau = [a + b for a, b in zip(setpoint.tau, weight, strict=True)]
        if not isfinite(sum(q) + sum(dq) + sum(tau)):
            raise ValueError(f"{self.spec.name}: a set-point is not finite: {setpoint}")
        if setpoint.tau is None:
            frames = [motor.command(q[k], dq[k], motor.kp, motor.kd, tau[k]) for k, motor in enumerate(motors)]
        else:  # damped around the present speed: nothing while it is streamed, a brake where the stream ends
            frames = [motor.command(q[k], motor.dq, 0.0, _BRAKE * motor.kd, tau[k]) for k, motor in enumerate(motors)]
        for motor, frame in zip(motors, frames, strict=True):  # all are encoded: none has NaN
            chain.send(motor, frame)
        self._written = True
        self._target, self._dq_sent, self._tau_sent = list(q), dq, setpoint.tau
        self._holds = self._goal = None
        self.cycle_times.add(time.perf_counter() - began + self._reading_took)
        return True

    def halt(self) -> None:
        """Hold the last set-point at rest; after torques, the measured position."""
        if not self.engaged or self.chain.lost is not None:
            return
        self._written = False
        self._send_idle()
        self._written = True

    # Switching on.

    def engage(self) -> None:
        chain = self.chain
        chain.usable  # noqa: B018  # raises while there is no connection
        if self._fault is not None:
            remedy = f"{self._fault.remedy}; then robot.recover()"
            raise RobotFault(self._fault.cause, remedy, code=self._fault.code)
        if chain.ask_registers():
            return  # of a motor that was switched off and on again
        fault = chain.register_fault()
        if fault is not None:
            raise RobotFault(fault.cause, fault.remedy, code=fault.code)
        motor = self._switching
        if motor is not None:
            if motor.on and motor.status == 1 and motor.t >= self._t_switched:
                motor = self._switching = None
            elif self._now - self._t_switched < SWITCHING:
                return
        if motor is None:
            motor = next((one for one in self._motors if not one.on and one not in self._limp), None)
            self._attempts = 0
        if motor is None:
            if self._limp:
                self._give_up()
            self.engaged = True
            self._dq_sent, self._tau_sent = self._zeros, None
            return
        self._attempts += 1
        if self._attempts > _ATTEMPTS:  # the others come first: they hold what can be held
            motor.on, self._switching = False, None
            self._limp.append(motor)
            return
        self._switch_on(motor)

    def _switch_on(self, motor: ChainMotor) -> None:
        motor.on = False  # so that it holds where it is measured
        hold = self._hold_commands()[self._motors.index(motor)]
        self._switching, self._t_switched = motor, self._now
        self.chain.switch_on(motor, hold, self._attempts == 1)

    def _give_up(self) -> None:
        """Raise RobotFault for a motor that does not switch on; those that are on continue to hold."""
        motor = self._limp[0]
        self._limp.clear()
        fault = motor_fault(motor, self.settings.mosfet_limit, engaged=True)
        why = "" if fault is None else f" ({fault.cause.removeprefix(f'{motor.label}: ')})"
        raise RobotFault(
            f"{self.spec.name}: {motor.label} does not switch on{why}; the others hold",
            "support the arm, since this joint is limp; check the motor's power supply; closing the rig lowers the arm",
            code="not_switched_on",
        )

    def recover(self) -> None:
        """Acknowledge a fault. No motor gets a command: the next session clears its error and switches it on at once.

        Raises:
            RobotFault: A motor is still too hot, or still gets another program's commands; names the motor.
            ConnectionLost: The arm does not answer.
        """
        self.chain.usable  # noqa: B018  # raises while there is no connection
        self.chain.acknowledge_errors()
        fault = self.chain.fault(engaged=False)
        if fault is not None:
            raise RobotFault(fault.cause, fault.remedy, code=fault.code)
        self._fault = None
        self._limp.clear()

    # Model and statistics.

    def _weight(self, q: Sequence[float]) -> list[float]:
        """Return the joint torques (n,), Nm, that hold the arm still at ``q`` (n,), rad."""
        weight: list[float] = self.dynamics.gravity(q).tolist()
        return weight

    def mass_matrix(self, q: Sequence[float]) -> Any:
        """Return the joint-space inertia (n, n), kg m2, at ``q`` (n,), rad, from the URDF's masses."""
        return self.dynamics.mass_matrix(q)

    def reset_statistics(self) -> None:
        self.chain.reset_statistics()
        self.cycle_times = Histogram(2e-6, 2500)
        """Time that ``read`` and ``write`` of one cycle took together, s."""

    def statistics(self) -> dict[str, Any]:
        return {"read_and_write_s": self.cycle_times.summary(), **self.chain.statistics()}
