"""Hand a bar from one arm to another."""

from __future__ import annotations

from collections.abc import Iterator

from ...geometry import Pose
from .hand import GRASP_HEIGHT
from .task_env import CLOSED, HEIGHT, OPEN, Action, TaskEnv, closeness

LENGTH, WIDTH, TALL = 0.24, 0.03, 0.05
"""Size of the bar along x, y and z, m."""
ENDS = ((-0.085, 0.0, 0.0), (0.085, 0.0, 0.0))
"""Where the left and the right hand take the bar, in its frame, m."""
MEETING = 0.09
"""Height of the tcp at which the left hand offers the bar, m."""
HIGH = 0.08
"""Height of the middle of the bar over the table above which it is lifted, m."""
TURN = 0.3
"""Greatest turn of the bar, either way, rad."""


class HandOver(TaskEnv):
    """Lift a bar with the left arm and hand it over to the right one, which faces it.

    The bar lies near the middle of the work area, turned by up to 17 degrees either way, an end towards each arm.
    Success: the right hand holds the bar at its end, 8 cm over the table or higher, and the left hand is open.

    Dense reward: -1, and a quarter each for the left hand near its end, the progress of its grasp or the bar held, the
    right hand near its end while the bar is held, and the bar held by the right hand alone.
    """

    arms = ("left", "right")
    objects = (
        {"name": "bar", "shape": "box", "half_extents": [LENGTH / 2, WIDTH / 2, TALL / 2], "mass": 0.08}
        | {"rgba": [0.6, 0.2, 0.7, 1]},
    )
    width = WIDTH

    def place(self) -> dict[str, Pose]:
        """Return a random start pose of the bar."""
        x, y = self.centre + self.np_random.uniform((-0.02, -0.06), (0.02, 0.06))
        return {"bar": Pose.from_rpy((x, y, TALL / 2), (0.0, 0.0, self.np_random.uniform(-TURN, TURN)))}

    def find_holders(self) -> tuple[bool, bool]:
        """Return whether the left and the right hand hold the bar at their ends."""
        left, right = (hand.holds(self.poses["bar"], end) for hand, end in zip(self.hands, ENDS, strict=True))
        return left, right

    def success(self) -> bool:
        """Return whether the right hand alone holds the bar over the table."""
        left, right = self.find_holders()
        lifted = self.poses["bar"].position[2] > HIGH
        return bool(right and lifted and not left and self.hands[0].opening > WIDTH + 0.005)

    def reward(self) -> float:
        """Return -1 to 0: reach, hold, meet, let go."""
        if self.success():
            return 0.0
        bar, (left, right) = self.poses["bar"], self.find_holders()
        near, far = (
            closeness(hand.tcp.position, bar.transform(end)) for hand, end in zip(self.hands, ENDS, strict=True)
        )
        grasp = max(self.hands[0].measure_grasp(bar, ENDS[0]), float(right))
        return -1.0 + (max(near, float(right)) + grasp + (left or right) * far + (right and not left)) / 4.0

    def solve(self) -> Iterator[Action]:
        """Yield actions: the left hand lifts the bar, the right one grasps it, the left one opens."""
        x, y, _ = self.poses["bar"].transform(ENDS[0])
        yaw = self.yaw(self.poses["bar"])
        yield from self.go((x, y, HEIGHT), yaw, OPEN)
        yield from self.go((x, y, GRASP_HEIGHT), yaw, OPEN)
        yield from self.wait(12, CLOSED)
        yield from self.go((x, y, MEETING), yaw, CLOSED)
        end, yaw = self.poses["bar"].transform(ENDS[1]), self.yaw(self.poses["bar"])
        yield from self.go((*end[:2], end[2] + 0.1), yaw, OPEN, hand=1)
        yield from self.go(end, yaw, OPEN, hand=1)
        yield from self.wait(12, CLOSED, hand=1)
        yield from self.wait(12, OPEN)
        yield from self.go((*end[:2], MEETING + 0.03), yaw, CLOSED, hand=1)
        yield from self.wait(10, CLOSED, hand=1)
