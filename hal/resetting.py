"""Before an episode: everything back to where it starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .placement import draw_poses
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
    random: np.random.Generator | None = None,
    deadman: Deadman | None = None,
    unattended: bool = False,
) -> dict[str, Pose]:
    """A simulated world as it began, and the arm at ``q`` (n,), rad. Returns where things are that began elsewhere.

    With ``random``, things that have random ranges are put to poses drawn from it (:func:`hal.placement.draw_poses`);
    those named in ``poses`` are put there instead. On a real bench nobody puts things anywhere.

    An arm of that world is put there (where it began, without ``q``). Any other arm **drives**, as ``move_to`` does,
    and then opens its gripper, which drops what it holds; without ``q`` it drives home. Raises what ``move_to`` raises:
    MotionStopped, too, as long as nobody has acknowledged ``rig.stop()``.
    """
    inside = stands_in_world(rig, robot)
    if not inside:  # first: on its way its copy would push what is put there
        robot.move_to(robot.home if q is None else np.asarray(q, float), deadman=deadman, unattended=unattended)
        if robot.gripper is not None:
            robot.gripper.open()
    if not rig.has_world:
        return {}
    rig.world.reset()
    put = dict(poses or {})
    for name, pose in put.items():
        rig.world.reset(name, pose=pose)
    if random is not None:
        drawn = draw_poses(rig, random, given=put)
        for name, pose in drawn.items():
            rig.world.reset(name, pose=pose)
        put |= drawn
    if inside:
        rig.world.reset(robot.name, q=robot.spec.initial if q is None else np.asarray(q, float))
    return put
