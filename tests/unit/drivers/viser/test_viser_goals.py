"""Goals of the 3D viewer: which drag counts, and when a goal ends."""

from __future__ import annotations

from math import inf, nan

import numpy as np
import pytest

from hal.drivers.viser.goals import FARTHEST, UNUSED, HandleDrag, checked_pose
from hal.geometry import Pose

LEVEL = (0.0, 0.0, 0.0, 1.0)
HERE, THERE = (0.3, 0.0, 0.5), (0.4, 0.0, 0.5)
AT = [Pose(HERE), Pose(HERE)]


def dragged(let_go: bool = True) -> HandleDrag:
    drag = HandleDrag()
    drag.grab(1)
    assert drag.move(1, THERE, LEVEL, 10.0)
    if let_go:
        drag.release(1)
    return drag


@pytest.mark.parametrize(
    ("position", "orientation"),
    [
        ((nan, 0.0, 0.5), LEVEL),
        ((0.0, inf, 0.5), LEVEL),
        ((0.0, 0.0, FARTHEST + 0.01), LEVEL),
        ((0.0, 0.5), LEVEL),
        (HERE, (0.0, 0.0, 0.0, 0.0)),
        (HERE, (0.0, nan, 0.0, 1.0)),
        (HERE, (0.0, 0.0, 1.0)),
        (HERE, (0.0, 0.0, 0.0, 30.0)),
    ],
)
def test_numbers_that_make_no_sense_are_no_goal(position: tuple[float, ...], orientation: tuple[float, ...]) -> None:
    assert checked_pose(position, orientation) is None
    drag = HandleDrag()
    drag.grab(1)
    assert not drag.move(1, position, orientation, 0.0)
    assert drag.goal is None


def test_a_goal_is_a_unit_quaternion_and_has_a_number_of_its_own() -> None:
    drag = dragged(let_go=False)
    first = drag.goal
    assert drag.move(1, THERE, (0.0, 0.0, 0.9, 0.9), 11.0)
    second = drag.goal
    assert second.seq > first.seq
    assert np.linalg.norm(second.pose.orientation) == pytest.approx(1.0)
    drag.clear()
    drag.grab(1)
    drag.move(1, THERE, LEVEL, 12.0)
    assert drag.goal.seq > second.seq


def test_handle_belongs_to_the_page_that_holds_it() -> None:
    drag = HandleDrag()
    assert not drag.move(2, THERE, LEVEL, 0.0)  # never grabbed
    drag.grab(1)
    assert not drag.free
    drag.grab(2)
    assert not drag.move(2, THERE, LEVEL, 0.0)
    drag.release(2)
    drag.leave(2)
    assert drag.move(1, THERE, LEVEL, 0.0)
    drag.release(1)
    drag.grab(2)  # it was released
    assert drag.move(2, HERE, LEVEL, 0.0)


def test_grabbing_alone_sets_no_goal() -> None:
    drag = HandleDrag()
    drag.grab(1)
    assert drag.goal is None
    assert not drag.free
    drag.release(1)
    assert drag.free


def test_goal_is_reached_only_after_its_release() -> None:
    drag = dragged(let_go=False)
    near = [Pose(HERE), Pose((0.4, 0.0015, 0.5))]
    drag.update(10.1, near, tripped=False)
    assert drag.goal is not None
    drag.release(1)
    turned = [Pose(THERE, (0.0, 0.0, np.sin(0.01), np.cos(0.01)))]  # by 0.02 rad
    drag.update(10.2, turned, tripped=False)
    assert drag.goal is not None
    drag.update(10.3, near, tripped=False)
    assert drag.goal is None
    assert drag.free


def test_unused_goal_ends() -> None:
    for drag in (dragged(), dragged(let_go=False)):  # also when a page froze in the middle of a drag
        drag.update(10.0, AT, tripped=False)
        drag.update(10.0 + UNUSED - 0.1, AT, tripped=False)
        assert drag.goal is not None
        drag.update(10.0 + UNUSED + 0.1, AT, tripped=False)
        assert drag.goal is None
        assert not drag.move(1, THERE, LEVEL, 21.0)  # until it is grabbed again


def test_approached_goal_stays() -> None:
    drag = dragged()
    for step in range(40):
        drag.update(10.0 + step, [Pose((0.3 + 0.002 * step, 0.0, 0.5))], tripped=False)
        assert drag.goal is not None
    drag.update(50.0 + UNUSED, [Pose((0.3, 0.0, 0.5))], tripped=False)
    assert drag.goal is None


def test_trip_ends_a_goal_and_its_drag() -> None:
    drag = dragged(let_go=False)
    drag.update(10.1, AT, tripped=True)
    assert drag.goal is None
    assert not drag.move(1, THERE, LEVEL, 10.2)
    drag.grab(1)
    assert drag.move(1, THERE, LEVEL, 10.3)  # a new drag
    drag.update(10.4, AT, tripped=True)
    assert drag.goal is not None


def test_goal_ends_with_its_page() -> None:
    drag = dragged()
    drag.leave(2)
    assert drag.goal is not None
    drag.leave(1)
    assert drag.goal is None
