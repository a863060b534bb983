"""Random streams of commands through the servo, judged by the emulator's limit checker, with and without losses.

No network: the servo's set-points go into the same samples that the emulator makes of what it receives, some of them
are lost on the way, and what comes back is rounded as an FR3 rounds it. 50,000 cycles; with HAL_SOAK=1 a million.
"""

from __future__ import annotations

import math
import os
import random

import numpy as np
import pytest

from hal.commands import CommandRecord, Inbox, Kind, Session
from hal.config import load
from hal.driver import Reading, Setpoint
from hal.drivers.franka.limits import LIMITS
from hal.servo.servo import Servo
from hal.specs import RobotSpec
from hal_emulators.franka.motion import LimitChecker, MotionSample, at_rest, extrapolate, step_position

pytestmark = pytest.mark.slow

DT = 1e-3
SOAK = os.environ.get("HAL_SOAK") == "1"
CYCLES = 1_000_000 if SOAK else 50_000
"""In all, over both arms, with and without losses."""
STRETCH = 5_000
"""Cycles of one session."""


def spec_of(arm: str) -> RobotSpec:
    model = "panda" if arm == "fer" else "fr3"
    overrides = [f"robots.arm.model={model}", "cameras={}", "robots.arm.workspace=null"]
    return load("franka_emulator", overrides=overrides).resolve().robots[0]


class Controller:
    """The robot's side: takes a set-point, or extrapolates where one was lost, and checks what it took."""

    def __init__(self, arm: str, q: tuple[float, ...]) -> None:
        self.checker = LimitChecker(LIMITS[arm])
        self.sample: MotionSample = at_rest(q)
        self.single = arm == "fr3"
        self.cycles = self.lost = 0
        self.travel = 0.0

    def take(self, setpoint: Setpoint | None, lose: bool) -> None:
        self.cycles += 1
        before = self.sample
        if setpoint is None or lose:
            self.lost += 1
            self.sample = extrapolate(before)
            return
        self.sample = step_position(before, setpoint.q)
        violation = self.checker.joints(before, self.sample)
        assert violation is None, f"cycle {self.cycles}: {violation.text if violation else ''}"
        self.travel += math.dist(before.q, self.sample.q)

    def reading(self, now: float) -> Reading:
        q, dq = self._seen(self.sample.q), self._seen(self.sample.dq)
        return Reading(now, now, self.cycles, q, dq, None, q, dq)

    def _seen(self, values: object) -> list[float]:
        found: list[float] = np.asarray(values, np.float32 if self.single else np.float64).tolist()
        return found


class Commander:
    """Sends what a program might: any kind, at any rate, smooth, in jumps, or not at all for a while."""

    def __init__(self, spec: RobotSpec, chance: random.Random) -> None:
        self.spec, self.chance = spec, chance
        self.seq = self.rearms = 0
        self.command: CommandRecord | None = None
        self._new_mood(0)

    def _new_mood(self, cycle: int) -> None:
        chance = self.chance
        self.kind = chance.choice([Kind.JOINT_TARGET, Kind.JOINT_VELOCITY, Kind.TWIST, Kind.TWIST])
        self.every = chance.choice([1, 2, 5, 20, 50, 100])
        self.until = cycle + chance.randrange(100, 1500)
        self.wild = chance.random() < 0.4
        self.silent = chance.random() < 0.1

    def inbox(self, cycle: int, now: float, q: list[float]) -> Inbox:
        if cycle >= self.until:
            self._new_mood(cycle)
            self.rearms += 1
        if cycle % self.every == 0 and not self.silent:
            self.seq += 1
            deadline = now + max(0.1, 2.5 * self.every * DT)
            self.command = CommandRecord(self.seq, 1, now, deadline, self.kind, self._values(now, q), 0.0)
        return Inbox(self.command, None, 0, self.rearms, now)

    def _values(self, now: float, q: list[float]) -> tuple[float, ...]:
        chance, limits = self.chance, self.spec.limits
        swing = [math.sin((1.0 + 0.3 * k) * now + k) for k in range(7)]
        if self.wild:
            swing = [chance.uniform(-1.5, 1.5) for _ in range(7)]
        if self.kind is Kind.JOINT_TARGET:
            reach = 0.09  # a first target that is farther away is refused
            return (*[a + reach * b for a, b in zip(q, swing, strict=True)], *[0.0] * 7)
        if self.kind is Kind.JOINT_VELOCITY:
            return tuple(v * s for v, s in zip(limits.velocity, swing, strict=True))
        return (*[0.3 * s for s in swing[:3]], *[0.8 * s for s in swing[3:6]], 0.0)


@pytest.mark.parametrize("share", [0.0, 0.05, 0.2])
@pytest.mark.parametrize("arm", ["fr3", "fer"])
def test_no_limit_of_the_robot_is_ever_broken(arm: str, share: float) -> None:
    chance = random.Random(f"{arm} {share}")
    spec = spec_of(arm)
    cycles = CYCLES // 6
    travel, lost, reanchored = 0.0, 0, 0
    for begin in range(0, cycles, STRETCH):
        middle = [0.5 * (a + b) for a, b in zip(spec.limits.lower, spec.limits.upper, strict=True)]
        start = tuple(h + chance.uniform(-0.5, 0.5) * (m - h) for h, m in zip(spec.home, middle, strict=True))
        servo, controller, commander = (
            Servo(spec, DT, extrapolates=True),
            Controller(arm, start),
            Commander(spec, chance),
        )
        reading = controller.reading(0.0)
        servo.anchor(reading.q_commanded or ())
        inbox = commander.inbox(0, 0.0, list(start))
        # With losses at a rig's own greatest speed: at full speed a fifth lost could carry a joint past its stop.
        speed = spec.speed if share else chance.choice([spec.speed, 1.0])
        servo.open_session(Session(1, speed, 5.0, False), inbox)
        for cycle in range(1, min(STRETCH, cycles - begin)):
            now = cycle * DT
            reading = controller.reading(now)
            setpoint = servo.answer(now, reading)
            servo.tick(now, reading, inbox)
            controller.take(setpoint, chance.random() < share)
            inbox = commander.inbox(cycle, now, list(controller.sample.q))
        travel, lost = travel + controller.travel, lost + controller.lost
        reanchored += servo.report.reanchored
    assert travel > 2e-5 * cycles, "nothing moved: the test shows nothing"
    if share:
        assert lost > 0.8 * share * cycles
        assert reanchored > 0.1 * lost


def test_the_checker_stops_a_client_that_does_not_re_anchor() -> None:
    """The same stream and losses without the answer of the robot: the checker is not blind."""
    spec = spec_of("fr3")
    servo, controller = Servo(spec, DT), Controller("fr3", spec.home)
    servo.anchor(spec.home)
    inbox = Inbox(None, None, 0, 0, 0.0)
    servo.open_session(Session(1, 1.0, 5.0, False), inbox)
    chance = random.Random(1)
    with pytest.raises(AssertionError, match="limit"):
        for cycle in range(1, 5000):
            now = cycle * DT
            blind = Reading(now, now, cycle, list(controller.sample.q), list(controller.sample.dq))
            swing = [0.5 if cycle // 200 % 2 else -0.5] * 7
            command = CommandRecord(cycle, 1, now, now + 0.1, Kind.JOINT_VELOCITY, tuple(swing), 0.0)
            setpoint = servo.tick(now, blind, Inbox(command, None, 0, 0, now))
            controller.take(setpoint, chance.random() < 0.2)


def test_the_checker_stops_a_step_of_50_mrad() -> None:
    controller = Controller("fr3", spec_of("fr3").home)
    q = list(controller.sample.q)
    q[0] += 0.05
    with pytest.raises(AssertionError, match="velocity"):
        controller.take(Setpoint(q, [0.0] * 7, [0.0] * 7), False)
