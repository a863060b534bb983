"""Before an episode: everything back to where it starts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike

from .errors import MotionStopped
from .geometry import Pose
from .placement import draw_poses

if TYPE_CHECKING:
    from .clock import Clock
    from .deadman import Deadman
    from .rig import Rig
    from .robot import Robot

__all__ = ["put_back", "stands_in_world"]

_LOOKS_HZ = 50.0
"""At the dead-man."""


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
    since: int | None = None,
    patience: float = 60.0,
    hand: bool = True,
) -> dict[str, Pose]:
    """A simulated world as it began, and the arm at ``q`` (n,), rad. Returns where things are that began elsewhere.

    With ``random``, things that have random ranges are put to poses drawn from it (:func:`hal.placement.draw_poses`);
    those named in ``poses`` are put there instead. On a real bench nobody puts things anywhere.

    An arm of that world is put there (where it began, without ``q``). Any other arm **drives**, as ``move_to`` does,
    and then opens its gripper, which drops what it holds, unless ``hand`` is False; without ``q`` it drives home. With
    a dead-man that takes a new press: more than ``since`` in all, or than there were at this call. What is held for
    something else, or after a stop, drives nobody home.

    Raises what ``move_to`` raises: MotionStopped, too, as long as nobody has acknowledged ``rig.stop()``, and when the
    dead-man was not pressed, or held, for ``patience`` s.
    """
    inside = stands_in_world(rig, robot)
    if not inside:  # first: on its way its copy would push what is put there
        if deadman is not None:
            _wait_for_press(rig.clock, deadman, deadman.record.presses if since is None else since, patience)
        target = robot.home if q is None else np.asarray(q, float)
        robot.move_to(target, deadman=deadman, unattended=unattended, patience=patience)
        if hand and robot.gripper is not None:
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


def _wait_for_press(clock: Clock, deadman: Deadman, since: int, patience: float) -> None:
    for tick in clock.rate(_LOOKS_HZ):
        record = deadman.record
        if record.held and record.presses > since:
            return
        if tick.elapsed > patience:
            raise MotionStopped(f"nobody pressed the dead-man for {patience:g} s", "let go of it, and hold it")
