"""``move_to``: a session that goes to one place and ends there."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .arguments import number, vector
from .control import Control, check_deadman
from .errors import CommandError, MotionStopped
from .pose import Pose
from .types import RobotState

if TYPE_CHECKING:
    from .deadman import Deadman
    from .robot import Robot

__all__ = ["move_to"]


def move_to(
    robot: Robot,
    target: ArrayLike | Pose | None,
    position: ArrayLike | None,
    *,
    deadman: Deadman | None,
    unattended: bool,
    speed: float | None,
    tcp_speed: float | None,
    timeout: float | None,
    patience: float,
) -> RobotState:
    """See :meth:`hal.robot.Robot.move_to`."""
    if patience != math.inf:
        number("patience", patience, "s", least=0.0)
    if timeout is not None:
        number("timeout", timeout, "s", least=0.0, above=True)
    check_deadman(deadman)
    if (target is None) == (position is None):
        raise CommandError("pass move_to either a target (joint positions or a hal.Pose) or position=")
    if position is not None:
        target = Pose(vector("position", position, 3), robot.state().tcp_set.orientation)
    goal = robot.ik(target) if isinstance(target, Pose) else vector("target", target)
    if goal.size != robot.n:
        hint = "; for a position of the tcp pass position=" if goal.size == 3 else ""
        raise CommandError(f"{robot.name} has {robot.n} joints; the target has {goal.size}{hint}")
    limits = robot.limits
    outside = np.flatnonzero((goal < limits.lower) | (goal > limits.upper))
    if outside.size:
        names = ", ".join(robot.joints[k] for k in outside)
        raise CommandError(f"the target is outside the position limits of {names}")
    session = Control(
        robot,
        deadman=deadman,
        rate_hz=50.0,
        speed=speed,
        tcp_speed=tcp_speed,
        unattended=unattended,
        goal=tuple(goal.tolist()),
    )
    clock = robot.clock
    start = held = clock.now()
    with session:
        for _ in clock.rate(50.0):
            servo = session._peek()
            session._check_trip(servo, clock.now())
            if servo.refused and servo.session == session._id:
                raise CommandError(f"the way to the target leaves the workspace of {robot.name}")
            if servo.arrived and servo.session == session._id:
                break
            if deadman is None or deadman.held:
                held = clock.now()
            elif clock.now() - held > patience:
                raise MotionStopped(f"nobody held the dead-man for {patience:g} s", "call move_to again")
            if timeout is not None and clock.now() - start > timeout:
                raise TimeoutError(f"{robot.name} did not reach the target within {timeout:g} s")
    return robot.state()
