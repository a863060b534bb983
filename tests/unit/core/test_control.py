"""Control sessions through the public interface, on the built-in rig with mock devices in lock-step."""

import itertools
import threading
import warnings
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest

import hal
from hal import (
    CommandError,
    ConnectionLost,
    ControlTaken,
    JointTarget,
    JointVelocity,
    MotionStopped,
    RobotFault,
    RobotStatus,
    StaleStateError,
    Trip,
    Twist,
)
from hal.drivers.mock.robot import MockRobot
from hal.servo.audit import SetpointAudit


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock") as opened:
        yield opened


@pytest.fixture
def arm(rig: hal.Rig) -> hal.Robot:
    return rig.robots["panda"]


def turns(rig: hal.Rig, count: int) -> Iterator[None]:
    for _ in itertools.islice(rig.clock.rate(50.0), count):
        yield


def let_pass(rig: hal.Rig, seconds: float) -> None:
    rig.clock.sleep(seconds)


def press(rig: hal.Rig) -> None:
    rig.driver("pad").press("l2")
    let_pass(rig, 0.05)


def release(rig: hal.Rig) -> None:
    rig.driver("pad").release("l2")
    let_pass(rig, 0.05)


def test_an_arm_follows_targets_and_rests_after_the_session(rig: hal.Rig, arm: hal.Robot) -> None:
    start = arm.state().q
    with arm.control(rate_hz=50) as control:
        for k, _ in enumerate(turns(rig, 60)):
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
        for k, _ in enumerate(turns(rig, 200)):
            control.send(JointTarget(start + (1.5 if k > 5 else 0.0) * np.array([1, 0, 0, 0, 0, 0, 0])))
        assert arm.state().q[0] == pytest.approx(start[0] + 1.5, abs=2e-3)
    audit = SetpointAudit(arm.limits, 1.0 / arm.spec.rate_hz)
    for setpoint in rig.driver("panda").log:
        audit.add(setpoint.q)
    peaks = audit.peaks()
    assert 0.2 < peaks["velocity"] <= arm.spec.speed + 1e-6
    assert max(peaks.values()) <= 1.0 + 1e-6


def test_sent_says_what_was_changed(rig: hal.Rig, arm: hal.Robot) -> None:
    start = arm.state().q
    with arm.control() as control:
        assert control.send(JointTarget(start)).reasons == ()
        let_pass(rig, 0.02)
        beyond = start.copy()
        beyond[3] = 5.0
        sent = control.send(JointTarget(beyond))
        assert sent.command.q[3] == arm.limits.upper[3]
        assert sent.reasons == (f"position limit of {arm.joints[3]}",)


@pytest.mark.parametrize(
    ("make", "text"),
    [
        (lambda: JointTarget([0.0] * 6), "has 7 joints; JointTarget has 6"),
        (lambda: JointVelocity([0.0] * 8), "has 7 joints; JointVelocity has 8"),
        (lambda: JointTarget([float("nan")] * 7), "not finite"),
        (lambda: hal.JointTorque([0.0] * 6), "has 7 joints; JointTorque has 6"),
        (lambda: hal.JointTorque([float("inf")] * 7), "not finite"),
        (lambda: Twist([0.1, 0.0]), r"shape \(3,\), not \(2,\)"),
        (lambda: Twist([0.1, 0.0, float("inf")]), "not finite"),
        (lambda: "up", "str is not a command"),
        (lambda: hal.Pose([0.4, 0.0, 0.4]), r"did you mean hal\.CartesianTarget"),
    ],
)
def test_a_malformed_command_is_refused_and_nothing_moves(rig: hal.Rig, arm: hal.Robot, make, text: str) -> None:
    with arm.control() as control:
        with pytest.raises(CommandError, match=text):
            control.send(make())
        let_pass(rig, 0.1)
    assert np.array_equal(arm.state().q, arm.home)


def test_a_driver_that_takes_no_torques_says_so(arm: hal.Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MockRobot, "modes", frozenset({"position"}))
    with (
        arm.control() as control,
        pytest.raises(hal.NotSupported, match="driver mock takes no torques, only: position"),
    ):
        control.send(hal.JointTorque([0.0] * 7))


def test_a_model_without_limits_of_torque_says_so(arm: hal.Robot) -> None:
    arm.spec = replace(arm.spec, limits=replace(arm.spec.limits, torque=None))
    with arm.control() as control, pytest.raises(hal.NotSupported, match="without limits.torque"):
        control.send(hal.JointTorque([0.0] * 7))


def test_torques_are_cut_to_their_limits_and_that_is_told(arm: hal.Robot) -> None:
    with arm.control() as control:
        sent = control.send(hal.JointTorque([100.0, 0.0, 0.0, 0.0, 0.0, 0.0, -13.0]))
        assert sent.command.tau.tolist() == [87.0, 0.0, 0.0, 0.0, 0.0, 0.0, -12.0]
        assert sent.reasons == (f"torque limit of {arm.joints[0]}, {arm.joints[6]}",)


def test_a_first_target_far_away_is_refused(rig: hal.Rig, arm: hal.Robot) -> None:
    far = arm.state().q + 0.2
    pose = arm.state().tcp
    with arm.control() as control:
        with pytest.raises(CommandError, match=r"0\.200 rad from the set-point at .*use move_to"):
            control.send(JointTarget(far))
        with pytest.raises(CommandError, match=r"0\.000 m and \d\.\d+ rad from the set-point, .*use move_to"):
            control.send(hal.CartesianTarget(hal.Pose(pose.position, [0, 1, 0, 0])))
        with pytest.raises(CommandError, match=r"0\.100 m and 0\.000 rad from the set-point, .*use move_to"):
            control.send(hal.CartesianTarget(hal.Pose(pose.position + np.array([0.1, 0, 0]), pose.orientation)))
        let_pass(rig, 0.1)
    assert np.array_equal(arm.state().q, arm.home)


def test_a_loop_in_which_no_time_passes_is_an_error(rig: hal.Rig, arm: hal.Robot) -> None:
    velocity = JointVelocity([0.2, 0, 0, 0, 0, 0, 0])
    with arm.control(rate_hz=50) as control:
        for _ in turns(rig, 150):
            control.send(velocity)
        with pytest.raises(CommandError, match=r"rig\.clock\.rate"):
            for _ in range(150):
                control.send(velocity)


def test_commands_that_stop_coming_trip_and_rearm_goes_on(rig: hal.Rig, arm: hal.Robot) -> None:
    velocity = JointVelocity([0.2, 0, 0, 0, 0, 0, 0])
    with arm.control(rate_hz=50) as control:
        for _ in turns(rig, 20):
            control.send(velocity)
        assert arm.state().dq_set[0] == pytest.approx(0.2)
        let_pass(rig, 0.5)
        assert control.trip is Trip.COMMAND_LATE
        assert np.abs(arm.state().dq_set).max() == 0.0
        with pytest.raises(MotionStopped) as stop:
            control.send(velocity)
        assert stop.value.code == "command_deadline"
        stopped = arm.state().q
        control.rearm()
        for _ in turns(rig, 20):
            control.send(velocity)
        assert arm.state().q[0] > stopped[0] + 0.01


def test_stop_from_another_thread_is_latched_also_for_the_next_session(rig: hal.Rig, arm: hal.Robot) -> None:
    velocity = JointVelocity([0.2, 0, 0, 0, 0, 0, 0])
    with arm.control() as control, pytest.raises(MotionStopped) as stop:
        for k, _ in enumerate(turns(rig, 100)):
            control.send(velocity)
            if k == 20:
                thread = threading.Thread(target=rig.stop)
                thread.start()
                thread.join()
    assert stop.value.code == "rig_stop"
    with pytest.raises(MotionStopped) as stop:
        arm.move_to(arm.home)
    assert stop.value.code == "rig_stop"
    rig.rearm()
    arm.move_to(arm.home)
    assert arm.state().q == pytest.approx(arm.home, abs=1e-6)


def test_the_deadman_starts_stops_and_starts_again(rig: hal.Rig, arm: hal.Robot) -> None:
    pad = rig.gamepads["pad"]
    let_pass(rig, 0.1)
    velocity = JointVelocity([0.2, 0, 0, 0, 0, 0, 0])
    with arm.control(deadman=pad.hold("l2")) as control:
        for _ in turns(rig, 10):
            assert "dead-man is not held" in control.send(velocity).reasons[0]
        assert np.array_equal(arm.state().q, arm.home), "nothing moves before it is pressed"
        press(rig)
        for _ in turns(rig, 20):
            control.send(velocity)
        assert arm.state().dq_set[0] == pytest.approx(0.2)
        release(rig)
        for _ in turns(rig, 20):
            control.send(velocity)
        assert control.status is RobotStatus.HOLDING
        held = arm.state().q
        for _ in turns(rig, 5):
            control.send(velocity)
        assert np.array_equal(arm.state().q, held)
        press(rig)
        for _ in turns(rig, 20):
            control.send(velocity)
        assert arm.state().q[0] > held[0] + 0.01


@pytest.mark.parametrize(("knob", "trip"), [("freeze", Trip.DEADMAN_SILENT), ("disconnect", Trip.DEADMAN_LOST)])
def test_a_pad_that_freezes_or_goes_stops_the_arm_until_it_is_pressed_anew(
    rig: hal.Rig, arm: hal.Robot, knob: str, trip: Trip
) -> None:
    pad, driver = rig.gamepads["pad"], rig.driver("pad")
    let_pass(rig, 0.1)
    velocity = JointVelocity([0.2, 0, 0, 0, 0, 0, 0])
    with arm.control(deadman=pad.hold("l2")) as control:
        press(rig)
        for _ in turns(rig, 20):
            control.send(velocity)
        assert arm.state().dq_set[0] == pytest.approx(0.2)
        driver.inject(**{knob: True})
        with pytest.raises(MotionStopped) as stop:
            for _ in turns(rig, 50):
                control.send(velocity)
        assert stop.value.code == trip.code
        let_pass(rig, 0.3)
        assert control.trip is trip
        assert np.abs(arm.state().dq_set).max() == 0.0
        stopped = arm.state().q
        driver.inject(**{knob: False})
        let_pass(rig, 0.3)
        with pytest.raises(MotionStopped):  # the dead-man is still held, from before
            control.send(velocity)
        release(rig)
        press(rig)
        for _ in turns(rig, 20):
            control.send(velocity)
        assert arm.state().q[0] > stopped[0] + 0.01


def test_one_arm_one_session(arm: hal.Robot) -> None:
    with arm.control():
        with pytest.raises(ControlTaken):
            arm.control().__enter__()
        with pytest.raises(ControlTaken):
            arm.move_to(arm.home)
    with arm.control():
        pass


def test_the_users_exception_is_the_one_that_is_raised(rig: hal.Rig, arm: hal.Robot) -> None:
    with pytest.raises(ZeroDivisionError), arm.control() as control:
        for _ in turns(rig, 10):
            control.send(JointVelocity([0.2] * 7))
        raise ZeroDivisionError
    assert arm.state().status is RobotStatus.IDLE
    assert np.abs(arm.state().dq_set).max() == 0.0


def test_a_fault_stops_and_recover_is_the_users_own_act(rig: hal.Rig, arm: hal.Robot) -> None:
    with arm.control() as control:
        for _ in turns(rig, 10):
            control.send(JointVelocity([0.2] * 7))
        arm.inject(fault="collision")
        let_pass(rig, 0.1)
        with pytest.raises(RobotFault, match="collision"):
            control.send(JointVelocity([0.2] * 7))
        assert arm.state().fault.cause == "collision"
        arm.recover()
        let_pass(rig, 0.1)
        with pytest.raises(MotionStopped):
            control.send(JointVelocity([0.2] * 7))
        control.rearm()
        let_pass(rig, 0.1)
        control.send(JointVelocity([0.2] * 7))


def test_a_lost_arm_is_told_at_once(rig: hal.Rig, arm: hal.Robot) -> None:
    arm.inject(disconnect=True)
    let_pass(rig, 0.05)
    with pytest.raises(ConnectionLost):
        arm.state()
    with pytest.raises(ConnectionLost):
        arm.control().__enter__()
    arm.inject(disconnect=False)
    let_pass(rig, 0.05)
    assert np.array_equal(arm.state().q, arm.home)


def test_a_frozen_arm_has_a_stale_state(rig: hal.Rig, arm: hal.Robot) -> None:
    arm.inject(freeze=True)
    let_pass(rig, 0.2)
    with pytest.raises(StaleStateError, match=r"0\.2\d\d s old"):
        arm.state()
    assert np.array_equal(arm.state(max_age=1.0).q, arm.home)


def test_garbage_from_an_arm_trips(rig: hal.Rig, arm: hal.Robot) -> None:
    with arm.control() as control:
        for _ in turns(rig, 10):
            control.send(JointVelocity([0.2] * 7))
        arm.inject(garbage="nan")
        let_pass(rig, 0.3)
        assert control.trip is Trip.BAD_READING
        arm.inject(garbage=None)


def test_move_to_blocks_keeps_its_speed_and_checks_its_goal(rig: hal.Rig, arm: hal.Robot) -> None:
    goal = arm.home.copy()
    goal[0] += 0.5
    before = rig.clock.now()
    assert arm.move_to(goal).q == pytest.approx(goal, abs=1e-6)
    fastest = max(abs(s.dq[0]) / arm.limits.velocity[0] for s in rig.driver("panda").log)
    assert 0.05 < fastest <= arm.spec.move_speed + 1e-9
    assert rig.clock.now() - before > 0.5 / (0.1 * arm.limits.velocity[0])
    with pytest.raises(CommandError, match=f"outside the position limits of {arm.joints[3]}"):
        arm.move_to([0, 0, 0, 1.0, 0, 0, 0])
    with pytest.raises(CommandError, match="7 joints; the target has 3"):
        arm.move_to([0, 0, 0])
    with pytest.raises(hal.Unreachable, match="m, "):
        arm.move_to(hal.Pose([2.5, 0, 0.5], [1, 0, 0, 0]))
    with pytest.raises(TimeoutError, match="did not reach"):
        arm.move_to(arm.home, timeout=0.2)
    assert arm.state().status is RobotStatus.IDLE


def test_move_to_waits_for_the_deadman_as_long_as_it_was_told(rig: hal.Rig, arm: hal.Robot) -> None:
    start = rig.clock.now()
    with pytest.raises(MotionStopped) as stop:
        arm.move_to(arm.home + 0.1, deadman=rig.gamepads["pad"].hold("l2"), patience=0.5)
    assert stop.value.code == "deadman_released"
    assert 0.5 <= rig.clock.now() - start < 0.7
    with pytest.raises(CommandError, match="patience"):
        arm.move_to(arm.home, patience=float("nan"))


def test_move_to_pauses_while_the_deadman_is_released(rig: hal.Rig, arm: hal.Robot) -> None:
    pad, driver = rig.gamepads["pad"], rig.driver("pad")
    let_pass(rig, 0.1)
    press(rig)
    goal = arm.home.copy()
    goal[0] += 0.5
    events = iter([(0.5, "release"), (1.0, "press")])
    pending = [next(events)]
    seen: list[float] = []
    start = rig.clock.now()
    host = rig._local

    def hand(now: float) -> None:
        if pending and now - start > pending[0][0]:
            getattr(driver, pending.pop(0)[1])("l2")
            pending.extend(itertools.islice(events, 1))
        if 0.8 < now - start < 0.95:
            seen.append(float(arm.state().dq_set[0]))

    host.pollers.insert(0, hand)
    arm.move_to(goal, deadman=pad.hold("l2"))
    assert arm.state().q == pytest.approx(goal, abs=1e-6)
    assert not pending
    assert seen
    assert max(map(abs, seen)) == 0.0, "it rested while the dead-man was released"


def test_the_gripper_takes_metres_and_fractions(rig: hal.Rig, arm: hal.Robot) -> None:
    gripper = arm.gripper
    assert gripper.move(0.04).width == pytest.approx(0.04, abs=1e-4)
    assert gripper.grip(1.0).width == pytest.approx(0.0, abs=1e-4)
    assert gripper.open().width == pytest.approx(gripper.width_max, abs=1e-4)
    for bad in (-0.01, 0.09, float("nan")):
        with pytest.raises(CommandError, match="width must be"):
            gripper.start(bad)
    with pytest.raises(CommandError, match="from 0 .open. to 1"):
        gripper.grip(1.5)


def test_a_pose_without_orientation_is_no_goal_for_a_hand(arm: hal.Robot) -> None:
    pose = hal.Pose(arm.state().tcp.position)
    assert not pose.has_orientation
    for ask in (arm.move_to, arm.ik, hal.CartesianTarget):
        with pytest.raises(CommandError, match=r"move_to\(position="):
            ask(pose)
    with pytest.raises(CommandError, match="position="):
        arm.move_to(pose.position)
    pointing_up = hal.Pose(pose.position, [0, 0, 0, 1])  # said on purpose
    assert hal.CartesianTarget(pointing_up).pose.has_orientation


def test_a_move_to_a_position_keeps_the_orientation(arm: hal.Robot) -> None:
    before = arm.state().tcp
    after = arm.move_to(position=before.position + [0.0, 0.1, -0.1], speed=1.0).tcp
    assert after.distance(hal.Pose(before.position + [0.0, 0.1, -0.1], before.orientation)) == pytest.approx(
        (0.0, 0.0), abs=1e-4
    )
    for wrong in ({}, {"target": arm.home, "position": before.position}, {"position": [0.1, 0.2]}):
        with pytest.raises(CommandError, match="position"):
            arm.move_to(**wrong)


def test_the_gripper_rests_while_a_stop_is_latched(rig: hal.Rig, arm: hal.Robot) -> None:
    rig.stop()
    with pytest.raises(MotionStopped) as stop:
        arm.gripper.grip(1.0)
    assert stop.value.code == "rig_stop"
    rig.rearm()
    assert arm.gripper.grip(1.0).width < 1e-3


def test_a_trip_and_the_end_of_a_session_leave_the_grip_alone(rig: hal.Rig, arm: hal.Robot) -> None:
    with arm.control() as control:
        for _ in turns(rig, 60):
            control.send(JointVelocity([0.0] * 7), grip=1.0)
        let_pass(rig, 0.5)
        assert control.trip is Trip.COMMAND_LATE
    let_pass(rig, 0.5)
    assert arm.gripper.state().width_target == 0.0


def test_unknown_devices_name_the_known_ones(rig: hal.Rig) -> None:
    with pytest.raises(hal.DeviceNotFound, match=r"no robot 'pandas' \(did you mean 'panda'\?\); it has: panda"):
        rig.robots["pandas"]
    with pytest.raises(hal.DeviceNotFound, match="no camera 'wirst'"):
        rig.cameras["wirst"]
    with pytest.raises(hal.NotSupported, match="exists in simulation only"):
        rig.world.pose("cube")


def test_closing_is_idempotent_and_ends_an_open_session() -> None:
    rig = hal.open("panda_table", driver="mock")
    arm = rig.robots["panda"]
    control = arm.control()
    control.__enter__()
    control.send(JointVelocity([0.2] * 7))
    rig.clock.sleep(0.3)
    rig.close()
    rig.close()
    with pytest.raises(hal.HalError):
        arm.state()
    with pytest.raises(hal.HalError, match="closed"):
        rig.clock.sleep(0.1)


def test_a_pose_beyond_reach_is_refused_in_mid_session_too(rig: hal.Rig, arm: hal.Robot) -> None:
    pose = arm.state().tcp
    with arm.control() as control:
        for _ in turns(rig, 5):
            control.send(hal.CartesianTarget(pose))
        with pytest.raises(hal.Unreachable, match="reaches"):
            control.send(hal.CartesianTarget(hal.Pose(pose.position * 1000.0, pose.orientation)))  # mm


def test_what_the_servo_holds_back_is_told(rig: hal.Rig, arm: hal.Robot) -> None:
    with arm.control() as control:
        told = [control.send(Twist([0, 0, 50.0])).reasons for _ in turns(rig, 5)]
    assert "tcp speed" in str(told[-1])


def test_a_stop_that_nobody_was_told_of_is_a_warning(rig: hal.Rig, arm: hal.Robot) -> None:
    with pytest.warns(RuntimeWarning, match="commands stopped coming"), arm.control() as control:
        control.send(JointTarget(arm.state().q))
        let_pass(rig, 1.0)


def test_ctrl_c_while_a_session_opens_leaves_nothing_moving(
    rig: hal.Rig, arm: hal.Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    request = rig._local.request

    def interrupted(method: str, params: dict[str, object] | None = None) -> object:
        request(method, params)
        if method == "begin":
            raise KeyboardInterrupt
        return None

    monkeypatch.setattr(rig._local, "request", interrupted)
    goal = arm.home + 0.2
    with pytest.raises(KeyboardInterrupt):
        arm.move_to(goal)
    monkeypatch.undo()
    let_pass(rig, 1.0)
    assert arm.state().status is RobotStatus.IDLE
    assert np.abs(arm.state().q - arm.home).max() < 0.01
    arm.move_to(goal)  # and the arm is free


def test_a_device_that_takes_no_setpoints_is_lost_and_does_not_leap(rig: hal.Rig, arm: hal.Robot) -> None:
    driver = rig.driver("panda")
    write, broken = driver.write, []

    def failing(setpoint: object) -> None:
        if broken:
            raise OSError("cable")
        write(setpoint)

    driver.write = failing
    velocity = JointVelocity([0.2] * 7)
    with arm.control() as control:
        for _ in turns(rig, 20):
            control.send(velocity)
        broken.append(True)
        let_pass(rig, 0.06)
        with pytest.raises(ConnectionLost, match="cable"):
            arm.state()
        broken.clear()
        let_pass(rig, 0.3)
        assert control.trip is Trip.DEVICE_LOST
        with pytest.raises(MotionStopped):
            control.send(velocity)
    audit = SetpointAudit(arm.limits, 1.0 / arm.spec.rate_hz)
    for setpoint in driver.log:
        audit.add(setpoint.q)
    assert audit.peaks()["velocity"] <= 1.0


def test_short_sleeps_add_up(rig: hal.Rig) -> None:
    before = rig.clock.now()
    for _ in range(100):
        rig.clock.sleep(0.001)
    assert rig.clock.now() > before + 0.09


def test_a_stop_keeps_the_fingers_where_it_finds_them(rig: hal.Rig, arm: hal.Robot) -> None:
    arm.gripper.start(0.0)
    let_pass(rig, 0.2)
    moving = arm.gripper.state()
    assert moving.moving
    rig.stop()
    let_pass(rig, 1.0)
    assert arm.gripper.state().width == pytest.approx(moving.width, abs=2e-3)
    assert not arm.gripper.state().moving


def test_a_warning_that_is_an_error_does_not_keep_the_arm_from_stopping(rig: hal.Rig, arm: hal.Robot) -> None:
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        with pytest.raises(RuntimeWarning, match="commands stopped coming"), arm.control() as control:
            control.send(JointVelocity([0.2] * 7))
            let_pass(rig, 1.0)
    assert arm.state().status is RobotStatus.IDLE
    with arm.control():
        pass


@pytest.mark.parametrize(
    ("asked", "expected"),
    [({"grip": 0.0}, 0.08), ({"grip": 1}, 0.0), ({"width": 0.0}, 0.0), ({"width": np.float32(0.02)}, 0.02)],
)
def test_a_gripper_is_told_a_grip_or_a_width(
    rig: hal.Rig, arm: hal.Robot, asked: dict[str, float], expected: float
) -> None:
    arm.gripper.grip(0.5)
    with arm.control() as control:
        for _ in turns(rig, 60):
            control.send(JointVelocity([0.0] * 7), **asked)
    assert arm.gripper.state().width_target == pytest.approx(expected, abs=1e-6)


def test_the_former_name_of_a_grip_is_deprecated(rig: hal.Rig, arm: hal.Robot) -> None:
    with arm.control() as control:
        for _ in turns(rig, 60):
            with pytest.warns(DeprecationWarning, match="grip="):
                control.send(JointVelocity([0.0] * 7), gripper=1.0)
    assert arm.gripper.state().width_target == 0.0


@pytest.mark.parametrize(
    "asked",
    [
        {"grip": 0.5, "width": 0.02},
        {"width": 0.09},
        {"width": -0.01},
        {"width": float("nan")},
        {"width": 40},
        {"grip": "closed"},
        {"grip": [0.1, 0.2]},
        {"width": 10**400},
    ],
)
def test_what_is_no_grip_and_no_width_sends_nothing(rig: hal.Rig, arm: hal.Robot, asked: dict[str, float]) -> None:
    with arm.control() as control:
        with pytest.raises(CommandError, match=r"grip|width"):
            control.send(hal.Twist([0.1, 0.0, 0.0]), **asked)
        rig.clock.sleep(0.05)
        assert arm.state().target_seq == 0
    assert arm.gripper.state().width_target != 0.02


@pytest.mark.parametrize("grip", [float("nan"), -0.1, 1.1])
def test_a_grip_that_cannot_be_sends_nothing_to_the_arm_either(rig: hal.Rig, arm: hal.Robot, grip: float) -> None:
    with arm.control() as control:
        for _ in range(3):
            with pytest.raises(CommandError):
                control.send(hal.Twist([0.1, 0.0, 0.0]), grip=grip)
            rig.clock.sleep(0.02)
        assert not arm.state().dq_set.any()
        assert arm.state().target_seq == 0
