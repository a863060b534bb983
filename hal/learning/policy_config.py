"""What a policy wants to see, and what its actions mean: a YAML file in ``config/policies/`` or of your own.

A file names each entry of the policy's request and where it comes from (a camera's picture, the arm's state, a text),
and how a row of its actions becomes joint positions and a grip.
"""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ..config.files import load_record
from ..config.schema import Quantity, Strict, ValueProblem
from ..errors import DeviceNotFound, NotSupported, PolicyError
from ..geometry import Pose, quaternion_to_matrix

if TYPE_CHECKING:
    from ..observation import Observation
    from ..rig import Rig
    from ..robot import Robot

__all__ = [
    "ActionConfig",
    "GripperAction",
    "PolicyConfig",
    "Source",
    "load_policy_config",
]

Array = NDArray[np.float64]

StateName = Literal["q", "dq", "tcp_position", "tcp_quaternion", "tcp_rpy", "tcp_rotvec", "width", "open", "closed"]
PixelCount = Annotated[int, Field(ge=8, le=4096)]


class Source(Strict):
    """Where an entry of a request comes from: a camera's picture, numbers of the arm, or a text; one of the three."""

    camera: str | None = None
    """Name of the camera in the rig whose picture is sent, uint8 RGB."""
    size: tuple[PixelCount, PixelCount] | None = None
    """Height and width of the picture in pixels: it is scaled to fit, and padded with black. None: as it is."""
    layout: Literal["hwc", "chw"] = "hwc"
    """Order of height, width and channels."""
    state: StateName | list[StateName] | None = None
    """Numbers, float32, one after the other: ``q`` (n,) rad, ``dq`` (n,) rad/s; of the tcp in the base frame
    ``tcp_position`` (3,) m, ``tcp_quaternion`` (4,) as x, y, z, w, ``tcp_rpy`` (3,) and ``tcp_rotvec`` (3,) rad; of the
    gripper ``width`` in m, ``open`` and ``closed`` from 0 to 1."""
    text: str | None = None
    """A text; ``task`` stands for that of the run."""

    @model_validator(mode="after")
    def _one_source(self) -> Source:
        if sum(value is not None for value in (self.camera, self.state, self.text)) != 1:
            raise ValueProblem("needs one of camera, state and text", "conflict")
        return self

    @property
    def names(self) -> list[StateName]:
        """Names of the numbers; empty for another kind of source."""
        return self.state if isinstance(self.state, list) else [self.state] if self.state is not None else []


class GripperAction(Strict):
    """The number of an action that moves the gripper."""

    index: int = -1
    """Its place in the action; -1 is the last."""
    open: float = 0.0
    """Its value for an open gripper."""
    closed: float = 1.0
    """Its value for a closed gripper."""
    metres: bool = False
    """Whether it is the distance between the fingers in m, in place of ``open`` and ``closed``."""
    threshold: Annotated[float, Field(gt=0.0, lt=1.0)] | None = None
    """Share of the way to closed from which the gripper closes, and below which it opens; None: in proportion."""

    def grip(self, values: Array, width_max: float) -> Array:
        """Return the grips (k,), 0 open to 1 closed, for values of the action (k,) and a gripper of this width, m."""
        opened, closed = (width_max, 0.0) if self.metres else (self.open, self.closed)
        share = np.clip((values - opened) / (closed - opened), 0.0, 1.0)
        return share if self.threshold is None else (share >= self.threshold).astype(float)

    @model_validator(mode="after")
    def _differ(self) -> GripperAction:
        if self.open == self.closed:
            raise ValueProblem("open and closed must differ", "conflict")
        return self


class ActionConfig(Strict):
    """The meaning of a row of actions."""

    kind: Literal["joint_position", "joint_delta", "joint_velocity", "tcp_delta"]
    """``joint_position``: targets, rad. ``joint_delta``: the same, from the measured positions at the time of the
    observation. ``joint_velocity``: steps of ``scale`` rad, added up from those positions. ``tcp_delta``: steps of the
    tcp along the base's axes, added up: translation in ``scale`` m, then a rotation vector in ``turn`` rad."""
    scale: Annotated[float, Quantity("rad or m per step", 0.0, 10.0, above=True)] = 1.0
    """Step for an action of 1."""
    turn: Annotated[float, Quantity("rad per step", 0.0, 3.2, above=True)] = 1.0
    """Turn for an action of 1, for ``tcp_delta``."""
    first: Annotated[int, Field(ge=0, le=1)] | None = None
    """Steps after the observation at which the first action is due; None: 0 for ``joint_position`` and ``joint_delta``,
    1 for steps that are added up."""
    clip: bool = False
    """Whether an action with a number beyond -1 to 1 is scaled down as a whole."""
    gripper: GripperAction | None = None
    """None: the policy does not move the gripper."""


class Decoded(NamedTuple):
    """Targets of a chunk."""

    q: Array
    """Joint positions (k, n), rad."""
    grip: Array | None
    """Grips (k,), 0 open to 1 closed."""
    first: int
    """Steps after the observation at which the first target is due."""


class PolicyConfig(Strict):
    """Requests and actions of one kind of policy."""

    description: str = ""
    rate_hz: Annotated[float, Quantity("Hz", 1.0, 200.0)]
    """Rate of the policy's actions, Hz."""
    execute: Annotated[int, Field(ge=1, le=256)] | None = None
    """Actions of a chunk that are driven before those of the next one; None: half of the chunk."""
    observation: dict[str, Source]
    """Key of the request -> where its value comes from."""
    action: ActionConfig

    def cameras(self) -> tuple[str, ...]:
        """Return the names of the cameras that are needed, each once."""
        return tuple(dict.fromkeys(source.camera for source in self.observation.values() if source.camera is not None))

    def check(self, rig: Rig, robot: Robot) -> None:
        """Check that a rig has what the policy needs.

        Raises:
            DeviceNotFound: A camera is missing; names those that are needed and those that are there.
            NotSupported: The policy uses a gripper, and the arm has none.
        """
        missing = [name for name in self.cameras() if name not in rig.cameras]
        if missing:
            raise DeviceNotFound(
                f"the policy needs the cameras {', '.join(self.cameras())}; this rig has: "
                f"{', '.join(rig.cameras) or 'none'}; change the names in the policy's file, or in the rig's"
            )
        names = {name for source in self.observation.values() for name in source.names}
        uses = self.action.gripper is not None or names & {"width", "open", "closed"}
        if uses and robot.gripper is None:
            raise NotSupported(f"the policy uses a gripper, and {robot.name} has none")

    def numbers(self, joints: int) -> int:
        """Return the length of an action for an arm with so many joints."""
        return (6 if self.action.kind == "tcp_delta" else joints) + (self.action.gripper is not None)

    def request(self, observation: Observation, robot: Robot, task: str) -> dict[str, Any]:
        """Return the request for an observation. Raises NotSupported for a camera without colour."""
        request: dict[str, Any] = {}
        for key, source in self.observation.items():
            if source.camera is not None:
                color = observation.cameras[source.camera].frame.color
                if color is None:
                    raise NotSupported(f"the policy needs colour of camera {source.camera}, which has none")
                request[key] = _picture(color, source)
            elif source.names:
                numbers = [_state(name, observation, robot) for name in source.names]
                request[key] = np.concatenate(numbers).astype(np.float32)
            else:
                request[key] = task if source.text == "task" else source.text
        return request

    def decode(self, actions: Array, observation: Observation, robot: Robot) -> Decoded:
        """Return the targets of a chunk of actions (k, numbers), which answer ``observation``.

        Raises:
            PolicyError: A pose of the tcp is out of reach (code ``policy_unreachable_pose``).
        """
        action, state = self.action, observation.robots[robot.name]
        grip = None
        if action.gripper is not None:
            assert robot.gripper is not None
            grip = action.gripper.grip(actions[:, action.gripper.index], robot.gripper.width_max)
            actions = np.delete(actions, action.gripper.index, axis=1)
        if action.clip:
            actions = actions / np.maximum(1.0, np.abs(actions).max(axis=1, keepdims=True))
        summed = action.kind in ("joint_velocity", "tcp_delta")
        if action.kind == "tcp_delta":
            q = self._follow_steps(actions, state.tcp, state.q, robot)
        else:
            q = action.scale * (np.cumsum(actions, axis=0) if summed else actions)
            q = q if action.kind == "joint_position" else state.q + q
        return Decoded(q, grip, int(summed) if action.first is None else action.first)

    def _follow_steps(self, actions: Array, tcp: Pose, q: Array, robot: Robot) -> Array:
        """Return the joint positions (k, n) of steps (k, 6) of the tcp, which begin at ``tcp`` and ``q``."""
        from ..errors import Unreachable

        found, rotation, position = [], quaternion_to_matrix(tcp.orientation), np.array(tcp.position)
        for step in actions:
            position = position + self.action.scale * step[:3]
            rotation = _turn(self.action.turn * step[3:]) @ rotation
            matrix = np.eye(4)
            matrix[:3, :3], matrix[:3, 3] = rotation, position
            try:
                q = robot.ik(Pose.from_matrix(matrix), q)
            except Unreachable as error:
                raise PolicyError(
                    f"the policy leads out of the arm's reach: {error}", code="policy_unreachable_pose"
                ) from error
            found.append(q)
        return np.array(found)


def load_policy_config(config: str | Path | Mapping[str, Any] | PolicyConfig) -> PolicyConfig:
    """Return a checked policy configuration.

    Args:
        config: The path of a file, the name of a built-in one (``droid``, ``libero``, ...), a dict with the same keys,
            or a configuration.

    Raises:
        ConfigError: It has problems; all are listed.
    """
    return load_record(PolicyConfig, config, "policies", "policy_config")


def _state(name: StateName, observation: Observation, robot: Robot) -> Array:
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
        return _rpy(quaternion_to_matrix(state.tcp.orientation))
    if name == "tcp_rotvec":
        return _rotation_vector(state.tcp.orientation)
    width = observation.grippers[robot.name].width
    if name == "width":
        return np.array([width])
    assert robot.gripper is not None
    share = float(np.clip(width / robot.gripper.width_max, 0.0, 1.0))
    return np.array([share if name == "open" else 1.0 - share])


def _picture(color: NDArray[np.uint8], source: Source) -> NDArray[np.uint8]:
    """Return a picture in the size and the layout of its source."""
    if source.size is not None and color.shape[:2] != source.size:
        from PIL import Image

        height, width = source.size
        scale = min(height / color.shape[0], width / color.shape[1])
        inner = max(1, round(color.shape[1] * scale)), max(1, round(color.shape[0] * scale))
        scaled = np.asarray(Image.fromarray(color).resize(inner, Image.Resampling.BILINEAR))
        top, left = (height - inner[1]) // 2, (width - inner[0]) // 2
        color = np.zeros((height, width, 3), np.uint8)
        color[top : top + inner[1], left : left + inner[0]] = scaled
    return np.ascontiguousarray(color.transpose(2, 0, 1) if source.layout == "chw" else color)


def _turn(vector: Array) -> Array:
    """Return the rotation matrix (3, 3) of a rotation vector (3,), rad (Rodrigues)."""
    angle = float(np.linalg.norm(vector))
    if angle < 1e-12:
        return np.eye(3)
    half = np.sin(angle / 2.0) / angle * vector
    return quaternion_to_matrix([*half, np.cos(angle / 2.0)])


def _rotation_vector(quaternion: Array) -> Array:
    """Return the rotation vector (3,), rad, at most pi long, of a quaternion x, y, z, w."""
    x, y, z, w = quaternion if quaternion[3] >= 0.0 else -quaternion
    sine = float(np.sqrt(x * x + y * y + z * z))
    angle = 2.0 * float(np.arctan2(sine, w))
    return np.array([x, y, z]) * (angle / sine if sine > 1e-12 else 2.0)


def _rpy(matrix: Array) -> Array:
    """Return roll, pitch and yaw (3,) about the fixed axes, rad, of a rotation matrix."""
    across = float(np.hypot(matrix[0, 0], matrix[1, 0]))
    pitch = np.arctan2(-matrix[2, 0], across)
    if across < 1e-9:  # gimbal lock: the yaw is 0 by choice
        return np.array([np.arctan2(-matrix[1, 2], matrix[1, 1]), pitch, 0.0])
    return np.array([np.arctan2(matrix[2, 1], matrix[2, 2]), pitch, np.arctan2(matrix[1, 0], matrix[0, 0])])
