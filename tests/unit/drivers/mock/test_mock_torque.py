"""The mock arm driven by torques, as wheels with friction."""

from __future__ import annotations

from math import exp

import numpy as np
import pytest

from hal.driver import Setpoint
from hal.drivers.mock.robot import FRICTION, INERTIA, KEEP_UP, MockRobot
from hal.specs import RobotSpec

HERE = (0.1, -0.2, 0.3)  # robot_spec.initial
ZERO = (0.0, 0.0, 0.0)
DT = 1e-3


@pytest.fixture
def arm(robot_spec: RobotSpec) -> MockRobot:
    arm = MockRobot(robot_spec)
    arm.open()
    arm.read(0.0)
    return arm


def drive(arm: MockRobot, tau: tuple[float, ...], ticks: int, start: int = 0) -> None:
    for k in range(start, start + ticks):
        reading = arm.read(k * DT)
        arm.write(Setpoint(reading.q, reading.dq, ZERO, tau))


def test_torque_turns_a_wheel_with_friction(arm: MockRobot) -> None:
    drive(arm, (2.0, 0.0, -1.0), 500)
    reading = arm.read(0.5)
    rate = FRICTION / INERTIA
    speed = 2.0 / FRICTION * (1.0 - exp(-0.5 * rate))
    assert reading.dq == pytest.approx((speed, 0.0, -0.5 * speed), rel=2e-3)
    way = 2.0 / FRICTION * (0.5 - (1.0 - exp(-0.5 * rate)) / rate)
    assert np.subtract(reading.q, HERE) == pytest.approx((way, 0.0, -0.5 * way), rel=5e-3)


def test_first_step_is_that_of_the_inertia(arm: MockRobot) -> None:
    drive(arm, (2.0, 0.0, 0.0), 1)
    momentum = np.array(arm.mass_matrix(HERE)) @ arm.read(DT).dq
    assert momentum == pytest.approx((2.0 * DT, 0.0, 0.0), rel=2e-3)


def test_arm_stops_when_torques_stop_coming(arm: MockRobot) -> None:
    drive(arm, (2.0, 0.0, 0.0), 100)
    speeds = [arm.read((100 + k) * DT).dq[0] for k in range(60)]
    kept_up = round(KEEP_UP / DT)
    assert all(speed > 0.0 for speed in speeds[: kept_up - 1])
    assert speeds[kept_up - 1] > speeds[0]
    assert speeds[kept_up + 3 :] == [0.0] * (60 - kept_up - 3)
    assert arm.read(0.2).q == arm.read(0.3).q


def test_dropped_torque_repeats_the_one_before(arm: MockRobot) -> None:
    drive(arm, (2.0, 0.0, 0.0), 100)
    arm.inject(drop=1)
    drive(arm, (-50.0, 0.0, 0.0), 5, start=100)
    assert 0.0 < arm.read(105 * DT).dq[0] < 0.25


@pytest.mark.parametrize("how", ["halt", "fault", "position"])
def test_arm_stays_where_torques_end(arm: MockRobot, how: str) -> None:
    drive(arm, (2.0, 0.0, 0.0), 100)
    q = arm.read(0.1).q
    if how == "halt":
        arm.halt()
    elif how == "fault":
        arm.inject(fault="too hot")
    else:
        arm.write(Setpoint(q, ZERO, ZERO))
    for k in range(1, 5):
        reading = arm.read(0.1 + k * DT)
    assert reading.q == pytest.approx(q, abs=1e-3)
    assert reading.dq == ZERO
