"""Before an episode: everything back to where it starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .pose import Pose

if TYPE_CHECKING:
    from .deadman import Deadman
    from .rig import Rig
    from .robot import Robot

__all__ = ["put_back", "stands_in_world"]


def stands_in_world(rig: Rig, robot: Robot) -> bool:
    """Is this arm a part of the simulated world, and no copy of a real one? Then it need not drive to be elsewhere."""
    world = rig.plan.world
    return world is not None and robot.spec.driver == world.driver


def put_back(
    rig: Rig,
    robot: Robot,
    q: ArrayLike | None = None,
    *,
    poses: Mapping[str, Pose] | None = None,
    deadman: Deadman | None = None,
    unattended: bool = False,
) -> None:
    """A simulated world as it began, things at ``poses`` where they are named; the arm at ``q`` (n,), rad.

    An arm of that world is put there (where it began, without ``q``). Any other arm **drives**, as ``move_to`` does,
    and then opens its gripper, which drops what it holds; without ``q`` it drives home. Raises what ``move_to`` raises:
    MotionStopped, too, as long as nobody has acknowledged ``rig.stop()``.
    """
    if rig.has_world:
        rig.world.reset()
        for name, pose in (poses or {}).items():
            rig.world.reset(name, pose=pose)
    if stands_in_world(rig, robot):
        rig.world.reset(robot.name, q=robot.spec.initial if q is None else np.asarray(q, float))
        return
    robot.move_to(robot.home if q is None else np.asarray(q, float), deadman=deadman, unattended=unattended)
    if robot.gripper is not None:
        robot.gripper.open()
