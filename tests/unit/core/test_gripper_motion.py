"""A gripper in an app: motions that are started, asked after and waited for. In lock-step, with the mock."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

import hal
from hal import CommandError, ConnectionLost, GripperOutcome, JointVelocity, MotionStopped, RobotFault, StaleStateError


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock", pad="none", overrides=["cameras={}"]) as opened:
        yield opened


@pytest.fixture
def hand(rig: hal.Rig) -> hal.gripper.Gripper:
    gripper = rig.robots["panda"].gripper
    assert gripper is not None
    return gripper


def test_a_motion_is_asked_after_and_waited_for(rig: hal.Rig, hand: hal.gripper.Gripper) -> None:
    motion = hand.start(0.04)
    assert not motion.done
    rig.clock.sleep(0.1)
    assert hand.state().outcome is GripperOutcome.RUNNING
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


def test_a_motion_that_is_not_over_in_time(hand: hal.gripper.Gripper) -> None:
    motion = hand.start(0.0, speed=0.01)
    with pytest.raises(TimeoutError, match=r"still moving after 0\.5 s"):
        motion.wait(timeout=0.5)
    assert motion.wait()


def test_the_newest_command_wins_and_the_others_are_stopped(hand: hal.gripper.Gripper) -> None:
    first = hand.start(0.0)
    second = hand.start(0.06)
    assert second.wait()
    result = first.wait()
    assert result.outcome is GripperOutcome.STOPPED
    assert not result


def test_a_result_is_not_forgotten_when_the_next_command_comes(rig: hal.Rig, hand: hal.gripper.Gripper) -> None:
    first = hand.start(0.06)
    rig.clock.sleep(1.0)
    second = hand.start(0.0)
    assert second.wait()
    assert first.wait().outcome is GripperOutcome.DONE


def test_a_grasp_says_whether_something_is_held(rig: hal.Rig, hand: hal.gripper.Gripper) -> None:
    assert hand.grasp(0.03) is False
    assert hand.state().outcome is GripperOutcome.MISSED
    hand.open()
    hand.inject(object_width=0.03)
    assert hand.grasp(0.03, force=15.0) is True
    state = hand.state()
    assert (state.grasped, state.force) == (True, 15.0)
    assert state.width_target == pytest.approx(0.03)
    hand.open()
    assert hand.grasp(0.04) is False
    hand.open()
    assert hand.grasp(0.04, inner=0.012) is True
    hand.open()
    assert hand.start_grasp(0.03).wait()
    assert rig.driver("panda.gripper").log[-1] == (0.03, hand.spec.speed, hand.spec.force)


def test_closing_on_something_returns_where_the_fingers_rest(hand: hal.gripper.Gripper) -> None:
    hand.inject(object_width=0.03)
    assert hand.grip(1.0).width == pytest.approx(0.03)
    result = hand.start(0.0).wait()
    assert result.outcome is GripperOutcome.MISSED


def test_homing(rig: hal.Rig, hand: hal.gripper.Gripper) -> None:
    hand.move(0.02)
    assert hand.home().width == pytest.approx(hand.width_max)
    assert rig.driver("panda.gripper").homed == 1


def test_a_failure_is_raised_with_its_remedy_and_told_to_who_waits(hand: hal.gripper.Gripper) -> None:
    hand.inject(fail="the motor is too hot")
    for call in (hand.open, hand.home, lambda: hand.grasp(0.02), lambda: hand.move(0.01)):
        with pytest.raises(RobotFault) as caught:
            call()
        assert caught.value.cause == "the motor is too hot"
        assert caught.value.remedy
    result = hand.start(0.02).wait()
    assert result.outcome is GripperOutcome.FAILED
    assert result.fault is not None
    assert result.fault.cause == "the motor is too hot"
    assert "the motor is too hot" in hand.trouble
    hand.inject(fail=None)
    assert hand.start(0.02).wait()
    assert (hand.trouble, hand.state().fault) == ("", None)


def test_a_command_that_the_device_does_not_take_fails(hand: hal.gripper.Gripper) -> None:
    hand.inject(disconnect=True)
    with pytest.raises(RobotFault, match=r"does not answer .*; check that it is on and connected"):
        hand.move(0.02)


def test_a_device_that_goes_while_somebody_waits(rig: hal.Rig, hand: hal.gripper.Gripper) -> None:
    motion = hand.start(0.0, speed=0.01)
    rig.clock.sleep(0.1)
    hand.inject(disconnect=True)
    with pytest.raises(ConnectionLost, match="has not answered for"):
        motion.wait()
    with pytest.raises(ConnectionLost, match="does not answer"):
        _ = motion.done
    assert "does not answer" in hand.trouble
    hand.inject(disconnect=False)
    assert motion.wait()


def test_a_gripper_that_repeats_itself_is_silent(hand: hal.gripper.Gripper) -> None:
    hand.inject(freeze=True)
    with pytest.raises(StaleStateError, match="has been silent for"):
        hand.move(0.02)
    assert hand.state(max_age=10.0).outcome is GripperOutcome.RUNNING


@pytest.mark.parametrize("how", ["gripper.stop", "rig.stop"])
def test_a_stop_ends_a_motion(rig: hal.Rig, hand: hal.gripper.Gripper, how: str) -> None:
    motion = hand.start(0.0)
    rig.clock.sleep(0.2)
    if how == "rig.stop":
        rig.stop()
    else:
        hand.stop()
    at = hand.state().width
    result = motion.wait()
    assert result.outcome is GripperOutcome.STOPPED
    rig.clock.sleep(0.5)
    assert hand.state().width == pytest.approx(at, abs=2e-3)
    if how == "rig.stop":
        with pytest.raises(MotionStopped, match="rig.rearm"):
            hand.start_home()
        rig.rearm()
    assert hand.move(0.0).width == pytest.approx(0.0, abs=1e-6)


@pytest.mark.parametrize("how", ["gripper.stop", "rig.stop"])
def test_a_stop_overtakes_a_command_that_nobody_took_yet(rig: hal.Rig, hand: hal.gripper.Gripper, how: str) -> None:
    motion = hand.start(0.0)
    if how == "rig.stop":
        rig.stop()
    else:
        hand.stop()
    assert motion.wait().outcome is GripperOutcome.STOPPED
    rig.clock.sleep(0.5)
    assert hand.state().width == pytest.approx(hand.width_max)


def test_a_helper_whose_motion_is_stopped_says_so(rig: hal.Rig, hand: hal.gripper.Gripper) -> None:
    calls = 0

    def stop_soon(now: float) -> None:
        nonlocal calls
        calls += 1
        if calls == 20:
            hand.stop()
        elif calls == 200:
            rig.stop()

    rig._hosts[0].pollers.append(stop_soon)  # type: ignore[attr-defined]
    with pytest.raises(MotionStopped, match="was stopped, or got a newer command"):
        hand.move(0.0)
    with pytest.raises(MotionStopped, match=r"rig\.stop\(\) was called; .*rearm"):
        hand.move(0.0, speed=0.01)


def test_a_grip_that_is_sent_while_a_stop_is_latched_moves_nothing(rig: hal.Rig, hand: hal.gripper.Gripper) -> None:
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
    assert hand.state().width == pytest.approx(hand.width_max)


def test_numbers_that_cannot_be_are_refused(hand: hal.gripper.Gripper) -> None:
    for bad in (-0.001, float("nan"), float("inf")):
        with pytest.raises(CommandError, match="inner must be"):
            hand.start_grasp(0.03, inner=bad)
        with pytest.raises(CommandError, match="outer must be"):
            hand.grasp(0.03, outer=bad)
    for wrong in ({"width": 0.09}, {"width": 0.03, "force": 0.0}, {"width": 0.03, "speed": 9.0}):
        with pytest.raises(CommandError):
            hand.start_grasp(**wrong)
    assert hand.state().target_seq == 0
