"""Pick the cube up by a script: above it, down, close, up.

python examples/pick.py [SEED]
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


def main(seed: str = "0") -> None:
    """Put the cube somewhere, pick it up, and check that it was lifted."""
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none") as rig:
        arm = rig.robots["panda"]
        reset_scene(rig, arm, random=np.random.default_rng(int(seed)))
        start = rig.world.pose("cube")
        grasp = grasp_pose(arm, start)

        arm.gripper.open()
        arm.move_to(above(grasp), speed=0.5)
        arm.move_to(grasp, speed=0.2)
        held = arm.gripper.grasp(WIDTH)
        arm.move_to(above(grasp), speed=0.2)

        height = rig.world.pose("cube").position[2] - start.position[2]
        print(f"held: {held}; the cube was lifted by {100 * height:.1f} cm")
        assert height > 0.9 * LIFT


if __name__ == "__main__":
    main(*sys.argv[1:])
