"""Set-points that the device did not take: the servo goes on from what the device says, inside the limits."""

from __future__ import annotations

import random
from typing import Any

import pytest
from servo_kit import STILL, Bench, N

from hal.servo.audit import SetpointAudit
from hal.types import Fault, Limited, RobotStatus


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
        assert setpoint is not None
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


@pytest.mark.parametrize("kind", ["repeats", "extrapolates"])
@pytest.mark.parametrize("loss", [0.0, 0.05])
@pytest.mark.parametrize("ahead", [False, True], ids=["at once", "computed ahead"])
def test_a_device_that_misses_set_points(kind: str, loss: float, ahead: bool) -> None:
    bench = Bench(rate_hz=1000.0)
    bench.prepares = ahead
    device = Device(bench, kind)
    rng = random.Random(4)
    target = list(bench.q)
    speeds = [0.0] * N
    lost = False
    for k in range(3000):
        if k % 20 == 0:
            if k % 400 == 0:
                speeds = [rng.uniform(-0.5, 0.5) for _ in range(N)]
            target = [x + 20 * bench.dt * v for x, v in zip(target, speeds, strict=True)]
            bench.target(target, speeds)
        lost = not lost and rng.random() < loss  # single losses, so that each is recovered from
        device.cycle(take=not lost)
    assert (device.missed > 50) is (loss > 0.0)
    assert bool(bench.limited & Limited.REANCHORED) is (loss > 0.0)
    assert bench.status is RobotStatus.FOLLOWING
    audit = SetpointAudit(bench.spec.limits, bench.dt)
    for q in device.history:
        audit.add(q)
    peaks = audit.peaks()
    assert peaks["velocity"] > 0.1
    assert max(peaks.values()) <= 1.0, peaks


def test_an_arm_that_a_fault_stopped_is_taken_from_where_it_stands() -> None:
    bench = Bench()
    bench.reading = {"q_commanded": list(bench.q), "dq_commanded": list(STILL)}
    for k in range(60):
        if k % 5 == 0:
            bench.target([x + 0.09 for x in bench.q])
        setpoint = bench.tick()
        assert setpoint is not None
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


def test_an_arm_that_was_away_is_taken_from_where_it_is() -> None:
    bench = Bench()
    bench.drive()
    for _ in range(100):
        bench.lose()
    found = [x + 0.3 for x in bench.q]
    bench.reading = {"q": found}
    bench.tick()
    assert bench.servo.report.q_set == pytest.approx(found)
    assert bench.limited & Limited.REANCHORED


def test_an_old_reading_says_nothing_about_the_last_set_point() -> None:
    bench = Bench()
    bench.reading = {"q_commanded": list(bench.q), "dq_commanded": list(STILL), "seq": 7}
    bench.drive(0.1)
    assert not bench.limited & Limited.REANCHORED
    assert bench.moving
