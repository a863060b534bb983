"""Drivers of leader arms on a servo bus: their motors have torque only to follow an arm or to push the hand."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import suppress
from math import pi
from typing import Literal

from hal.config.files import Problems, check_record, validate
from hal.config.schema import Strict
from hal.errors import ConnectionLost
from hal.leader import Angles, LeaderDriver
from hal.specs import PadSpec

from .chain import Chain, Joint
from .protocol import COUNT, MotorState
from .settings import PROTOCOLS, MotorId, ServoSettings, check_baud

_WIDEST = 3.0
"""Widest range of a calibrated lever, rad."""
_FORCE, _RISE = 0.3, 0.1
"""Greatest torque that the hand feels, share of the stall torque, and time in which it may rise to that, s: chosen."""
_SPEED, _LEAD, _MOVED = 0.5, 0.3, 40
"""Speed at which the goals of a leader that follows come to the arm's joints, rad/s, how far they are ahead of it at
most, rad, and how far it may be moved while its torque is switched on, counts: chosen."""


class ServoLeaderSettings(Strict):
    """Options of a leader on a servo bus (``leaders.<name>.options``, and its ``port``)."""

    port: str
    ids: tuple[MotorId, ...]
    """Ids of the joints' motors, from base to tip."""
    lever: MotorId | None = None
    """Id of the lever's motor."""
    lever_deg: tuple[float, float] | None = None
    """Angle of the lever's motor where it is open, and closed; None: upper and lower end of its calibrated range."""
    zero: int | None = None
    """Count of every joint's motor at which its angle is 0; None for the middle of its calibrated range."""
    baud: Literal[57_600, 115_200, 1_000_000, 2_000_000, 3_000_000, 4_000_000] = 1_000_000


def check_leader(spec: PadSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a leader's record: key in its entry of the rig file, message and code."""
    problems = Problems()
    settings = validate(ServoLeaderSettings, spec.options, "", problems, "options")
    for problem in problems.found:
        yield problem.key.replace("options.port", "port"), problem.message, problem.code
    if problems.found or spec.leader is None:
        return
    if len(settings.ids) != len(spec.leader.joints):
        yield "options.ids", f"has {len(settings.ids)} motors for {len(spec.leader.joints)} joints", "wrong_count"
    if settings.lever is None and spec.leader.lever != "none":
        yield "options.lever", "is missing: the id of its motor; or set lever: none", "missing_key"
    if spec.leader.feedback and PROTOCOLS[spec.driver].name != "Dynamixel":
        message = f"a {PROTOCOLS[spec.driver].name} motor has no small torques: a Dynamixel leader has"
        yield "feedback", message, "unsupported"
    motors = len(settings.ids) + (settings.lever is not None)
    yield from (("options.baud", *problem) for problem in check_baud(spec.driver, motors, settings.baud))


class ServoLeader(LeaderDriver):
    """A leader on a servo bus (options: :class:`ServoLeaderSettings`)."""

    def __init__(self, spec: PadSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        own = self.settings = check_record(ServoLeaderSettings, spec.options, f"leaders.{spec.name}.options")
        self.protocol = PROTOCOLS[spec.driver]()
        motors = dict(zip(self.leader.joints, own.ids, strict=True))
        if own.lever is not None:
            motors["the lever"] = own.lever
        joints = [Joint(label, (id,), 0.0) for label, id in motors.items()]
        bus = ServoSettings(port=own.port, baud=own.baud)
        self.chain = Chain(spec.name, self.protocol, bus, joints, watch=False)
        self._goal: Sequence[float] = ()
        """Joint positions that it comes to, rad."""
        self._mine, self._t_driven = 0.0, 0.0
        """Share of its torque that was switched on here, and when goals were written, s."""
        self._pushes: Sequence[float] = ()
        """By how much goals are ahead of the joints so that the hand feels a torque, rad."""

    def read_angles(self, now: float) -> Angles:
        chain = self.chain
        try:
            if chain.bus is None:
                chain.open()
                self._find_ends()
            states = chain.read(now)
            own = len(self.settings.ids) if self._mine else 0
            holding = [label for label, state in zip(chain.labels[own:], states[own:], strict=True) if state.on]
            if holding:
                text = f"{', '.join(holding)} has torque: this may be a follower; if not, switch its supply off and on"
                raise ConnectionLost(text, code="has_torque")
            angles = [COUNT * (s.position - zero) for s, zero in zip(states, self._zeros, strict=False)]
            self.limp = self._find_limp(states)
            self._drive(states, self.find_joints(angles), now)
        except BaseException:
            self._disconnect()
            raise
        t = min(state.t for state in states)
        return Angles(t, angles, 0.0 if self.settings.lever is None else self._pulled(COUNT * states[-1].position))

    def _find_limp(self, states: Sequence[MotorState]) -> str:
        """Return why its motors get no torque although they may: their goals must be where they are."""
        if not (self.leader.follow or self.leader.feedback):
            return ""
        places = [state.position for state in states[: len(self.settings.ids)]]
        away = zip(self.chain.labels, places, self._clip(places), strict=False)
        names = [label for label, place, nearest in away if abs(nearest - place) >= _MOVED]
        advice = "move it inside by hand, or calibrate it"
        return f"{', '.join(names)} is outside of its calibrated range; {advice}" if names else ""

    def _find_ends(self) -> None:
        """Note zeros and the ends of the lever. Raises ConnectionLost if the lever is not calibrated."""
        own, stored = self.settings, [registers.calibration for registers in self.chain.registers]
        middles = [0.5 * (c.range_min + c.range_max) for c in stored[: len(own.ids)]]
        self._zeros = middles if own.zero is None else [float(own.zero)] * len(own.ids)
        if own.lever_deg is not None:
            self._opened, self._closed = (angle * pi / 180.0 for angle in own.lever_deg)
        else:
            self._opened, self._closed = COUNT * stored[-1].range_max, COUNT * stored[-1].range_min
        span = abs(self._opened - self._closed)
        if own.lever is not None and not 0.0 < span < _WIDEST:
            text = f"the lever (motor {own.lever}): its range is {span:.2f} rad; calibrate it, or give "
            raise ConnectionLost(f"{text}options.lever_deg", code="not_calibrated")

    def _pulled(self, angle: float) -> float:
        middle = 0.5 * (self._opened + self._closed)
        angle -= 2.0 * pi * round((angle - middle) / (2.0 * pi))
        return min(max((self._opened - angle) / (self._opened - self._closed), 0.0), 1.0)

    def _drive(self, states: Sequence[MotorState], here: Sequence[float], now: float) -> None:
        """Come to the joints of an arm, or push the hand, with little torque; let go if there is nothing to do."""
        wanted, felt, chain = self.wanted, self.felt, self.chain
        share = self.leader.follow if wanted is not None else 0.0 if felt is None else _FORCE
        if share and (fault := chain.fault(states)) is not None:
            raise ConnectionLost.of(self.spec.name, fault)
        states = states[: len(here)]
        if self._mine not in (0.0, share):
            chain.switch(False, len(here))
            if not any(state.on for state in states):
                self._mine = 0.0
        elif share and not (self._mine and all(state.on and not state.stopped for state in states)):
            self._switch_on(states, here, share)
        elif share:
            dt, gains = min(now - self._t_driven, 0.1), self.leader.gains
            goals = self._approach(here, wanted, dt) if wanted is not None else self._push(here, felt or (), dt)
            ways = [(b - a) / gain / COUNT for a, b, gain in zip(here, goals, gains, strict=True)]
            chain.write_goals(self._clip([state.position + way for state, way in zip(states, ways, strict=True)]))
        self._t_driven = now

    def _approach(self, here: Sequence[float], wanted: Sequence[float], dt: float) -> Sequence[float]:
        """Return goals that come to the joints of an arm at a bounded speed, rad."""
        step, goals = _SPEED * dt, []
        for goal, q, end in zip(self._goal, here, wanted, strict=True):
            goal += min(max(end - goal, -step), step)
            goals.append(min(max(goal, q - _LEAD), q + _LEAD))
        self._goal = goals
        return goals

    def _push(self, here: Sequence[float], felt: Sequence[float], dt: float) -> Sequence[float]:
        """Return goals that are ahead of the joints by the torques that the hand is to feel over their stiffness, rad.

        What a program leaves that is killed is so a motor that holds near where it is, not one that turns on for ever.
        """
        pushes = []
        for push, torque, gain, r in zip(self._pushes, felt, self.leader.gains, self.chain.registers, strict=False):
            most, unit = abs(gain) * _FORCE * r.stall_torque / r.stiffness, gain * gain / r.stiffness
            step = most * dt / _RISE
            push += min(max(min(max(unit * torque, -most), most) - push, -step), step)
            pushes.append(push)
        self._pushes = pushes
        return [q + push for q, push in zip(here, pushes, strict=True)]

    def _switch_on(self, states: Sequence[MotorState], here: Sequence[float], share: float) -> None:
        """Give the motors their positions as goals, then, if they have these and are still there, their torque."""
        most = round(share * self.protocol.full)
        limits = [min(most, registers.limit_max) for registers in self.chain.registers[: len(states)]]
        ready = [(s.torque_limit, abs(s.goal - s.position) < _MOVED) for s in states]
        if ready == [(limit, True) for limit in limits]:
            self._goal, self._pushes, self._mine = here, [0.0] * len(here), share
            self.chain.switch(True, len(states))
        else:
            self.chain.prepare(self._clip([state.position for state in states]), limits)

    def _clip(self, counts: Sequence[float]) -> list[int]:
        """Return goals that the motors take."""
        ends = [(r.calibration.range_min, r.calibration.range_max, r.turns) for r in self.chain.registers]
        return [
            round(x) if turns == 2 else min(max(round(x), low), high)
            for x, (low, high, turns) in zip(counts, ends, strict=False)
        ]

    def _disconnect(self) -> None:
        """Let it go, and release the bus; motors that did not confirm it are told when they answer again."""
        bus = self.chain.bus
        if self._mine and bus is not None:
            with suppress(ConnectionLost):
                off = [any(bus.store(id, self.protocol.torque, b"\0") for _ in range(3)) for id in self.settings.ids]
                self._mine *= not all(off)
        self.chain.close()

    def close(self) -> None:
        super().close()
        self._disconnect()
