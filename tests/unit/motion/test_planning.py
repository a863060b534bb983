"""The way of the tcp along poses, and what is refused before anything moves."""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest
from errors_kit import raises_code
from specs import PANDA_HOME, panda

import hal
from hal.errors import CommandError, Unreachable
from hal.geometry import apply_rotation, difference
from hal.kinematics.arm import Kinematics
from hal.motion.lines import METRES_PER_RADIAN, tcp_lines
from hal.motion.planning import PathPlanner
from hal.servo.path import JointPath
from hal.specs import WorkspaceSpec

SPEC = panda()
ARM = Kinematics(SPEC.kinematics)
START = ARM.fk(PANDA_HOME)


def planner(**terms) -> PathPlanner:
    return PathPlanner(ARM, SPEC.limits.lower, SPEC.limits.upper, **terms)


def moved(way, turn=(0.0, 0.0, 0.0)) -> list[float]:
    return [*np.add(START[:3], way), *apply_rotation(START[3:], turn)]


def test_a_corner_is_rounded_near_its_pose_and_a_way_back_is_not() -> None:
    poses = [START, moved([0.1, 0.0, 0.0]), moved([0.1, 0.1, 0.0], (0.0, 0.0, 0.4)), moved([0.1, 0.0, 0.0])]
    round_then_back = tcp_lines(poses, 0.02)
    assert [round(line.length, 6) for line in round_then_back] == [0.2, 0.1]
    line = round_then_back[0]
    nearest = min(np.linalg.norm(difference(line.at(s), poses[1])[:3]) for s in np.linspace(0.0, line.length, 2001))
    assert nearest == pytest.approx(0.1875 * 0.02 * np.sqrt(2.0), rel=1e-3)
    assert len(tcp_lines(poses, 0.0)) == 3
    # No jump of the curvature: the second difference changes by little from sample to sample.
    way = np.array([line.at(s) for s in np.linspace(0.0, line.length, 4001)])
    bends = np.diff(way, 2, axis=0)
    assert np.abs(np.diff(bends, axis=0)).max() < 0.02 * np.abs(bends).max()
    assert line.at(line.length) == pytest.approx(poses[2], abs=1e-9)


def test_a_rotation_on_the_spot_and_poses_that_repeat() -> None:
    turned = moved([0.0, 0.0, 0.0], (0.0, 0.0, 1.0))
    (line,) = tcp_lines([START, START, turned, turned], 0.01)
    assert line.length == pytest.approx(METRES_PER_RADIAN)
    assert tcp_lines([START, START], 0.01) == []
    straight = [moved([0.02 * k, 0.0, 0.0]) for k in range(1, 5)]
    assert len(tcp_lines([START, *straight], 0.0)) == 1, "no rest where there is no corner"


def test_the_spline_is_on_the_way_everywhere() -> None:
    poses = [moved([0.1, 0.0, -0.1]), moved([0.1, 0.2, 0.0], (0.0, 0.3, 0.4)), moved([-0.1, 0.2, 0.0])]
    plan = planner().plan_poses(PANDA_HOME, poses, 0.02)
    (line,) = tcp_lines([START, *poses], 0.02)
    path = JointPath(plan.sections[0])
    for s in np.linspace(0.0, line.length, 1000).tolist():
        error = difference(ARM.fk(path.at(s)[0]), line.at(s))
        assert np.linalg.norm(error[:3]) < 2e-4
        assert np.linalg.norm(error[3:]) < 1e-3


@pytest.mark.parametrize(
    ("goal", "code"),
    [
        (moved([0.7, 0.0, 0.0]), "singular"),
        (moved([0.0, 0.0, 0.0], (0.0, 2.9, 0.0)), "joint_limit"),
        (moved([0.0, 0.3, 0.0]), "outside_workspace"),
    ],
)
def test_refusals_say_how_far_along(goal: list[float], code: str) -> None:
    box = WorkspaceSpec((-1.0, -0.2, 0.0), (1.5, 0.2, 1.5))
    with pytest.raises(Unreachable) as caught:
        planner(workspace=box).plan_poses(PANDA_HOME, [goal])
    found = caught.value
    assert found.code == code
    assert 0.0 < found.along < 1.0
    assert found.q is None or len(found.q) == 7
    (line,) = tcp_lines([START, goal], 0.0)
    assert found.distance == pytest.approx(found.along * line.length)
    if code == "workspace":
        assert found.along == pytest.approx(0.2 / 0.3, abs=0.03)
    short = line.at(0.98 * found.distance - 0.005)  # up to there it can be followed
    assert planner(workspace=box).plan_poses(PANDA_HOME, [short]).sections


def test_a_start_outside_may_come_back_in() -> None:
    box = WorkspaceSpec((-1.0, -1.0, 0.6), (1.0, 1.0, 1.5))
    assert planner(workspace=box).plan_poses(PANDA_HOME, [moved([0.0, 0.0, 0.2])]).sections
    with raises_code(Unreachable, "outside_workspace"):
        planner(workspace=box).plan_poses(PANDA_HOME, [moved([0.0, 0.0, -0.1])])


def test_waypoints_are_passed_exactly_or_rounded() -> None:
    points = [np.add(PANDA_HOME, d) for d in ([0.3] * 7, [0.3, 0.6, 0, 0, 0, 0, 0], [0.3, 0.9, -0.3, 0, 0, 0, 0])]
    exact = planner().plan_joints(PANDA_HOME, points)
    assert [section.q[-1] for section in exact.sections] == [tuple(point.tolist()) for point in points]
    (section,) = planner().plan_joints(PANDA_HOME, points, 0.1).sections
    samples = JointPath(section).samples(4)
    for point in points[:-1]:
        assert 0.005 < np.linalg.norm(samples - point, axis=1).min() < 0.04
    legs = [PANDA_HOME, *points]
    for sample in samples:  # no farther from the straight ways than at the corners
        away = []
        for a, b in pairwise(legs):
            along = np.clip((sample - a) @ np.subtract(b, a) / np.sum(np.square(np.subtract(b, a))), 0.0, 1.0)
            away.append(np.linalg.norm(sample - a - along * np.subtract(b, a)))
        assert min(away) < 0.04


def test_a_further_check_gets_the_whole_way() -> None:
    seen = []

    def check(samples: np.ndarray) -> None:
        seen.append(samples)
        raise CommandError("no", code="refused_here")

    with raises_code(CommandError, "refused_here"):
        planner(check=check).plan_poses(PANDA_HOME, [moved([0.1, 0.1, 0.0])])
    assert seen[0][0] == pytest.approx(PANDA_HOME)
    assert np.abs(np.diff(seen[0], axis=0)).max() < 0.05


def test_a_way_of_too_many_knots_is_refused() -> None:
    poses = [moved([0.05 * (-1) ** k, 0.001 * k, 0.0]) for k in range(120)]
    with raises_code(CommandError, "path_too_long"):
        planner().plan_poses(PANDA_HOME, poses, 0.0)
    assert isinstance(hal.Unreachable, type)
