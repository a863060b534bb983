"""A servo with everything around it, for tests: a device that takes every set-point, and an app's inbox by hand."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

from specs import panda

from hal.commands import CommandRecord, DeadmanRecord, Inbox, Kind, Session
from hal.driver import Reading, Setpoint
from hal.errors import Fault
from hal.kinematics.arm import Kinematics
from hal.servo.audit import SetpointAudit
from hal.servo.servo import Servo
from hal.specs import LimitsSpec, RobotSpec
from hal.types import Limited, RobotStatus, Trip

N = 7
STILL = (0.0,) * N
FAR = 1e9


def tightened(limits: LimitsSpec, acceleration: float, jerk: float) -> LimitsSpec:
    """The same limits with these shares of acceleration and jerk."""
    return replace(
        limits,
        acceleration=tuple(acceleration * a for a in limits.acceleration),
        jerk=tuple(jerk * j for j in limits.jerk),
    )


class HandTicked:
    """Base of a servo that is ticked by hand: the app's side, with the app and the pad alive until a test says no."""

    servo: Servo

    def __init__(self, spec: RobotSpec, rate_hz: float, now: float, deadman: bool) -> None:
        self.spec = spec
        self.dt = 1.0 / rate_hz
        self.audit = SetpointAudit(spec.limits, self.dt)
        self.now = self.t_app = now
        self.seq = 0
        self.command: CommandRecord | None = None
        self.deadman = DeadmanRecord(False, True, 0, 0.0) if deadman else None
        self.pad_alive = self.app_alive = True
        self.stops = self.rearms = self.acknowledged = 0
        self.limited = Limited.NONE

    def rearm(self) -> None:
        """Acknowledge the trip, and every stop so far."""
        self.rearms, self.acknowledged = self.rearms + 1, self.stops

    def press(self) -> None:
        self.deadman = self.deadman._replace(held=True, presses=self.deadman.presses + 1)

    def release(self) -> None:
        self.deadman = self.deadman._replace(held=False)

    def press_again(self) -> None:
        """Release the dead-man for a tick, and press it."""
        self.release()
        self.tick()
        self.press()

    def send(self, kind: Kind, values: Sequence[float], deadline: float = 0.1) -> int:
        self.seq += 1
        self.command = CommandRecord(self.seq, 1, self.now, self.now + deadline, kind, tuple(values))
        return self.seq

    def inbox(self) -> Inbox:
        if self.app_alive:
            self.t_app = self.now
        if self.deadman is not None and self.pad_alive:
            self.deadman = self.deadman._replace(t_alive=self.now)
        return Inbox(self.command, self.deadman, self.stops, self.rearms, self.t_app, self.acknowledged)

    def tick(self) -> Setpoint | None:
        raise NotImplementedError

    def run(self, seconds: float) -> None:
        """Tick without new commands."""
        for _ in range(round(seconds / self.dt)):
            self.tick()

    def assert_within_limits(self) -> None:
        for name, peak in self.audit.peaks().items():
            assert peak <= 1.0, f"{name} reached {peak} of its limit"


class Bench(HandTicked):
    """One servo whose device takes every set-point."""

    def __init__(
        self,
        spec: RobotSpec | None = None,
        *,
        rate_hz: float = 240.0,
        speed: float = 1.0,
        tcp_speed: float = FAR,
        deadman: bool = False,
        move_to: Sequence[float] | None = None,
        begin: bool = True,
        extrapolates: bool = False,
        kinematics: Kinematics | None = None,
    ) -> None:
        super().__init__(panda() if spec is None else spec, rate_hz, 50.0, deadman)
        self.servo = Servo(self.spec, self.dt, kinematics, extrapolates=extrapolates)
        self.extrapolates = extrapolates
        self.ticks = 0
        self.q: list[float] = list(self.spec.home)
        self.late = False
        """Whether there was a pause that the clock does not show."""
        self.fault: Fault | None = None
        self.reading: dict[str, Any] = {}
        """Values of the next readings that are not the truth."""
        self.history: list[list[float]] = []
        self.session = Session(1, speed, tcp_speed, deadman, None if move_to is None else tuple(move_to))
        self.servo.anchor(self.q)
        if begin:
            self.begin()

    def begin(self, known_stops: int | None = None) -> None:
        """Open the session; the app knew of so many stops then (all of them)."""
        self.acknowledged = self.stops if known_stops is None else known_stops
        self.servo.open_session(self.session, self.inbox())

    @property
    def status(self) -> RobotStatus:
        return self.servo.report.status

    @property
    def trip(self) -> Trip:
        return self.servo.report.trip

    @property
    def moving(self) -> bool:
        return any(abs(v) > 1e-6 for v in self.servo.report.dq_set)

    def target(self, q: Sequence[float], dq: Sequence[float] = STILL) -> int:
        return self.send(Kind.JOINT_TARGET, (*q, *dq))

    def tick(self) -> Setpoint | None:
        self.now += self.dt
        self.ticks += 1
        values = {"q": self.q, "dq": STILL, "fault": self.fault} | self.reading
        reading = Reading(values.pop("t", self.now), self.now, values.pop("seq", self.ticks), **values)
        answer = self.servo.answer(self.now, reading)
        setpoint = self.servo.tick(self.now, reading, self.inbox(), self.late)
        if answer is not None:
            setpoint = answer
        return self._take(setpoint)

    def lose(self) -> Setpoint | None:
        """A cycle in which the device did not answer."""
        self.now += self.dt
        return self._take(self.servo.device_lost(self.now, self.inbox()))

    def _take(self, setpoint: Setpoint | None) -> Setpoint | None:
        self.limited |= self.servo.report.limited
        if setpoint is not None:
            self.q = list(setpoint.q)
            self.audit.add(self.q)
            self.history.append(self.q)
        return setpoint

    def stream(self, seconds: float, kind: Kind, values: Sequence[float], every: int = 5) -> None:
        """The same command again and again."""
        for k in range(round(seconds / self.dt)):
            if k % every == 0:
                self.send(kind, values)
            self.tick()

    def drive(self, seconds: float = 0.3, joint: int = 0, speed: float = 0.5) -> None:
        """Move one joint at a constant speed."""
        self.stream(seconds, Kind.JOINT_VELOCITY, [speed if i == joint else 0.0 for i in range(N)])

    def until_rest(self, most: float = 2.0) -> float:
        """Tick until nothing moves; returns how long that took."""
        begun = self.now
        while self.moving or self.now == begun:
            self.tick()
            assert self.now < begun + most, "the arm did not come to rest"
        return self.now - begun
