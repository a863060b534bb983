"""The base of all tasks: objects on a table before an arm with a gripper, as a Gymnasium environment.

A task is a subclass with its objects, their start poses, a success and a reward; ``pick_cube.py`` is an example.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, ClassVar, Literal, get_args

import numpy as np
from gymnasium.spaces import Box, Dict, Space
from numpy.typing import ArrayLike, NDArray

from ...arguments import choice
from ...deadman import Deadman
from ...errors import CommandError
from ...geometry import Pose
from ...observation import Observation
from ...rig import Rig
from ..episode import stands_in_world
from ..gym import EnvSettings, RigEnv
from ..spaces import ObservationDict, entry_key, pose_array
from .by_depth import DepthJudge
from .hand import GRASP_HEIGHT, UPRIGHT_GAIN, Array, Hand, fold, yaw_of

__all__ = ["CLOSED", "GRASP_HEIGHT", "OPEN", "RewardType", "TaskEnv", "closeness", "cube_entry", "goal_entry"]

Action = NDArray[np.float32]
RewardType = Literal["dense", "sparse"]
"""``dense``: :meth:`TaskEnv.reward`. ``sparse``: -1 in every step, 0 in that of the success."""
Judge = Literal["truth", "depth"]
"""Where the poses of the objects come from: the simulation, or the picture of a camera with depth."""

OPEN = -1.0
"""Last number of an action that opens the fingers."""
CLOSED = 1.0
"""Last number of an action that closes the fingers."""
AREA = 0.1
"""Half the side of the square of the table in which a task takes place, m."""
HEIGHT = 0.13
"""Greatest height of the tcp over the table of which a task makes use, m."""
_BASE = Pose((-0.55, 0.0, 0.6))
"""The arm's base in the world, level with the table."""
_DISTANCES = (0.5, 0.45, 0.4, 0.35, 0.3, 0.25)
"""Distances of the middle of the work area from the base, m; the first at which the arm reaches all of it is taken."""
_APART = 1.0
"""Distance of the bases of two arms, m."""
_ASIDE = 0.15
"""Distance of the hands of two arms from the middle of the work area at the start, m."""
_TURN = 0.25 * math.pi
"""Greatest turn of the hand about the vertical, either way, with which the arm must reach all of it, rad."""
_BOUND = 2.0
"""Bound of the positions in an observation, m."""
_GAIN = UPRIGHT_GAIN
"""Velocity of a scripted motion for each metre or radian to its goal, 1/s."""
_LONGEST = 15.0
"""Longest time of one way of a scripted solution, s."""
_DRAWS = 1000
"""Most pairs of poses that are drawn until two objects are apart."""
_ARRIVED = (0.004, 0.03)
"""Distance and angle from its goal at which a scripted motion has arrived, m and rad."""
_RECENT = 10
"""Steps over which the speed of an object that a camera sees is measured."""


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


class TaskEnv(RigEnv):
    """A task on a table for an arm with a gripper whose hand points down; for two of them with two :attr:`arms`.

    An action is float32 (5,), each number in -1 to 1: the velocity of the tcp along x, y and z of the arm's base (1 is
    0.25 m/s), that of the hand's turn about z (1 is 1 rad/s), and the fingers, from -1 (open) to 1 (closed).

    An observation is a dict of float32, positions in m in the arm's base frame: ``q`` and ``dq`` (n,), ``tcp`` (7,) and
    ``gripper`` (1,) as of :class:`.RigEnv`, and the pose ``object_<name>`` (7,) of each of :attr:`objects`. What is
    outside the bounds of the space is clipped to them.

    With two arms, ``left`` and ``right``, an action has the numbers of the right one after those of the left one, and
    the arm's name leads its entries. All positions and velocities are in the base frame of the left one.

    ``info["success"]`` tells whether the task is done, which ends the episode (``terminated``). Rewards should be 0 at
    most: an agent that is paid for every step learns to put the end off.

    On a real or emulated arm (``rig=``, ``sim=False``) the poses of the objects are found in the picture of a camera
    with depth. The arm drives to its start in each reset, and a person puts the objects into the work area. While it
    does not show all of them, a step is paid -1, and ``info["hidden"]`` names them.

    Args:
        robot: Name of a model with a gripper (``hal list robots``), or a dict: its entry in a rig file. With ``rig``
            the name of an arm in that file; None for its first.
        rig: A rig file (as for :func:`hal.open`) whose arm and camera are used, in place of the task's own table. The
            table must be level with the arm's base.
        sim: As for :func:`hal.open`; only with ``rig``.
        engine: Engine of the simulation, as for :func:`hal.open`.
        reward_type: ``dense`` or ``sparse``.
        judge: ``truth`` or ``depth``: where the poses of the objects come from. None for ``truth`` in simulation.
        distance: Distance of the middle of the work area from the arm's base, m; None for the greatest, up to 0.5 m, at
            which the arm reaches all of it.
        rate_hz: Steps per second; less for a real arm whose stops say that commands came too late.
        overrides: Changes of the rig file, ``key=value``.
        deadman: As for :class:`.RigEnv`: a real arm needs it, or ``unattended=True``.
        unattended: Let a real arm move without a dead-man.
        render_mode: None, or ``rgb_array``: the picture of a camera beside the table.

    Raises:
        ConfigError: There is no such model or engine.
        NotSupported: The arm has no gripper (code ``no_gripper``), its fingers open less than :attr:`width` requires
            (``too_wide``), no camera has depth (``no_depth``), or depth cannot judge this task (``not_by_depth``).
        CommandError: The arm does not reach all of the work area (``out_of_reach``), or an argument is wrong.
    """

    metadata: ClassVar[dict[str, Any]] = {"render_modes": ["rgb_array"], "render_fps": 20}  # type: ignore[misc]

    arms: ClassVar[tuple[str, ...]] = ("arm",)
    """Names of the arms; the second one faces the first, beyond the work area."""
    objects: ClassVar[tuple[Mapping[str, Any], ...]] = ()
    """What is on the table: entries of a rig file, as :func:`cube_entry` and :func:`goal_entry` return them."""
    links: ClassVar[Mapping[str, str]] = {}
    """Link of an object whose pose is observed, where that is not the object's own: name -> link."""
    width: ClassVar[float] = 0.0
    """Width of the widest object that the fingers grasp, m."""

    def __init__(
        self,
        robot: str | Mapping[str, Any] | None = None,
        *,
        rig: str | Path | Mapping[str, Any] | None = None,
        sim: bool | None = None,
        engine: str | None = None,
        reward_type: RewardType = "dense",
        judge: Judge | None = None,
        distance: float | None = None,
        rate_hz: float = 20.0,
        overrides: tuple[str, ...] = (),
        deadman: Callable[[Rig], Deadman] | None = None,
        unattended: bool = False,
        render_mode: str | None = None,
    ) -> None:
        choice("reward_type", reward_type, get_args(RewardType), "bad_reward_type")
        if judge is not None:
            choice("judge", judge, get_args(Judge), "bad_judge")
        self._sparse = reward_type == "sparse"
        self.poses: dict[str, Pose] = {}
        """Pose of each object in the arm's base frame, at the newest observation in which it was seen."""
        self.hidden: set[str] = set()
        """Objects that the newest picture does not show; while there are any, the task is not done."""
        by_depth = judge == "depth" or (judge is None and rig is not None and sim is False)
        names = [] if by_depth else [entry["name"] for entry in self.objects]
        own = rig is None
        settings = EnvSettings(
            robots=self._choose_robots(robot if rig is not None else None),
            action="twist",
            objects=names,
            rate_hz=rate_hz,
            cameras=None if by_depth or render_mode else [],
        )
        super().__init__(
            self._make_rig(robot, camera=by_depth or render_mode is not None, depth=by_depth) if rig is None else rig,
            settings,
            sim=True if own else sim,
            engine=engine,
            overrides=overrides,
            deadman=deadman,
            unattended=unattended,
            render_mode=render_mode,
        )
        try:
            self._check_bench(by_depth, _DISTANCES if distance is None else (distance,))
        except BaseException:
            self.rig.close()
            raise
        self._most = self.action_space.high[[0, 1, 2, 5]].astype(float)
        self._grips = [OPEN] * len(self.hands)
        self._track: list[dict[str, Pose]] = []
        """The newest poses of the objects, one for each step."""
        self.action_space: Box = Box(-1.0, 1.0, (5 * len(self.hands),), np.float32)
        self._bounds = self._find_bounds()
        boxes: dict[str, Space[Any]] = {
            name: Box(low, high, dtype=np.float32) for name, (low, high) in self._bounds.items()
        }
        self.observation_space: Dict = Dict(boxes)

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
        """Pose of the first arm's tcp at the newest observation."""
        return self.hands[0].tcp

    @property
    def opening(self) -> float:
        """Distance between the first arm's fingers at the newest observation, m."""
        return self.hands[0].opening

    @property
    def at_rest(self) -> bool:
        """Whether all arms were at rest at the newest observation."""
        return all(hand.at_rest for hand in self.hands)

    def holds(self, name: str) -> bool:
        """Return whether the first arm's fingers press on something, and the object is where the fingers are."""
        return self.hands[0].holds(self.poses[name])

    def measure_grasp(self, name: str) -> float:
        """Return how far the first arm's grasp of an object has come, from 0 to 1; see :meth:`.Hand.measure_grasp`."""
        return self.hands[0].measure_grasp(self.poses[name])

    def speed(self, name: str) -> float:
        """Return the speed of an object, m/s; of one that a camera sees, its mean of 10 steps."""
        if self._judge is None:
            return float(np.linalg.norm(self.rig.world.velocity(name)[0]))
        if len(self._track) < 2:
            return math.inf
        moved = self._track[0][name].distance(self._track[-1][name])[0]
        return float(moved) * self.settings.rate_hz / (len(self._track) - 1)

    def draw(self, height: float) -> Pose:
        """Return a random pose in the work area at a height over the table, m, turned by up to 45 degrees."""
        x, y = self.centre + self.np_random.uniform(-AREA, AREA, 2)
        return Pose.from_rpy((x, y, height), (0.0, 0.0, self.np_random.uniform(-_TURN, _TURN)))

    def draw_apart(self, first: float, second: float, apart: float) -> tuple[Pose, Pose]:
        """Return two such poses at these heights, m, at least ``apart`` from each other across the table, m."""
        for _ in range(_DRAWS):
            a, b = self.draw(first), self.draw(second)
            if np.linalg.norm((a.position - b.position)[:2]) >= apart:
                return a, b
        raise CommandError(f"there is no room for two objects {apart} m apart in the work area", code="no_room")

    def go(self, position: ArrayLike, yaw: float, grip: float, hand: int = 0) -> Iterator[Action]:
        """Yield actions until a tcp is at a position (3,), m, and its hand turned by ``yaw`` about z.

        A ``yaw`` of 0 is straight ahead for that arm, rad.

        Raises:
            CommandError: It was not there after 15 s (code ``not_arrived``).
        """
        for _ in range(round(_LONGEST * self.settings.rate_hz)):
            tcp = self.hands[hand].tcp
            turn = fold(self.hands[hand].ahead + yaw - yaw_of(tcp), 2.0 * math.pi)
            off = np.append(np.subtract(position, tcp.position), turn)
            if np.linalg.norm(off[:3]) < _ARRIVED[0] and abs(off[3]) < _ARRIVED[1]:
                return
            yield self.move(_GAIN * off, grip, hand)
        x, y, z = np.asarray(position, float).round(3)
        text = f"{self.hands[hand].robot.name} did not arrive at ({x}, {y}, {z}) m within {_LONGEST:g} s"
        raise CommandError(f"{text}: something is in its way, or it was stopped", code="not_arrived")

    def move(self, velocity: ArrayLike, grip: float, hand: int = 0) -> Action:
        """Return the action for a velocity (4,): of a tcp along x, y and z, m/s, and of its turn about z, rad/s.

        Other hands stay where they are.
        """
        action = np.zeros((len(self.hands), 5))
        action[:, 4] = self._grips
        action[hand] = np.append(np.clip(np.divide(velocity, self._most), -1.0, 1.0), grip)
        return action.ravel().astype(np.float32)

    def wait(self, steps: int, grip: float, hand: int = 0) -> Iterator[Action]:
        """Yield actions that move only the fingers."""
        for _ in range(steps):
            yield self.move(np.zeros(4), grip, hand)

    def yaw(self, pose: Pose) -> float:
        """Return the angle of a pose's x axis about z, rad."""
        return yaw_of(pose)

    def grasp_yaw(self, cube: Pose) -> float:
        """Return the turn of the hand, within 45 degrees of straight ahead, whose fingers lie along sides of a cube."""
        return fold(yaw_of(cube), 0.5 * math.pi)

    # Gymnasium's interface.

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[ObservationDict, dict[str, Any]]:
        """Place the arm over the middle of the work area, and the objects.

        On a real bench the objects are where they were put.

        Args:
            seed: Seed of ``np_random``; the same seed gives the same episode, to the bit. None continues its sequence.
            options: ``poses``: name of an object -> its :class:`~hal.geometry.Pose` in the arm's base frame, instead
                of a random one.

        Raises:
            CommandError: The arm does not reach an object (code ``out_of_reach``), or no camera sees one
                (``not_seen``).
        """
        if seed is not None:
            super(RigEnv, self).reset(seed=seed)  # the poses are drawn before the scene is reset
        self.poses = self.place() | dict((options or {}).get("poses", {}))
        for name, pose in self.poses.items():
            self._check_reach(name, pose)
        there = set(self.rig.world.bodies) if self.rig.has_world else set()
        world = {name: self.robot.base @ pose for name, pose in self.poses.items() if name in there}
        self._track, self._grips, self.hidden = [], [OPEN] * len(self.hands), set()
        seen, info = super().reset(options={"q": self._above, "poses": world})
        info.pop("poses", None)
        if self.hidden:
            text = f"no camera sees {' and '.join(sorted(self.hidden))}: put it into the work area"
            raise CommandError(f"{text}, before {self.centre.round(2)} m from the arm's base", code="not_seen")
        return seen, info | {"success": False}

    def step(self, action: Action) -> tuple[ObservationDict, float, bool, bool, dict[str, Any]]:
        """Send an action and wait one period; returns Gymnasium's five values.

        Raises:
            CommandError: ``reset`` was not called (code ``not_reset``), or the action's shape is wrong
                (``bad_action``).
        """
        numbers = np.asarray(action, float)
        if numbers.shape != self.action_space.shape:
            text = f"an action has shape {self.action_space.shape}, not {numbers.shape}"
            raise CommandError(text, code="bad_action")
        twists: list[float] = []
        self._grips = np.clip(numbers[4::5], -1.0, 1.0).tolist()
        for hand, own in zip(self.hands, np.clip(numbers, -1.0, 1.0).reshape(-1, 5), strict=True):
            twists += [*hand.twist(own[:4] * self._most, self._most), 0.5 * (own[4] + 1.0)]
        shown, reward, done, truncated, info = super().step(np.array(twists, np.float32))
        if self.hidden:  # where they are is not known
            done, reward, info["hidden"] = False, -1.0, sorted(self.hidden)
        return shown, float(done) - 1.0 if self._sparse else reward, done, truncated, info | {"success": done}

    # Details.

    def _check_bench(self, by_depth: bool, distances: tuple[float, ...]) -> None:
        """Check the grippers, and find the camera of the judge and the middle of the work area."""
        self.hands = tuple(Hand(self, arm.robot, self.robot.base) for arm in self._arms)
        """The arms with their grippers."""
        for hand in self.hands:
            hand.check_gripper(self.width)
        self._judge = DepthJudge(self, self.objects) if by_depth else None
        if self._judge is not None:
            self._cameras = (self._judge.camera,)  # no other picture is waited for
        elif not stands_in_world(self.rig, self.robot):
            raise CommandError("judge='truth' is for simulated arms; use judge='depth'", code="bad_judge")
        self.centre, self._above = self._find_centre(distances)
        """Middle of the work area (2,) in the arm's base frame, m; it ends :data:`AREA` from there."""

    def _observation_dict(self, observation: Observation) -> ObservationDict:
        """Return an observation, and note the poses of the objects."""
        seen = super()._observation_dict(observation)
        base = self.robot.base
        shown: ObservationDict = {}
        for lead, hand in zip(self._leads, self.hands, strict=True):
            shown |= {lead + name: seen[lead + name] for name in ("q", "dq", "gripper")}
            shown[lead + "tcp"] = pose_array(hand.tcp)
        if self._judge is not None:
            found = self._judge.find(observation, self.centre)
            self.hidden = self._judge.names - found.keys()
            self.poses |= found
        else:
            to_base = base.inverse()
            for name in self._objects:
                key, link = entry_key("object", name), self.links.get(name)
                pose = self.rig.world.pose(name, link) if link else Pose(seen[key][:3], seen[key][3:])
                self.poses[name] = to_base @ pose
        self._track = [*self._track[-_RECENT:], dict(self.poses)]
        for entry in self.objects:
            shown[entry_key("object", entry["name"])] = pose_array(self.poses[entry["name"]])
        return {name: np.clip(shown[name], *bounds).astype(np.float32) for name, bounds in self._bounds.items()}

    def _find_bounds(self) -> dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]]:
        """Return the lower and upper bounds of each entry of an observation."""
        pose = np.array([_BOUND] * 3 + [1.0] * 4, np.float32)
        bounds: dict[str, tuple[NDArray[np.float32], NDArray[np.float32]]] = {}
        for lead, hand in zip(self._leads, self.hands, strict=True):
            limits = hand.robot.limits
            speed, width = np.array(limits.velocity, np.float32), np.array([hand.gripper.width_max], np.float32)
            bounds |= {
                lead + "q": (np.array(limits.lower, np.float32), np.array(limits.upper, np.float32)),
                lead + "dq": (-speed, speed),
                lead + "tcp": (-pose, pose),
                lead + "gripper": (0.0 * width, width),
            }
        return bounds | {entry_key("object", entry["name"]): (-pose, pose) for entry in self.objects}

    def _check_reach(self, name: str, pose: Pose) -> None:
        """Check that an arm reaches an object. Raises CommandError."""
        for hand in self.hands:
            try:
                hand.reach(pose.position, 0.0, name)
                return
            except CommandError as error:
                failed = error
        raise failed

    def _find_centre(self, distances: tuple[float, ...]) -> tuple[Array, dict[str, Array]]:
        """Return the middle of the work area (2,), m, and each arm's joint positions (n,) over it, rad."""
        error = CommandError("")
        for distance in distances:
            try:
                for hand in self.hands:
                    for x, y, z in np.ndindex(2, 2, 2):
                        at = (distance + AREA * (2 * x - 1), AREA * (2 * y - 1), (GRASP_HEIGHT, HEIGHT)[z])
                        for turn in (-_TURN, _TURN):
                            hand.reach(at, turn, "the work area")
                aside = (0.0,) if len(self.hands) == 1 else (-_ASIDE, _ASIDE)
                starts = {
                    hand.robot.name: hand.reach((distance + x, 0.0, HEIGHT), 0.0, "the work area")
                    for hand, x in zip(self.hands, aside, strict=True)
                }
                return np.array([distance, 0.0]), starts
            except CommandError as failed:
                error = failed
        raise error

    def _choose_robots(self, robot: str | Mapping[str, Any] | None) -> str | tuple[str, ...] | None:
        """Return the names of the arms in the rig, as :class:`.EnvSettings` takes them; None for the first."""
        if len(self.arms) > 1:
            return self.arms
        return robot if isinstance(robot, str) else None

    def _make_rig(self, robot: str | Mapping[str, Any] | None, *, camera: bool, depth: bool) -> dict[str, Any]:
        """Return the rig file of a task: the arms at a table with the objects and, if wanted, a camera.

        A camera that judges must not see goals, which are not on a real table.
        """
        model = {"model": robot or "panda"} if not isinstance(robot, Mapping) else dict(robot)
        view = {"target": [-0.1, 0, 0.7], "distance": 0.85, "yaw_deg": 60, "pitch_deg": -30}
        streams = ["color", "depth"]
        picture = {"model": "pinhole", "look_at": view, "streams": streams, "output": {"width": 256, "height": 256}}
        table = {"name": "table", "size": [1.5, 1, 0.05]}
        bases = (_BASE, _BASE @ Pose.from_rpy((_APART, 0.0, 0.0), (0.0, 0.0, math.pi)))
        robots = {
            name: {"base": {"position": base.position.tolist(), "orientation": base.orientation.tolist()}}
            | {"workspace": {"table_height": 0.01}}
            | model
            for name, base in zip(self.arms, bases, strict=False)
        }
        unseen = {"visible": False} if depth else {}
        entries = [dict(entry) | (unseen if entry.get("collision") is False else {}) for entry in self.objects]
        return {
            "robots": robots,
            "cameras": {"scene": picture} if camera else {},
            "objects": ["floor", "table", *entries],
            "collisions": {"boxes": [table | {"position": [0, 0, 0.5645]}]},  # 10.5 mm lower, for the margin of 10 mm
        }
