"""Lines, waypoints and background motions through the public interface, on mock devices in lock-step."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal import CommandError, ControlTaken, MotionStopped, Unreachable
from hal.servo.audit import SetpointAudit
from hal.types import MotionOutcome, Trip


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock") as opened:
        yield opened


@pytest.fixture
def arm(rig: hal.Rig) -> hal.Robot:
    return rig.robots["panda"]


def beside(arm: hal.Robot, *way: float) -> hal.Pose:
    tcp = arm.state().tcp_set
    return hal.Pose(tcp.position + way, tcp.orientation)


def assert_within_limits(rig: hal.Rig, arm: hal.Robot) -> None:
    audit = SetpointAudit(arm.limits, 1.0 / rig._local.spec.rate_hz)
    for setpoint in rig.driver("panda").log:
        audit.add(setpoint.q)
    assert max(audit.peaks().values()) <= 1.0


def test_a_straight_line_a_polyline_and_waypoints(rig: hal.Rig, arm: hal.Robot) -> None:
    start, goal = arm.state().tcp, beside(arm, 0.1, 0.2, -0.15)
    state = arm.move_to(goal, straight=True, speed=1.0)
    assert state.tcp_set.distance(goal) == pytest.approx((0.0, 0.0), abs=1e-6)
    tcp = np.array([arm.fk(setpoint.q).position for setpoint in rig.driver("panda").log])
    way = (goal.position - start.position) / np.linalg.norm(goal.position - start.position)
    off = (tcp - start.position) - np.outer((tcp - start.position) @ way, way)
    assert np.linalg.norm(off, axis=1).max() < 2e-4
    square = [beside(arm, *step) for step in ([0, -0.1, 0], [0, -0.1, 0.1], [0, 0, 0.1], [0, 0, 0])]
    before = rig.clock.now()
    assert arm.move_along(square, blend=0.02, speed=1.0).tcp_set.distance(goal)[0] < 1e-6
    rounded = rig.clock.now() - before
    arm.move_along(square, blend=0.0, speed=1.0)
    assert rounded < rig.clock.now() - before - rounded, "a rounded corner takes less time than a rest"
    end = arm.move_to([arm.home + 0.1, arm.home], speed=0.5)
    assert end.q == pytest.approx(arm.home, abs=1e-9)
    assert_within_limits(rig, arm)
    t = rig.clock.now()
    arm.move_to(arm.state().tcp_set, straight=True)
    assert rig.clock.now() - t < 0.1, "it is there already"


def test_a_motion_in_the_background(rig: hal.Rig, arm: hal.Robot) -> None:
    start, goal = arm.state().tcp_set, beside(arm, 0.0, 0.2, -0.1)
    motion = arm.start_move_to(goal, straight=True, speed=1.0)
    assert (motion.progress, motion.done, motion.result) == (0.0, False, None)
    for call in (arm.move_to, arm.start_move_to):
        with pytest.raises(ControlTaken):
            call(arm.home)
    rig.clock.sleep(0.5)
    half = motion.progress
    assert 0.3 < half < 0.8
    with pytest.raises(TimeoutError):
        motion.wait(0.1)
    result = motion.wait()
    assert result
    assert (result.outcome, result.progress, motion.progress) == (MotionOutcome.ARRIVED, 1.0, 1.0)
    assert result.state.tcp_set.distance(goal)[0] < 1e-6
    motion = arm.start_move_along([start, goal], speed=1.0)
    rig.clock.sleep(0.3)
    motion.cancel()
    result = motion.wait()
    assert (result.outcome, bool(result)) == (MotionOutcome.CANCELLED, False)
    assert 0.05 < result.progress < 0.4
    assert not result.state.dq_set.any()
    away = result.state.tcp_set.position - goal.position
    line = (start.position - goal.position) / np.linalg.norm(start.position - goal.position)
    assert np.linalg.norm(away - (away @ line) * line) < 2e-4, "it braked on the line"
    motion = arm.start_move_to(arm.home, speed=0.5)
    rig.clock.sleep(0.1)
    motion.cancel()
    arm.move_to(arm.home, speed=0.5)  # waits for the rest by itself
    assert motion.result.outcome is MotionOutcome.CANCELLED
    motion = arm.start_move_to(arm.home + 0.05, speed=0.5)
    rig.clock.sleep(2.0)
    with arm.control() as control:  # one that arrived, and was never asked for its result, gives the arm up
        control.send(hal.JointTarget(arm.home + 0.05))
    assert motion.result.outcome is MotionOutcome.ARRIVED
    assert_within_limits(rig, arm)


def test_a_trip_ends_a_motion_in_the_background(rig: hal.Rig, arm: hal.Robot) -> None:
    motion = arm.start_move_to(beside(arm, 0.0, 0.2, -0.1), straight=True, speed=1.0)
    rig.clock.sleep(0.3)
    rig.stop()
    rig.clock.sleep(0.5)
    assert motion.done
    assert (motion.result.outcome, motion.result.trip) == (MotionOutcome.STOPPED, Trip.STOP)
    with raises_code(MotionStopped, "rig_stop"):
        arm.move_to(arm.home)


def test_a_released_deadman_pauses_a_line(rig: hal.Rig, arm: hal.Robot) -> None:
    pad, held = rig.driver("pad"), rig.gamepads["pad"].hold("l2")
    rig.clock.sleep(0.1)
    pad.press("l2")
    rig.clock.sleep(0.05)
    motion = arm.start_move_to(beside(arm, 0.0, 0.2, 0.0), straight=True, speed=1.0, deadman=held)
    rig.clock.sleep(0.4)
    pad.release("l2")
    rig.clock.sleep(0.5)
    paused = motion.progress
    assert 0.1 < paused < 0.9
    rig.clock.sleep(0.5)
    assert (motion.progress, motion.done) == (paused, False)
    pad.press("l2")
    assert motion.wait(5.0)
    tcp = np.array([arm.fk(setpoint.q).position for setpoint in rig.driver("panda").log])
    assert np.ptp(tcp[:, [0, 2]], axis=0).max() < 2e-4


def test_what_cannot_be_done_is_refused_before_anything_moves(rig: hal.Rig, arm: hal.Robot) -> None:
    far = beside(arm, 0.7, 0.0, 0.0)
    for call in (
        lambda: arm.move_to(far, straight=True),
        lambda: arm.start_move_along([beside(arm, 0.05, 0, 0), far]),
        lambda: arm.move_to(beside(arm, 0.0, 0.0, -0.5), straight=True),
    ):
        with pytest.raises(Unreachable) as caught:
            call()
        assert 0.0 < caught.value.along < 1.0
    with raises_code(CommandError, "outside_limits"):
        arm.move_to([arm.home, arm.home + 4.0])
    for wrong in ({"target": arm.home, "straight": True}, {"target": [arm.home, arm.home[:3]]}):
        with pytest.raises(CommandError):
            arm.move_to(**wrong)
    for poses in ([], arm.state().tcp, [arm.home], [hal.Pose([0.4, 0, 0.4])]):
        with pytest.raises(CommandError):
            arm.move_along(poses)
    with pytest.raises(CommandError):
        arm.move_along([far], blend=float("nan"))
    assert not rig.driver("panda").log
    assert arm.state().q_set == pytest.approx(arm.home, abs=1e-12)
