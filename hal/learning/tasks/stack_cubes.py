"""Stack one cube on another."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...geometry import Pose
from .hand import Array
from .task_env import CLOSED, GRASP_HEIGHT, HEIGHT, OPEN, Action, TaskEnv, closeness, cube_entry

SIDE = 0.05
"""Of both cubes, m."""
APART = 0.1
"""Least distance of their middles at the start, m: an open hand fits around one."""
BESIDE = 0.02
"""Distance across at which the upper cube still counts as stacked, m."""
STILL = 0.01
"""Speed below which it is at rest, m/s."""


class StackCubes(TaskEnv):
    """Put the red cube on the green one and let go.

    Both stand anywhere in the work area, 10 cm apart or more, turned by up to 45 degrees either way. Success: the
    middle of the red cube is above that of the green one, within 2 cm across and 5 mm of height, at rest, and not held.

    Dense reward: -1, and a quarter each for the hand near the red cube, the progress of its grasp or that cube stacked,
    that cube held near its place or stacked, and that cube stacked with open fingers.
    """

    objects = (cube_entry("red", SIDE, (0.85, 0.2, 0.2, 1.0)), cube_entry("green", SIDE, (0.2, 0.7, 0.3, 1.0)))
    width = SIDE

    def place(self) -> dict[str, Pose]:
        """Return random start poses of the cubes."""
        red, green = self.draw_apart(SIDE / 2, SIDE / 2, APART)
        return {"red": red, "green": green}

    def measure_offset(self) -> Array:
        """Return how far the red cube is from its place (3,), m."""
        return self.poses["red"].position - self.poses["green"].position - (0.0, 0.0, SIDE)

    def is_stacked(self) -> bool:
        """Return whether the red cube is on the green one, held or not."""
        off = self.measure_offset()
        return bool(np.linalg.norm(off[:2]) < BESIDE and abs(off[2]) < 0.005)

    def success(self) -> bool:
        """Return whether the red cube rests on the green one, and the fingers do not hold it."""
        return self.is_stacked() and self.opening > SIDE + 0.005 and self.speed("red") < STILL

    def reward(self) -> float:
        """Return -1 to 0: reach, hold, bring, let go."""
        if self.success():
            return 0.0
        stacked, held = self.is_stacked(), self.holds("red")
        near = closeness(self.tcp.position, self.poses["red"].position)
        grasp = max(self.measure_grasp("red"), float(stacked))
        brought = (held or stacked) * closeness(self.measure_offset(), np.zeros(3))
        return -1.0 + (near + grasp + brought + stacked * (self.opening > SIDE + 0.005)) / 4.0

    def solve(self) -> Iterator[Action]:
        """Yield actions: grasp the red cube, carry it over the green one, down, open, up."""
        red, green = self.poses["red"], self.poses["green"]
        yaw, (x, y) = self.grasp_yaw(red), red.position[:2]
        yield from self.go((x, y, HEIGHT), yaw, OPEN)
        yield from self.go((x, y, GRASP_HEIGHT), yaw, OPEN)
        yield from self.wait(12, CLOSED)
        yield from self.go((x, y, HEIGHT), yaw, CLOSED)
        (x, y), yaw = green.position[:2], self.grasp_yaw(green)
        yield from self.go((x, y, HEIGHT), yaw, CLOSED)
        yield from self.go((x, y, GRASP_HEIGHT + SIDE + 0.006), yaw, CLOSED)
        yield from self.wait(12, OPEN)
        yield from self.go((x, y, HEIGHT), yaw, OPEN)
