"""Twists and poses: the tcp goes where it is told, straight, no faster than allowed, and not through walls."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from servo_kit import FAR, Bench, tightened
from specs import panda

from hal.commands import Kind
from hal.geometry import Pose, apply_rotation, difference, quaternion_to_matrix, rotate
from hal.specs import WorkspaceSpec
from hal.types import Limited, RobotStatus

UNIT = st.floats(-1.0, 1.0)


def tcp(bench: Bench) -> np.ndarray:
    """Position of the tcp of every set-point (ticks, 3)."""
    return np.array([bench.servo.kinematics.fk(q)[:3] for q in bench.history])


def tcp_speeds(bench: Bench) -> np.ndarray:
    return np.linalg.norm(np.diff(tcp(bench), axis=0), axis=1) / bench.dt


def turned(bench: Bench) -> float:
    """Angle between the first and the last orientation of the tcp, rad."""
    first, last = (bench.servo.kinematics.pose(q) for q in (bench.history[0], bench.history[-1]))
    return first.distance(last)[1]


@pytest.mark.parametrize("rate_hz", [240.0, 1000.0])
@pytest.mark.parametrize("direction", [(1, 0, 0), (0, -1, 0), (0, 0, -1), (0.6, 0.6, 0.5)])
def test_a_twist_moves_the_tcp_straight(direction: tuple[float, float, float], rate_hz: float) -> None:
    bench = Bench(rate_hz=rate_hz, tcp_speed=0.25)
    linear = 0.15 * np.array(direction)
    bench.stream(1.0, Kind.TWIST, [*linear, 0, 0, 0, 0])
    path = tcp(bench) - tcp(bench)[0]
    along = path @ linear / np.linalg.norm(linear)
    assert along[-1] == pytest.approx(np.linalg.norm(linear), rel=0.05)
    off = np.linalg.norm(path - np.outer(along, linear) / np.linalg.norm(linear), axis=1)
    assert off.max() < 1e-3
    assert turned(bench) < 0.005
    bench.assert_within_limits()


def test_a_turn_keeps_the_tcp_in_place() -> None:
    bench = Bench(tcp_speed=0.25)
    bench.stream(1.0, Kind.TWIST, [0, 0, 0, 0, 0, 0.5, 0])
    assert turned(bench) == pytest.approx(0.5, rel=0.05)
    assert np.linalg.norm(tcp(bench) - tcp(bench)[0], axis=1).max() < 2e-3


def test_a_twist_along_the_tools_own_axes() -> None:
    bench = Bench(tcp_speed=0.25)
    pose = bench.servo.kinematics.pose(bench.q)
    axis = quaternion_to_matrix(pose.orientation)[:, 2]
    bench.stream(1.0, Kind.TWIST, [0, 0, 0.1, 0, 0, 0, 1.0])
    moved = tcp(bench)[-1] - tcp(bench)[0]
    assert moved @ axis == pytest.approx(0.1, rel=0.05)
    assert np.linalg.norm(moved) == pytest.approx(0.1, rel=0.05)


def test_letting_go_of_the_stick_stops_without_coming_back() -> None:
    bench = Bench(tcp_speed=0.25)
    bench.stream(1.0, Kind.TWIST, [0.2, 0, 0, 0, 0, 0, 0])
    ticks = len(bench.history)
    bench.stream(1.0, Kind.TWIST, [0.0] * 7)
    x = tcp(bench)[ticks:, 0]
    assert x[-1] - x[0] < 0.02
    assert x.max() - x[-1] < 1e-5
    assert not bench.moving
    bench.assert_within_limits()


def test_pushes_and_stops_do_not_add_up_to_a_tilted_hand() -> None:
    """Joints that brake each by itself lose 6 mm of height and turn the hand by a degree in every stop."""
    bench = Bench(tcp_speed=0.25)
    for k in range(6):
        bench.stream(0.5, Kind.TWIST, [0.2 * (-1) ** k, 0, 0, 0, 0, 0, 0])
        bench.stream(0.3, Kind.TWIST, [0.0] * 7)
        assert not bench.moving
    assert abs(tcp(bench)[-1, 2] - tcp(bench)[0, 2]) < 0.003
    assert turned(bench) < math.radians(0.1)
    bench.assert_within_limits()


def test_the_tcp_speed_is_kept_through_reversals_and_turns() -> None:
    bench = Bench(tcp_speed=0.25, speed=0.5)
    for k in range(720):
        if k % 5 == 0:
            t = 9.4 * k * bench.dt
            signs = math.copysign(1.0, math.sin(t)), math.copysign(1.0, math.cos(t))
            bench.send(Kind.TWIST, [0.4 * signs[0], 0.4 * signs[1], 0.0, 0.0, 0.0, 0.5, 1.0])
        bench.tick()
    assert bench.limited & Limited.TCP_SPEED
    assert 0.22 < tcp_speeds(bench).max() <= 0.25
    bench.assert_within_limits()


@pytest.mark.parametrize("kind", [Kind.JOINT_TARGET, Kind.JOINT_VELOCITY])
def test_the_tcp_speed_is_kept_in_joint_space(kind: Kind) -> None:
    bench = Bench(tcp_speed=0.25)
    bench.stream(0.05, kind, [*bench.q, *[0.0] * 7] if kind is Kind.JOINT_TARGET else [0.0] * 7)
    goal = [x + d for x, d in zip(bench.q, (1.2, 0.5, -0.4, 0.6, 0.3, -0.5, 1.2), strict=True)]
    values = [*goal, *[0.0] * 7] if kind is Kind.JOINT_TARGET else [0.8, 0.6, -0.4, 0.5, 0.3, 0.5, 1.0]
    bench.stream(1.0, kind, values)
    assert 0.22 < tcp_speeds(bench).max() <= 0.255
    assert bench.limited & Limited.TCP_SPEED or kind is Kind.JOINT_TARGET
    if kind is Kind.JOINT_TARGET:
        bench.stream(4.0, kind, values)
        assert bench.q == pytest.approx(goal, abs=1e-6)
    bench.assert_within_limits()


@pytest.mark.parametrize("shares", [(1.0, 1.0), (0.1, 0.02)])
def test_a_pose_is_reached_straight_and_not_passed(shares: tuple[float, float]) -> None:
    spec = panda()
    bench = Bench(replace(spec, limits=tightened(spec.limits, *shares)), tcp_speed=0.25)
    start = bench.servo.kinematics.pose(bench.q)
    goal = Pose(
        start.position + np.array([0.025, 0.02, -0.03]), apply_rotation(start.orientation.tolist(), [0.0, 0.1, 0.1])
    )
    bench.stream(3.0, Kind.CARTESIAN_TARGET, [*goal.position, *goal.orientation])
    distance, angle = bench.servo.kinematics.pose(bench.q).distance(goal)
    assert distance < 1e-6
    assert angle < 1e-5
    line = goal.position - start.position
    along = (tcp(bench) - start.position) @ line / np.linalg.norm(line)
    assert along.max() - np.linalg.norm(line) < 1e-4
    assert not bench.moving
    bench.assert_within_limits()


def test_the_first_pose_must_be_near() -> None:
    bench = Bench(tcp_speed=0.25)
    pose = bench.servo.kinematics.pose(bench.q)
    for position, rotation in (((0.0, 0.0, 0.051), (0.0, 0.0, 0.0)), ((0.0, 0.0, 0.0), (0.0, 0.21, 0.0))):
        orientation = apply_rotation(pose.orientation.tolist(), rotation)
        refused = bench.send(Kind.CARTESIAN_TARGET, [*(pose.position + position), *orientation])
        bench.run(0.2)
        assert bench.servo.report.refused == refused
        assert bench.status is RobotStatus.HOLDING


def test_a_far_pose_in_a_stream_is_approached_with_a_short_lead() -> None:
    bench = Bench(tcp_speed=0.25)
    pose = bench.servo.kinematics.pose(bench.q)
    bench.stream(0.1, Kind.CARTESIAN_TARGET, [*pose.position, *pose.orientation])
    bench.stream(2.0, Kind.CARTESIAN_TARGET, [*(pose.position + np.array([0.0, 0.25, 0.0])), *pose.orientation])
    assert bench.limited & Limited.LEAD
    assert bench.servo.kinematics.pose(bench.q).position[1] == pytest.approx(0.25, abs=1e-4)
    assert tcp_speeds(bench).max() <= 0.25


def test_a_twist_into_a_singularity_stays_within_the_limits_and_says_so() -> None:
    bench = Bench(tcp_speed=0.25)
    bench.stream(4.0, Kind.TWIST, [0.25, 0, 0.1, 0, 0, 0, 0])  # until the arm is stretched out
    assert bench.limited & (Limited.SINGULAR | Limited.POSITION)
    bench.assert_within_limits()
    bench.stream(1.0, Kind.TWIST, [-0.2, 0, -0.1, 0, 0, 0, 0])
    assert tcp(bench)[-1][0] < tcp(bench)[-240][0] - 0.1  # and comes back


BOX = WorkspaceSpec((0.25, -0.1, 0.3), (0.4, 0.1, 0.6))


ROOM = WorkspaceSpec((0.0, -0.3, 0.2), (0.5, 0.3, 0.7))


@pytest.mark.parametrize(
    ("kind", "values", "box", "face", "axis", "brakes"),
    [
        (Kind.TWIST, [0.25, 0.1, 0.0, 0, 0, 0, 0], BOX, 0.4, 0, True),
        (Kind.TWIST, [0.0, 0.0, -0.25, 0, 0, 0, 0], BOX, 0.3, 2, True),
        (Kind.TWIST, [-0.25, 0.0, 0.0, 0, 0, 0, 0], BOX, 0.25, 0, True),
        (Kind.JOINT_VELOCITY, [0.8, 0, 0, 0, 0, 0, 0], BOX, 0.1, 1, True),
        (Kind.JOINT_VELOCITY, [0, 0.8, 0, 0.8, 0, 0, 0], BOX, 0.4, 0, True),
        # The slow-down before the faces does not suffice here; the check of where the stop would end must act.
        (Kind.JOINT_VELOCITY, [1.5, 0, 0, 0, 0, 0, 0], ROOM, 0.3, 1, False),
        (Kind.JOINT_VELOCITY, [-1.5, 0, 0, 0, 0, 0, 0], ROOM, -0.3, 1, False),
        (Kind.JOINT_VELOCITY, [0, 1.5, 0, 1.0, 0, 0, 0], ROOM, 0.5, 0, False),
        (Kind.JOINT_VELOCITY, [0, -1.0, 0, 1.0, 0, 0, 0], ROOM, 0.7, 2, False),
    ],
)
def test_the_workspace_is_never_left(
    kind: Kind, values: list[float], box: WorkspaceSpec, face: float, axis: int, brakes: bool
) -> None:
    spec = panda(workspace=box)
    if not brakes:
        spec = replace(spec, limits=tightened(spec.limits, 0.1, 0.02))
    bench = Bench(spec, tcp_speed=0.25 if brakes else FAR)
    bench.stream(3.0, kind, values)
    path = tcp(bench)
    assert bench.limited & Limited.WORKSPACE
    assert (path >= np.array(box.lower) - 1e-6).all()
    assert (path <= np.array(box.upper) + 1e-6).all()
    assert path[-1][axis] == pytest.approx(face, abs=5e-3)
    bench.assert_within_limits()


def test_outside_the_workspace_the_tcp_may_only_come_back_in() -> None:
    box = WorkspaceSpec((0.35, -0.1, 0.3), (0.5, 0.1, 0.6))
    bench = Bench(panda(workspace=box), tcp_speed=0.25)
    begun = bench.servo.kinematics.fk(bench.q)[0]
    assert begun < box.lower[0]
    bench.stream(1.0, Kind.TWIST, [-0.2, 0, 0, 0, 0, 0, 0])
    assert tcp(bench)[:, 0].min() >= begun - 1e-6
    bench.stream(1.0, Kind.TWIST, [0.1, 0, 0, 0, 0, 0, 0])
    assert tcp(bench)[-1][0] > box.lower[0]


@given(st.tuples(UNIT, UNIT, UNIT), st.tuples(UNIT, UNIT, UNIT), st.tuples(UNIT, UNIT, UNIT))
def test_quaternions(a, turn, vector):
    start = apply_rotation((0.0, 0.0, 0.0, 1.0), a)
    matrix = quaternion_to_matrix(start)
    assert rotate(start, vector) == pytest.approx(list(matrix @ vector), abs=1e-12)
    end = apply_rotation(start, turn)
    assert difference([0.0, 0.0, 0.0, *start], [1.0, 2.0, 3.0, *end]) == pytest.approx([1, 2, 3, *turn], abs=1e-7)
