"""Grasp a cube and bring it to a goal above the table."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...geometry import Pose
from .task_env import CLOSED, GRASP_HEIGHT, HEIGHT, OPEN, Action, TaskEnv, closeness, cube_entry, goal_entry

SIDE = 0.05
"""Of the cube, m."""
NEAR = 0.025
"""Distance from the goal at which the cube is there, m."""


class PickCube(TaskEnv):
    """Grasp a cube and bring it to a goal above the table.

    The cube stands anywhere in the work area, turned by up to 45 degrees either way; the goal is 8 to 12 cm over the
    table. Success: the cube's middle is within 2.5 cm of the goal, and the arm is at rest.

    Dense reward: -1, and a third each for the hand near the cube, the progress of its grasp, and the cube held near the
    goal.
    """

    objects = (cube_entry("cube", SIDE, (0.85, 0.2, 0.2, 1.0)), goal_entry("goal", NEAR))
    width = SIDE

    def place(self) -> dict[str, Pose]:
        """Return random start poses of the cube and the goal."""
        return {"cube": self.draw(SIDE / 2), "goal": self.draw(self.np_random.uniform(0.08, 0.12))}

    def success(self) -> bool:
        """Return whether the cube is at the goal and the arm at rest."""
        off = np.linalg.norm(self.poses["cube"].position - self.poses["goal"].position)
        return bool(off < NEAR) and self.at_rest

    def reward(self) -> float:
        """Return -1 to 0: reach, hold, bring."""
        if self.success():
            return 0.0
        cube, goal = self.poses["cube"].position, self.poses["goal"].position
        brought = self.holds("cube") * closeness(cube, goal)
        return -1.0 + (closeness(self.tcp.position, cube) + self.measure_grasp("cube") + brought) / 3.0

    def solve(self) -> Iterator[Action]:
        """Yield actions: above the cube, down, close, to the goal."""
        cube, goal = self.poses["cube"], self.poses["goal"].position
        yaw, (x, y) = self.grasp_yaw(cube), cube.position[:2]
        yield from self.go((x, y, HEIGHT), yaw, OPEN)
        yield from self.go((x, y, GRASP_HEIGHT), yaw, OPEN)
        yield from self.wait(12, CLOSED)
        yield from self.go(goal + (0.0, 0.0, GRASP_HEIGHT - SIDE / 2), yaw, CLOSED)
        yield from self.wait(10, CLOSED)
