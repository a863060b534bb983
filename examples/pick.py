"""Pick the cube up by a script: above it, down, close, up.

python examples/pick.py [SEED]
hal generate --skill examples.pick:pick --sim --episodes 20 --workers 2 --task "pick the cube" --out data/picks
"""

from __future__ import annotations

import sys

import numpy as np

import hal
from hal.learning.episode import reset_scene

WIDTH = 0.03
"""Of the cube between the fingers, m."""
LIFT = 0.15
"""Height above the cube at which the hand approaches, and to which it lifts, m."""


def grasp_pose(arm: hal.Robot, cube: hal.Pose) -> hal.Pose:
    """Return the tcp's pose in the arm's base frame: at the cube, pointing down, fingers across its narrow side."""
    seen = arm.base.inverse() @ cube
    long_side = seen.matrix()[:3, 0]
    yaw = np.arctan2(long_side[1], long_side[0])
    return hal.Pose.from_rpy(seen.position, (np.pi, 0.0, yaw))


def above(pose: hal.Pose) -> hal.Pose:
    """Return the pose that is :data:`LIFT` higher."""
    return hal.Pose(pose.position + [0.0, 0.0, LIFT], pose.orientation)


def pick(rig: hal.Rig, random: np.random.Generator) -> bool:
    """Pick the cube up, and return whether it was lifted: a skill for hal generate, which resets the scene before."""
    arm = next(iter(rig.robots.values()))
    start = rig.world.pose("cube")
    approach = random.uniform(0.2, 0.3)  # of the arm's speed, so that the demonstrations differ
    grasp = grasp_pose(arm, start)

    arm.gripper.open()
    arm.move_to(above(grasp), speed=approach)
    arm.move_to(grasp, speed=0.2)
    arm.gripper.grasp(WIDTH)
    arm.move_to(above(grasp), speed=0.2)
    return rig.world.pose("cube").position[2] - start.position[2] > 0.9 * LIFT


def main(seed: str = "0") -> None:
    """Put the cube somewhere, pick it up, and check that it was lifted."""
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none") as rig:
        random = np.random.default_rng(int(seed))
        reset_scene(rig, rig.robots["panda"], random=random)
        lifted = pick(rig, random)
        print(f"lifted: {lifted}")
        assert lifted


if __name__ == "__main__":
    main(*sys.argv[1:])
