"""Open a drawer."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

from ...geometry import Pose
from .task_env import CLOSED, HEIGHT, OPEN, Action, TaskEnv, closeness

POST = (-0.12, 0.0, 0.045)
"""Middle of the post on the closed drawer in the frame of the cabinet, m; the fingers take it."""
WIDTH = 0.03
"""Of the post, m."""
WIDE = 0.1
"""Opening of the drawer at the success, m; it ends at 0.13."""
TURN = 0.3
"""Greatest turn of the cabinet, either way, rad."""


class OpenDrawer(TaskEnv):
    """Open the drawer of a cabinet by the post on its front.

    The cabinet stands behind the middle of the work area, turned by up to 17 degrees either way. Success: the drawer is
    10 cm open, and the arm at rest.

    Dense reward: -1, and a half each for the hand near the post and for the drawer near its end.
    """

    objects = ({"file": "drawer", "name": "drawer"},)
    links = {"drawer": "drawer"}  # noqa: RUF012  # the pose that is observed is that of the post
    width = WIDTH

    def place(self) -> dict[str, Pose]:
        """Return a random pose of the cabinet."""
        x, y = self.centre + self.np_random.uniform((0.08, -0.06), (0.12, 0.06))
        return {"drawer": Pose.from_rpy((x, y, 0.0), (0.0, 0.0, self.np_random.uniform(-TURN, TURN)))}

    def arrange(self, options: dict[str, Any]) -> None:
        """Note where the post is while the drawer is closed, wherever the cabinet was put."""
        self.closed = self.poses["drawer"] @ Pose(POST)
        """Pose of the post when the drawer is closed."""

    def measure_opening(self) -> float:
        """Return how far the drawer is open, m."""
        return -float(self.closed.inverse().transform(self.poses["drawer"].position)[0])

    def success(self) -> bool:
        """Return whether the drawer is open and the arm at rest."""
        return self.measure_opening() > WIDE and self.at_rest

    def reward(self) -> float:
        """Return -1 to 0: reach, pull."""
        if self.success():
            return 0.0
        near = closeness(self.tcp.position, self.poses["drawer"].position)
        return -1.0 + 0.5 * near + 0.5 * min(1.0, max(0.0, self.measure_opening() / WIDE))

    def solve(self) -> Iterator[Action]:
        """Yield actions: above the post, down, close, pull."""
        yaw, (x, y, z) = self.yaw(self.closed), self.closed.position
        yield from self.go((x, y, HEIGHT), yaw, OPEN)
        yield from self.go((x, y, z), yaw, OPEN)
        yield from self.wait(12, CLOSED)
        yield from self.go(self.closed.transform((-WIDE - 0.015, 0.0, 0.0)), yaw, CLOSED)
        yield from self.wait(10, CLOSED)
