"""Grasp an object at a known pose, or at one that is a little off, with any arm and gripper."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..arguments import number
from ..geometry import Pose, tcp_pose
from .running import SkillProgress, SkillResult, SkillRun, above, flipped

if TYPE_CHECKING:
    from ..deadman import Deadman
    from ..robot import Robot

__all__ = ["gentle_grasp", "grasp"]

Array = NDArray[np.float64]

PHASES = ("open", "approach", "descend", "close", "lift", "hold")
"""Phases of :func:`grasp`."""
GENTLE_PHASES = ("open", "approach", "descend", "touch", "centre", "close", "lift", "hold")
"""Phases of :func:`gentle_grasp`."""
NOTHING = 0.002
"""Width up to which closed fingers hold nothing, m."""
TOLERANCE = 0.01
"""Difference up to which an object of another width counts as the expected one, m."""
_SLIPPED = 0.005
"""Change of the width from which on a held object counts as dropped, m."""
_TOUCHED = 0.5
"""Share of the force of a touch from which on a finger counts as touching."""
_TOUCHES = 4
"""Greatest number of touches after the first one."""
_PROBE = 0.003
"""Step to one side that shows which side is the right one, m."""
_CENTRED = 0.001
"""Distance from the middle up to which an object counts as centred, m."""
_LET_GO = 0.01
"""By how much the fingers open between the last touch and the grasp, m."""
_SLOW = 0.03
"""Speed of the tcp with the object between the fingers, m/s."""
_SPEED = 0.1
"""Speed of the tcp near the object, m/s."""


def grasp(
    arm: Robot,
    pose: Pose,
    *,
    width: float | None = None,
    force: float | None = None,
    approach: float = 0.1,
    lift: float = 0.1,
    hold: float = 0.0,
    flip: bool = True,
    speed: float | None = None,
    deadman: Deadman | None = None,
    unattended: bool = False,
    patience: float = 60.0,
    progress: Callable[[SkillProgress], None] | None = None,
) -> SkillResult:
    """Open the gripper, approach along the tcp's z axis, close, lift, and check that the object is held.

    After a miss the fingers open again and the arm backs off to where it came from.

    Args:
        arm: The arm, with a gripper.
        pose: Pose of the tcp that grasps, in the arm's base frame, with an orientation.
        width: Width of the object between the fingers, m; None if it is unknown.
        force: Force to hold it with, N; the gripper's default if left out.
        approach: Distance from ``pose``, against the tcp's z axis, at which the approach begins, m.
        lift: Height to which the object is lifted, along the z axis of the base, m.
        hold: Time for which it is held up before the last check, s.
        flip: Whether the hand may be turned by half a turn about the tcp's z axis, if that is nearer.
        speed: Share of the joint speed limits on the way to the approach; the rig's ``move_speed`` by default.
        deadman: Switch that must be held for the arm and the fingers to move, for example ``pad.hold("l2")``.
        unattended: Move an arm that really moves without a dead-man.
        patience: Longest time for which the dead-man may be released, s.
        progress: Called when a phase begins: ``open``, ``approach``, ``descend``, ``close``, ``lift``, ``hold``.

    Returns:
        The result; false, with the reason, for what may go wrong in the world (:data:`hal.skills.Reason`).

    Raises:
        CommandError: An invalid argument, or neither ``deadman`` nor ``unattended`` for an arm that really moves.
        NotSupported: The arm has no gripper.
        MotionStopped: A stop, or the dead-man was released for longer than ``patience``.
        RobotFault: The arm or the gripper reports a fault.
        ConnectionLost: The arm or the gripper does not answer.
    """
    run = SkillRun(
        "grasp",
        arm,
        PHASES,
        deadman=deadman,
        unattended=unattended,
        patience=patience,
        speed=speed,
        progress=progress,
    )
    hold = number("hold", hold, "s", least=0.0)
    with run:
        before, pose, q = plan_grasp(run, pose, width, approach, lift, flip)
        reach_for(run, before, pose, q)
        close_on(run, width, force)
        lift_up(run, lift, hold)
    if run.reason in ("missed", "wrong_width"):
        back_off(run, before)
    return run.result()


def gentle_grasp(
    arm: Robot,
    pose: Pose,
    width: float,
    *,
    touch_force: float = 3.0,
    touch_speed: float = 0.02,
    force: float | None = None,
    approach: float = 0.1,
    lift: float = 0.1,
    hold: float = 0.0,
    flip: bool = True,
    speed: float | None = None,
    deadman: Deadman | None = None,
    unattended: bool = False,
    patience: float = 60.0,
    progress: Callable[[SkillProgress], None] | None = None,
) -> SkillResult:
    """Grasp an object that is not quite between the fingers, and hardly move it.

    The fingers close slowly until the first one touches. The width there shows by how much the object is off the
    middle. The fingers open, the arm moves a little to one side, and a second touch shows whether that was the right
    one; then the arm moves by what is missing, and the fingers close. An object that slides under ``touch_force`` is
    pushed to the middle instead.

    Args:
        arm: The arm, with a gripper whose fingers close along the tcp's y axis.
        pose: Pose of the tcp that grasps, in the arm's base frame, with an orientation.
        width: Width of the object between the fingers, m.
        touch_force: Greatest force of a finger that touches, N.
        touch_speed: Speed at which the width shrinks until the touch, m/s.
        force: Force to hold the object with, N; the gripper's default if left out.
        approach: Distance from ``pose``, against the tcp's z axis, at which the approach begins, m.
        lift: Height to which the object is lifted, along the z axis of the base, m.
        hold: Time for which it is held up before the last check, s.
        flip: Whether the hand may be turned by half a turn about the tcp's z axis, if that is nearer.
        speed: Share of the joint speed limits on the way to the approach; the rig's ``move_speed`` by default.
        deadman: Switch that must be held for the arm and the fingers to move, for example ``pad.hold("l2")``.
        unattended: Move an arm that really moves without a dead-man.
        patience: Longest time for which the dead-man may be released, s.
        progress: Called when a phase begins: ``open``, ``approach``, ``descend``, ``touch``, ``centre``, ``close``,
            ``lift``, ``hold``.

    Returns:
        The result; false, with the reason, for what may go wrong in the world (:data:`hal.skills.Reason`).

    Raises:
        CommandError: An invalid argument, or neither ``deadman`` nor ``unattended`` for an arm that really moves.
        NotSupported: The arm has no gripper.
        MotionStopped: A stop, or the dead-man was released for longer than ``patience``.
        RobotFault: The arm or the gripper reports a fault.
        ConnectionLost: The arm or the gripper does not answer.
    """
    run = SkillRun(
        "gentle_grasp",
        arm,
        GENTLE_PHASES,
        deadman=deadman,
        unattended=unattended,
        patience=patience,
        speed=speed,
        progress=progress,
    )
    hold = number("hold", hold, "s", least=0.0)
    number("touch_force", touch_force, "N", least=0.0, above=True)
    number("touch_speed", touch_speed, "m/s", least=0.0, above=True)
    with run:
        before, pose, q = plan_grasp(run, pose, width, approach, lift, flip)
        reach_for(run, before, pose, q)
        centre_on(run, pose, width, touch_force, touch_speed)
        close_on(run, width, force)
        lift_up(run, lift, hold)
    if run.reason in ("missed", "wrong_width", "not_centred"):
        back_off(run, before)
    return run.result()


# The parts of a grasp, for other skills as well.


def plan_grasp(
    run: SkillRun, pose: Pose, width: float | None, approach: float, lift: float, flip: bool
) -> tuple[Pose, Pose, Array]:
    """Check the arguments of a grasp, and that the arm reaches all of it.

    Returns:
        The pose from which the approach begins, the pose of the grasp, which may be flipped, and the joint positions
        (n,) at the first, rad.
    """
    pose = tcp_pose("pose", pose)
    number("approach", approach, "m", least=0.0)
    number("lift", lift, "m", least=0.0)
    gripper = run.gripper
    if width is not None and number("width", width, "m", least=0.0) > gripper.width_max:
        run.fail("too_wide", f"the object is {width:.3f} m wide; {gripper.name} opens to {gripper.width_max:.3f} m")
    grasps = (pose, flipped(pose)) if flip else (pose,)
    (before, at, _), q = run.choose_way([(way @ Pose((0.0, 0.0, -approach)), way, above(way, lift)) for way in grasps])
    return before, at, q


def reach_for(run: SkillRun, before: Pose, pose: Pose, q: Array) -> None:
    """Open the fingers, and bring them around the object."""
    run.begin("open")
    run.open_fingers()
    run.begin("approach")
    run.go(before, q)
    run.begin("descend")
    run.move(pose, tcp_speed=_SPEED)


def centre_on(run: SkillRun, pose: Pose, width: float, force: float, speed: float) -> None:
    """Move the tcp, along its y axis, until an object of this width in m is in the middle between the fingers."""
    run.begin("touch")
    missing = 0.5 * (touch(run, force, speed) - width)
    run.begin("centre")
    at, side = 0.0, 1.0
    for turn in range(_TOUCHES):
        if missing < -TOLERANCE:
            run.fail("wrong_width", f"the object is {2e3 * -missing:.0f} mm narrower than {width:.3f} m")
        if missing <= _CENTRED:  # let go: some hands cannot press harder on what they touch already
            run.open_fingers(width + 2.0 * missing + _LET_GO)
            return
        run.open_fingers()
        step = min(missing, _PROBE) if turn == 0 else missing  # the first one, to find out which side is right
        at += side * step
        run.move(pose @ Pose((0.0, at, 0.0)), tcp_speed=_SLOW)
        before, missing = missing, 0.5 * (touch(run, force, speed) - width)
        if missing > before:
            side = -side
    run.fail("not_centred", f"after {_TOUCHES + 1} touches the object is still {1e3 * missing:.0f} mm off the middle")


def touch(run: SkillRun, force: float, speed: float) -> float:
    """Close the fingers until one touches something; return the width there, m. Fail as ``missed`` if none does."""
    gripper = run.gripper

    def pressed() -> bool:
        now = gripper.state().force
        return now is not None and now >= _TOUCHED * force

    run.close_fingers(lambda: gripper.start(0.0, min(speed, gripper.spec.speed), force), pressed)
    width = gripper.state().width
    if width <= NOTHING:
        run.fail("missed", f"{gripper.name} closed on nothing")
    return width


def close_on(run: SkillRun, width: float | None, force: float | None) -> None:
    """Close the fingers on an object of this width, m; None if it is unknown."""
    run.begin("close")
    gripper = run.gripper
    least = NOTHING if width is None else max(NOTHING, width - TOLERANCE)
    most = gripper.width_max if width is None else width + TOLERANCE
    middle = 0.5 * (least + most)
    expected = min(middle, gripper.width_max)
    result = run.close_fingers(
        lambda: gripper.start_grasp(expected, force, inner=expected - least, outer=most - expected)
    )
    assert result is not None
    rests = result.state.width
    if result or (result.state.grasped and least < rests < most):
        return
    if rests <= NOTHING:
        run.fail("missed", f"{gripper.name} closed on nothing")
    wanted = "" if width is None else f" instead of {width:.3f} m"
    run.fail("wrong_width", f"{gripper.name} closed on something that is {rests:.3f} m wide{wanted}")


def lift_up(run: SkillRun, lift: float, hold: float) -> None:
    """Lift what the fingers hold, and check that they still hold it at the end."""
    arm, gripper = run.arm, run.gripper
    held = gripper.state().width
    run.begin("lift")
    run.move(above(arm.state().tcp_set, lift), tcp_speed=_SPEED)
    check_held(run, held)
    run.begin("hold")
    arm.clock.sleep(hold)
    check_held(run, held)


def check_held(run: SkillRun, width: float) -> None:
    """Fail as ``dropped`` if the fingers, which held something of this width in m, do not hold it any more."""
    state = run.gripper.state()
    if state.grasped is False or abs(state.width - width) > _SLIPPED:
        run.fail("dropped", f"the object was held at {width:.3f} m; the fingers are now at {state.width:.3f} m")


def back_off(run: SkillRun, before: Pose) -> None:
    """Let go, and go back to where the approach began."""
    with run:
        run.open_fingers()
        run.move(before, tcp_speed=_SPEED)
