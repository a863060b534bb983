"""Driver of an arm with Feetech STS3215 servos. Tested against an emulator, not against a real arm.

* ``open`` reads what the motors have stored, and writes nothing. ``engage`` gives each motor its present position as
  its goal, and only then switches its torque on.
* The motors hold their last goal for ever, with the torque limit of the model: ``halt`` and ``close`` send nothing.
* The motors' position control has no integrator, so a joint would sag by its load over its stiffness. Goals lead by
  what the model's weight makes of it; this fades in once the torque is on, before the first set-point.
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

from .bus import MotorState
from .chain import COUNT, OUTSIDE, STIFFNESS, Chain
from .settings import FeetechArmSettings

_ENGAGE = 0.8
"""Time in which all motors must be on, s."""
_PAUSE = 0.1
"""Time without a call of ``engage`` after which it begins anew, s."""
_FADE = 0.3
"""Time after the torque is on in which the lead of the goals grows, s."""
_LEAD = 0.1
"""Greatest lead of a goal, rad."""
_FOLLOWING, _LAG, _FOLLOWING_PATIENCE = 0.2, 0.15, 0.1
"""Largest distance of a joint from its set-point, rad, by how much it may be larger for each rad/s, s, and for how
long it may be larger still, s: chosen."""
_AWAY = 0.05
"""Goals this far from an arm that is no longer driven are replaced by where it is, rad."""
_SENT = 8
"""Number of set-points by which a goal that a motor reports is recognised."""


class FeetechArm(RobotDriver):
    """An arm on a servo bus (settings: :class:`~.settings.FeetechArmSettings`)."""

    modes: ClassVar[frozenset[str]] = frozenset({"position"})

    def __init__(self, spec: RobotSpec, world: object | None = None) -> None:
        super().__init__(spec, world)
        self.settings = FeetechArmSettings.of(spec)
        self.engaged = False
        urdf = read_urdf(Path(spec.urdf), meshes=False).joints
        ends = [(urdf[name].lower or 0.0, urdf[name].upper or 0.0) for name in spec.joints]
        spans = [high - low for low, high in ends]  # not of the limits, which a rig may tighten
        self.chain = Chain(spec.name, self.settings, self.settings.ids, spec.joints, spans)
        self._dynamics = Dynamics.of(spec)
        labels = list(self.chain.labels.values())
        self._following = Following(labels, [_FOLLOWING] * len(labels), _LAG, _FOLLOWING_PATIENCE)
        self.faults = 0
        """Number of faults that ended an engagement."""
        self._forget()

    def _forget(self) -> None:
        self.engaged = False
        self._now, self._seq = -inf, 0
        self._states: list[MotorState] = []
        self._fault: Fault | None = None
        """Fault that ended an engagement; kept until recover()."""
        self._t_states, self._t_engaging, self._t_last_try, self._t_on = -inf, -inf, -inf, -inf
        """When the states were asked for, engaging began and went on, and the torque was switched on, s."""
        self._goals: list[int] = []
        self._first: list[int] = []
        """Goals that the motors have while they are engaged, and those before their torque is switched on."""
        self._sent: deque[tuple[list[int], Setpoint]] = deque(maxlen=_SENT)
        self._lead = [0.0] * len(self.spec.joints)
        """Present lead of the goals, rad."""
        self._held: list[bool] = []
        """Which joints were held already before they were engaged: their goals lead already."""

    def open(self) -> None:
        """Connect, and check the motors (:meth:`Chain.open`). Nothing moves, and nothing is written."""
        self.close()
        self._forget()
        self.chain.open()
        stored = [registers.calibration for registers in self.chain.registers]
        self._middle = [0.5 * (c.range_min + c.range_max) for c in stored]

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
        q = self._angles([state.position for state in states])
        dq = tuple(COUNT * state.velocity for state in states)
        commanded = self._find_commanded(states) if self.engaged else None
        fault = self._judge(states, q, commanded)
        reading = Reading(t, t, self._seq, q, dq, fault=fault)
        if commanded is None or not self.engaged:
            return reading
        return reading._replace(q_commanded=commanded.q, dq_commanded=commanded.dq)

    def _angles(self, counts: Sequence[int]) -> tuple[float, ...]:
        return tuple(COUNT * (count - middle) for count, middle in zip(counts, self._middle, strict=True))

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
            off = [label for label, state in zip(self.chain.labels.values(), states, strict=True) if not state.on]
            if fault is None and off:
                remedy = "support the arm; check its power supply, and that no other program drives it"
                fault = Fault("switched_off", f"{', '.join(off)} went off, so that it falls", remedy)
            fault = fault or self._following.check(self._now, q, commanded.q, commanded.dq)
            if fault is not None:
                self._fault = fault
                self.faults += 1
                self._disengage()
                self._stay(states)
        return self._fault or fault

    def _disengage(self) -> None:
        self.engaged, self._t_last_try = False, -inf
        self._following.forget()

    def _stay(self, states: Sequence[MotorState]) -> None:
        """Tell joints that are away from their goals to stay where they are: they neither push on nor leap."""
        goals = [s.position if abs(s.goal - s.position) * COUNT > _AWAY else s.goal for s in states]
        self.chain.write_goals(self._clip(goals))

    def _clip(self, counts: Sequence[float]) -> list[int]:
        """Return goals that the motors take: within their calibrated ranges, which they keep by themselves, too."""
        stored = [registers.calibration for registers in self.chain.registers]
        return [min(max(round(x), c.range_min), c.range_max) for x, c in zip(counts, stored, strict=True)]

    def write(self, setpoint: Setpoint) -> bool:
        self.chain.check()
        if not self.engaged:
            return False
        self._lead = self._find_lead(setpoint.q)
        counts = [
            (q + lead) / COUNT + middle for q, lead, middle in zip(setpoint.q, self._lead, self._middle, strict=True)
        ]
        goals = self._clip(counts)
        self.chain.write_goals(goals)
        self._sent.append((goals, setpoint))
        return True

    def _find_lead(self, q: Sequence[float]) -> list[float]:
        """Return by how much the goals lead, rad: weight over stiffness."""
        return [
            min(max(float(tau) / (STIFFNESS * max(1, registers.gain)), -_LEAD), _LEAD)
            for tau, registers in zip(self._dynamics.gravity(q), self.chain.registers, strict=True)
        ]

    def halt(self) -> None:
        """Send nothing: the motors hold their last goals."""

    # Switching on.

    def engage(self) -> None:
        """Give the motors their present positions as goals, then switch their torque on. One step per call.

        Raises:
            RobotFault: A motor reports an error, is too far outside of its range, or does not switch on.
            ConnectionLost: A motor does not answer.
        """
        self.chain.check()
        states = self._states
        if self.engaged or not states:
            return
        fault = self._fault or self.chain.fault(states) or self.find_outside()
        if fault is not None:
            raise self._refusal(Fault(fault.code, fault.cause, f"{fault.remedy}; then robot.recover()"))
        if self._now - self._t_last_try > _PAUSE:  # a new attempt
            self._t_engaging, self._t_on, self._goals = self._now, inf, []
        self._t_last_try = self._now
        on = all(state.on for state in states)
        if (not on and self._t_on < inf) or (self._t_on == inf and [state.goal for state in states] != self._goals):
            self._prepare(states)  # also motors that went off meanwhile: their goals may be any
        elif not on:
            self.chain.switch_on()
        else:
            self._t_on = min(self._t_on, self._now)
            self.engaged = self._fade_in(min(1.0, (self._now - self._t_on) / _FADE))
            return
        if self._now - self._t_engaging > _ENGAGE:
            off = [label for label, state in zip(self.chain.labels.values(), states, strict=True) if not state.on]
            cause = f"{', '.join(off) or 'a motor'} does not switch on"
            raise self._refusal(Fault("not_switched_on", cause, "check its power supply and its cable"))

    def _prepare(self, states: Sequence[MotorState]) -> None:
        """Make goals of the present positions; motors that hold keep the goals at which they do."""
        self._held = [bool(s.on) and abs(s.goal - s.position) * COUNT <= _LEAD for s in states]
        goals = self._clip([s.goal if held else s.position for s, held in zip(states, self._held, strict=True)])
        torques = self.spec.limits.torque or (inf,) * len(goals)
        limits = [
            round(min(r.torque_max, 1000 * torque / r.stall_torque))
            for r, torque in zip(self.chain.registers, torques, strict=True)
        ]
        self.chain.prepare(goals, limits)
        self._goals, self._first, self._t_on = goals, goals, inf
        self._sent.clear()
        self._lead = self._find_lead(self._angles([state.position for state in states]))

    def _fade_in(self, share: float) -> bool:
        """Let this share of the lead act on the joints that were not held before; return whether that is all of it."""
        leads = [0.0 if held else share * lead / COUNT for held, lead in zip(self._held, self._lead, strict=True)]
        self._goals = self._clip([goal + lead for goal, lead in zip(self._first, leads, strict=True)])
        self.chain.write_goals(self._goals)
        return share >= 1.0

    def find_outside(self) -> Fault | None:
        """Return a fault that names the joints so far outside of their ranges that a motor would pull them in."""
        found = []
        states = self._states or self.chain.read(self._now)
        for label, state, registers in zip(self.chain.labels.values(), states, self.chain.registers, strict=True):
            c = registers.calibration
            beyond = max(c.range_min - state.position, state.position - c.range_max) * COUNT
            if beyond > OUTSIDE:
                found.append(f"{label} is {beyond:.2f} rad outside of its calibrated range")
        if not found:
            return None
        return Fault("out_of_range", "; ".join(found), "move it inside by hand, or calibrate it: lerobot-calibrate")

    def _refusal(self, fault: Fault) -> RobotFault:
        return RobotFault(f"{self.spec.name}: {fault.cause}", fault.remedy, code=fault.code)

    def recover(self) -> None:
        """End an overload, whose motor keeps its torque and its place, and forget a fault that is over.

        Raises:
            RobotFault: An error stays.
            ConnectionLost: A motor does not answer.
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
            "voltages": [state.voltage / 10 for state in states],
            "loads": [state.load / 1000 for state in states],
            "currents": [round(6.5e-3 * state.current, 3) for state in states],
        }
