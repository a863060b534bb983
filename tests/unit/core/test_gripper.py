"""A gripper: motions that run in the background or block, and grips out of a session. In lock-step, with the mock."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal import CommandError, ConnectionLost, GripperOutcome, JointVelocity, MotionStopped, RobotFault, StaleStateError


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock", pad="none", overrides=["cameras={}"]) as opened:
        yield opened


@pytest.fixture
def gripper(rig: hal.Rig) -> hal.Gripper:
    found = rig.robots["panda"].gripper
    assert found is not None
    return found


def test_a_motion_runs_in_the_background_until_it_is_waited_for(rig: hal.Rig, gripper: hal.Gripper) -> None:
    motion = gripper.start(0.04)
    assert not motion.done
    rig.clock.sleep(0.1)
    assert gripper.state().outcome is GripperOutcome.RUNNING
    assert not motion.done
    before = rig.clock.now()
    result = motion.wait()
    assert rig.clock.now() > before
    assert result
    assert (result.outcome, result.fault) == (GripperOutcome.DONE, None)
    assert result.state.width == pytest.approx(0.04, abs=1e-6)
    assert motion.done
    assert motion.wait(timeout=0.0) is result, "it costs no more time"
    with pytest.raises(AttributeError):
        result.outcome = GripperOutcome.MISSED  # type: ignore[misc]


def test_a_motion_that_is_not_over_in_time_continues(gripper: hal.Gripper) -> None:
    motion = gripper.start(0.0, speed=0.01)
    with pytest.raises(TimeoutError):
        motion.wait(timeout=0.5)
    assert motion.wait()


def test_a_newer_command_stops_the_one_before(gripper: hal.Gripper) -> None:
    first = gripper.start(0.0)
    second = gripper.start(0.06)
    assert second.wait()
    result = first.wait()
    assert result.outcome is GripperOutcome.STOPPED
    assert not result


def test_a_result_survives_the_next_command(rig: hal.Rig, gripper: hal.Gripper) -> None:
    first = gripper.start(0.06)
    rig.clock.sleep(1.0)
    second = gripper.start(0.0)
    assert second.wait()
    assert first.wait().outcome is GripperOutcome.DONE


def test_a_grasp_returns_whether_an_object_is_held(rig: hal.Rig, gripper: hal.Gripper) -> None:
    assert gripper.grasp(0.03) is False
    assert gripper.state().outcome is GripperOutcome.MISSED
    gripper.open()
    gripper.inject(object_width=0.03)
    assert gripper.grasp(0.03, force=15.0) is True
    state = gripper.state()
    assert (state.grasped, state.force) == (True, 15.0)
    assert (state.width_target, state.force_target) == (0.0, 15.0)
    gripper.open()
    assert gripper.grasp(0.04) is False
    gripper.open()
    assert gripper.grasp(0.04, inner=0.012) is True
    gripper.open()
    assert gripper.start_grasp(0.03).wait()
    assert rig.driver("panda.gripper").log[-1] == (0.03, gripper.spec.speed, gripper.spec.force)


def test_closing_on_an_object_returns_its_width(gripper: hal.Gripper) -> None:
    gripper.inject(object_width=0.03)
    assert gripper.grip(1.0).width == pytest.approx(0.03)
    result = gripper.start(0.0).wait()
    assert result.outcome is GripperOutcome.MISSED


def test_homing(rig: hal.Rig, gripper: hal.Gripper) -> None:
    gripper.move(0.02)
    assert gripper.home().width == pytest.approx(gripper.width_max)
    assert rig.driver("panda.gripper").homed == 1


def test_a_failure_is_raised_with_its_remedy_and_ends_the_motion(gripper: hal.Gripper) -> None:
    gripper.inject(fail="the motor is too hot")
    for call in (gripper.open, gripper.home, lambda: gripper.grasp(0.02), lambda: gripper.move(0.01)):
        with pytest.raises(RobotFault) as caught:
            call()
        assert caught.value.cause == "the motor is too hot"
        assert caught.value.remedy
    result = gripper.start(0.02).wait()
    assert result.outcome is GripperOutcome.FAILED
    assert result.fault is not None
    assert result.fault.cause == "the motor is too hot"
    assert "the motor is too hot" in gripper.trouble
    gripper.inject(fail=None)
    assert gripper.start(0.02).wait()
    assert (gripper.trouble, gripper.state().fault) == ("", None)


def test_a_command_that_the_device_does_not_take_fails(gripper: hal.Gripper) -> None:
    gripper.inject(disconnect=True)
    with pytest.raises(RobotFault) as caught:
        gripper.move(0.02)
    assert caught.value.remedy


def test_a_device_that_disconnects_during_a_motion(rig: hal.Rig, gripper: hal.Gripper) -> None:
    motion = gripper.start(0.0, speed=0.01)
    rig.clock.sleep(0.1)
    gripper.inject(disconnect=True)
    with pytest.raises(ConnectionLost):
        motion.wait()
    with pytest.raises(ConnectionLost):
        _ = motion.done
    assert gripper.trouble
    gripper.inject(disconnect=False)
    assert motion.wait()


def test_a_gripper_without_new_states_is_stale(gripper: hal.Gripper) -> None:
    gripper.inject(freeze=True)
    with pytest.raises(StaleStateError):
        gripper.move(0.02)
    assert gripper.state(max_age=10.0).outcome is GripperOutcome.RUNNING


@pytest.mark.parametrize("how", ["gripper.stop", "rig.stop"])
def test_a_stop_ends_a_motion(rig: hal.Rig, gripper: hal.Gripper, how: str) -> None:
    motion = gripper.start(0.0)
    rig.clock.sleep(0.2)
    if how == "rig.stop":
        rig.stop()
    else:
        gripper.stop()
    at = gripper.state().width
    result = motion.wait()
    assert result.outcome is GripperOutcome.STOPPED
    rig.clock.sleep(0.5)
    assert gripper.state().width == pytest.approx(at, abs=2e-3)
    if how == "rig.stop":
        with raises_code(MotionStopped, "rig_stop"):
            gripper.start_home()
        rig.rearm()
    assert gripper.move(0.0).width == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("how", ["gripper.stop", "rig.stop"])
def test_a_stop_overtakes_a_command_that_was_not_taken_yet(rig: hal.Rig, gripper: hal.Gripper, how: str) -> None:
    motion = gripper.start(0.0)
    if how == "rig.stop":
        rig.stop()
    else:
        gripper.stop()
    assert motion.wait().outcome is GripperOutcome.STOPPED
    rig.clock.sleep(0.5)
    assert gripper.state().width == pytest.approx(gripper.width_max)


def test_a_blocking_motion_that_is_stopped_raises(rig: hal.Rig, gripper: hal.Gripper) -> None:
    calls = 0

    def stop_soon(now: float) -> None:
        nonlocal calls
        calls += 1
        if calls == 20:
            gripper.stop()
        elif calls == 200:
            rig.stop()

    rig._hosts[0].pollers.append(stop_soon)  # type: ignore[attr-defined]
    with raises_code(MotionStopped, "gripper_stopped"):
        gripper.move(0.0)
    with raises_code(MotionStopped, "rig_stop"):
        gripper.move(0.0, speed=0.01)


def test_a_grip_that_is_sent_while_a_stop_is_latched_moves_nothing(rig: hal.Rig, gripper: hal.Gripper) -> None:
    arm = rig.robots["panda"]
    with arm.control() as control:
        control.send(JointVelocity([0.0] * 7))
        rig.clock.sleep(0.02)
        rig.stop()
        control.send(JointVelocity([0.0] * 7), grip=1.0)  # the arm's servo has not seen the stop yet
        rig.clock.sleep(0.02)
        with pytest.raises(MotionStopped):
            control.send(JointVelocity([0.0] * 7), grip=1.0)
    rig.clock.sleep(0.5)
    assert gripper.state().width == pytest.approx(gripper.width_max)


def test_impossible_numbers_are_refused(gripper: hal.Gripper) -> None:
    for bad in (-0.001, float("nan"), float("inf")):
        with pytest.raises(CommandError):
            gripper.start_grasp(0.03, inner=bad)
        with pytest.raises(CommandError):
            gripper.grasp(0.03, outer=bad)
    for wrong in ({"width": 0.09}, {"width": 0.03, "force": 0.0}, {"width": 0.03, "speed": 9.0}):
        with pytest.raises(CommandError):
            gripper.start_grasp(**wrong)
    assert gripper.state().target_seq == 0


def test_widths_in_metres_and_grips_as_fractions(gripper: hal.Gripper) -> None:
    assert gripper.move(0.04).width == pytest.approx(0.04, abs=1e-4)
    assert gripper.grip(1.0).width == pytest.approx(0.0, abs=1e-4)
    assert gripper.open().width == pytest.approx(gripper.width_max, abs=1e-4)
    with pytest.raises(AttributeError, match=r"use grip\(1\.0\)"):
        gripper.close()  # type: ignore[attr-defined]


# Grips out of a control session

REST = JointVelocity([0.0] * 7)


def send(rig: hal.Rig, count: int = 60, **grip: Any) -> None:
    """Send a grip at 50 Hz in a session of its own."""
    with rig.robots["panda"].control() as control:
        for _, _ in zip(rig.clock.rate(50), range(count), strict=False):
            control.send(REST, **grip)


@pytest.mark.parametrize(
    ("passed", "expected"),
    [({"grip": 0.0}, 0.08), ({"grip": 1}, 0.0), ({"width": 0.0}, 0.0), ({"width": np.float32(0.02)}, 0.02)],
)
def test_a_grip_or_a_width_is_sent_with_a_command(
    rig: hal.Rig, gripper: hal.Gripper, passed: dict[str, float], expected: float
) -> None:
    gripper.grip(0.5)
    send(rig, **passed)
    assert gripper.state().width_target == pytest.approx(expected, abs=1e-6)


def test_a_grip_counts_again_once_another_command_moved_the_fingers(rig: hal.Rig, gripper: hal.Gripper) -> None:
    with rig.robots["panda"].control() as control:
        for opens in (False, True):
            if opens:
                gripper.start(gripper.width_max)
            for _, _ in zip(rig.clock.rate(50), range(60), strict=False):
                control.send(REST, grip=1.0)
            assert gripper.state().width == pytest.approx(gripper.width_min, abs=1e-6)


@pytest.mark.parametrize(
    "passed",
    [
        {"grip": 0.5, "width": 0.02},
        {"width": 0.09},
        {"width": -0.01},
        {"width": float("nan")},
        {"width": 40},
        {"width": 10**400},
        {"grip": "closed"},
        {"grip": [0.1, 0.2]},
        {"grip": np.array([0.5])},
        {"grip": True},
        {"grip": 10**400},
        {"grip": float("nan")},
        {"grip": -0.1},
        {"grip": 1.1},
    ],
)
def test_an_impossible_grip_sends_nothing_to_the_arm_either(
    rig: hal.Rig, gripper: hal.Gripper, passed: dict[str, float]
) -> None:
    arm = rig.robots["panda"]
    with arm.control() as control:
        for _ in range(3):
            with raises_code(CommandError, "bad_command"):
                control.send(hal.Twist([0.1, 0.0, 0.0]), **passed)
            rig.clock.sleep(0.02)
        assert not arm.state().dq_set.any()
        assert arm.state().target_seq == 0
    assert gripper.state().target_seq == 0
