"""Put a peg into the hole of a board."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from ...geometry import Pose
from .hand import Array
from .task_env import CLOSED, OPEN, Action, TaskEnv, closeness

RADIUS = 0.02
"""Of the peg, m; the hole is a square of 48 mm."""
LENGTH = 0.09
"""Of the peg, m; the board is 30 mm high."""
GRASPED = 0.065
"""Height at which the fingers take the standing peg, m: above the board."""
LIFTED = 0.11
"""Height of the fingers at which the peg passes over the board, m."""
APART = 0.12
"""Least distance of the peg from the middle of the board at the start, m."""
STILL = 0.01
"""Speed below which it is at rest, m/s."""


class PegInHole(TaskEnv):
    """Put a peg into the hole of a board that is fixed to the table.

    Both are anywhere in the work area, 12 cm apart or more, the board turned by up to 45 degrees either way. The hole
    is 4 mm wider than the peg on each side. Success: the peg is at rest in the hole, within 1 cm of its ground.

    Dense reward: -1, and a third each for the hand near the peg, the progress of its grasp or the peg in the hole, and
    the peg held near its place.
    """

    objects = (
        {
            "name": "peg",
            "shape": "cylinder",
            "radius": RADIUS,
            "length": LENGTH,
            "mass": 0.1,
            "rgba": [0.9, 0.6, 0.1, 1],
        },
        {"file": "peg_board", "name": "board"},
    )
    width = 2 * RADIUS

    def place(self) -> dict[str, Pose]:
        """Return random start poses of the peg and the board."""
        peg, board = self.draw_apart(LENGTH / 2, 0.0, APART)
        return {"peg": peg, "board": board}

    def measure_offset(self) -> Array:
        """Return how far the peg is from its place (3,), m."""
        return self.poses["peg"].position - self.poses["board"].position - (0.0, 0.0, LENGTH / 2)

    def is_inserted(self) -> bool:
        """Return whether the peg is in the hole, held or not."""
        off = self.measure_offset()
        return bool(np.linalg.norm(off[:2]) < 0.01 and off[2] < 0.01)

    def success(self) -> bool:
        """Return whether the peg is at rest in the hole."""
        return self.is_inserted() and self.speed("peg") < STILL

    def reward(self) -> float:
        """Return -1 to 0: reach, hold, insert."""
        if self.success():
            return 0.0
        peg = self.poses["peg"]
        near = closeness(self.tcp.position, peg.transform((0.0, 0.0, GRASPED - LENGTH / 2)))
        inserted = self.is_inserted()
        grasp = max(self.measure_grasp("peg"), float(inserted))
        brought = (self.holds("peg") or inserted) * closeness(self.measure_offset(), np.zeros(3))
        return -1.0 + (near + grasp + brought) / 3.0

    def solve(self) -> Iterator[Action]:
        """Yield actions: grasp the peg, lift it, carry it over the hole, down, open."""
        x, y = self.poses["peg"].position[:2]
        yield from self.go((x, y, LIFTED), 0.0, OPEN)
        yield from self.go((x, y, GRASPED), 0.0, OPEN)
        yield from self.wait(12, CLOSED)
        yield from self.go((x, y, LIFTED), 0.0, CLOSED)
        over = self.poses["board"].position[:2] + self.tcp.position[:2] - self.poses["peg"].position[:2]
        yield from self.go((*over, LIFTED), 0.0, CLOSED)
        yield from self.wait(4, CLOSED)
        yield from self.go((*over, GRASPED + 0.002), 0.0, CLOSED)
        yield from self.wait(12, OPEN)
        yield from self.go((*over, LIFTED), 0.0, OPEN)
