"""The schema of a rig's file: every key with its unit and default.

.. code-block:: yaml

    robots:
      panda: {model: panda}
    cameras:
      wrist:
        model: realsense_d435
        attached: {robot: panda, link: panda_hand, translation: [0.09, 0, 0.02], target: [-0.45, 0, 0.9]}
    gamepads:
      pad: {model: auto}
    objects: [table, cube]
"""

from __future__ import annotations

import ast
import inspect
import itertools
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Annotated, Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, BeforeValidator, Field, model_validator
from pydantic.json_schema import GenerateJsonSchema
from pydantic_core.core_schema import ModelSchema

from ..geometry import Pose, matrix_to_quaternion, quaternion_to_matrix, rpy_to_matrix
from ..registry import explain_engine
from ..specs import CollisionSpec, ViewSpec
from ..types import STREAMS
from .models import (
    Capture,
    Depth,
    Distortion,
    Drivers,
    FieldOfView,
    LeaderJoints,
    LeverUse,
    LimitsModel,
    TcpModel,
    expand_names,
)
from .randomize import RandomizeConfig
from .schema import (
    Address,
    CameraRate,
    Coordinate,
    Degrees,
    Direction,
    Distance,
    Flag,
    Force,
    Gravity,
    JointPositions,
    Mass,
    Name,
    Offset,
    Pixels,
    PoseConfig,
    Position,
    Quantity,
    QuaternionConfig,
    RateHz,
    Several,
    Share,
    Sizes,
    Speed,
    Strict,
    TcpSpeed,
    ValueProblem,
    describe,
)

Array = NDArray[np.float64]


class LookAt(Strict):
    """A fixed camera that is aimed at a point, as by PyBullet's ``computeViewMatrixFromYawPitchRoll``.

    With yaw, pitch and roll 0 and ``up_axis: z`` the camera is at ``distance`` m from ``target`` towards -y, upright.
    Pitch turns that about x (-30: the camera is 30 degrees above the target and points down), roll about y, then yaw
    about z. With a pitch beyond +-90 the image is upside down, as in PyBullet. World frame.
    """

    target: Position
    distance: Distance
    yaw_deg: Degrees = 0.0
    pitch_deg: Degrees = 0.0
    roll_deg: Degrees = 0.0
    up_axis: Literal["y", "z"] = "z"

    def pose(self) -> Pose:
        """Return the pose of the optical frame (x right, y down, z forward) in the world."""
        yaw, pitch, roll = (math.radians(angle) for angle in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        if self.up_axis == "z":
            turn = rpy_to_matrix(0, 0, yaw) @ rpy_to_matrix(0, roll, 0) @ rpy_to_matrix(pitch, 0, 0)
            back, up = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
        else:  # PyBullet's order of rotations differs here
            turn = rpy_to_matrix(0, 0, roll) @ rpy_to_matrix(0, yaw, 0) @ rpy_to_matrix(-pitch, 0, 0)
            back, up = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
        eye = np.asarray(self.target) + self.distance * (turn @ back)
        return make_optical_pose(eye, -(turn @ back), turn @ up)


_ROTATION = Several(
    Quantity("rad", -2.0 * math.pi, 2.0 * math.pi), None, "roll, pitch, yaw; or a unit quaternion x, y, z, w"
)


def _check_rotation(rotation: tuple[float, ...]) -> tuple[float, ...]:
    if len(rotation) not in (3, 4):
        message = f"must be roll, pitch, yaw in rad, or a quaternion x, y, z, w, not {len(rotation)} numbers"
        raise ValueProblem(message, "wrong_count")
    if len(rotation) == 4 and abs(math.hypot(*rotation) - 1.0) > 0.01:
        raise ValueProblem("must be a unit quaternion x, y, z, w, or three angles in rad", "bad_rotation")
    return rotation


class Attached(Strict):
    """A camera on a link of a robot.

    The camera is at ``translation`` (m, in the frame of the link). ``rotation`` (roll, pitch, yaw in rad, or a
    quaternion) turns a bracket there; in the bracket's frame the optical axis points along ``target``, and ``up`` is
    upwards in the image (default: z, or x for a camera that points along z). A camera that points along the fingers of
    a hand has no rotation and ``target: [0, 0, 1]``.

    Or ``pose`` alone: that of the optical frame (x right, y down, z forward) in the frame of the link, as calibration
    writes it.
    """

    robot: str
    link: str
    translation: Offset = (0.0, 0.0, 0.0)
    rotation: Annotated[tuple[float, ...], _ROTATION, AfterValidator(_check_rotation)] = (0.0, 0.0, 0.0)
    target: Direction = (0.0, 0.0, 1.0)
    up: Direction | None = None
    pose: PoseConfig | None = None

    @model_validator(mode="after")
    def _check_pose(self) -> Attached:
        others = sorted(self.model_fields_set & {"translation", "rotation", "target", "up"})
        if self.pose is not None and others:
            raise ValueProblem(f"pose is complete; it excludes {', '.join(others)}", "conflict")
        return self

    @model_validator(mode="after")
    def _check_directions(self) -> Attached:
        if self.up is not None and np.linalg.norm(np.cross(self.target, self.up)) < 1e-6:
            raise ValueProblem("up must not be parallel to target", "conflict")
        return self

    def optical_pose(self) -> Pose:
        """Return the pose of the optical frame in the frame of the link."""
        if self.pose is not None:
            return Pose(self.pose.position, self.pose.orientation)
        target = np.asarray(self.target) / np.linalg.norm(self.target)
        up = self.up or ((0.0, 0.0, 1.0) if abs(target[2]) < 0.999 else (1.0, 0.0, 0.0))
        bracket = quaternion_to_matrix(self.rotation) if len(self.rotation) == 4 else rpy_to_matrix(*self.rotation)
        return make_optical_pose(self.translation, bracket @ target, bracket @ np.asarray(up))


def make_optical_pose(position: ArrayLike, forward: Array, up: Array) -> Pose:
    """Return the pose of an optical frame (x right, y down, z forward).

    Args:
        position: (3,) m.
        forward: (3,) direction of the optical axis.
        up: (3,) direction that is upwards in the image.
    """
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return Pose(position, matrix_to_quaternion(np.column_stack([x, np.cross(z, x), z])))


def make_view(pose: Pose, robot: str | None = None, link: str | None = None) -> ViewSpec:
    """Return a camera's pose, in the world or in a link's frame, as the record that drivers get."""
    x, y, z = pose.position.tolist()
    a, b, c, d = pose.orientation.tolist()
    return ViewSpec((x, y, z), (a, b, c, d), robot, link)


Margin = Annotated[float, Quantity("m", 0.0, 0.5)]

DEVICES, OBJECTS = 64, 1000
"""Greatest number of devices of one kind, and of objects, in a rig; more would take minutes to check."""


class Device(Strict):
    """Keys of every robot, gripper and camera."""

    sim: Flag | None = None
    """This device's own flag; default: the rig's."""
    drivers: Drivers | None = None
    """Drivers instead of the model's."""
    real: dict[str, Any] = Field(default_factory=dict)
    """Options of the real driver."""
    simulated: dict[str, Any] = Field(default_factory=dict)
    """Options of the simulated driver."""


class ServedDevice(Strict):
    """A device that another computer may serve."""

    at: Address | None = None
    """The computer that serves this device (``hal serve``), ``NAME`` or ``NAME:PORT``. Its rig has a device of this
    name, with all settings; the other keys of this entry, but ``drives``, are for ``--sim``."""


class LimitsConfig(LimitsModel):
    """Tighter limits than the model's, per joint or one number for all; rad, rad/s, rad/s2, rad/s3, Nm."""

    allow_looser_limits: Flag = False
    """Whether limits may be looser than the model's."""


class WorkspaceConfig(Strict):
    """The space that the tcp may be in, in the arm's base frame, m."""

    lower: Position | None = None
    upper: Position | None = None
    table_height: Coordinate | None = None
    """Height of a plane that the tcp stays above."""


class PayloadConfig(Strict):
    """What an arm carries besides its own gripper: a tool, a camera. Its weight is held by the arm's motors."""

    mass: Mass
    """kg"""
    position: Offset = (0.0, 0.0, 0.0)
    """Centre of mass in the frame of the tcp, m."""


class GripperConfig(Device):
    """The gripper on this arm: the model's, or another one."""

    model: str | None = None
    """A name in ``robots/grippers/``, or the path of a file of your own; default: the arm's own gripper."""
    mount: TcpModel | None = None
    """Where that gripper is on the arm; default: the ``flange`` of the arm's model."""
    enabled: Flag = True
    speed: Speed | None = None
    """Speed of the width, m/s; at most the model's."""
    force: Force | None = None
    """Grip force, N."""


def _expand_gripper(value: Any) -> Any:
    """Return ``gripper: robotiq_2f85`` as ``{model: robotiq_2f85}``."""
    return {"model": value} if isinstance(value, str) else value


class RobotConfig(Device, ServedDevice):
    """An arm."""

    model: str = ""
    """A name in ``robots/``, or the path of a file of your own."""
    arm: Name | None = None
    """Which arm, where the model has several (``left`` or ``right`` of a ``baxter``)."""
    same: Name | None = None
    """Another arm of this rig that is an arm of the same robot; the robot's base is that arm's."""
    base: PoseConfig = PoseConfig()
    """Pose of the base link in the world."""
    initial: JointPositions | None = None
    """Joint positions at the start of a simulation, rad; default: home."""
    rate_hz: RateHz | None = None
    """Rate of a real arm's control cycle; default: the model's."""
    gripper: Annotated[GripperConfig, BeforeValidator(_expand_gripper, json_schema_input_type=GripperConfig | str)] = (
        GripperConfig()
    )
    speed: Share = 0.3
    """Greatest share of the joint speed limits in a control session."""
    move_speed: Share = 0.1
    """Default share of the joint speed limits in ``move_to``, and so of every move home."""
    tcp_speed: TcpSpeed = 0.25
    """Greatest speed of the tcp, m/s (ISO 10218's reduced speed)."""
    limits: LimitsConfig = LimitsConfig()
    workspace: WorkspaceConfig | None = None
    payload: PayloadConfig | None = None
    """For real arms whose driver holds their weight. Others have settings of their own, such as ``real.load``."""


class Output(Strict):
    """Size of the frames, pixels."""

    width: Pixels
    height: Pixels


class StreamConfig(Strict):
    """One stream. Size and rate default to those of ``capture``."""

    format: str | None = None
    """Format of the real camera (``bgr8``, ``z16``, ...). Frames are always in RGB and metres."""
    width: Pixels | None = None
    height: Pixels | None = None
    rate_hz: CameraRate | None = None

    @model_validator(mode="after")
    def _check_size(self) -> StreamConfig:
        if (self.width is None) != (self.height is None):
            raise ValueProblem("needs width and height, or neither", "missing_key")
        return self


if TYPE_CHECKING:
    Stream = str
else:
    Stream = Literal[tuple(STREAMS)]


def _make_default_streams() -> dict[Stream, StreamConfig]:
    return {"color": StreamConfig(), "depth": StreamConfig()}


_Place = Annotated[float, Quantity("pixels", -1e5, 1e5)]
_FocalLength = Annotated[float, Quantity("pixels", 1.0, 1e5)]


class IntrinsicsConfig(Strict):
    """Intrinsics of a camera for one size of the captured images, pixels."""

    width: Pixels
    height: Pixels
    fx: _FocalLength
    fy: _FocalLength
    cx: _Place
    cy: _Place
    distortion: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 (OpenCV's order)."""


class CameraConfig(Device, ServedDevice):
    """A camera. One of ``look_at``, ``pose`` and ``attached`` gives its pose."""

    model: str = ""
    """A name in ``sensors/cameras/``, or the path of a file of your own."""
    capture: Capture | None = None
    """One of the model's modes, for every stream without its own size and rate."""
    output: Output | None = None
    """Size after a centre crop and scaling; default: the captured size."""
    streams: Annotated[
        dict[Stream, StreamConfig],
        BeforeValidator(expand_names, json_schema_input_type=dict[Stream, StreamConfig | None] | list[Stream]),
    ] = Field(default_factory=_make_default_streams)
    """``{color: {format: bgr8}, ...}`` or just ``[color, depth]``."""
    align: Literal["color", "depth"] | None = None
    """Stream whose view colour and depth are returned in; default: colour's, if there is colour."""
    look_at: LookAt | None = None
    pose: PoseConfig | None = None
    """Pose of the optical frame (x right, y down, z forward) in the world, as calibration writes it."""
    attached: Attached | None = None
    field_of_view: FieldOfView | None = None
    """Only for models that leave it to the rig (``pinhole``)."""
    depth: Depth | None = None
    """Nearest and farthest depth, m; only for models that leave it to the rig."""
    intrinsics: IntrinsicsConfig | None = None
    """Of the colour images, as ``hal calibrate intrinsics`` writes them; only for models that leave them to the rig."""

    @model_validator(mode="after")
    def _check_place(self) -> CameraConfig:
        given = [key for key in ("look_at", "pose", "attached") if getattr(self, key) is not None]
        if len(given) > 1:
            raise ValueProblem(f"has more than one pose: give one of {', '.join(given)}", "conflict")
        return self


class PadConfig(ServedDevice):
    """A gamepad."""

    sim: Flag | None = None
    """``true``: simulated, which the program operates, or which plays ``file``. ``false``: one that a person operates.
    Default: as ``driver`` says. The rig's flag is for robots and cameras: a real pad drives a simulated arm."""
    model: str = "auto"
    """``auto``, a name in ``sensors/gamepads/``, or the path of a file of your own."""
    driver: str = "auto"
    """``auto``, ``evdev``, ``web``, ``terminal``, ``playback`` or another driver."""
    file: str | None = None
    """Recording for a simulated pad, the driver ``playback``."""
    drives: str | None = None
    """Arm that this pad drives where several arms are driven at once; default: the first that no other pad drives."""
    dead_zone: Annotated[float, Quantity("", 0.0, 0.9)] = 0.08
    """Share of a stick's travel that counts as rest."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the driver."""


class LeaderConfig(LeaderJoints, ServedDevice):
    """A leader arm, which a person moves and an arm of the rig follows."""

    model: str = ""
    """A name in ``sensors/leaders/``, or the path of a file of your own."""
    sim: Flag = False
    """``true``: simulated, moved by the program. The rig's flag is for robots and cameras, as with gamepads."""
    driver: str | None = None
    """A driver instead of the model's."""
    port: str | None = None
    """Serial device of its motors, best ``/dev/serial/by-id/...``."""
    drives: str | None = None
    """Arm that it leads where several arms are driven at once; default: the first that no other one drives."""
    deadman: str | None = None
    """Gamepad or pedal of the rig that must be held; default: the lever if it is the dead-man, else the first one."""
    lever: LeverUse | None = None
    """What its lever is instead of what the model says: ``gripper``, ``deadman`` or ``none``."""
    engage: Literal["clutch", "approach"] = "clutch"
    """``clutch``: the arm follows what the leader moves from engaging on. ``approach``: it also comes to the leader's
    own position, at the arm's ``move_speed``."""
    pose_scale: Annotated[float, Quantity("", 0.0, 10.0, above=True)] = 1.0
    """Way of the arm's tcp for each m of the leader's, if it leads by poses."""
    follow: Annotated[float, Quantity("", 0.0, 0.5)] = 0.0
    """Share of its motors' torque with which the leader follows the arm while a policy drives it; 0: it never does."""
    feedback: Annotated[float, Quantity("", 0.0, 1.0)] = 0.0
    """Force feedback: torque of the leader's joints for each Nm of external torque on the arm's while it leads."""


def _check_engine(name: str) -> str:
    if message := explain_engine(name):
        raise ValueProblem(message, "invalid_choice")
    return name


class SimulationConfig(Strict):
    """The simulated world."""

    engine: Annotated[str, AfterValidator(_check_engine)] = "auto"
    """The physics engine: ``pybullet``, ``mujoco`` or a driver with a world; ``auto`` is PyBullet where it is
    installed, else MuJoCo."""
    physics_hz: Annotated[float, Quantity("Hz", 50.0, 10000.0)] = 240.0
    """Steps of the simulation, and of the servos in it, per second."""
    gravity: Gravity = (0.0, 0.0, -9.81)
    """m/s2"""
    clock: Literal["real_time", "lock_step"] | None = None
    """``lock_step``: time advances only while the program waits. Default: real time; lock-step for the mock."""
    renderer: Literal["auto", "gl", "tiny"] = "auto"
    """``gl`` is moderngl, ``tiny`` PyBullet's own; ``auto`` is the first that works."""
    shadows: Flag = True
    """Whether pictures have shadows; ``tiny`` draws none."""
    randomize: RandomizeConfig | None = None
    """What ``rig.world.randomize(seed)``, and so every new episode, varies."""


class BoxConfig(Strict):
    """A box in the world that no arm may touch: its position and size, or the name of an object of this rig."""

    name: Name
    """Its own name; or, alone, that of an object that is fixed and consists of boxes."""
    position: Position | None = None
    """Of its middle, m."""
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)
    size: Sizes | None = None
    """Its whole sides, m."""

    @model_validator(mode="after")
    def _check_box(self) -> BoxConfig:
        given = [key for key in ("position", "orientation", "size") if key in self.model_fields_set]
        missing = [key for key in ("position", "size") if key not in given]
        if given and missing:
            raise ValueProblem(f"{missing[0]} is missing; or give the name of an object alone", "missing_key")
        return self


def _expand_box(value: Any) -> Any:
    return {"name": value} if isinstance(value, str) else value


class CollisionsConfig(Strict):
    """What the arms must not touch."""

    self: Flag = True
    """Whether an arm must not touch itself."""
    arms: Flag = True
    """Whether the arms must not touch each other."""
    boxes: list[Annotated[BoxConfig, BeforeValidator(_expand_box, json_schema_input_type=Name | BoxConfig)]] = Field(
        default_factory=list, max_length=DEVICES
    )
    """Boxes that no arm may touch: ``{name, position, size}``, or names of objects of this rig."""
    margin: Margin = CollisionSpec.margin
    """Distance that is kept, m."""


def _check_objects(value: Any) -> Any:
    if value is None:  # "objects:" without a value
        return []
    if not isinstance(value, (list, tuple)):
        message = f"must be a list of files, names or {{name, shape, ...}}, not {describe(value)}"
        raise ValueProblem(message, "wrong_type")
    return value


def _fill_section(value: Any) -> Any:
    """Return a section; a key without a value is an empty one."""
    return {} if value is None else value


_FEW = Field(max_length=DEVICES)


class RigFile(Strict):
    """A rig as written."""

    description: str = ""
    sim: Flag = True
    """Whether every device without a flag of its own is simulated."""
    robots: Annotated[dict[Name, RobotConfig], BeforeValidator(_fill_section), _FEW] = Field(default_factory=dict)
    cameras: Annotated[dict[Name, CameraConfig], BeforeValidator(_fill_section), _FEW] = Field(default_factory=dict)
    leaders: Annotated[dict[Name, LeaderConfig], BeforeValidator(_fill_section), _FEW] = Field(default_factory=dict)
    gamepads: Annotated[dict[Name, PadConfig], BeforeValidator(_fill_section), _FEW] = Field(default_factory=dict)
    objects: Annotated[list[Any], BeforeValidator(_check_objects)] = Field(default_factory=list, max_length=OBJECTS)
    """Objects of the simulated world: names in ``config/objects/``, paths, or ``{name, shape, ...}``."""
    collisions: Annotated[CollisionsConfig, BeforeValidator(_fill_section)] = CollisionsConfig()
    simulation: Annotated[SimulationConfig, BeforeValidator(_fill_section)] = SimulationConfig()


class _DescribedSchema(GenerateJsonSchema):
    """Describes each key by the docstring of its field; pydantic would read them whenever a rig is opened."""

    def model_schema(self, schema: ModelSchema) -> dict[str, Any]:
        found = super().model_schema(schema)
        for name, text in _field_docstrings(schema["cls"]):
            found["properties"][name]["description"] = text
        return found


def _field_docstrings(record: type) -> Iterator[tuple[str, str]]:
    """Yield the name and the docstring of each documented field of a record."""
    for kind in reversed(record.__mro__[: record.__mro__.index(Strict)]):
        (definition,) = ast.parse(inspect.getsource(kind)).body
        assert isinstance(definition, ast.ClassDef)
        for field, text in itertools.pairwise(definition.body):
            if isinstance(field, ast.AnnAssign) and isinstance(text, ast.Expr) and isinstance(text.value, ast.Constant):
                yield ast.unparse(field.target), inspect.cleandoc(str(text.value.value))


def rig_schema() -> dict[str, Any]:
    """Return the JSON schema of a rig's file: an editor uses it for completion and checks."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | RigFile.model_json_schema(
        schema_generator=_DescribedSchema
    )
