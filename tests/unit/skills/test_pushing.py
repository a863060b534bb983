"""``hal.skills.push`` and ``push_to``: in lock-step, with the mock's arm and gripper."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
import pytest
from errors_kit import raises_code

import hal
from hal.skills import LocatedObject, SkillProgress, object_from_points, push, push_path, push_to

DOWN = [1.0, 0.0, 0.0, 0.0]
START, END = hal.Pose([0.45, 0.0, 0.05], DOWN), hal.Pose([0.55, 0.0, 0.05], DOWN)
PHASES = ["close", "approach", "descend", "push", "back_off", "lift"]


@pytest.fixture(scope="module")
def rig() -> Iterator[hal.Rig]:
    with hal.open("panda_table", driver="mock", pad="none", overrides=["cameras={}"]) as opened:
        yield opened


def block(x: float, y: float, size: tuple[float, float, float] = (0.06, 0.03, 0.03), yaw: float = 0.0) -> LocatedObject:
    """Return a block on a table that is level with the arm's base."""
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (2000, 3)) * size + [0.0, 0.0, 0.5 * size[2]]
    return object_from_points(hal.Pose.from_rpy((x, y, 0.0), (0.0, 0.0, yaw)).transform(points), 0.0)


def test_a_push_follows_its_path_and_leaves(rig: hal.Rig) -> None:
    arm, seen = rig.robots["panda"], list[tuple[str, hal.Pose]]()

    def progress(now: SkillProgress) -> None:
        seen.append((now.phase, arm.state().tcp))

    result = push(arm, [START, END], opening=0.02, approach=0.1, speed=1.0, progress=progress)
    assert result
    assert [phase for phase, _ in seen] == PHASES
    at = dict(seen)
    assert at["push"].distance(START)[0] < 2e-3
    assert at["back_off"].distance(END)[0] < 2e-3
    assert at["lift"].position == pytest.approx(END.position - [0.02, 0.0, 0.0], abs=2e-3)
    assert result.tcp.position == pytest.approx(END.position + [-0.02, 0.0, 0.1], abs=2e-3)
    widths = [width for width, _, _ in rig.driver("panda.gripper").log[-2:]]
    assert widths == pytest.approx([0.02, 0.03]), "the fingers let go before they back off"


def test_a_push_begins_where_the_arm_can_follow_its_line_to_the_end(rig: hal.Rig) -> None:
    """With the half turn of the hand that is nearer, joint 7 would be at its limit after 60 % of this line."""
    arm, leaning = rig.robots["panda"], [-0.9911718735, -0.0232643579, -0.1304902527, 0.0030628108]
    arm.move_to(arm.home, speed=1.0)
    result = push(
        arm, [hal.Pose(place, leaning) for place in ([0.4175, 0.0814, 0.02], [0.5692, 0.0886, 0.02])], speed=1.0
    )
    assert result, result.message


def test_what_a_push_cannot_do(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    with raises_code(hal.CommandError, "path_too_short"):
        push(arm, [START])
    with raises_code(hal.CommandError, "no_orientation"):
        push(arm, [START, hal.Pose(END.position)])
    far = push(arm, [START, hal.Pose([0.95, 0.0, 0.05], DOWN)])
    assert (far.reason, far.phase) == ("unreachable", "plan")


@pytest.mark.parametrize("angle", [0.0, 1.0, -2.5])
def test_the_way_is_behind_the_object_and_short_of_the_goal(angle: float) -> None:
    way = np.array([math.cos(angle), math.sin(angle)])
    start, end = push_path(block(0.5, 0.1, (0.04, 0.04, 0.03), angle), [0.5, 0.1] + 0.1 * way, finger=0.01)
    assert start.position[:2] == pytest.approx([0.5, 0.1] - 0.05 * way, abs=2e-3), "20 mm, a finger and half the object"
    assert end.position[:2] == pytest.approx([0.5, 0.1] + 0.07 * way, abs=2e-3)
    assert start.position[2] == pytest.approx(0.012, abs=1e-3)
    matrix = start.matrix()
    assert matrix[:2, 0] == pytest.approx(way, abs=5e-3), "x along the way"
    assert matrix[2, 2] == pytest.approx(-1.0), "and z down"


def test_an_object_does_not_turn_on_a_short_way() -> None:
    """Pushed at its corner, it lies against the fingers with its side only after a long way: else it goes too far."""
    turned = math.radians(50.0)
    found, way = block(0.5, 0.1, (0.06, 0.02, 0.03), turned), np.array([1.0, 0.0])
    corner, side = 0.03 * math.cos(turned) + 0.01 * math.sin(turned), 0.01
    for length, left in ((0.003, corner), (0.1, side)):
        goal = [0.5, 0.1] + length * way
        end = push_path(found, goal, finger=0.01)[-1]
        assert goal[0] - end.position[0] == pytest.approx(left + 0.01, abs=2e-3)


def test_the_hand_leans_back_from_tall_objects() -> None:
    leans = []
    for height in (0.03, 0.06, 0.12):
        start, _ = push_path(block(0.5, 0.0, (0.05, 0.05, height)), [0.6, 0.0])
        leans.append(math.acos(min(1.0, -start.matrix()[2, 2])))
        assert start.matrix()[0, 2] >= -1e-9, "its palm is behind its fingertips"
    assert leans == sorted(leans)
    assert leans[0] == pytest.approx(0.0, abs=1e-6)
    assert 0.1 < leans[-1] < 0.6
    with raises_code(hal.CommandError, "at_the_goal"):
        push_path(block(0.5, 0.0), block(0.5, 0.0).pose.position[:2])


def test_pushes_are_repeated_until_the_object_is_there(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    places = [block(0.45, 0.0), block(0.51, 0.01), block(0.548, 0.001)]
    left = iter(places)
    result = push_to(arm, lambda: next(left), [0.55, 0.0], speed=1.0)
    assert result
    assert [phase.name for phase in result.phases] == ["locate", "push", "locate", "push", "locate"]
    stuck = push_to(arm, lambda: places[0], [0.55, 0.0], tries=1, speed=1.0)
    assert (stuck.reason, stuck.phase) == ("off_goal", "locate")
    assert push_to(arm, lambda: None, [0.55, 0.0]).reason == "not_seen"
    assert push_to(arm, lambda: places[0], [1.5, 0.0]).reason == "unreachable"
    assert push_to(arm, lambda: places[0], [0.55, 0.0], tries=9, timeout=15.0, speed=1.0).reason == "timed_out"
