"""Torques through everything: the public interface, the host, the servo and the simulated physics."""

from collections.abc import Iterator

import numpy as np
import pytest
from engines_kit import Engine

import hal
from hal import JointTarget, JointTorque, MotionStopped, RobotStatus, Trip

NOTHING = [0.0] * 7
WRIST = [0.0] * 6 + [0.3]


@pytest.fixture
def rig(engine: Engine) -> Iterator[hal.Rig]:
    options = {"clock": "lock_step", "pad": "none", "overrides": ["cameras={}"]}
    with hal.open("panda_table", sim=True, engine=engine.name, **options) as opened:
        yield opened


def drive(rig: hal.Rig, control: hal.Control, tau: list[float], seconds: float) -> list[str]:
    """What ``send`` said."""
    reasons: list[str] = []
    begun = rig.clock.now()
    for _ in rig.clock.rate(100.0):
        reasons += control.send(JointTorque(tau)).reasons
        if rig.clock.now() - begun > seconds:
            return reasons
    raise AssertionError


def test_an_arm_floats_turns_and_is_held_after_the_session(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    start = arm.state().q  # right after the start, when the motors have not carried the arm yet
    with arm.control(rate_hz=100) as control:
        assert drive(rig, control, NOTHING, 1.0) == []
        assert np.abs(arm.state().q - start).max() < 1e-4
        drive(rig, control, WRIST, 0.4)
        state = arm.state()
        assert state.status is RobotStatus.FOLLOWING
        assert state.dq[6] > 0.3
    rest = arm.state()
    assert rest.status is RobotStatus.IDLE
    assert np.abs(rest.dq).max() < 5e-3
    rig.clock.sleep(0.5)
    assert arm.state().q == pytest.approx(rest.q, abs=1e-3)
    peaks = rig.statistics()["simulation"]["robots"]["panda"]["peak"]
    assert max(peaks.values()) <= 1.0
    assert peaks["torque_rate"] > 0.05


def test_a_stop_trips_and_says_why_and_a_motion_goes_on_from_there(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    with arm.control(rate_hz=100) as control:
        drive(rig, control, WRIST, 0.3)
        rig.stop()
        rig.clock.sleep(0.5)
        assert control.trip is Trip.STOP
        with pytest.raises(MotionStopped, match=r"rig\.stop"):
            control.send(JointTorque(NOTHING))
        assert np.abs(arm.state().dq).max() < 5e-3
        control.rearm()
        rig.clock.sleep(0.05)
        target = arm.state().q_set + 0.05
        for _ in zip(range(50), rig.clock.rate(50.0), strict=False):
            control.send(JointTarget(target))
        assert arm.state().q == pytest.approx(target, abs=2e-3)
    arm.move_to(arm.home)


def test_another_kind_of_command_in_between_is_refused_and_that_is_told(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    with arm.control(rate_hz=100) as control:
        drive(rig, control, WRIST, 0.3)
        control.send(JointTarget(arm.state().q))
        rig.clock.sleep(0.02)
        sent = control.send(JointTorque(NOTHING))
        assert any("without a rest in between" in reason for reason in sent.reasons)


def test_commands_that_stop_coming_brake_it(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    with pytest.warns(RuntimeWarning, match="commands stopped"), arm.control(rate_hz=100) as control:
        drive(rig, control, WRIST, 0.3)
        rig.clock.sleep(0.1 + 0.25)
        assert control.trip is Trip.COMMAND_LATE
        assert np.abs(arm.state().dq).max() < 5e-3
