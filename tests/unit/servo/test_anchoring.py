"""Set-points that the device did not take: the servo goes on from what the device says, inside the limits."""

from __future__ import annotations

import math
import os
import random
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from servo_kit import STILL, Bench, N
from specs import panda

from hal.commands import Kind
from hal.driver import Reading
from hal.errors import Fault
from hal.kinematics.arm import Kinematics
from hal.servo.anchoring import LATEST
from hal.servo.audit import SetpointAudit
from hal.types import Limited, RobotStatus
from hal_emulators.franka.motion import at_rest, extrapolate, step_position


class Device:
    """What a driver reports as commanded, and how it goes on when a set-point is missed."""

    def __init__(self, bench: Bench, kind: str) -> None:
        self.bench = bench
        self.kind = kind
        self.q: list[float] = list(bench.q)
        self.dq = [0.0] * N
        self.ddq = [0.0] * N
        self.history: list[list[float]] = []
        self.missed = 0
        self._say()

    def cycle(self, take: bool) -> None:
        dt = self.bench.dt
        setpoint = self.bench.tick()
        if take:
            q = list(setpoint.q)
        elif self.kind == "repeats":
            self.missed += 1
            self._say()
            return
        else:  # extrapolates at constant acceleration, as a Franka does
            self.missed += 1
            q = [x + dt * (v + dt * a) for x, v, a in zip(self.q, self.dq, self.ddq, strict=True)]
        dq = [(x - x0) / dt for x, x0 in zip(q, self.q, strict=True)]
        self.ddq = [(v - v0) / dt for v, v0 in zip(dq, self.dq, strict=True)]
        self.q, self.dq = q, dq
        if self.kind == "repeats":  # it reports the speed that it was given
            self.dq = list(setpoint.dq)
        self.history.append(self.q)
        self._say()

    def _say(self) -> None:
        says: dict[str, Any] = {"q_commanded": list(self.q), "dq_commanded": list(self.dq)}
        self.bench.reading = says


@pytest.mark.parametrize(
    ("kind", "loss", "burst"),
    [
        ("repeats", 0.0, 1), ("repeats", 0.05, 1), ("repeats", 0.05, 4), ("extrapolates", 0.0, 1),
        ("extrapolates", 0.01, 1), ("extrapolates", 0.05, 1), ("extrapolates", 0.2, 1), ("extrapolates", 0.05, 5),
        ("extrapolates", 0.05, 19),
    ],
)  # fmt: skip
def test_a_device_that_misses_set_points(kind: str, loss: float, burst: int) -> None:
    bench = Bench(rate_hz=1000.0, extrapolates=kind == "extrapolates")
    device = Device(bench, kind)
    rng = random.Random(4)
    target = list(bench.q)
    speeds = [0.0] * N
    missing = 0
    for k in range(3000):
        if k % 20 == 0:
            if k % 400 == 0:
                speeds = [rng.uniform(-0.5, 0.5) for _ in range(N)]
            target = [x + 20 * bench.dt * v for x, v in zip(target, speeds, strict=True)]
            bench.target(target, speeds)
        missing = missing - 1 if missing else burst if rng.random() < loss / burst else 0
        device.cycle(take=not missing)
    assert (device.missed > 20) is (loss > 0.0)
    assert bench.status is RobotStatus.FOLLOWING
    if kind == "repeats":
        assert not bench.limited & Limited.REANCHORED
        peaks = bench.audit.peaks()
    else:
        assert bool(bench.limited & Limited.REANCHORED) is (loss > 0.0)
        peaks = peaks_of(bench, device.history)
    assert peaks["velocity"] > 0.1
    assert max(peaks.values()) <= (1.0 if kind == "repeats" else 1.0001), peaks


LATENESS = [(0.02, 0.3, 15), (0.1, 0.1, 15), (0.3, 0.1, 4), (0.6, 0.0, 2), (0.4, 0.1, 8)]
"""Share of set-points that come late, share of readings that do, and for how many cycles these do at most."""


@pytest.mark.parametrize("lateness", LATENESS)
def test_a_robot_is_followed_through_any_late_set_points_and_readings(lateness: tuple[float, float, int]) -> None:
    """An FR3's reports in single precision; what it commands itself has the limits of what is sent."""
    late, gap, longest = lateness
    chance = random.Random(str(lateness))
    bench = Bench(rate_hz=1000.0, extrapolates=True, speed=0.3, tcp_speed=0.25)
    robot, cycle, sent = at_rest(bench.q), 0, None
    commanded, lost = [robot.q], 0
    while cycle < 3000:
        cycles = chance.randint(2, longest) if chance.random() < gap else 1
        for k in range(cycles):
            takes = k == 0 and sent is not None and chance.random() >= late
            robot = step_position(robot, sent) if takes else extrapolate(robot)
            commanded.append(robot.q)
            lost += not takes
        before, cycle = cycle, cycle + cycles
        t = bench.now = cycle * bench.dt
        if before // 20 != cycle // 20:
            turn = [0.1 * math.sin(2 * t), 0.1 * math.cos(3 * t), 0.05 * math.sin(t), 0.0, 0.2, 0.3 * math.sin(2 * t)]
            bench.send(Kind.TWIST, [*turn, 0.0])
        q, dq = (np.array(values, np.float32).tolist() for values in (robot.q, robot.dq))
        reading = Reading(t, t, cycle, q, dq, None, q, dq)
        answer = bench.servo.answer(t, reading)
        bench.servo.tick(t, reading, bench.inbox())
        assert answer is not None
        sent = answer.q
    assert lost > 100
    assert bench.servo.statistics()["report_error"] < 1.3e-7, "only what single precision rounds"
    peaks = peaks_of(bench, commanded)
    assert max(peaks.values()) <= 1.0001, peaks
    assert math.dist(commanded[0], commanded[-1]) > 0.01


@pytest.mark.parametrize("seed", [14, 23, 24])
def test_noise_with_outliers_corrects_nothing(seed: int) -> None:
    """A device that takes every set-point and reports it with noise: 2 % of its reports have five times as much."""
    bench = Bench(rate_hz=1000.0, extrapolates=True)
    chance = random.Random(seed)
    for k in range(2000):
        if k % 100 == 0:
            speeds = [chance.uniform(-1.0, 1.0) * v for v in bench.spec.limits.velocity]
        if k % 20 == 0:
            bench.send(Kind.JOINT_VELOCITY, speeds)
        noise = 1e-5 if chance.random() < 0.02 else 2e-6
        bench.reading = {"q": bench.q, "q_commanded": [x + chance.gauss(0.0, noise) for x in bench.q]}
        bench.tick()
    assert bench.servo.report.reanchored == 0
    bench.assert_within_limits()


def test_an_arm_that_a_fault_stopped_or_that_was_lost_continues_from_where_it_is() -> None:
    bench = Bench()
    bench.reading = {"q_commanded": list(bench.q), "dq_commanded": list(STILL)}
    for k in range(60):
        if k % 5 == 0:
            bench.target([x + 0.09 for x in bench.q])
        setpoint = bench.tick()
        bench.reading = {"q_commanded": list(setpoint.q), "dq_commanded": list(setpoint.dq)}
    stands = list(bench.q)
    assert bench.moving
    bench.fault = Fault("reflex", "a reflex", "recover")
    bench.run(0.5)
    assert bench.status is RobotStatus.FAULT
    bench.fault = None
    bench.tick()
    assert bench.limited & Limited.REANCHORED
    assert bench.q == pytest.approx(stands, abs=1e-9)
    assert not bench.moving
    bench = Bench()
    bench.drive()
    for _ in range(100):
        bench.lose()
    bench.reading = {"q": [x + 0.3 for x in bench.q]}
    found = bench.reading["q"]
    bench.tick()
    assert bench.servo.report.q_set == pytest.approx(found)
    assert bench.limited & Limited.REANCHORED


@pytest.mark.parametrize("speed", [0.03, 1.0, 50.0, 900.0])
@pytest.mark.parametrize("cause", ["silence", "fault", "withheld"])
def test_a_wrong_measured_speed_moves_no_set_point(cause: str, speed: float) -> None:
    bench = Bench(rate_hz=1000.0, deadman=True)
    bench.press()
    bench.drive(0.2)
    bench.release()
    bench.run(0.5)
    found = [x + 0.011 for x in bench.q]
    if cause == "silence":
        for _ in range(200):
            bench.lose()
    elif cause == "fault":
        bench.fault = Fault("reflex", "a reflex", "recover")
        bench.run(0.1)
        bench.fault = None
    else:
        bench.servo.note_withheld()
    bench.reading = {"q": found, "dq": [speed] + [0.0] * (N - 1), "q_commanded": found}
    bench.tick()
    assert bench.q == pytest.approx(found, abs=1e-12)
    bench.reading = {"q": found, "q_commanded": found}
    bench.run(1.0)
    assert bench.q == pytest.approx(found, abs=1e-12)


def test_an_old_reading_does_not_contradict_the_last_set_point() -> None:
    bench = Bench()
    bench.reading = {"q_commanded": list(bench.q), "dq_commanded": list(STILL), "seq": 7}
    bench.drive(0.1)
    assert not bench.limited & Limited.REANCHORED
    assert bench.moving


# Devices whose reports are anything but true.

KINDS = (
    "true", "late", "repeated", "noisy", "quantised", "swapped", "offset", "ahead", "random", "measured", "lossy",
    "not a number", "elsewhere",
)  # fmt: skip
Stretch = tuple[str, int, float, int]
"""What the device reports, a lag in cycles, an amplitude from 0 to 1, and for how many cycles."""
STRETCHES = st.lists(
    st.tuples(st.sampled_from(KINDS), st.integers(0, LATEST), st.floats(0.0, 1.0), st.integers(1, 150)),
    min_size=1,
    max_size=5,
)
KINEMATICS = Kinematics(panda().kinematics)
STREAMS = 10_000 if os.environ.get("HAL_SOAK") == "1" else 100


class Liar:
    """A device that takes every set-point and reports something else.

    ``claimed`` is what a reader who knows nothing but the device's rule believes that it did: it took every set-point,
    except where its report is, to a microradian, what it would say after a loss.
    """

    def __init__(self, bench: Bench, chance: random.Random) -> None:
        self.bench, self.chance = bench, chance
        self.taken: list[list[float]] = [list(bench.q)] * (LATEST + 1)
        self.claimed: list[list[float]] = [list(bench.q)] * 4
        self.measured = list(bench.q)
        self.said: list[float] = list(bench.q)
        self.claims = 0
        """How often the servo took it at its word that it lost a set-point in motion."""

    def say(self, kind: str, lag: int, size: float) -> None:
        chance, q = self.chance, self.taken[-1]
        self.measured = [x + 0.1 * (y - x) for x, y in zip(self.measured, q, strict=True)]
        amplitude = 10.0 ** (-9.0 + 8.0 * size)  # 1 nrad to 0.1 rad
        said = list(q)
        dq = [chance.uniform(-2.0, 2.0) for _ in q] if kind in ("random", "elsewhere", "late") else None
        if kind == "late":
            said = list(self.taken[-1 - lag])
        elif kind == "repeated" and chance.random() < size:
            said = self.said
        elif kind == "noisy":
            said = [x + chance.gauss(0.0, amplitude) for x in q]
        elif kind == "quantised":
            said = [amplitude * round(x / amplitude) for x in q]
        elif kind == "swapped":
            said[lag], said[6] = said[6], said[lag]
        elif kind == "offset":
            said = [x + amplitude for x in q]
        elif kind == "ahead":  # what pulls a servo along that believes it
            before = self.taken[-2]
            said = [x + (1.0 + 10.0 * size) * (x - y) for x, y in zip(q, before, strict=True)]
        elif kind == "random":
            limits = self.bench.spec.limits
            said = [chance.uniform(low, high) for low, high in zip(limits.lower, limits.upper, strict=True)]
        elif kind == "measured":
            said = list(self.measured)
        elif kind == "lossy":
            if chance.random() < 0.6 * size:
                said = self.after_a_loss()
            if lag % 2:  # some tell their speeds, too
                dq = [(x - y) / self.bench.dt for x, y in zip(said, self.claimed[-2], strict=True)]
        elif kind == "not a number" and chance.random() < size:
            said[lag] = math.nan
        elif kind == "elsewhere":
            said = [x + 89.0 * size for x in q]
        self.said = said
        self.bench.reading = {"q": self.measured, "q_commanded": list(said), "dq_commanded": dq}

    def after_a_loss(self) -> list[float]:
        """What a device that did not take the last set-point reports."""
        if not self.bench.extrapolates:
            return list(self.claimed[-2])
        return [3.0 * (a - b) + c for a, b, c in zip(*reversed(self.claimed[-4:-1]), strict=True)]

    def cycle(self) -> bool:
        """One tick; returns whether a set-point came. The servo may only correct what the device's rule explains."""
        corrected = self.bench.servo.report.reanchored
        setpoint = self.bench.tick()
        if self.bench.servo.report.reanchored > corrected and self.bench.extrapolates:
            claim = self.after_a_loss()
            if max(abs(x - y) for x, y in zip(self.said, claim, strict=True)) <= 5e-7:
                self.claims += claim != self.claimed[-2]
                self.claimed[-1] = claim
        if setpoint is None:
            return False
        self.taken.append(list(setpoint.q))
        self.claimed.append(list(setpoint.q))
        return True


def peaks_of(bench: Bench, positions: Sequence[Sequence[float]]) -> dict[str, float]:
    audit = SetpointAudit(bench.spec.limits, bench.dt)
    for q in positions:
        audit.add(q)
    return audit.peaks()


@pytest.mark.timeout(1200)
@settings(max_examples=STREAMS, deadline=None, suppress_health_check=list(HealthCheck))
@given(STRETCHES, st.integers(0, 2**32), st.booleans(), st.sampled_from([240.0, 1000.0]))
def test_no_report_breaks_a_limit(stretches, seed, extrapolates, rate_hz):
    """Whatever a device reports, position, speed, acceleration and jerk of every joint stay inside the limits.

    The device takes every set-point, so what the driver is given is what the device sees. Judged by backward
    differences, from the first set-point to the last, through trips, faults and recoveries:

    * a device that does not report, in motion, just what its own rule makes of a lost set-point: what the driver is
      given;
    * a device that extrapolates and does is taken at its word, since nothing tells it from one that loses set-points:
      what it claims, which is every set-point, and in the place of each that it claims to have lost the continuation by
      its rule. The continuation itself is not the servo's: with it, limits may be exceeded by 1 %, and by what 0.4 urad
      that are too small to be noticed look like. A correction that the claims do not explain shows as a step.
    """
    chance = random.Random(seed)
    bench = Bench(rate_hz=rate_hz, extrapolates=extrapolates, kinematics=KINEMATICS)
    device = Liar(bench, chance)
    speeds = [0.0] * N
    k = 0
    for kind, lag, size, cycles in stretches:
        for _ in range(cycles):
            if k % 10 == 0:
                if k % 50 == 0:
                    speeds = [chance.uniform(-1.0, 1.0) * v for v in bench.spec.limits.velocity]
                if k % 100 < 50:
                    bench.send(Kind.JOINT_VELOCITY, speeds)
                else:
                    bench.target([x + chance.uniform(-0.1, 0.1) for x in bench.servo.report.q_set])
            if bench.trip and not bench.moving and chance.random() < 0.1:
                bench.servo.recover()
                bench.rearms += 1
            k += 1
            device.say(kind, lag, size)
            assert device.cycle()
    told = peaks_of(bench, device.taken)
    if device.claims and max(told.values()) > 1.0:
        claimed = peaks_of(bench, device.claimed)
        limits, unnoticed = bench.spec.limits, 4e-7
        assert max(claimed["position"], claimed["velocity"]) <= 1.01, claimed
        assert claimed["acceleration"] <= 1.01 + 2.0 * unnoticed / bench.dt**2 / min(limits.acceleration), claimed
        assert claimed["jerk"] <= 1.01 + 4.0 * unnoticed / bench.dt**3 / min(limits.jerk), claimed
    else:
        assert max(told.values()) <= 1.0, told
