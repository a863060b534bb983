"""Push an object over a table with the fingertips, with any arm."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import integer, number, vector
from ..errors import CommandError
from ..geometry import Pose, tcp_pose
from .objects import LocatedObject
from .running import SkillOptions, SkillResult, SkillRun, flip_pose, lift_pose

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ..robot import Robot

Array = NDArray[np.float64]

PHASES = ("close", "approach", "descend", "push", "back_off", "lift")
"""Phases of :func:`push`."""
FINGER = 0.009
"""Distance from the tcp to the front of the fingertips along the tcp's x axis, m: that of the Franka Hand."""
PALM = (0.032, 0.037)
"""How far the palm reaches before the tcp, along its x axis, and its distance from the tcp along z, m."""
_ROOM = 0.004
"""Least distance between the palm and the object, m."""
_BEHIND = 0.02
"""Distance from the object at which the fingers come down, and to which they back off, m."""
_LET_GO = 0.01
"""By how much the fingers open before they back off, m."""
_TURN = 2.0
"""Length of the way on which an object turns until a side lies against the fingers, as a multiple of the distance from
its middle to its corner behind."""
_SAME_PLACE = 1e-3
"""Distance below which an object needs no push, m."""


def push(
    arm: Robot,
    path: Sequence[Pose],
    *,
    opening: float = 0.02,
    tcp_speed: float = 0.05,
    approach: float = 0.15,
    flip: bool = True,
    **options: Unpack[SkillOptions],
) -> SkillResult:
    """Close the gripper, come down at the start of a path, follow it to its end, back off and lift.

    Args:
        arm: The arm; its gripper, if it has one, closes first.
        path: Poses of the tcp in the arm's base frame, at least two, with straight lines between them.
        opening: Distance between the fingers while they push, m: two open fingers turn an object less than one does.
        tcp_speed: Speed of the tcp on the path, m/s: slow enough that the object stops when the fingers do.
        approach: Height above the path at which the arm arrives and leaves, m.
        flip: Whether the hand may be turned by half a turn about the tcp's z axis, if that is nearer.
        **options: ``speed``, ``deadman``, ``timeout`` and others, which all skills take:
            :class:`~hal.skills.running.SkillOptions`.

    Returns:
        The result; false, with the reason, for what may go wrong in the world (:data:`hal.skills.Reason`).

    Raises:
        CommandError: An invalid argument, or neither ``deadman`` nor ``unattended`` for an arm that really moves.
        MotionStopped: A stop, or the dead-man was released for longer than ``patience``.
        RobotFault: The arm or the gripper reports a fault.
        ConnectionLost: The arm or the gripper does not answer.
    """
    if isinstance(path, Pose) or len(path) < 2:
        raise CommandError("path must be at least two poses of the tcp", code="path_too_short")
    poses = [tcp_pose("path", pose) for pose in path]
    number("tcp_speed", tcp_speed, "m/s", least=0.0, above=True)
    number("approach", approach, "m", least=0.0)
    run = SkillRun("push", arm, PHASES, **options)
    with run:
        ways = [poses, [flip_pose(pose) for pose in poses]] if flip else [poses]
        heights = (approach, 0.6 * approach)  # lower where the arm does not reach that high
        way, q = run.choose_way(*([_list_poses(each, height) for each in ways] for height in heights))
        start, *rest, away, end = way
        run.begin("close")
        if arm.gripper is not None:
            run.set_fingers(opening)
        run.approach(start, q, rest[0])
        run.begin("push")
        for pose in rest[1:]:
            run.move(pose, tcp_speed=tcp_speed)
        run.begin("back_off")
        if arm.gripper is not None and opening > 0.0:  # something round between two fingers would come back with them
            run.set_fingers(opening + _LET_GO)
        run.move(away)
        run.begin("lift")
        run.move(end)
    return run.result()


def _list_poses(path: Sequence[Pose], approach: float) -> list[Pose]:
    """Return all poses that a push visits: above its start, along its path, back from its end, and up."""
    last, step = path[-1], path[-1].position - path[-2].position
    length = float(np.linalg.norm(step))
    back = step * (min(1.0, _BEHIND / length) if length > 0.0 else 0.0)
    away = Pose(last.position - back, last.orientation)
    return [lift_pose(path[0], approach), *path, away, lift_pose(away, approach)]


def push_path(
    found: LocatedObject, goal: ArrayLike, *, height: float = 0.02, clearance: float = 0.012, finger: float = FINGER
) -> list[Pose]:
    """Return the poses of the tcp that push an object straight to a goal: behind the object, and short of the goal.

    The tcp's z axis points down and its fingers close across the way, so that both touch the object; if the palm would
    touch it first, the hand leans back. The side of the box around the object that faces the fingers most is taken to
    come to lie against them, but the shorter the way, the less the object turns on it.

    Args:
        found: The object.
        goal: Where the middle of the object goes (2,), x and y in the arm's base frame, m.
        height: Height of the tcp above the table, m; less for a low object.
        clearance: Least distance of the tcp from the table, m.
        finger: Distance from the tcp to the front of the fingertips along the tcp's x axis, m.

    Raises:
        CommandError: The object is at the goal already (``code`` is ``at_the_goal``).
    """
    middle = found.pose.position[:2]
    way = vector("goal", goal, 2) - middle
    length = float(np.linalg.norm(way))
    if length < _SAME_PLACE:
        raise CommandError("the object is at the goal already", code="at_the_goal")
    way = way / length
    axes = found.pose.matrix()[:2, :2]
    side = 0.5 * found.size[int(np.argmax(np.abs(way @ axes)))]
    behind = float(np.max((middle - found.points[:, :2]) @ way))
    side += (behind - side) * max(0.0, 1.0 - length / (_TURN * behind))
    z = found.table + max(clearance, min(height, 0.4 * found.height))
    yaw = math.atan2(way[1], way[0])
    tilt = _lean(found.table + found.height - z, finger)

    def find_pose(distance: float) -> Pose:
        """Return the pose of the tcp at a distance along the way, m."""
        return Pose.from_rpy([*(middle + distance * way), z], (math.pi, -tilt, yaw))

    return [find_pose(-behind - finger - _BEHIND), find_pose(max(length - side, -behind) - finger)]


def _lean(height: float, finger: float) -> float:
    """Return the least angle by which the hand leans back, so that its palm does not touch the object, rad.

    Args:
        height: Height of the object above the tcp, m.
        finger: Distance from the tcp to the front of the fingertips, m.
    """
    for lean in np.radians(range(0, 35, 5)):
        ahead, up = PALM @ np.array([[math.cos(lean), math.sin(lean)], [-math.sin(lean), math.cos(lean)]])
        if up > height + _ROOM or ahead < finger:
            break
    return float(lean)


def push_to(
    arm: Robot,
    locate: Callable[[], LocatedObject | None],
    goal: ArrayLike,
    *,
    tolerance: float = 0.005,
    tries: int = 4,
    opening: float = 0.02,
    tcp_speed: float = 0.05,
    approach: float = 0.15,
    flip: bool = True,
    **options: Unpack[SkillOptions],
) -> SkillResult:
    """Push an object to a goal: find it, push it, and correct what is left, until it is there.

    Args:
        arm: The arm.
        locate: Finds the object, as ``lambda: locate_by_truth(rig, arm, "cube")``; None if it is not seen.
        goal: Where the middle of the object goes (2,), x and y in the arm's base frame, m.
        tolerance: Distance from the goal at which it is there, m.
        tries: Greatest number of pushes.
        opening: As for :func:`push`, like all that follow.
        tcp_speed: Speed of the tcp on the path, m/s.
        approach: Height above the path at which the arm arrives and leaves, m.
        flip: Whether the hand may be turned by half a turn.
        **options: :class:`~hal.skills.running.SkillOptions`; ``timeout`` is that of all pushes together.

    Returns:
        The result; its reason is also ``not_seen`` or ``off_goal``, or that of the push which failed.

    Raises:
        CommandError: An invalid argument. The other errors are those of :func:`push`.
    """
    target = vector("goal", goal, 2)
    run = SkillRun("push_to", arm, ("locate", "push"), **options)
    with run:
        for left in range(integer("tries", tries, least=1), -1, -1):
            run.begin("locate")
            found = locate()
            if found is None:
                run.fail("not_seen", "no object was seen on the table")
            off = float(np.linalg.norm(found.pose.position[:2] - target))
            if off <= tolerance:
                break
            if not left:
                run.fail("off_goal", f"after {tries} pushes the object is {1e3 * off:.0f} mm from the goal")
            run.begin("push")
            options["timeout"] = run.time_left()
            path = push_path(found, target)
            pushed = push(arm, path, opening=opening, tcp_speed=tcp_speed, approach=approach, flip=flip, **options)
            if not pushed:
                run.fail(pushed.reason, f"{pushed.phase}: {pushed.message}")
    return run.result()
