"""The base of all tasks: objects on a table before an arm with a gripper, as a Gymnasium environment.

A task is a subclass with its objects, their start poses, a success and a reward; ``pick_cube.py`` is an example.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any, ClassVar, Literal, get_args

import gymnasium
import numpy as np
from gymnasium.spaces import Box, Dict, Space
from numpy.typing import ArrayLike, NDArray

from ...errors import CommandError, NotSupported, Unreachable
from ...geometry import Pose
from ...observation import Observation
from ..gym import ObservationDict, RigEnv, entry_key, pose_array

__all__ = ["CLOSED", "GRASP_HEIGHT", "OPEN", "RewardType", "TaskEnv", "closeness", "cube_entry", "goal_entry"]

Array = NDArray[np.float64]
Action = NDArray[np.float32]
RewardType = Literal["dense", "sparse"]
"""``dense``: :meth:`TaskEnv.reward`. ``sparse``: -1 in every step, 0 in that of the success."""

OPEN, CLOSED = -1.0, 1.0
"""Last number of an action: the fingers."""
GRASP_HEIGHT = 0.03
"""Height of the tcp over the table at which fingers grasp what stands on it, m."""
AREA = 0.1
"""Half the side of the square of the table in which a task takes place, m."""
HEIGHT = 0.13
"""Greatest height of the tcp over the table of which a task makes use, m."""
_BASE = Pose((-0.55, 0.0, 0.6))
"""The arm's base in the world, level with the table."""
_DISTANCES = (0.5, 0.45, 0.4, 0.35, 0.3, 0.25)
"""Distances of the middle of the work area from the base, m; the first at which the arm reaches all of it is taken."""
_TURN = 0.25 * math.pi
"""Greatest turn of the hand about the vertical, either way, with which the arm must reach all of it, rad."""
_FREE = 0.01
"""How much wider than an object the fingers must open, m."""
_BOUND = 2.0
"""Bound of the positions in an observation, m."""
_GAIN = 6.0
"""Velocity of a scripted motion for each metre or radian to its goal, 1/s; also that which keeps the hand upright."""
_LONGEST = 300
"""Most steps of one way of a scripted solution: those of the longest episode."""
_ARRIVED = (0.004, 0.03)
"""Distance and angle from its goal at which a scripted motion has arrived, m and rad."""
_STILL = 0.2
"""Speed of every joint below which the arm is at rest, rad/s."""


def cube_entry(name: str, side: float, rgba: tuple[float, float, float, float]) -> dict[str, Any]:
    """Return the entry of a rig file for a cube with sides of ``side``, m."""
    return {"name": name, "shape": "box", "half_extents": [side / 2] * 3, "mass": 0.2, "rgba": list(rgba)}


def goal_entry(name: str, radius: float) -> dict[str, Any]:
    """Return the entry of a rig file for a green ball of ``radius``, m, that shows a goal and touches nothing."""
    entry = {"name": name, "shape": "sphere", "radius": radius, "rgba": [0.2, 0.8, 0.3, 1.0]}
    return entry | {"collision": False, "fixed": True}


def closeness(a: ArrayLike, b: ArrayLike) -> float:
    """Return 1 for two points at the same place, 0.54 at a distance of 0.1 m, 0.01 at 0.5 m."""
    return 1.0 - math.tanh(5.0 * float(np.linalg.norm(np.subtract(a, b))))


class TaskEnv(gymnasium.Env[ObservationDict, Action]):
    """A task on a table for an arm with a gripper whose hand points down. Always simulated, in lock-step.

    An action is float32 (5,), each number in -1 to 1: the velocity of the tcp along x, y and z of the arm's base (1 is
    0.25 m/s), that of the hand's turn about z (1 is 1 rad/s), and the fingers, from -1 (open) to 1 (closed).

    An observation is a dict of float32, positions in m in the arm's base frame: ``q`` and ``dq`` (n,), ``tcp`` (7,) and
    ``gripper`` (1,) as of :class:`.RigEnv`, and the pose ``object_<name>`` (7,) of each of :attr:`objects`. What is
    outside the bounds of the space is clipped to them.

    ``info["success"]`` tells whether the task is done, which ends the episode (``terminated``). Rewards should be 0 at
    most: an agent that is paid for every step learns to put the end off.

    Args:
        robot: Name of a model with a gripper (``hal list robots``), or a dict: its entry in a rig file.
        engine: Engine of the simulation, as for :func:`hal.open`.
        reward_type: ``dense`` or ``sparse``.
        distance: Distance of the middle of the work area from the arm's base, m; None for the greatest, up to 0.5 m, at
            which the arm reaches all of it.
        render_mode: None, or ``rgb_array``: the picture of a camera beside the table.

    Raises:
        ConfigError: There is no such model or engine.
        NotSupported: The arm has no gripper (code ``no_gripper``), or its fingers open less than :attr:`width`
            requires (``too_wide``).
        CommandError: The arm does not reach all of the work area (``out_of_reach``), or an argument is wrong.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}  # type: ignore[misc]

    objects: ClassVar[tuple[Mapping[str, Any], ...]] = ()
    """What is on the table: entries of a rig file, as :func:`cube_entry` and :func:`goal_entry` return them."""
    width: ClassVar[float] = 0.0
    """Width of the widest object that the fingers grasp, m."""
    rate_hz: ClassVar[float] = 20.0
    """Steps per second."""

    def __init__(
        self,
        robot: str | Mapping[str, Any] = "panda",
        *,
        engine: str | None = None,
        reward_type: RewardType = "dense",
        distance: float | None = None,
        render_mode: str | None = None,
    ) -> None:
        if reward_type not in get_args(RewardType):
            raise CommandError(f"reward_type is dense or sparse, not {reward_type!r}", code="bad_reward_type")
        self.render_mode, self._sparse = render_mode, reward_type == "sparse"
        self.poses: dict[str, Pose] = {}
        """Pose of each object in the arm's base frame, at the newest observation."""
        self.rig_env = RigEnv(
            _make_rig(robot, self.objects, camera=render_mode is not None),
            sim=True,
            engine=engine,
            action="twist",
            objects=[entry["name"] for entry in self.objects],
            rate_hz=self.rate_hz,
            render_mode=render_mode,
        )
        """The environment of the rig beneath; ``rig_env.rig`` is the rig."""
        self.arm = self.rig_env.robot
        try:
            self._check_gripper()
            self.centre, self._start = self._find_centre(_DISTANCES if distance is None else (distance,))
            """Middle of the work area (2,) in the arm's base frame, m; it ends :data:`AREA` from there."""
        except BaseException:
            self.rig_env.close()
            raise
        self._most = self.rig_env.action_space.high[[0, 1, 2, 5]].astype(float)
        self.action_space: Box = Box(-1.0, 1.0, (5,), np.float32)  # type: ignore[assignment]
        self._bounds = self._find_bounds()
        boxes: dict[str, Space[Any]] = {
            name: Box(low, high, dtype=np.float32) for name, (low, high) in self._bounds.items()
        }
        self.observation_space: Dict = Dict(boxes)  # type: ignore[assignment]  # gymnasium's is invariant

    # What a task overrides.

    def place(self) -> dict[str, Pose]:
        """Return the start pose of each object in the arm's base frame; random numbers come from ``np_random``."""
        raise NotImplementedError

    def success(self) -> bool:
        """Return whether the task is done; called after each step."""
        raise NotImplementedError

    def reward(self) -> float:
        """Return the dense reward of a step: -1 to 0, and 0 if the task is done."""
        return 0.0 if self.success() else -1.0

    def solve(self) -> Iterator[Action]:
        """Yield the actions of a scripted solution; the caller passes each to ``step`` before it takes the next."""
        raise NotImplementedError

    # What its methods use.

    @property
    def tcp(self) -> Pose:
        """Pose of the tcp in the arm's base frame, at the newest observation."""
        return self._seen.robots[self.arm.name].tcp

    @property
    def opening(self) -> float:
        """Distance between the fingers at the newest observation, m."""
        return self._seen.grippers[self.arm.name].width

    @property
    def at_rest(self) -> bool:
        """Whether the arm was at rest at the newest observation."""
        return bool(np.abs(self._seen.robots[self.arm.name].dq).max() < _STILL)

    def holds(self, name: str) -> bool:
        """Return whether the fingers press on something, and the object is where the fingers are."""
        near = float(np.linalg.norm(self.poses[name].position - self.tcp.position)) < GRASP_HEIGHT
        return near and bool(self._seen.grippers[self.arm.name].grasped)

    def speed(self, name: str) -> float:
        """Return the speed of an object, m/s."""
        return float(np.linalg.norm(self.rig_env.rig.world.velocity(name)[0]))

    def draw(self, height: float) -> Pose:
        """Return a random pose in the work area at a height over the table, m, turned by up to 45 degrees."""
        x, y = self.centre + self.np_random.uniform(-AREA, AREA, 2)
        return Pose.from_rpy((x, y, height), (0.0, 0.0, self.np_random.uniform(-_TURN, _TURN)))

    def go(self, position: ArrayLike, yaw: float, grip: float) -> Iterator[Action]:
        """Yield actions until the tcp is at a position (3,), m, and the hand at a turn about z, rad; at most 15 s."""
        for _ in range(_LONGEST):
            off = np.append(np.subtract(position, self.tcp.position), _fold(yaw - self.yaw(self.tcp), 2.0 * math.pi))
            if np.linalg.norm(off[:3]) < _ARRIVED[0] and abs(off[3]) < _ARRIVED[1]:
                return
            yield self.move(_GAIN * off, grip)

    def move(self, velocity: ArrayLike, grip: float) -> Action:
        """Return the action for a velocity (4,): of the tcp along x, y and z, m/s, and of its turn about z, rad/s."""
        return np.append(np.clip(np.divide(velocity, self._most), -1.0, 1.0), grip).astype(np.float32)

    def wait(self, steps: int, grip: float) -> Iterator[Action]:
        """Yield actions that move only the fingers."""
        for _ in range(steps):
            yield self.move(np.zeros(4), grip)

    def yaw(self, pose: Pose) -> float:
        """Return the angle of a pose's x axis about z, rad."""
        x, y = pose.matrix()[:2, 0]
        return math.atan2(y, x)

    def grasp_yaw(self, cube: Pose) -> float:
        """Return the turn of the hand, within 45 degrees of straight ahead, whose fingers lie along sides of a cube."""
        return _fold(self.yaw(cube), 0.5 * math.pi)

    # Gymnasium's interface.

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationDict, dict[str, Any]]:
        """Place the arm over the middle of the work area, and the objects.

        Args:
            seed: Seed of ``np_random``; the same seed gives the same episode, to the bit. None continues its sequence.
            options: ``poses``: name of an object -> its :class:`~hal.geometry.Pose` in the arm's base frame, instead
                of a random one.

        Raises:
            CommandError: The arm does not reach an object (code ``out_of_reach``).
        """
        super().reset(seed=seed)
        poses = self.place() | dict((options or {}).get("poses", {}))
        for name, pose in poses.items():
            self._reach(pose.position, 0.0, name)
        world = {name: self.arm.base @ pose for name, pose in poses.items()}
        seen, info = self.rig_env.reset(options={"q": self._start, "poses": world})
        del info["poses"]
        return self._observe(seen), info | {"success": False}

    def step(self, action: Action) -> tuple[ObservationDict, float, bool, bool, dict[str, Any]]:
        """Send an action and wait one period; returns Gymnasium's five values.

        Raises:
            CommandError: ``reset`` was not called (code ``not_reset``), or the action's shape is wrong
                (``bad_action``).
        """
        numbers = np.asarray(action, float)
        if numbers.shape != (5,):
            raise CommandError(f"an action has shape (5,), not {numbers.shape}", code="bad_action")
        numbers = np.clip(numbers, -1.0, 1.0)
        upright = np.cross(self.tcp.matrix()[:3, 2], (0.0, 0.0, -1.0))[:2]  # what turns the tcp's z axis down again
        velocity = numbers[:4] * self._most
        twist = [*velocity[:3], *(_GAIN * upright).clip(-self._most[3], self._most[3]), velocity[3]]
        seen, _, _, truncated, info = self.rig_env.step(np.array([*twist, 0.5 * (numbers[4] + 1.0)], np.float32))
        shown = self._observe(seen)
        done = bool(self.success())
        reward = float(done) - 1.0 if self._sparse else float(self.reward())
        return shown, reward, done, truncated, info | {"success": done}

    def render(self) -> NDArray[np.uint8] | None:
        """Return the picture of the camera beside the table (H, W, 3)."""
        return self.rig_env.render()

    def close(self) -> None:
        """Close the rig. Idempotent."""
        self.rig_env.close()

    # Details.

    @property
    def _seen(self) -> Observation:
        if self.rig_env.observation is None:
            raise CommandError("call reset before step", code="not_reset")
        return self.rig_env.observation

    def _observe(self, seen: ObservationDict) -> ObservationDict:
        """Return an observation from one of the rig, and note the poses of the objects."""
        to_base = self.arm.base.inverse()
        shown = {name: seen[name] for name in ("q", "dq", "tcp", "gripper")}
        for entry in self.objects:
            key = entry_key("object", entry["name"])
            pose = to_base @ Pose(seen[key][:3], seen[key][3:])
            self.poses[entry["name"]], shown[key] = pose, pose_array(pose)
        return {name: np.clip(value, *self._bounds[name]).astype(np.float32) for name, value in shown.items()}

    def _find_bounds(self) -> dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Return the lower and upper bounds of each entry of an observation."""
        limits, gripper = self.arm.limits, self.arm.gripper
        assert gripper is not None
        pose = np.array([_BOUND] * 3 + [1.0] * 4, np.float32)
        speed, width = np.array(limits.velocity, np.float32), np.array([gripper.width_max], np.float32)
        bounds = {
            "q": (np.array(limits.lower, np.float32), np.array(limits.upper, np.float32)),
            "dq": (-speed, speed),
            "tcp": (-pose, pose),
            "gripper": (0.0 * width, width),
        }
        return bounds | {entry_key("object", entry["name"]): (-pose, pose) for entry in self.objects}

    def _check_gripper(self) -> None:
        """Check that the arm has a gripper that opens far enough. Raises NotSupported."""
        gripper, task = self.arm.gripper, type(self).__name__
        if gripper is None:
            text = f"robot=: this arm has no gripper, which {task} needs; `hal list robots` shows those that have one"
            raise NotSupported(text, code="no_gripper")
        if self.width and gripper.width_max < self.width + _FREE:
            text = f"robot=: its fingers open to {gripper.width_max:.3f} m; {task} needs {self.width + _FREE:.3f} m"
            raise NotSupported(text, code="too_wide")

    def _find_centre(self, distances: tuple[float, ...]) -> tuple[Array, Array]:
        """Return the middle of the work area (2,), m, and the joint positions (n,) over it, rad."""
        error = CommandError("")
        for distance in distances:
            try:
                for x, y, z in np.ndindex(2, 2, 2):
                    at = (distance + AREA * (2 * x - 1), AREA * (2 * y - 1), (GRASP_HEIGHT, HEIGHT)[z])
                    for turn in (-_TURN, _TURN):
                        self._reach(at, turn, "the work area")
                return np.array([distance, 0.0]), self._reach((distance, 0.0, HEIGHT), 0.0, "the work area")
            except CommandError as failed:
                error = failed
        raise error

    def _reach(self, position: ArrayLike, yaw: float, what: str) -> Array:
        """Return joint positions (n,), rad, with the hand over or around something. Raises CommandError."""
        x, y, z = np.asarray(position, float)
        try:
            q = self.arm.ik(Pose.from_rpy((x, y, max(z, GRASP_HEIGHT)), (math.pi, 0.0, yaw)), self.arm.home)
            touched = self.arm.collisions.check(q)
        except Unreachable:
            why = "the arm does not get there"
        else:
            if not touched:
                return q
            why = str(touched[0])
        text = (
            f"{what} is out of reach: with the hand pointing down at {x:.2f}, {y:.2f}, {z:.2f} m from the base, {why}"
        )
        raise CommandError(f"{text}; choose another robot, place or distance=", code="out_of_reach")


def _make_rig(
    robot: str | Mapping[str, Any], objects: tuple[Mapping[str, Any], ...], *, camera: bool
) -> dict[str, Any]:
    """Return the rig file of a task: the arm at a table with the objects and, if wanted, a camera."""
    arm = {"model": robot} if isinstance(robot, str) else dict(robot)
    view = {"target": [-0.1, 0, 0.7], "distance": 0.85, "yaw_deg": 60, "pitch_deg": -30}
    picture = {"model": "pinhole", "look_at": view, "streams": ["color"], "output": {"width": 256, "height": 256}}
    base, table = {"position": _BASE.position.tolist()}, {"name": "table", "size": [1.5, 1, 0.05]}
    return {
        "robots": {"arm": {"base": base, "workspace": {"table_height": 0.01}} | arm},
        "cameras": {"scene": picture} if camera else {},
        "objects": ["floor", "table", *(dict(entry) for entry in objects)],
        "collisions": {"boxes": [table | {"position": [0, 0, 0.5645]}]},  # 10.5 mm lower, for the margin of 10 mm
    }


def _fold(angle: float, period: float) -> float:
    """Return an angle plus a multiple of ``period``, at most half a period from 0, rad."""
    return angle - period * round(angle / period)
