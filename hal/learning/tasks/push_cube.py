"""Push a cube over the table to a goal."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...geometry import Pose
from .task_env import GRASP_HEIGHT, Action, TaskEnv, closeness, cube_entry, goal_entry

SIDE = 0.05
"""Of the cube, m."""
NEAR = 0.025
"""Distance from the goal at which the cube is there, m."""
STILL = 0.01
"""Speed below which it is at rest, m/s."""
BEHIND = 0.08
"""Distance of the tcp from the cube's middle at which the fingers come down behind it, m."""
THERE = 0.015
"""Distance from the goal at which the scripted solution ends its push, m."""
SHORT = 0.004
"""Distance before the goal at which a push ends, m."""
FASTEST = 0.12
"""Greatest speed of a push, m/s."""
GAIN = 6.0
"""Speed for each metre that is missing, 1/s."""
HIGH = 0.1
"""Height at which the hand passes over the cube, m."""
NEARLY_CLOSED = 0.1
"""Last number of an action: two fingers that are a little open turn the cube less than one does."""


class PushCube(TaskEnv):
    """Push a cube over the table to a goal that is 6 to 18 cm farther ahead.

    The cube stands near the middle of the work area, turned by up to 45 degrees either way. Success: the cube's middle
    is within 2.5 cm of the goal, and at rest.

    Dense reward: -1, and a half each for the hand near the cube and for the cube near the goal.
    """

    objects = (cube_entry("cube", SIDE, (0.2, 0.3, 0.8, 1.0)), goal_entry("goal", NEAR))

    def place(self) -> dict[str, Pose]:
        """Return random start poses of the cube and the goal."""
        start = self.np_random.uniform((-0.04, -0.06), (0.0, 0.06))
        end = self.np_random.uniform((0.06, -0.06), (0.1, 0.06))
        turned = self.draw(0.0).orientation
        return {
            "cube": Pose((*(self.centre + start), SIDE / 2), turned),
            "goal": Pose((*(self.centre + end), SIDE / 2)),
        }

    def success(self) -> bool:
        """Return whether the cube is at rest at the goal."""
        off = np.linalg.norm(self.poses["cube"].position - self.poses["goal"].position)
        return bool(off < NEAR) and self.speed("cube") < STILL

    def reward(self) -> float:
        """Return -1 to 0: reach, push."""
        if self.success():
            return 0.0
        cube, goal = self.poses["cube"].position, self.poses["goal"].position
        return -1.0 + 0.5 * closeness(self.tcp.position, cube) + 0.5 * closeness(cube, goal)

    def solve(self) -> Iterator[Action]:
        """Yield actions: down behind the cube and straight ahead, again from where it then is until it is there."""
        goal = self.poses["goal"].position[:2]
        while (left := np.linalg.norm(way := goal - self.poses["cube"].position[:2])) > THERE:
            ahead = way / left
            yaw, start = float(np.arctan2(ahead[1], ahead[0])), goal - (left + BEHIND) * ahead
            yield from self.go((*start, HIGH), yaw, NEARLY_CLOSED)
            yield from self.go((*start, GRASP_HEIGHT), yaw, NEARLY_CLOSED)
            while (left := (goal - self.poses["cube"].position[:2]) @ ahead) > SHORT:
                off = start - self.tcp.position[:2]
                velocity = min(FASTEST, GAIN * left) * ahead + GAIN * (off - (off @ ahead) * ahead)
                yield self.move((*velocity, GAIN * (GRASP_HEIGHT - self.tcp.position[2]), 0.0), NEARLY_CLOSED)
            yield from self.wait(4, NEARLY_CLOSED)
            back = self.tcp.position[:2] - 0.02 * ahead
            yield from self.go((*back, GRASP_HEIGHT), yaw, NEARLY_CLOSED)
            yield from self.go((*back, HIGH), yaw, NEARLY_CLOSED)
