"""Control sessions through the public interface, on the built-in rig with mock devices in lock-step."""

import itertools
import warnings
from collections.abc import Callable, Iterator
from dataclasses import replace

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal import (
    CommandError,
    ConnectionLost,
    ControlTaken,
    JointTarget,
    JointVelocity,
    MotionStopped,
    NotSupported,
    RobotFault,
    RobotStatus,
    Trip,
    Twist,
)
from hal.deadman import Deadman
from hal.drivers.mock.faults import FIELDS
from hal.drivers.mock.robot import MockRobot
from hal.servo.audit import SetpointAudit

TURN = JointVelocity([0.2, 0, 0, 0, 0, 0, 0])


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock") as opened:
        yield opened


@pytest.fixture
def arm(rig: hal.Rig) -> hal.Robot:
    return rig.robots["panda"]


def turns(rig: hal.Rig, count: int) -> Iterator[int]:
    for k, _ in enumerate(itertools.islice(rig.clock.rate(50.0), count)):
        yield k


def drive(rig: hal.Rig, control: hal.Control, command: hal.Command = TURN, count: int = 20) -> list[hal.Sent]:
    """Send one command again and again at 50 Hz."""
    return [control.send(command) for _ in turns(rig, count)]


def press(rig: hal.Rig) -> None:
    rig.driver("pad").press("l2")
    rig.clock.sleep(0.05)


def release(rig: hal.Rig) -> None:
    rig.driver("pad").release("l2")
    rig.clock.sleep(0.05)


def audit(rig: hal.Rig, arm: hal.Robot) -> dict[str, float]:
    """Return the peaks of all set-points written so far, as shares of the limits."""
    found = SetpointAudit(arm.limits, 1.0 / arm.spec.rate_hz)
    for setpoint in rig.driver("panda").log:
        found.add(setpoint.q)
    return found.peaks()


# Commands


def test_an_arm_follows_targets_and_rests_after_the_session(rig: hal.Rig, arm: hal.Robot) -> None:
    start = arm.state().q
    with arm.control(rate_hz=50) as control:
        for k in turns(rig, 60):
            control.send(JointTarget(start + 0.1 * np.sin(0.05 * k)))
        assert control.status is RobotStatus.FOLLOWING
        assert np.abs(arm.state().q - start).max() > 0.03
    state = arm.state()
    assert state.status is RobotStatus.IDLE
    assert np.abs(state.dq_set).max() == 0.0
    assert state.q == pytest.approx(state.q_set)


def test_every_setpoint_of_a_jump_keeps_the_limits(rig: hal.Rig, arm: hal.Robot) -> None:
    start = arm.state().q
    with arm.control() as control:
        for k in turns(rig, 200):
            control.send(JointTarget(start + (1.5 if k > 5 else 0.0) * np.array([1, 0, 0, 0, 0, 0, 0])))
        assert arm.state().q[0] == pytest.approx(start[0] + 1.5, abs=2e-3)
    peaks = audit(rig, arm)
    assert 0.2 < peaks["velocity"] <= arm.spec.speed + 1e-6
    assert max(peaks.values()) <= 1.0 + 1e-6


def test_targets_and_torques_are_cut_to_the_limits_with_a_reason(rig: hal.Rig, arm: hal.Robot) -> None:
    start = arm.state().q
    with arm.control() as control:
        assert control.send(JointTarget(start)).reasons == ()
        rig.clock.sleep(0.02)
        beyond = start.copy()
        beyond[3] = 5.0
        sent = control.send(JointTarget(beyond))
        assert sent.command.q[3] == arm.limits.upper[3]
        assert sent.reasons == (f"position limit of {arm.joints[3]}",)
    with arm.control() as control:
        sent = control.send(hal.JointTorque([100.0, 0.0, 0.0, 0.0, 0.0, 0.0, -13.0]))
        assert sent.command.tau.tolist() == [87.0, 0.0, 0.0, 0.0, 0.0, 0.0, -12.0]
        assert sent.reasons == (f"torque limit of {arm.joints[0]}, {arm.joints[6]}",)


def test_a_grip_that_was_sent_before_the_press_moves_nothing_after_it(rig: hal.Rig, arm: hal.Robot) -> None:
    assert arm.gripper is not None
    with arm.control(deadman=rig.gamepads["pad"].hold("l2")) as control:
        rig.clock.sleep(0.05)
        assert control.send(None, grip=1.0).reasons
        press(rig)
        rig.clock.sleep(0.3)
        assert arm.gripper.state().width == pytest.approx(arm.gripper.width_max)
        assert not control.send(None, grip=1.0).reasons
        rig.clock.sleep(0.3)
    assert arm.gripper.state().width < 0.9 * arm.gripper.width_max


def test_the_dead_man_of_an_earlier_session_does_not_guard_the_next_one(rig: hal.Rig, arm: hal.Robot) -> None:
    first, second = Deadman("first"), Deadman("second")
    for switch in (first, second):
        switch.update(False, True, rig.clock.now())
    for guard, moves in ((first, True), (second, False)):
        with arm.control(deadman=guard) as control:
            first.update(False, True, rig.clock.now())
            rig.clock.sleep(0.02)
            first.update(True, True, rig.clock.now())
            rig.clock.sleep(0.02)
            control.send(TURN)
            rig.clock.sleep(0.02)
            assert (arm.state().status is RobotStatus.FOLLOWING) is moves


def test_the_first_target_of_a_chunk_is_the_one_that_is_due(rig: hal.Rig, arm: hal.Robot) -> None:
    now, way = rig.clock.now(), np.array([0.0] * 6 + [0.3])
    with arm.control() as control:
        control.send(hal.JointChunk([now - 1.0, now + 1.0], [arm.home - way, arm.home + way]))  # home, now
    with arm.control() as control, raises_code(CommandError, "first_step_too_far"):
        control.send(hal.JointChunk([now - 1.0, now + 1.0], [arm.home + way, arm.home + way]))


def test_limits_of_the_servo_are_among_the_reasons(rig: hal.Rig, arm: hal.Robot) -> None:
    with arm.control() as control:
        assert "tcp speed" in str(drive(rig, control, Twist([0, 0, 50.0]), 5)[-1].reasons)


@pytest.mark.parametrize(
    ("make", "code"),
    [
        (lambda: JointTarget([0.0] * 6), "wrong_joint_count"),
        (lambda: JointVelocity([0.0] * 8), "wrong_joint_count"),
        (lambda: hal.JointTorque([0.0] * 6), "wrong_joint_count"),
        (lambda: JointTarget([float("nan")] * 7), "bad_command"),
        (lambda: hal.JointTorque([float("inf")] * 7), "bad_command"),
        (lambda: Twist([0.1, 0.0]), "bad_command"),
        (lambda: Twist([0.1, 0.0, float("inf")]), "bad_command"),
        (lambda: hal.JointChunk([-2.0, -1.0], [[0.0] * 7] * 2), "chunk_in_the_past"),
        (lambda: hal.JointChunk([1.0, 4.0], [[0.0] * 7] * 2), "chunk_too_long"),
        (lambda: "up", "not_a_command"),
        (lambda: hal.Pose([0.4, 0.0, 0.4]), "not_a_command"),
    ],
)
def test_a_malformed_command_is_refused_and_nothing_moves(
    rig: hal.Rig, arm: hal.Robot, make: Callable[[], hal.Command], code: str
) -> None:
    with arm.control() as control:
        with raises_code(CommandError, code):
            control.send(make())
        rig.clock.sleep(0.1)
    assert np.array_equal(arm.state().q, arm.home)


def test_torques_need_a_driver_and_a_model_that_take_them(arm: hal.Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    torque = hal.JointTorque([0.0] * 7)
    with monkeypatch.context() as patch, arm.control() as control:
        patch.setattr(MockRobot, "modes", frozenset({"position"}))
        with raises_code(NotSupported, "no_torque_mode"):
            control.send(torque)
    arm.spec = replace(arm.spec, limits=replace(arm.spec.limits, torque=None))
    with arm.control() as control, raises_code(NotSupported, "no_torque_limits"):
        control.send(torque)


def test_a_pose_beyond_reach_is_refused_in_mid_session_too(rig: hal.Rig, arm: hal.Robot) -> None:
    pose = arm.state().tcp
    with arm.control() as control:
        drive(rig, control, hal.CartesianTarget(pose), 5)
        with raises_code(hal.Unreachable, "unreachable"):
            control.send(hal.CartesianTarget(hal.Pose(pose.position * 1000.0, pose.orientation)))  # mm


@pytest.mark.parametrize("rate_hz", [50, 1000])
def test_commands_that_the_servo_refuses_do_not_keep_the_arm_moving(
    rig: hal.Rig, arm: hal.Robot, rate_hz: float
) -> None:
    """Not even where a new one is there in every tick. The deadline is that of the last one that was followed."""
    with arm.control(rate_hz=50) as control:
        drive(rig, control, count=20)
        last = rig.clock.now()
        with pytest.raises(MotionStopped, match="refused newer ones: a first target too far away") as stop:
            for tick in rig.clock.rate(rate_hz):
                control.send(JointTarget(arm.home + 0.5))
                assert tick.t - last < 0.2
        assert stop.value.code == "command_deadline"


def test_a_loop_in_which_no_time_passes_is_an_error(rig: hal.Rig, arm: hal.Robot) -> None:
    with arm.control(rate_hz=50) as control:
        drive(rig, control, count=150)
        with raises_code(CommandError, "no_time_passed"):
            for _ in range(150):
                control.send(TURN)


# Stops


@pytest.mark.parametrize("field", FIELDS)
@pytest.mark.parametrize("garbage", ["nan", "inf"])
def test_impossible_values_from_an_arm_trip(rig: hal.Rig, arm: hal.Robot, garbage: str, field: str) -> None:
    with pytest.warns(RuntimeWarning, match="impossible"), arm.control() as control:
        drive(rig, control, count=10)
        arm.inject(garbage=garbage, garbage_in=field)
        rig.clock.sleep(0.3)
        assert control.trip is Trip.BAD_READING
        state = arm.state(max_age=1.0)
        values = [state.q, state.dq, state.tau, state.tau_ext, state.wrench_ext, state.q_set]
        assert all(np.isfinite(value).all() for value in values if value is not None)
        arm.inject(garbage=None)


def test_a_device_that_takes_no_setpoints_is_lost_and_does_not_leap(rig: hal.Rig, arm: hal.Robot) -> None:
    driver = rig.driver("panda")
    write, broken = driver.write, []

    def failing(setpoint: object) -> None:
        if broken:
            raise OSError("cable")
        write(setpoint)

    driver.write = failing
    with arm.control() as control:
        drive(rig, control)
        broken.append(True)
        rig.clock.sleep(0.06)
        with pytest.raises(ConnectionLost):
            arm.state()
        broken.clear()
        rig.clock.sleep(0.3)
        assert control.trip is Trip.DEVICE_LOST
        with raises_code(MotionStopped, "device_lost"):
            control.send(TURN)
    assert audit(rig, arm)["velocity"] <= 1.0


def test_what_was_not_written_to_a_lost_arm_is_no_peak(rig: hal.Rig, arm: hal.Robot) -> None:
    with arm.control() as control:
        drive(rig, control)
        arm.inject(disconnect=True)
        rig.clock.sleep(0.06)
        arm.inject(disconnect=False)
        rig.clock.sleep(0.3)
        control.rearm()
        drive(rig, control)
        peak = next(iter(rig.statistics().values()))["robots"]["panda"]["peak"]
    assert all(0.0 < share <= 1.0 for share in peak.values()), peak


def test_a_recovered_arm_continues_at_once(rig: hal.Rig, arm: hal.Robot) -> None:
    with arm.control() as control:
        arm.inject(fault="too hot")
        rig.clock.sleep(0.3)
        with pytest.raises(RobotFault):
            control.send(TURN)
        arm.recover()
        control.rearm()
        drive(rig, control)
        assert arm.state().status is RobotStatus.FOLLOWING


def test_an_arm_whose_driver_passes_no_set_point_on_is_a_fault(rig: hal.Rig, arm: hal.Robot) -> None:
    driver = rig.driver("panda")
    write = driver.write
    with arm.control() as control:
        rig.clock.sleep(0.1)
        driver.write = lambda setpoint: False
        rig.clock.sleep(0.5)  # an arm that is to hold may wait
        with pytest.raises(RobotFault):
            drive(rig, control)
        assert control.trip is Trip.FAULT
        assert arm.state().fault.code == "SETPOINTS_WITHHELD"
        driver.write = write
        arm.recover()
        rig.clock.sleep(0.1)
        control.rearm()
        drive(rig, control)
        assert arm.state().status is RobotStatus.FOLLOWING
    assert audit(rig, arm)["velocity"] <= 1.0


def test_a_stop_that_no_call_reported_is_a_warning(rig: hal.Rig, arm: hal.Robot) -> None:
    with pytest.warns(RuntimeWarning, match="panda was stopped"), arm.control() as control:
        control.send(JointTarget(arm.state().q))
        rig.clock.sleep(1.0)


def test_a_warning_that_is_an_error_does_not_keep_the_arm_from_stopping(rig: hal.Rig, arm: hal.Robot) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RuntimeWarning), arm.control() as control:
            control.send(TURN)
            rig.clock.sleep(1.0)
    assert arm.state().status is RobotStatus.IDLE
    with arm.control():
        pass


# Sessions


def test_one_arm_has_one_session(arm: hal.Robot) -> None:
    with arm.control():
        with pytest.raises(ControlTaken):
            arm.control().__enter__()
        with pytest.raises(ControlTaken):
            arm.move_to(arm.home)
    with arm.control():
        pass


def test_ctrl_c_while_a_session_opens_leaves_nothing_moving(
    rig: hal.Rig, arm: hal.Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = rig._local.request

    def interrupted(method: str, params: dict[str, object] | None = None) -> object:
        request(method, params)
        if method == "begin":
            raise KeyboardInterrupt
        return None

    goal = arm.home + 0.2
    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(rig._local, "request", interrupted)
        arm.move_to(goal)
    rig.clock.sleep(1.0)
    assert arm.state().status is RobotStatus.IDLE
    assert np.abs(arm.state().q - arm.home).max() < 0.01
    arm.move_to(goal)  # and the arm is free


# Motions to a goal


def test_move_to_blocks_and_keeps_its_speed(rig: hal.Rig, arm: hal.Robot) -> None:
    goal = arm.home + np.array([0.5, 0, 0, 0, 0, 0, 0])
    before = rig.clock.now()
    assert arm.move_to(goal).q == pytest.approx(goal, abs=1e-6)
    fastest = max(abs(s.dq[0]) / arm.limits.velocity[0] for s in rig.driver("panda").log)
    assert 0.05 < fastest <= arm.spec.move_speed + 1e-9
    assert rig.clock.now() - before > 0.5 / (0.1 * arm.limits.velocity[0])
    with pytest.raises(TimeoutError):
        arm.move_to(arm.home, timeout=0.2)
    assert arm.state().status is RobotStatus.IDLE


def test_move_to_checks_its_goal(arm: hal.Robot) -> None:
    with raises_code(CommandError, "outside_limits"):
        arm.move_to([0, 0, 0, 1.0, 0, 0, 0])
    with raises_code(CommandError, "wrong_joint_count"):
        arm.move_to([0, 0, 0])
    with pytest.raises(hal.Unreachable) as caught:
        arm.move_to(hal.Pose([2.5, 0, 0.5], [1, 0, 0, 0]))
    assert caught.value.position_error > 1.0
    for wrong in ({}, {"target": arm.home, "position": [0.4, 0, 0.4]}, {"position": [0.1, 0.2]}):
        with pytest.raises(CommandError):
            arm.move_to(**wrong)


def test_move_to_waits_for_the_deadman_only_for_its_patience(rig: hal.Rig, arm: hal.Robot) -> None:
    start = rig.clock.now()
    with raises_code(MotionStopped, "deadman_released"):
        arm.move_to(arm.home + 0.1, deadman=rig.gamepads["pad"].hold("l2"), patience=0.5)
    assert 0.5 <= rig.clock.now() - start < 0.7


def test_move_to_pauses_while_the_deadman_is_released(rig: hal.Rig, arm: hal.Robot) -> None:
    driver = rig.driver("pad")
    rig.clock.sleep(0.1)
    press(rig)
    goal = arm.home + np.array([0.5, 0, 0, 0, 0, 0, 0])
    pending = [(0.5, driver.release), (1.0, driver.press)]
    seen: list[float] = []
    start = rig.clock.now()

    def hand(now: float) -> None:
        if pending and now - start > pending[0][0]:
            pending.pop(0)[1]("l2")
        if 0.8 < now - start < 0.95:
            seen.append(float(arm.state().dq_set[0]))

    rig._local.pollers.insert(0, hand)
    arm.move_to(goal, deadman=rig.gamepads["pad"].hold("l2"))
    assert arm.state().q == pytest.approx(goal, abs=1e-6)
    assert not pending
    assert seen
    assert max(map(abs, seen)) == 0.0, "it rested while the dead-man was released"


def test_a_goal_of_the_tcp_needs_an_orientation(arm: hal.Robot) -> None:
    position = arm.state().tcp.position
    for call in (arm.move_to, arm.ik, hal.CartesianTarget):
        with raises_code(CommandError, "no_orientation"):
            call(hal.Pose(position))
    with pytest.raises(CommandError):
        arm.move_to(position)
    assert hal.CartesianTarget(hal.Pose(position, [0, 0, 0, 1])).pose.has_orientation, "the identity, on purpose"


def test_a_move_to_a_position_keeps_the_orientation(arm: hal.Robot) -> None:
    before = arm.state().tcp
    goal = before.position + [0.0, 0.1, -0.1]
    after = arm.move_to(position=goal, speed=1.0).tcp
    assert after.distance(hal.Pose(goal, before.orientation)) == pytest.approx((0.0, 0.0), abs=1e-4)


# The arm and the rig


def test_a_lost_arm_raises_at_once(rig: hal.Rig, arm: hal.Robot) -> None:
    arm.inject(disconnect=True)
    rig.clock.sleep(0.05)
    with pytest.raises(ConnectionLost):
        arm.state()
    with pytest.raises(ConnectionLost):
        arm.control().__enter__()
    arm.inject(disconnect=False)
    rig.clock.sleep(0.05)
    assert np.array_equal(arm.state().q, arm.home)


def test_a_frozen_arm_has_a_stale_state(rig: hal.Rig, arm: hal.Robot) -> None:
    arm.inject(freeze=True)
    rig.clock.sleep(0.2)
    with pytest.raises(hal.StaleStateError):
        arm.state()
    assert np.array_equal(arm.state(max_age=1.0).q, arm.home)


def test_unknown_devices_and_attributes_come_with_a_hint(rig: hal.Rig) -> None:
    with pytest.raises(hal.DeviceNotFound, match=r"no robot 'pandas'; did you mean 'panda'\? available: panda"):
        rig.robots["pandas"]
    with raises_code(hal.DeviceNotFound, "no_camera"):
        rig.cameras["wirst"]
    with pytest.raises(AttributeError, match=r"use rig\.cameras\['wrist'\]"):
        _ = rig.cameras.wrist
    with pytest.raises(NotSupported):
        rig.world.pose("cube")


def test_closing_is_idempotent_and_ends_an_open_session() -> None:
    rig = hal.open("panda_table", driver="mock")
    arm = rig.robots["panda"]
    control = arm.control()
    control.__enter__()
    drive(rig, control, count=3)
    rig.close()
    rig.close()
    with pytest.raises(hal.HalError):
        arm.state()
    with pytest.raises(hal.HalError):
        rig.clock.sleep(0.1)
