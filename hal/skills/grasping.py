"""Grasp an object at a known pose, or at one that is a little off, with any arm and gripper."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from ..arguments import number
from ..geometry import Pose, tcp_pose
from .running import SkillOptions, SkillResult, SkillRun, flip_pose, lift_pose

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ..robot import Robot

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
    **options: Unpack[SkillOptions],
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
        **options: ``speed``, ``deadman``, ``timeout`` and others, which all skills take:
            :class:`~hal.skills.running.SkillOptions`.

    Returns:
        The result; false, with the reason, for what may go wrong in the world (:data:`hal.skills.Reason`).

    Raises:
        CommandError: An invalid argument, or neither ``deadman`` nor ``unattended`` for an arm that really moves.
        NotSupported: The arm has no gripper.
        MotionStopped: A stop, or the dead-man was released for longer than ``patience``.
        RobotFault: The arm or the gripper reports a fault.
        ConnectionLost: The arm or the gripper does not answer.
    """
    run = SkillRun("grasp", arm, PHASES, **options)
    return run_grasp(run, pose, width, force, approach, lift, hold, flip)


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
    **options: Unpack[SkillOptions],
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
        force: As for :func:`grasp`, like all that follow.
        approach: Distance at which the approach begins, m.
        lift: Height to which the object is lifted, m.
        hold: Time for which it is held up, s.
        flip: Whether the hand may be turned by half a turn.
        **options: :class:`~hal.skills.running.SkillOptions`.

    Returns:
        The result; false, with the reason, for what may go wrong in the world (:data:`hal.skills.Reason`).

    Raises:
        HalError: As :func:`grasp`.
    """
    number("touch_force", touch_force, "N", least=0.0, above=True)
    number("touch_speed", touch_speed, "m/s", least=0.0, above=True)
    run = SkillRun("gentle_grasp", arm, GENTLE_PHASES, **options)

    def centre(at: Pose) -> None:
        centre_on(run, at, width, touch_force, touch_speed)

    return run_grasp(run, pose, width, force, approach, lift, hold, flip, centre)


# The parts of a grasp, for other skills as well.


def run_grasp(
    run: SkillRun,
    pose: Pose,
    width: float | None,
    force: float | None,
    approach: float,
    lift: float,
    hold: float,
    flip: bool,
    centre: Callable[[Pose], None] = lambda at: None,
) -> SkillResult:
    """Make a grasp with the arguments of :func:`grasp`; ``centre`` is called between the approach and the grasp."""
    hold = number("hold", hold, "s", least=0.0)
    with run:
        before, at, q = plan_grasp(run, pose, width, approach, lift, flip)
        check_free(run)
        run.begin("open")
        run.set_fingers()
        run.approach(before, q, at)
        centre(at)
        close_on(run, width, force)
        lift_up(run, lift, hold)
    if run.reason in ("missed", "wrong_width", "not_centred"):
        with run:  # let go, and go back to where the approach began
            run.set_fingers()
            run.move(before)
    return run.result()


def check_free(run: SkillRun) -> None:
    """Fail as ``holding`` if the fingers hold something, which would fall when they open."""
    gripper = run.gripper
    state = gripper.state()
    if state.grasped:
        text = f"{gripper.name} holds something already, {state.width:.3f} m wide"
        run.fail("holding", f"{text}: put it down, and open the fingers (gripper.open())")


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
    grasps = (pose, flip_pose(pose)) if flip else (pose,)
    (before, at, _), q = run.choose_way([(to @ Pose((0.0, 0.0, -approach)), to, lift_pose(to, lift)) for to in grasps])
    return before, at, q


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
            run.set_fingers(width + 2.0 * missing + _LET_GO)
            return
        run.set_fingers()
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

    def is_pressed() -> bool:
        now = gripper.state().force
        return now is not None and now >= _TOUCHED * force

    run.close_fingers(lambda: gripper.start(0.0, min(speed, gripper.spec.speed), force), is_pressed)
    width = gripper.state().width
    if width <= gripper.width_min + NOTHING:
        run.fail("missed", f"{gripper.name} closed on nothing")
    return width


def close_on(run: SkillRun, width: float | None, force: float | None) -> None:
    """Close the fingers on an object of this width, m; None if it is unknown."""
    run.begin("close")
    gripper = run.gripper
    nothing = gripper.width_min + NOTHING
    least = nothing if width is None else max(nothing, width - TOLERANCE)
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
    if rests <= nothing:
        run.fail("missed", f"{gripper.name} closed on nothing")
    wanted = "" if width is None else f" instead of {width:.3f} m"
    text = f"{gripper.name} closed on something that is {rests:.3f} m wide{wanted}"
    run.fail("wrong_width", f"{text}; if it was the table, grasp higher (clearance= of grasp_pose)")


def lift_up(run: SkillRun, lift: float, hold: float) -> None:
    """Lift what the fingers hold, and check that they still hold it at the end."""
    arm, gripper = run.arm, run.gripper
    held = gripper.state().width
    run.begin("lift")
    run.move(lift_pose(arm.state().tcp_set, lift))
    check_held(run, held)
    run.begin("hold")
    arm.clock.sleep(min(hold, run.time_left()))
    run.time_left()
    check_held(run, held)


def check_held(run: SkillRun, width: float) -> None:
    """Fail as ``dropped`` if the fingers, which held something of this width in m, do not hold it any more."""
    state = run.gripper.state()
    if state.grasped is False or abs(state.width - width) > _SLIPPED:
        run.fail("dropped", f"the object was held at {width:.3f} m; the fingers are now at {state.width:.3f} m")
