"""Where the guard of an arm takes the arms of other processes to be, and where they end if they stop."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from servo_kit import Bench
from specs import panda

from hal.commands import NO_INBOX, Session
from hal.dynamics import Dynamics
from hal.host.guards import ArmElsewhere
from hal.host.records import ServoRecord
from hal.servo.controllers import JointImpedance, controller_data, resolve
from hal.servo.servo import Servo
from hal.servo.smoothing import stop_distance
from hal.types import ControlMode, Limited, RobotStatus, Trip

SPEC = panda()
SET = np.array(SPEC.home)
MEASURED = SET - 0.01
SPEED = np.array([0.4, -0.3, 0.0, 0.2, 0.5, -0.4, 0.3])


def elsewhere(status: RobotStatus, controller: ControlMode, session: int = 1) -> tuple[Any, Any]:
    """Return what is taken of an arm whose set-point moves at ``SPEED``."""
    record = ServoRecord(
        status, Trip.NONE, Limited.NONE, 1, session, False, 0, 0.0, 0.0, SET.tolist(), SPEED.tolist(), controller
    )
    mail: Any = SimpleNamespace(peek=lambda: record, get_state=lambda: SimpleNamespace(q=MEASURED))
    q, end = ArmElsewhere(SPEC, mail)()
    return np.array(q), np.array(end)


def stop(jerk: Any) -> Any:
    limits = zip(SPEED, SPEC.limits.acceleration, jerk, strict=True)
    return SET + [np.copysign(stop_distance(abs(v), A, J), v) for v, A, J in limits]


def test_an_arm_that_follows_positions_is_at_its_set_point_and_may_stop_on_a_path() -> None:
    share = float(np.abs(SPEED / SPEC.limits.velocity).max())
    bench = Bench(SPEC, rate_hz=1000.0, speed=share, move_to=(SET + 1.5 * SPEED).tolist())
    bench.run(0.7)
    here, foretold = np.array(bench.q), bench.servo.stop_end()
    bench.stops += 1
    bench.until_rest(0.5)
    assert bench.q == pytest.approx(foretold, abs=1e-6)
    q, end = elsewhere(RobotStatus.FOLLOWING, ControlMode.POSITION)
    assert np.array_equal(q, SET)
    assert end - 0.004 * SPEED - SET == pytest.approx(bench.q - here, abs=1e-5)
    assert (np.abs(end - SET) >= np.abs(stop(SPEC.limits.jerk) - SET) + 0.004 * np.abs(SPEED) - 1e-9).all()


@pytest.mark.parametrize("at", [SET, SET + [0.0, 1.2, 0.0, 0.8, 0.0, 0.0, 0.0]])  # the second one: stretched out
def test_an_arm_with_a_controller_is_where_it_is_measured_and_stops_as_softly_as_its_set_point(at: Any) -> None:
    q, end = elsewhere(RobotStatus.FOLLOWING, ControlMode.JOINT_IMPEDANCE)
    assert np.array_equal(q, MEASURED)
    servo = Servo(SPEC, 1e-3, mass_matrix=Dynamics.of(SPEC).mass_matrix)
    servo.anchor(at.tolist())
    controller = resolve(JointImpedance(), SPEC, servo.kinematics, 1000.0)
    servo.open_session(Session(1, 0.3, 0.25, False, controller=controller_data(controller)), NO_INBOX)
    soft = stop(servo.smoother.jerk) - SET
    assert (np.abs(soft) > 2.0 * np.abs(stop(SPEC.limits.jerk) - SET)).any()
    assert (np.abs(end - SET) >= np.abs(soft) - 1e-6).all()


def test_an_arm_that_may_be_moved_by_hand_is_where_it_is_measured() -> None:
    for status in (RobotStatus.IDLE, RobotStatus.FAULT):
        for got in elsewhere(status, ControlMode.POSITION, 0):
            assert np.array_equal(got, MEASURED)


@pytest.mark.parametrize("status", [RobotStatus.LOST, RobotStatus.FAULT])
def test_an_arm_that_was_lost_on_its_way_still_stops(status: RobotStatus) -> None:
    q, end = elsewhere(status, ControlMode.POSITION)
    assert np.array_equal(q, MEASURED)
    assert np.array_equal(end, elsewhere(RobotStatus.FOLLOWING, ControlMode.POSITION)[1])


def test_an_arm_that_follows_torques_stops_in_the_way_of_a_tenth_of_a_second() -> None:
    q, end = elsewhere(RobotStatus.FOLLOWING, ControlMode.TORQUE)
    assert np.array_equal(q, SET)  # where it was measured
    assert end == pytest.approx(SET + 0.1 * SPEED)
