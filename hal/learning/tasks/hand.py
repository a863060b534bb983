"""One arm of a task with its gripper: what it does, and what was last seen of it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import CommandError, NotSupported, Unreachable
from ...geometry import Pose, difference
from ...gripper import Gripper
from ...observation import Observation
from ...robot import Robot
from ..gym import RigEnv
from ..spaces import pose_array

Array = NDArray[np.float64]

GRASP_HEIGHT = 0.03
"""Height of the tcp over the table at which fingers grasp what stands on it, m."""
UPRIGHT_GAIN = 6.0
"""Speed of the turn that keeps the hand upright for each radian that it leans, 1/s."""
_AROUND = 0.025
"""Distance of the tcp from an object below which the fingers are around it, m; on top of it they are farther away."""
_LEAD = (0.01, 0.05)
"""Greatest lead of the set-point, m and rad, over a hand that something holds back, beyond its :data:`_LAG`: more of it
would stop the arm, mostly while a policy explores around an object."""
_LAG = 0.1
"""How far a hand that nothing holds back may be behind its set-point for each m/s or rad/s, s: real arms lag."""
_FREE = 0.01
"""How much wider than an object the fingers must open, m."""
_STILL = 0.2
"""Speed of every joint below which the arm is at rest, rad/s."""


class Hand:
    """An arm of a task with its gripper. Poses and velocities are in the task's frame: the first arm's ``base``."""

    def __init__(self, env: RigEnv, robot: Robot, base: Pose) -> None:
        self.robot = robot
        self._env = env
        self._base = base.inverse() @ robot.base
        self._turn = self._base.matrix()[:3, :3].T
        self.ahead = yaw_of(self._base)
        """Turn of the hand about z that is straight ahead for this arm, rad."""

    @property
    def gripper(self) -> Gripper:
        """The gripper."""
        assert self.robot.gripper is not None
        return self.robot.gripper

    @property
    def seen(self) -> Observation:
        """The newest observation. Raises CommandError before the first reset."""
        if self._env.observation is None:
            raise CommandError("call reset before step", code="not_reset")
        return self._env.observation

    @property
    def tcp(self) -> Pose:
        """Pose of the tcp."""
        return self._base @ self.seen.robots[self.robot.name].tcp

    @property
    def opening(self) -> float:
        """Distance between the fingers, m."""
        return self.seen.grippers[self.robot.name].width

    @property
    def at_rest(self) -> bool:
        """Whether the arm is at rest."""
        return bool(np.abs(self.seen.robots[self.robot.name].dq).max() < _STILL)

    def holds(self, thing: Pose, at: ArrayLike = (0.0, 0.0, 0.0)) -> bool:
        """Return whether the fingers press on something, and a point of the object (3,), m, is where they are."""
        near = np.linalg.norm(thing.transform(at) - self.tcp.position) < GRASP_HEIGHT
        return bool(near) and bool(self.seen.grippers[self.robot.name].grasped)

    def measure_grasp(self, thing: Pose, at: ArrayLike = (0.0, 0.0, 0.0)) -> float:
        """Return how far the grasp of an object at a point of it (3,), m, has come, from 0 to 1.

        Away from it, open fingers are worth a half and closed ones nothing; around it, their closing raises the value,
        and 1 is an object that they hold.
        """
        if self.holds(thing, at):
            return 1.0
        opened = min(1.0, self.opening / self.gripper.width_max)
        around = np.linalg.norm(thing.transform(at) - self.tcp.position) < _AROUND
        return 1.0 - 0.5 * opened if around else 0.5 * opened

    def twist(self, velocity: Array, most: Array) -> list[float]:
        """Return the twist (6,) along the axes of the arm's base, with the hand kept upright.

        A hand that something holds back is not driven farther into it.

        Args:
            velocity: Velocity of the tcp along x, y and z, m/s, and of its turn about z, rad/s (4,).
            most: Greatest of them (4,).
        """
        state = self.seen.robots[self.robot.name]
        down = (self._base @ state.tcp_set).matrix()[:3, 2]
        lean = np.cross(down, (0.0, 0.0, -1.0))[:2]  # what turns the set-point's z axis down again
        turn = [*(UPRIGHT_GAIN * lean).clip(-most[3], most[3]), velocity[3]]
        twist = np.concatenate([self._turn @ velocity[:3], self._turn @ turn])
        poses = (pose_array(pose).tolist() for pose in (state.tcp, state.tcp_set))
        self._hold_back(twist, np.array(difference(*poses)), state.tcp_twist)
        numbers: list[float] = twist.tolist()
        return numbers

    def _hold_back(self, twist: Array, lead: Array, moves: Array) -> None:
        """Slow a twist (6,) down, or turn it round, where the set-point is well ahead of the hand.

        Args:
            twist: The twist, along the axes of the arm's base.
            lead: The twist that would bring the hand to the set-point within 1 s (6,).
            moves: The measured twist of the hand (6,), which explains some of it.
        """
        for part, most in zip((slice(3), slice(3, 6)), _LEAD, strict=True):
            away = float(np.linalg.norm(lead[part]))
            ahead = lead[part] / max(away, 1e-9)
            off = away - _LAG * max(0.0, float(moves[part] @ ahead))
            if off > 0.5 * most:
                fastest = (most - off) * self._env.settings.rate_hz
                twist[part] -= max(0.0, float(twist[part] @ ahead) - fastest) * ahead

    def check_gripper(self, width: float) -> None:
        """Check that the arm has a gripper that opens far enough for an object. Raises NotSupported."""
        gripper, task = self.robot.gripper, type(self._env).__name__
        if gripper is None:
            text = f"robot=: this arm has no gripper, which {task} needs; `hal list robots` shows those that have one"
            raise NotSupported(text, code="no_gripper")
        if width and gripper.width_max < width + _FREE:
            text = f"robot=: its fingers open to {gripper.width_max:.3f} m; {task} needs {width + _FREE:.3f} m"
            raise NotSupported(text, code="too_wide")

    def reach(self, position: ArrayLike, yaw: float, what: str) -> Array:
        """Return joint positions (n,), rad, with the hand over or around something.

        ``yaw`` is its turn about z from straight ahead, rad.

        Raises:
            CommandError: There are none (code ``out_of_reach``).
        """
        x, y, z = np.asarray(position, float)
        goal = Pose.from_rpy((x, y, max(z, GRASP_HEIGHT)), (math.pi, 0.0, self.ahead + yaw))
        try:
            q = self.robot.ik(self._base.inverse() @ goal, self.robot.home)
            others = tuple(f"{name}/" for name in self._env.rig.robots if name != self.robot.name)  # they move
            pairs = self.robot.collisions.check(q)
            touched = [pair for pair in pairs if not (pair.first.startswith(others) or pair.second.startswith(others))]
        except Unreachable:
            why = "the arm does not get there"
        else:
            if not touched:
                return q
            why = str(touched[0])
        text = f"{what} is out of reach: with the hand pointing down at {x:.2f}, {y:.2f}, {z:.2f} m, {why}"
        raise CommandError(f"{text}; choose another robot, place or distance=", code="out_of_reach")


def fold(angle: float, period: float) -> float:
    """Return an angle plus a multiple of ``period``, at most half a period from 0, rad."""
    return angle - period * round(angle / period)


def yaw_of(pose: Pose) -> float:
    """Return the angle of a pose's x axis about z, rad."""
    x, y = pose.matrix()[:2, 0]
    return math.atan2(y, x)
