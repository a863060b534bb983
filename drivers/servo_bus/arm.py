"""Driver of an arm with servos on a serial bus. Tested against an emulator, not against a real arm.

* ``open`` reads what the motors have stored, and writes nothing. ``engage`` gives each motor its present position as
  its goal, and only then switches its torque on.
* The motors hold their last goal for ever, with the torque limit of the model: ``halt`` and ``close`` send nothing.
  Dynamixel motors stop where they are, and hold there, once they hear nothing any more.
* The motors' position control has no integrator, so a joint would sag by its load over its stiffness, and lag by what
  its speed induces. Goals lead by what the model's weight and the speed make of it; the weight's part fades in once the
  torque is on, before the first set-point. What is left at rest, of friction and unknown loads, is crept away slowly.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import inf
from pathlib import Path
from time import sleep
from typing import Any, ClassVar

from hal.driver import Reading, RobotDriver, Setpoint
from hal.dynamics import Dynamics
from hal.errors import Fault, RobotFault
from hal.following import Following
from hal.kinematics.urdf import read_urdf
from hal.specs import RobotSpec

from .chain import Chain, Joint
from .protocol import COUNT, MotorState
from .settings import PROTOCOLS, ServoArmSettings

_ENGAGE = 0.8
"""Time in which all motors must be on, s."""
_PAUSE = 0.1
"""Time without a call of ``engage`` after which it begins anew, s."""
_FADE = 0.3
"""Time after the torque is on in which the lead of the goals grows, s."""
_LEAD = 0.1
"""Greatest lead of a goal for the weight, rad."""
_SLOW = 40
"""Greatest speed of a motor that counts as at rest, counts/s; a Dynamixel reports steps of 16."""
_CREEP, _DEAD, _MOST, _REST = 5.0, 1.7 * COUNT, 0.03, 0.01
"""At rest, the share of a joint's distance from its set-point that its goal creeps on in a second, the distance at
which it stops, rad, the most that it goes, rad, and the speed of a set-point at rest, rad/s: chosen."""
_FOLLOWING, _LAG, _FOLLOWING_PATIENCE = 0.2, 0.15, 0.1
"""Largest distance of a joint from its set-point, rad, by how much it may be larger for each rad/s, s, and for how
long it may be larger still, s: chosen."""
_AWAY = 0.05
"""Goals this far from an arm that is no longer driven are replaced by where it is, rad."""
_SENT = 8
"""Number of set-points by which a goal that a motor reports is recognised."""


class ServoArm(RobotDriver):
    """An arm on a servo bus (settings: :class:`~.settings.ServoArmSettings`)."""

    modes: ClassVar[frozenset[str]] = frozenset({"position"})

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = ServoArmSettings.of(spec)
        self.protocol = PROTOCOLS[spec.driver]()
        self.engaged = False
        urdf = read_urdf(Path(spec.urdf), meshes=False).joints
        joints = [
            # The model's range, not that of the limits, which a rig may tighten.
            Joint(name, ids, (urdf[name].upper or 0.0) - (urdf[name].lower or 0.0))
            for name, ids in zip(spec.joints, self.settings.motors, strict=True)
        ]
        self.chain = Chain(spec.name, self.protocol, self.settings, joints, watch=True)
        self._signs = [-1 if name in self.settings.reversed else 1 for name in spec.joints]
        self._dynamics = Dynamics.of(spec)
        self._following = Following(self.chain.labels, [_FOLLOWING] * len(joints), _LAG, _FOLLOWING_PATIENCE)
        self.faults = 0
        """Number of faults that ended an engagement."""
        self._forget()

    def _forget(self) -> None:
        self.engaged = False
        self._now, self._seq = -inf, 0
        self._states: list[MotorState] = []
        self._q: tuple[float, ...] = ()
        self._fault: Fault | None = None
        """Fault that ended an engagement; kept until recover()."""
        self._t_states, self._t_engaging, self._t_last_try, self._t_on = -inf, -inf, -inf, -inf
        """When the states were asked for, engaging began and went on, and the torque was switched on, s."""
        self._goals: list[int] = []
        self._first: list[int] = []
        """Goals that the motors have while they are engaged, and those before their torque is switched on."""
        self._sent: deque[tuple[list[int], Setpoint]] = deque(maxlen=_SENT)
        self._written = False
        """Whether a set-point was written since the last reading."""
        self._lead = [0.0] * len(self.spec.joints)
        """Present lead of the goals, rad."""
        self._crept = [0.0] * len(self.spec.joints)
        """The part of it that was crept, rad."""
        self._held: list[bool] = []
        """Which joints were held already before they were engaged: their goals lead already."""

    def open(self) -> None:
        """Connect, and check the motors (:meth:`Chain.open`). Nothing moves, and nothing is written."""
        self.close()
        self._forget()
        self.chain.open()
        stored = [registers.calibration for registers in self.chain.registers]
        zero = self.settings.zero
        self._zeros = [0.5 * (c.range_min + c.range_max) if zero is None else zero for c in stored]

    def close(self) -> None:
        """Disconnect. The motors hold their last goals. Idempotent."""
        self.engaged = False
        self.chain.close()

    # Every cycle.

    def read(self, now: float) -> Reading:
        self._now = now
        try:
            self._states = states = self.chain.read(now)
        except BaseException:
            self._disengage()
            raise
        t = min(state.t for state in states)
        if t > self._t_states:
            self._seq, self._t_states = self._seq + 1, t
        self._q = q = self._angles([state.position for state in states])
        dq = tuple(s * COUNT * state.velocity for s, state in zip(self._signs, states, strict=True))
        commanded = self._find_commanded(states) if self.engaged else None
        fault = self._judge(states, q, commanded)
        if self.engaged and self._sent and not self._written and max(map(abs, self._sent[-1][1].dq)) < _REST:
            self.write(self._sent[-1][1])  # between sessions it creeps on
        self._written = False
        reading = Reading(t, t, self._seq, q, dq, fault=fault)
        if commanded is None or not self.engaged:
            return reading
        return reading._replace(q_commanded=commanded.q, dq_commanded=commanded.dq)

    def _angles(self, counts: Sequence[int]) -> tuple[float, ...]:
        return tuple(s * COUNT * (n - zero) for s, n, zero in zip(self._signs, counts, self._zeros, strict=True))

    def _counts(self, q: Sequence[float]) -> list[float]:
        return [s * angle / COUNT + zero for s, angle, zero in zip(self._signs, q, self._zeros, strict=True)]

    def find_ranges(self) -> list[tuple[float, float]]:
        """Return the calibrated range of each joint, rad."""
        stored = [registers.calibration for registers in self.chain.registers]
        low, high = self._angles([c.range_min for c in stored]), self._angles([c.range_max for c in stored])
        return [(min(ends), max(ends)) for ends in zip(low, high, strict=True)]

    def _find_commanded(self, states: Sequence[MotorState]) -> Setpoint:
        """Return the set-point that the motors have as their goals, as exactly as it was sent if it is known."""
        goals = [state.goal for state in states]
        for counts, setpoint in reversed(self._sent):
            if counts == goals:
                return setpoint
        still = (0.0,) * len(goals)
        return Setpoint(tuple(a - b for a, b in zip(self._angles(goals), self._lead, strict=True)), still, still)

    def _judge(self, states: Sequence[MotorState], q: Sequence[float], commanded: Setpoint | None) -> Fault | None:
        """Return what keeps the arm from following; an engaged arm is then no longer engaged."""
        fault = self.chain.fault(states)
        if commanded is not None:
            off = self._find_off(states)
            if fault is None and off:
                remedy = "support the arm; check its power supply, and that no other program drives it"
                fault = Fault("switched_off", f"{', '.join(off)} went off, so that it falls", remedy)
            fault = fault or self._following.check(self._now, q, commanded.q, commanded.dq)
            if fault is not None:
                self._fault = fault
                self.faults += 1
                self._disengage()
            elif any(state.stopped for state in states):  # this process was frozen: they are switched on anew
                self._disengage()
        if self._fault is not None:
            self._stay(states)
        return self._fault or fault

    def _stay(self, states: Sequence[MotorState]) -> None:
        """Let joints that are away from their goals stay where they are, so that they neither push on nor leap.

        Also those that have fallen: a Feetech motor has its torque back by itself, once it is cool or has its supply.
        """
        if any(abs(s.goal - s.position) * COUNT > _AWAY for s in states):
            goals = [s.position if abs(s.goal - s.position) * COUNT > _AWAY else s.goal for s in states]
            self.chain.write_goals(self._clip(goals))

    def _find_off(self, states: Sequence[MotorState]) -> list[str]:
        return [label for label, state in zip(self.chain.labels, states, strict=True) if not state.on]

    def _disengage(self) -> None:
        self.engaged, self._t_last_try = False, -inf
        self._following.forget()

    def _clip(self, counts: Sequence[float]) -> list[int]:
        """Return goals that the motors take: within their calibrated ranges, which they keep by themselves, too."""
        stored = [registers.calibration for registers in self.chain.registers]
        return [min(max(round(x), c.range_min), c.range_max) for x, c in zip(counts, stored, strict=True)]

    def write(self, setpoint: Setpoint) -> bool:
        self.chain.check()
        if not self.engaged:
            return False
        if self._sent:
            before, most = self._sent[-1][1].q, _REST / self.spec.rate_hz
            for k, (target, q, state) in enumerate(zip(setpoint.q, self._q, self._states, strict=True)):
                if abs(target - before[k]) < most and abs(state.velocity) < _SLOW:
                    self._creep(k, target - q)
        self._lead = self._find_lead(setpoint.q, setpoint.dq)
        goals = self._clip(self._counts([q + lead for q, lead in zip(setpoint.q, self._lead, strict=True)]))
        self.chain.write_goals(goals)
        self._sent.append((goals, setpoint))
        self._written = True
        return True

    def _creep(self, k: int, off: float) -> None:
        """Let the goal of a joint that is off by so many rad go on a little."""
        if abs(off) > _DEAD:
            moved = self._crept[k] + _CREEP * off / self.spec.rate_hz
            self._crept[k] = min(max(moved, -_MOST), _MOST)

    def _find_lead(self, q: Sequence[float], dq: Sequence[float]) -> list[float]:
        """Return by how much the goals lead, rad: weight over stiffness, speed times lag, and what was crept."""
        leads = []
        joints = zip(self._dynamics.gravity(q), dq, self.chain.registers, self.chain.joints, self._crept, strict=True)
        for weight, speed, registers, joint, crept in joints:
            lead = float(weight) / (registers.stiffness * len(joint.ids))
            lag = registers.stall_torque / registers.speed / registers.stiffness
            leads.append(min(max(lead, -_LEAD), _LEAD) + lag * speed + crept)
        return leads

    def halt(self) -> None:
        """Send nothing: the motors hold their last goals."""

    # Switching on.

    def engage(self) -> None:
        """Give the motors their present positions as goals, then switch their torque on. One step per call."""
        self.chain.check()
        states = self._states
        if self.engaged or not states:
            return
        fault = self._fault or self.chain.fault(states) or self.chain.find_outside(states)
        if fault is not None:
            raise self._refusal(Fault(fault.code, fault.cause, f"{fault.remedy}; then robot.recover()"))
        if self._now - self._t_last_try > _PAUSE:  # a new attempt
            self._t_engaging, self._t_on, self._goals = self._now, inf, []
        self._t_last_try = self._now
        on = all(state.on and not state.stopped for state in states)
        if (not on and self._t_on < inf) or (self._t_on == inf and [state.goal for state in states] != self._goals):
            self._prepare(states)  # also motors that went off meanwhile: their goals may be any
        elif not on:
            self.chain.switch(True)
        else:
            self._t_on = min(self._t_on, self._now)
            since = self._now - self._t_on
            self.engaged = self._fade_in(min(1.0, since / _FADE)) or since > 2.0 * _FADE
            return
        if self._now - self._t_engaging > _ENGAGE:
            cause = f"{', '.join(self._find_off(states)) or 'a motor'} does not switch on"
            raise self._refusal(Fault("not_switched_on", cause, "check its power supply and its cable"))

    def _prepare(self, states: Sequence[MotorState]) -> None:
        """Make goals of the present positions; motors that hold keep the goals at which they do."""
        self._held = [bool(s.on) and abs(s.goal - s.position) * COUNT <= _LEAD for s in states]
        goals = self._clip([s.goal if held else s.position for s, held in zip(states, self._held, strict=True)])
        torques = self.spec.limits.torque or (inf,) * len(goals)
        full = self.protocol.full
        limits = [
            round(min(r.limit_max, full * torque / (r.stall_torque * len(joint.ids))))
            for r, torque, joint in zip(self.chain.registers, torques, self.chain.joints, strict=True)
        ]
        self.chain.prepare(goals, limits)
        self._goals, self._first, self._t_on = goals, goals, inf
        self._sent.clear()
        self._crept = [0.0] * len(goals)
        self._lead = self._find_lead(self._q, self._crept)

    def _fade_in(self, share: float) -> bool:
        """Let this share of the lead act on the joints that were not held before; return whether they are in place."""
        there = share >= 1.0
        counts: list[float] = list(self._first)
        for k, (held, sign, lead) in enumerate(zip(self._held, self._signs, self._lead, strict=True)):
            if not held:
                off = sign * COUNT * (self._first[k] - self._states[k].position)
                if share >= 1.0:
                    self._creep(k, off)
                there &= abs(off) <= _DEAD
                counts[k] += sign * (share * lead + self._crept[k]) / COUNT
        self._goals = self._clip(counts)
        self.chain.write_goals(self._goals)
        if there:
            self._lead = [lead + crept for lead, crept in zip(self._lead, self._crept, strict=True)]
        return there

    def _refusal(self, fault: Fault) -> RobotFault:
        return RobotFault(f"{self.spec.name}: {fault.cause}", fault.remedy, code=fault.code)

    def recover(self) -> None:
        """End an overload, whose motor keeps its torque and its place, and forget a fault that is over.

        Raises RobotFault if an error stays.
        """

        def wait() -> list[MotorState]:
            sleep(0.02)
            self._states = self.chain.read(self._now)
            return self._states

        self.chain.clear(wait)
        self._fault = None

    # Statistics.

    def reset_statistics(self) -> None:
        self.faults = 0
        if self.chain.bus is not None:
            self.chain.bus.reset_statistics()

    def statistics(self) -> dict[str, Any]:
        states = self._states
        return {
            "bus": {} if self.chain.bus is None else self.chain.bus.statistics(),
            "samples": self._seq,
            "faults": self.faults,
            "temperatures": [state.temperature for state in states],
            "voltages": [state.voltage for state in states],
            "loads": [round(state.load / self.protocol.full, 3) for state in states],
        }
