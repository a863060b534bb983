"""Driver of a gripper with one servo on the bus of its arm."""

from __future__ import annotations

from bisect import bisect_right
from math import inf

import numpy as np

from hal.driver import GripperDriver, GripperReading
from hal.errors import Fault
from hal.specs import GripperSpec
from hal.types import GripperOutcome

from .chain import Chain, Joint
from .protocol import COUNT, MotorState
from .settings import PROTOCOLS, ServoGripperSettings

_AT_REST = 0.15
"""Time without motion after which the jaw is at rest, s."""
_STILL = 4e-4
"""Largest change of the width of a jaw at rest, m."""
_TOLERANCE = 0.003
"""Largest distance from the target width at which the jaw counts as arrived, m."""
_LEAST_TORQUE = 0.1
"""Least torque limit, share of the stall torque, so that the jaw overcomes its own friction: chosen."""
_LOST = Fault("lost", "the connection was lost before the jaw was there", "give the command again")


class ServoGripper(GripperDriver):
    """A gripper on a servo bus (settings: :class:`~.settings.ServoGripperSettings`).

    The goal runs along at the speed of the command; the force of the command is the motor's torque limit. The motor
    holds its last goal for ever, with that limit. A command begins with a restart of a motor that reports an error,
    which a Dynamixel motor does until then. Nothing goes on by itself after a fault, or a loss of the connection.
    """

    def __init__(self, spec: GripperSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = ServoGripperSettings.of(spec)
        self.protocol = PROTOCOLS[spec.driver]()
        span = abs(spec.opened[0] - spec.closed[0]) if spec.opened and self.settings.widths is None else 0.0
        joint = Joint("the jaw", (self.settings.id,), span)
        self.chain = Chain(spec.name, self.protocol, self.settings, [joint], watch=False)
        self._forget()

    def _forget(self) -> None:
        self._now = -inf
        self._seq, self._t = 0, -inf
        self._state: MotorState | None = None
        self._target: float | None = None
        """Width of the newest command, m; None before the first one."""
        self._ramp: float | None = None
        """Width that the motor was sent last, m; None until it holds."""
        self._goal = self._speed = 0.0
        """Width at which the ramp ends, m, and its speed, m/s."""
        self._was_on = False
        """Whether the motor has had its torque since it was switched on."""
        self._t_restarted = -inf
        """When the motor was last told to restart, s."""
        self._limit = 0
        """Torque limit of the command."""
        self._fault: Fault | None = None
        """Why the newest command failed."""
        self._t_moved, self._still_at = -inf, 0.0

    def open(self) -> None:
        """Connect, and check the motor. Nothing moves, and nothing is written."""
        self.close()
        self._forget()
        self.chain.open()
        table = self.settings.widths
        if table is not None:
            self._ways, self._widths = [self.settings.zero + angle / COUNT for angle, _ in table], [w for _, w in table]
            return
        low, high = self.chain.registers[0].calibration[2:]
        self._ways = [low + share * (high - low) for share, _ in self.spec.travel]
        self._widths = [width for _, width in self.spec.travel]

    def close(self) -> None:
        """Disconnect. The motor holds its last goal. Idempotent."""
        self.chain.close()

    def _count(self, width: float) -> int:
        return round(float(np.interp(width, self._widths, self._ways)))

    def _width(self, count: float) -> float:
        return float(np.interp(count, self._ways, self._widths))

    def _lever(self, width: float) -> float:
        """Return the change of the width for each rad of the motor, m/rad."""
        k = min(max(bisect_right(self._widths, width), 1), len(self._widths) - 1)
        return (self._widths[k] - self._widths[k - 1]) / ((self._ways[k] - self._ways[k - 1]) * COUNT)

    def read(self, now: float) -> GripperReading:
        dt, self._now = max(0.0, min(now - self._now, _AT_REST)), now
        try:
            (state,) = self.chain.read(now)
        except BaseException:
            self._note_loss()
            raise
        self._state = state
        if state.t > self._t:
            self._t, self._seq = state.t, self._seq + 1
        width = self._width(state.position)
        if abs(width - self._still_at) > _STILL:
            self._still_at, self._t_moved = width, now
        if self._is_driven:
            self._follow(state, width, dt)
        moving = self._is_driven and (self._ramp != self._goal or now - self._t_moved < _AT_REST)
        torque = abs(state.load) / self.protocol.full * self.chain.registers[0].stall_torque if state.on else 0.0
        blocked = width - self._goal > _TOLERANCE
        return GripperReading(
            t=state.t,
            t_device=state.t,
            seq=self._seq,
            width=width,
            width_target=width if self._target is None else self._target,
            moving=moving,
            grasped=self._target is not None and self._ramp is not None and not moving and blocked,
            force=torque / self._lever(width),
            outcome=None if self._fault is None else GripperOutcome.FAILED,
            fault=self._fault,
        )

    @property
    def _is_driven(self) -> bool:
        return self._target is not None and self._fault is None

    def _find_fault(self, state: MotorState) -> Fault | None:
        fault = self.chain.fault([state])
        if fault is None and self._was_on and not state.on:
            cause = f"{self.chain.labels[0]} went off: what it held may be loose"
            fault = Fault("switched_off", cause, "check its power supply; give the command again")
        self._was_on |= state.on
        return fault

    def _follow(self, state: MotorState, width: float, dt: float) -> None:
        """Drive the jaw, unless the state is from before its motor's restart, or shows a fault."""
        if state.t <= self._t_restarted:
            return
        fault = self._find_fault(state)
        if fault is not None and self._ramp is not None:
            self._fail(fault)
        else:
            self._drive(state, width, dt)

    def _note_loss(self) -> None:
        restarts = self._now - self._t_restarted <= self.protocol.restart
        if self._is_driven and self._ramp != self._goal and not restarts:
            self._fail(_LOST)

    def _fail(self, fault: Fault) -> None:
        """End the command; the motor keeps its goal."""
        self._fault = fault
        self._goal = self._goal if self._ramp is None else self._ramp

    def _drive(self, state: MotorState, width: float, dt: float) -> None:
        """Switch the motor on where it is, then move its goal along at the speed of the command."""
        if self._ramp is None or not state.on or state.stopped:
            here = min(max(width, 0.0), self.spec.width_max)
            count = self._count(here)
            if state.goal == count and state.torque_limit == self._limit:
                self._ramp = here
                self.chain.switch(True)
            else:
                self.chain.prepare([count], [self._limit])
            self._t_moved = self._now
            return
        step, rest = self._speed * dt, self._goal - self._ramp
        if rest == 0.0 and state.goal == self._count(self._goal) and state.torque_limit == self._limit:
            return
        self._ramp = self._goal if abs(rest) <= step else self._ramp + (step if rest > 0.0 else -step)
        self._t_moved = self._now
        self._send(state, self._ramp)

    def _send(self, state: MotorState, width: float) -> None:
        if state.torque_limit != self._limit:
            self.chain.write(self.protocol.limit, {self.settings.id: self._limit.to_bytes(2, "little")})
        self.chain.write_goals([self._count(width)])

    def move(self, width: float, speed: float, force: float) -> None:
        self.chain.check()
        state, registers = self._state, self.chain.registers[0]
        self._target = self._goal = min(max(width, self.spec.width_min), self.spec.width_max)
        self._speed = min(speed, self.spec.speed)
        share = max(force * self._lever(self._target) / registers.stall_torque, _LEAST_TORQUE)
        self._limit = round(min(self.protocol.full * share, registers.limit_max))
        if state is None or not state.on or state.error:
            self._ramp, self._was_on = None, False  # switching on again ends an overload
            if state is not None and state.error and state.t > self._t_restarted:
                self._t_restarted = self._now
                for frame in self.protocol.clear({self.settings.id: state}):
                    self.chain.check().send(*frame)
        elif self._ramp is None:
            self._ramp = self._width(state.goal)
        if self._ramp is not None and state is not None and self._goal > self._ramp:
            self._ramp = min(max(self._ramp, self._width(state.position)), self._goal)  # an object had stopped the jaw
        self._fault, self._t_moved = None, self._now

    def stop(self) -> None:
        """Keep the jaw where it is; an object that it holds stays held with the same torque."""
        self.chain.check()
        state, ramp = self._state, self._ramp
        if ramp is None:  # it is not switched on any more
            self._target = None
        if state is None or ramp is None or (ramp == self._goal and self._now - self._t_moved >= _AT_REST):
            return
        if abs(state.load) < 0.5 * self._limit:  # the goal is ahead of a slow jaw
            ramp = min(max(self._width(state.position), 0.0), self.spec.width_max)
            self._send(state, ramp)
        self._goal = self._ramp = ramp
