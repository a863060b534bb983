"""What a policy wants to see, and what its actions mean: a YAML file in ``config/policies/`` or of your own.

A file names each entry of the policy's request and where it comes from (a camera's picture, numbers of an arm, a text),
and how a row of its actions becomes joint positions and a grip, of one arm or of several.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple, TypeVar

import numpy as np
from numpy.typing import NDArray
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from ..config.files import load_record
from ..config.schema import Flag, Quantity, Strict, ValueProblem
from ..errors import DeviceNotFound, NotSupported, PolicyError, Unreachable
from ..geometry import Pose, apply_rotation, difference, quaternion_to_matrix

if TYPE_CHECKING:
    from ..gripper import Gripper
    from ..observation import Observation
    from ..rig import Rig
    from ..robot import Robot

Array = NDArray[np.float64]
T = TypeVar("T")

STATES = ("q", "dq", "tcp_position", "tcp_quaternion", "tcp_rpy", "tcp_rotvec", "width", "open", "closed")
"""Names of numbers of an arm; the last three are of its gripper."""


_OF_GRIPPER = STATES[-3:]
_SUMMED = ("joint_velocity", "tcp_delta")
"""Kinds of actions that are steps from one target to the next."""
_LARGEST_STEP = np.pi
"""Greatest number of such a step, rad or m: a policy that asks for more is broken."""
_FOLLOWED = 0.9
"""Share of the rig's speeds that a step may use; the rest lets an arm that starts late catch up."""


def _check_state(name: str) -> str:
    if name.rpartition(".")[2] not in STATES:
        raise ValueProblem(f"{name!r} is not one of {', '.join(STATES)}, nor one after an arm's name", "unknown_value")
    return name


def _wrap_in_list(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


StateName = Annotated[str, AfterValidator(_check_state)]
PixelCount = Annotated[int, Field(ge=8, le=4096)]


class Source(Strict):
    """Where an entry of a request comes from: a camera's picture, an arm's numbers, objects' poses, or a text: one."""

    camera: str | None = None
    """Name of the camera in the rig whose picture is sent, uint8 RGB."""
    size: tuple[PixelCount, PixelCount] | None = None
    """Height and width of the picture in pixels: it is scaled to fit, and padded with black. None: as it is."""
    layout: Literal["hwc", "chw"] = "hwc"
    """Order of height, width and channels."""
    mirror: Flag = False
    """Whether left and right of the picture are exchanged."""
    state: Annotated[list[StateName] | None, BeforeValidator(_wrap_in_list)] = None
    """Numbers, float32, one after the other: ``q`` (n,) rad, ``dq`` (n,) rad/s; of the tcp in the base frame
    ``tcp_position`` (3,) m, ``tcp_quaternion`` (4,) as x, y, z, w, ``tcp_rpy`` (3,) and ``tcp_rotvec`` (3,) rad; of the
    gripper ``width`` in m, ``open`` and ``closed`` from 0 to 1. ``left.q`` is that of the arm with this name."""
    objects: list[str] | None = None
    """Names of objects of a simulation, whose poses in the world are sent as float32, one after the other: x, y, z in
    m, and the quaternion as x, y, z, w. A rig without a simulated world has none."""
    scale: float | list[float] = 1.0
    """Factor of the numbers, one for all or one for each."""
    offset: float | list[float] = 0.0
    """Is added after that."""
    text: str | None = None
    """A text; ``task`` stands for that of the run."""
    within: str | None = None
    """Key of a map in the request that has this entry; None: the request itself."""

    @model_validator(mode="after")
    def _check_source(self) -> Source:
        if sum(value is not None for value in (self.camera, self.state, self.objects, self.text)) != 1:
            raise ValueProblem("needs one of camera, state, objects and text", "conflict")
        return self

    @property
    def names(self) -> list[tuple[str, str]]:
        """Arm (empty for the first) and name of the numbers; empty for another kind of source."""
        return [(arm, name) for arm, _, name in (text.rpartition(".") for text in self.state or ())]


class GripperAction(Strict):
    """The number of an action that moves the gripper."""

    index: int = -1
    """Its place among the arm's numbers; -1 is the last."""
    open: float = 0.0
    """Its value for an open gripper."""
    closed: float = 1.0
    """Its value for a closed gripper."""
    metres: bool = False
    """Whether it is the distance between the fingers in m, in place of ``open`` and ``closed``."""
    threshold: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Share of the way to closed from which the gripper closes, and below which it opens; None: in proportion."""

    def values(self, grips: Array, gripper: Gripper) -> Array:
        """Return the values of the action (k,) for grips (k,), 0 open to 1 closed; the reverse of :meth:`grip`."""
        opened, closed = (gripper.width_max, gripper.width_min) if self.metres else (self.open, self.closed)
        return opened + grips * (closed - opened)

    def grip(self, values: Array, gripper: Gripper) -> Array:
        """Return the grips (k,), 0 open to 1 closed, for values of the action (k,)."""
        opened, closed = (gripper.width_max, gripper.width_min) if self.metres else (self.open, self.closed)
        share = np.clip((values - opened) / (closed - opened), 0.0, 1.0)
        return share if self.threshold is None else (share >= self.threshold).astype(float)

    @model_validator(mode="after")
    def _check_ends(self) -> GripperAction:
        if self.open == self.closed:
            raise ValueProblem("open and closed must differ", "conflict")
        return self


class Decoded(NamedTuple):
    """Targets of one arm in a chunk."""

    q: Array
    """Joint positions (k, n), rad."""
    grip: Array | None
    """Grips (k,), 0 open to 1 closed; None if the policy does not move the gripper."""

    def rows(self, which: Any) -> Decoded:
        """Return the targets of these indices."""
        return Decoded(self.q[which], None if self.grip is None else self.grip[which])


class ActionConfig(Strict):
    """The meaning of a row of actions, or of the part of it that moves one of several arms."""

    robot: str | None = None
    """Name of the arm; None for that of the run."""
    columns: tuple[Annotated[int, Field(ge=0)], Annotated[int, Field(ge=1)]] | None = None
    """Index of the arm's first number in a row, and the index after its last; None for all numbers."""
    kind: Literal["joint_position", "joint_delta", "joint_velocity", "tcp_delta"]
    """``joint_position``: targets, rad. ``joint_delta``: the same, from the measured positions at the time of the
    observation. ``joint_velocity``: steps of ``scale`` rad, added up from those positions. ``tcp_delta``: steps of the
    tcp along the base's axes, added up: translation in ``scale`` m, then a rotation vector in ``turn`` rad."""
    scale: Annotated[float, Quantity("rad or m per step", 0.0, 10.0, above=True)] = 1.0
    """Step for an action of 1; for joint positions rad for each unit of the policy's (0.0174533 for degrees)."""
    turn: Annotated[float, Quantity("rad per step", 0.0, 3.2, above=True)] = 1.0
    """Turn for an action of 1, for ``tcp_delta``."""
    first: Annotated[int, Field(ge=0, le=1)] | None = None
    """Steps after the observation at which the first action is due; None: 0 for ``joint_position`` and ``joint_delta``,
    1 for steps that are added up."""
    clip: bool = False
    """Whether an action with a number beyond -1 to 1 is scaled down as a whole."""
    gripper: GripperAction | None = None
    """None: the policy does not move the gripper."""

    @property
    def due(self) -> int:
        """Steps after the observation at which the first action is due."""
        return int(self.kind in _SUMMED) if self.first is None else self.first

    def numbers(self, joints: int) -> int:
        """Return how many numbers move an arm with so many joints."""
        return (6 if self.kind == "tcp_delta" else joints) + (self.gripper is not None)

    def decode(self, actions: Array, observation: Observation, robot: Robot, period: float) -> Decoded:
        """Return the targets of the rows (k, numbers) of one arm, which answer ``observation``, ``period`` s apart.

        Raises:
            PolicyError: A pose of the tcp is out of reach (code ``policy_unreachable_pose``); or a step is more than pi
                rad or m (``policy_bad_actions``).
        """
        state, grip = observation.robots[robot.name], None
        if self.gripper is not None:
            assert robot.gripper is not None
            grip = self.gripper.grip(actions[:, self.gripper.index], robot.gripper)
            actions = np.delete(actions, self.gripper.index, axis=1)
        if self.kind in _SUMMED:
            scales = [*[self.scale] * 3, *[self.turn] * 3] if self.kind == "tcp_delta" else self.scale
            steps = np.abs(actions * scales).max(axis=1)
            if steps.max() > _LARGEST_STEP:
                raise PolicyError(
                    f"action {int(steps.argmax()) + 1} of {len(steps)} in the policy's chunk is a step of "
                    f"{steps.max():.3g} rad or m; it may be {_LARGEST_STEP:.3g}",
                    code="policy_bad_actions",
                )
        if self.clip:
            actions = actions / np.maximum(1.0, np.abs(actions).max(axis=1, keepdims=True))
        if self.kind == "tcp_delta":
            return Decoded(self._follow_steps(actions, state.tcp, state.q, robot, period), grip)
        if self.kind == "joint_velocity":
            return Decoded(self._add_steps(actions, state.q, robot, period), grip)
        q = self.scale * actions
        return Decoded(q if self.kind == "joint_position" else state.q + q, grip)

    def encode(self, targets: Decoded, observation: Observation, robot: Robot) -> Array:
        """Return the rows (k, numbers) that stand for targets: the reverse of :meth:`decode` for actions of joints."""
        assert self.kind != "tcp_delta"
        q, start = targets.q, observation.robots[robot.name].q
        if self.kind == "joint_velocity":
            q = np.diff(q, axis=0, prepend=np.asarray(start)[None])
        elif self.kind == "joint_delta":
            q = q - start
        rows: Array = q / self.scale
        if self.gripper is None:
            return rows
        assert robot.gripper is not None
        assert targets.grip is not None
        values = self.gripper.values(targets.grip, robot.gripper)
        return np.insert(rows, self.gripper.index % (rows.shape[1] + 1), values, axis=1)

    def _add_steps(self, actions: Array, q: Array, robot: Robot, period: float) -> Array:
        """Return the joint positions (k, n) of steps (k, n), which begin at ``q``."""
        found = []
        for step in self.scale * actions:
            q = q + _find_share(robot, q, q + step, period) * step
            found.append(q)
        return np.array(found)

    def _follow_steps(self, actions: Array, tcp: Pose, q: Array, robot: Robot, period: float) -> Array:
        """Return the joint positions (k, n) of steps (k, 6) of the tcp, which begin at ``tcp`` and ``q``."""
        found, pose = [], tcp
        for action in actions:
            step = np.concatenate([self.scale * action[:3], self.turn * action[3:]])
            try:
                after = _move_pose(pose, step)
                goal = robot.ik(after, q)
                if (share := _find_share(robot, q, goal, period)) < 1.0:
                    after = _move_pose(pose, share * step)
                    goal = robot.ik(after, q)
            except Unreachable as error:
                raise PolicyError(
                    f"the policy leads out of the arm's reach: {error}", code="policy_unreachable_pose"
                ) from error
            q, pose = goal, after
            found.append(q)
        return np.array(found)


def _move_pose(pose: Pose, step: Array) -> Pose:
    """Return a pose after a step (6,): a translation, m, and a rotation vector, rad, along the base's axes."""
    return Pose(pose.position + step[:3], apply_rotation(pose.orientation.tolist(), step[3:].tolist()))


def _find_share(robot: Robot, q: Array, goal: Array, period: float) -> float:
    """Return the share of a step between joint positions that an arm covers in ``period`` s, at the rig's speeds.

    Policies that command speeds, such as DROID's, were trained on arms that move more slowly where they cannot follow.
    Targets farther away would leave the arm farther behind with each step, and the next chunk would be a jump.
    """
    spec = robot.spec
    joints = np.abs(goal - q) / (spec.speed * np.asarray(spec.limits.velocity))
    tcp = robot.fk(goal).distance(robot.fk(q))[0] / spec.tcp_speed
    return float(min(1.0, _FOLLOWED * period / max(joints.max(), tcp, 1e-9)))


class PolicyConfig(Strict):
    """Requests and actions of one kind of policy."""

    description: str = ""
    rate_hz: Annotated[float, Quantity("Hz", 1.0, 200.0)]
    """Rate of the policy's actions, Hz."""
    execute: Annotated[int, Field(ge=1, le=256)] | None = None
    """Actions of a chunk that are driven before those of the next one; None: half of the chunk."""
    blend: Annotated[int, Field(ge=0, le=256)] = 6
    """Steps over which the arm changes from one chunk to the next."""
    observation: dict[str, Source]
    """Key of the request -> where its value comes from."""
    action: ActionConfig | None = None
    """What a row of actions means."""
    arms: list[ActionConfig] | None = None
    """Instead of ``action`` for a policy that moves several arms: the part of each."""

    @model_validator(mode="after")
    def _check_maps(self) -> PolicyConfig:
        for source in self.observation.values():
            if source.within in self.observation:
                raise ValueProblem(f"{source.within} cannot be an entry and a map with entries", "conflict")
        return self

    @model_validator(mode="after")
    def _check_arms(self) -> PolicyConfig:
        if (self.action is None) == (self.arms is None):
            raise ValueProblem("needs an action, or arms with an action each", "missing_key")
        if self.arms is None:
            return self
        if not self.arms or any(action.robot is None or action.columns is None for action in self.arms):
            raise ValueProblem("each of the arms needs a robot and columns", "missing_key")
        names = [action.robot for action in self.arms]
        spans = sorted(action.columns for action in self.arms if action.columns is not None)
        if len(set(names)) < len(names) or any(one[1] > two[0] for one, two in pairwise(spans)):
            raise ValueProblem("each robot has one action, and no two have a column in common", "conflict")
        if len({action.due for action in self.arms}) > 1:
            raise ValueProblem("the first actions of all arms must be due at the same time", "conflict")
        return self

    @property
    def actions(self) -> list[ActionConfig]:
        """The action of each arm."""
        return [self.action] if self.action is not None else list(self.arms or ())

    @property
    def due(self) -> int:
        """Steps after the observation at which the first action of a chunk is due."""
        return self.actions[0].due

    def resize_pictures(self, height: int, width: int) -> PolicyConfig:
        """Return this configuration with all pictures in another size, in pixels."""
        resized = {
            key: source if source.camera is None else source.model_copy(update={"size": (height, width)})
            for key, source in self.observation.items()
        }
        return self.model_copy(update={"observation": resized})

    def cameras(self) -> tuple[str, ...]:
        """Return the names of the cameras that are needed, each once."""
        return tuple(dict.fromkeys(source.camera for source in self.observation.values() if source.camera is not None))

    def robots(self, rig: Rig, robot: Robot) -> dict[str, Robot]:
        """Return the arms that the policy moves and those that it sees, by name; ``robot`` if the file names none.

        Raises:
            DeviceNotFound: A robot, a camera or an object is missing; names those that are needed and those that are
                there.
            NotSupported: The policy uses a gripper, and the arm has none; or the columns of an arm are more or fewer
                than its joints, and a gripper's; or it sees objects, and the rig is not simulated.
        """
        moved = [action.robot or robot.name for action in self.actions]
        seen = [arm for source in self.observation.values() for arm, _ in source.names if arm]
        robots = _find_devices("robots", [*moved, *seen], rig.robots)
        _find_devices("cameras", self.cameras(), rig.cameras)
        if objects := [name for source in self.observation.values() for name in source.objects or ()]:
            if not rig.has_world:
                raise NotSupported(
                    "the policy sees poses of objects, which only a simulation knows", code="policy_mismatch"
                )
            _find_devices("objects", objects, dict.fromkeys(rig.world.bodies))
        for name, action in zip(moved, self.actions, strict=True):
            arm, numbers = robots[name], action.numbers(robots[name].n)
            first, end = action.columns or (0, numbers)
            if end - first != numbers:
                raise NotSupported(
                    f"the policy has {end - first} numbers for {name}, the columns {first} to {end}; with "
                    f"{arm.n} joints it needs {numbers}",
                    code="policy_mismatch",
                )
            if action.gripper is not None and not -numbers <= action.gripper.index < numbers:
                raise NotSupported(
                    f"the policy has {numbers} numbers for {name}, and none at {action.gripper.index} for its gripper",
                    code="policy_mismatch",
                )
        used = {name for name, action in zip(moved, self.actions, strict=True) if action.gripper is not None}
        names = [(arm or moved[0], name) for source in self.observation.values() for arm, name in source.names]
        used |= {arm for arm, name in names if name in _OF_GRIPPER}
        for name in sorted(used):
            if robots[name].gripper is None:
                raise NotSupported(f"the policy uses a gripper, and {name} has none", code="no_gripper")
        return robots

    def numbers(self, robots: Mapping[str, Robot]) -> int:
        """Return the length of a row of actions for these arms (see :meth:`robots`)."""
        ends = [action.columns[1] for action in self.actions if action.columns is not None]
        return max(ends) if ends else self.actions[0].numbers(next(iter(robots.values())).n)

    def request(self, rig: Rig, observation: Observation, robots: Mapping[str, Robot], task: str) -> dict[str, Any]:
        """Return the request for an observation; objects are where they are now.

        Raises:
            NotSupported: A camera has no colour, or a scale or an offset has another length than the numbers.
        """
        request: dict[str, Any] = {}
        first = next(iter(robots.values()))
        for key, source in self.observation.items():
            value: Any = task if source.text == "task" else source.text
            if source.camera is not None:
                color = observation.cameras[source.camera].frame.color
                if color is None:
                    raise NotSupported(f"the policy needs colour of camera {source.camera}, which has none")
                value = _fit_picture(color, source)
            elif source.names:
                numbers = [_read_state(name, observation, robots[arm] if arm else first) for arm, name in source.names]
                value = _scale(np.concatenate(numbers), source).astype(np.float32)
            elif source.objects is not None:
                poses = rig.world.poses(source.objects).poses
                parts = [part for name in source.objects for part in (poses[name].position, poses[name].orientation)]
                value = _scale(np.concatenate(parts), source).astype(np.float32)
            (request if source.within is None else request.setdefault(source.within, {}))[key] = value
        return request

    def decode(self, actions: Array, observation: Observation, robots: Mapping[str, Robot]) -> dict[str, Decoded]:
        """Return the targets of each moved arm for a chunk of actions (k, numbers), which answer ``observation``.

        Raises:
            PolicyError: A pose of the tcp is out of reach (code ``policy_unreachable_pose``).
        """
        found = {}
        for action in self.actions:
            name = action.robot or next(iter(robots))
            rows = actions if action.columns is None else actions[:, slice(*action.columns)]
            found[name] = action.decode(rows, observation, robots[name], 1.0 / self.rate_hz)
        return found

    def encode(self, targets: Mapping[str, Decoded], observation: Observation, robots: Mapping[str, Robot]) -> Array:
        """Return the actions (k, numbers) for targets of each arm: the reverse of :meth:`decode`."""
        steps = len(next(iter(targets.values())).q)
        actions = np.zeros((steps, self.numbers(robots)))
        for action in self.actions:
            name = action.robot or next(iter(robots))
            columns = slice(None) if action.columns is None else slice(*action.columns)
            actions[:, columns] = action.encode(targets[name], observation, robots[name])
        return actions


def load_policy_config(config: str | Path | Mapping[str, Any] | PolicyConfig) -> PolicyConfig:
    """Return a checked policy configuration.

    Args:
        config: The path of a file, the name of a built-in one (``droid``, ``libero``, ...), a dict with the same keys,
            or a configuration.

    Raises:
        ConfigError: It has problems; all are listed.
    """
    return load_record(PolicyConfig, config, "policies", "policy_config")


def _find_devices(kind: str, needed: Iterable[str], there: Mapping[str, T]) -> dict[str, T]:
    """Return the devices that are needed. Raises DeviceNotFound with both lists if one is missing."""
    names = list(dict.fromkeys(needed))
    if set(names) <= set(there):
        return {name: there[name] for name in names}
    raise DeviceNotFound(
        f"the policy needs the {kind} {', '.join(names)}; this rig has: {', '.join(there) or 'none'}; change the names "
        "in the policy's file, or in the rig's"
    )


def _scale(numbers: Array, source: Source) -> Array:
    for factor in (source.scale, source.offset):
        if isinstance(factor, list) and len(factor) != numbers.size:
            names = ", ".join(source.objects or [name for _, name in source.names])
            raise NotSupported(
                f"the policy's file scales {len(factor)} numbers, and {names} are {numbers.size}",
                code="policy_mismatch",
            )
    scaled: Array = np.asarray(source.scale, float) * numbers + np.asarray(source.offset, float)
    return scaled


def _read_state(name: str, observation: Observation, robot: Robot) -> Array:
    state = observation.robots[robot.name]
    if name == "q":
        return np.asarray(state.q)
    if name == "dq":
        return np.asarray(state.dq)
    if name == "tcp_position":
        return np.asarray(state.tcp.position)
    if name == "tcp_quaternion":
        return np.asarray(state.tcp.orientation)
    if name == "tcp_rpy":
        from pinocchio.rpy import matrixToRpy

        return np.asarray(matrixToRpy(quaternion_to_matrix(state.tcp.orientation)))
    if name == "tcp_rotvec":
        return np.array(difference((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, *state.tcp.orientation))[3:])
    width = observation.grippers[robot.name].width
    if name == "width":
        return np.array([width])
    assert robot.gripper is not None
    grip = robot.gripper.grip_at(width)
    return np.array([1.0 - grip if name == "open" else grip])


def _fit_picture(color: NDArray[np.uint8], source: Source) -> NDArray[np.uint8]:
    if source.size is not None and color.shape[:2] != source.size:
        from PIL import Image

        height, width = source.size
        scale = min(height / color.shape[0], width / color.shape[1])
        inner = max(1, round(color.shape[1] * scale)), max(1, round(color.shape[0] * scale))
        scaled = np.asarray(Image.fromarray(color).resize(inner, Image.Resampling.BILINEAR))
        top, left = (height - inner[1]) // 2, (width - inner[0]) // 2
        color = np.zeros((height, width, 3), np.uint8)
        color[top : top + inner[1], left : left + inner[0]] = scaled
    if source.mirror:
        color = color[:, ::-1]
    return np.ascontiguousarray(color.transpose(2, 0, 1) if source.layout == "chw" else color)
