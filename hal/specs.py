"""Records of devices, resolved and checked, that drivers are created from; none refers to a configuration file.

The rig's configuration (:mod:`hal.config`) is resolved into a :class:`Plan` of them. They are sent as JSON to the
process that owns a device (:func:`to_json`, :func:`from_json`), so they hold only numbers, text, tuples and each other.
"""

from __future__ import annotations

import types as _types
import typing
from collections.abc import Iterable
from dataclasses import asdict, dataclass, field, fields, is_dataclass
from functools import cached_property
from typing import Any, TypeVar

from .types import STREAMS

Floats = tuple[float, ...]
Vector3 = tuple[float, float, float]
Quaternion = tuple[float, float, float, float]


@dataclass(frozen=True)
class LimitsSpec:
    """Limits per joint, each (n,): rad, rad/s, rad/s2, rad/s3, Nm."""

    lower: Floats
    upper: Floats
    velocity: Floats
    acceleration: Floats
    jerk: Floats
    torque: Floats | None = None


@dataclass(frozen=True)
class KinematicsSpec:
    """Input of forward and inverse kinematics."""

    urdf: str
    """Absolute path."""
    joints: tuple[str, ...]
    """Names of the arm's joints, from base to tip; all others are held at zero."""
    lower: Floats
    upper: Floats
    home: Floats
    """Null-space posture, rad."""
    base_link: str | None
    """Link whose frame is the arm's base frame; the URDF's root when None."""
    tcp_link: str
    tcp_position: Vector3
    """Tool centre point in the frame of ``tcp_link``, m."""
    tcp_orientation: Quaternion


@dataclass(frozen=True)
class WorkspaceSpec:
    """Box that the tcp may be in, in the arm's base frame, m."""

    lower: Vector3
    upper: Vector3


@dataclass(frozen=True)
class GripperSpec:
    """A parallel gripper."""

    name: str
    driver: str
    width_max: float
    """m"""
    speed: float
    """Default and greatest speed of the width, m/s."""
    force: float
    """Default grip force, N."""
    joints: tuple[str, ...] = ()
    """Finger joints in the arm's URDF, which move together."""
    opened: Floats = ()
    """Position of each finger joint at the greatest width, rad or m; empty where each slides by half the width."""
    closed: Floats = ()
    """Position of each finger joint when closed, rad or m; empty like ``opened``."""
    widths: tuple[tuple[float, float], ...] = ()
    """Pairs of a position of the first joint (rad or m) and the width there, m, from closed to open; empty where the
    width is proportional to the way of the joints."""
    force_max: float = 0.0
    """Greatest grip force, N; 0 for :attr:`force`."""
    options: dict[str, Any] = field(default_factory=dict)

    @property
    def arm(self) -> str:
        """Name of its arm."""
        return self.name.removesuffix(".gripper")

    @property
    def width_min(self) -> float:
        """Width when closed on nothing, m: the pads of some grippers do not meet."""
        return max(0.0, self.width_at(0.0))

    def finger_positions(self, width: float) -> list[float]:
        """Return the position of each finger joint, rad or m, at a width, m."""
        if not self.opened:
            return [width / 2.0] * len(self.joints)
        share = self.travel_at(width)
        return [shut + share * (far - shut) for far, shut in zip(self.opened, self.closed, strict=True)]

    def travel_at(self, width: float) -> float:
        """Return the share of their way, from closed to open, that the joints have gone at a width, m."""
        return _interpolate(width, [(b, a) for a, b in self.travel])

    def width_at(self, share: float) -> float:
        """Return the width, m, at a share of the way of the joints from closed to open."""
        return _interpolate(share, self.travel)

    @cached_property
    def travel(self) -> list[tuple[float, float]]:
        """Pairs of the share of the way of the joints and the width there, m, both ascending."""
        if not self.widths:
            return [(0.0, 0.0), (1.0, self.width_max)]
        shut, way = self.closed[0], self.opened[0] - self.closed[0]
        return sorted(((angle - shut) / way, width) for angle, width in self.widths)


def _interpolate(x: float, table: list[tuple[float, float]]) -> float:
    """Return the value at ``x`` of pairs with ascending ``x``; beyond their ends the outermost lines continue."""
    k = 1
    while k < len(table) - 1 and x > table[k][0]:
        k += 1
    (x0, y0), (x1, y1) = table[k - 1], table[k]
    return y0 + (x - x0) * (y1 - y0) / (x1 - x0)


@dataclass(frozen=True)
class PayloadSpec:
    """What an arm carries besides its own gripper: a tool, a camera, an object. A point mass."""

    mass: float
    """kg"""
    position: Vector3 = (0.0, 0.0, 0.0)
    """Centre of mass in the frame of the tcp, m."""


@dataclass(frozen=True)
class RobotSpec:
    """One arm on a rig."""

    name: str
    model: str
    driver: str
    rate_hz: float
    """Rate of the servo and of the driver's cycle."""
    urdf: str
    joints: tuple[str, ...]
    home: Floats
    initial: Floats
    """Joint positions at the start of a simulation, rad."""
    limits: LimitsSpec
    kinematics: KinematicsSpec
    base_position: Vector3
    base_orientation: Quaternion
    """Pose of the base link in the world."""
    gripper: GripperSpec | None = None
    workspace: WorkspaceSpec | None = None
    payload: PayloadSpec | None = None
    """None where nothing is carried, or where it is not known."""
    speed: float = 0.3
    """Greatest share of the joint speed limits in a control session."""
    move_speed: float = 0.1
    """Default share of the joint speed limits in ``move_to``."""
    tcp_speed: float = 0.25
    """Greatest speed of the tcp, m/s."""
    attended: bool = False
    """Whether the arm or its gripper is real, so that a user must be present (a dead-man, or ``unattended=True``)."""
    emulated: bool = False
    """Whether all its real devices are emulators, so that nothing physical moves."""
    same: str | None = None
    """Name of the arm whose record includes the robot's body, if this is another arm of the same robot; this arm's URDF
    leaves the body out."""
    group: str | None = None
    """Arms with the same one share a process in real time; None for a process of its own."""
    deadline_max: float = 1.0
    """Longest deadline that a command may have, s (0.3 where something real moves)."""
    options: dict[str, Any] = field(default_factory=dict)
    """Options of the driver (``real:`` or ``simulated:`` of the rig's file)."""
    source: str = ""
    """The rig's file, or ``<dict>``."""
    at: str | None = None
    """Address of the computer that serves this arm; None if it is at this one."""

    def joint_positions(self, q: Iterable[float], width: float | None) -> dict[str, float]:
        """Return the positions of the arm's joints, and of its gripper's at a width, m, by their names."""
        found = dict(zip(self.joints, q, strict=True))
        if self.gripper is not None and width is not None:
            found |= dict(zip(self.gripper.joints, self.gripper.finger_positions(width), strict=True))
        return found


@dataclass(frozen=True)
class RangesSpec:
    """Range of the start poses of an object in an episode: its two ends, each (6,)."""

    lower: Floats
    """x, y, z in the world, m; roll, pitch, yaw: a turn about the world's axes on top of its orientation, rad."""
    upper: Floats


PRIMITIVES = {
    "box": ("half_extents",),
    "sphere": ("radius",),
    "cylinder": ("radius", "length"),
    "capsule": ("radius", "length"),
    "plane": (),
}
"""Shapes of objects that need no file -> the sizes that each needs."""


@dataclass(frozen=True)
class BodySpec:
    """An object of the simulated world."""

    name: str
    position: Vector3
    orientation: Quaternion
    shape: str
    """``box``, ``sphere``, ``cylinder``, ``capsule``, ``plane``, ``mesh`` or ``urdf``."""
    half_extents: Vector3 | None = None
    """Box, m."""
    radius: float | None = None
    length: float | None = None
    """Of a cylinder, and of a capsule without its caps, m."""
    urdf: str | None = None
    scale: float = 1.0
    """Factor on the lengths of a URDF or a mesh."""
    mass: float = 0.0
    """kg; an object of mass 0 does not move. A URDF has its own masses; a mesh has the inertia of its hull."""
    fixed: bool = False
    rgba: tuple[float, float, float, float] = (0.7, 0.7, 0.7, 1.0)
    """Red, green, blue and opacity, 0..1; white leaves a mesh the colours of its file."""
    collision: bool = True
    visible: bool = True
    robot: str | None = None
    """The arm that carries it on ``link``: it moves with the link and touches nothing. ``position`` and ``orientation``
    are then in the frame of the link."""
    link: str | None = None
    random: RangesSpec | None = None
    """Range of :func:`hal.learning.episode.sample_poses`; None for a fixed start pose."""
    mesh: str | None = None
    """Path of an OBJ, STL or Collada file; its convex hull collides."""
    parts: bool = False
    """Whether each part of the mesh collides with a hull of its own: :func:`hal.kinematics.hulls.mesh_parts`."""


@dataclass(frozen=True)
class BoxSpec:
    """A box that no arm may touch."""

    name: str
    position: Vector3
    """Of its middle, in the world, m."""
    orientation: Quaternion
    size: Vector3
    """Its whole sides, m."""


@dataclass(frozen=True)
class CollisionSpec:
    """What the arms of a rig must not touch."""

    own: bool = True
    """Whether an arm must not touch itself."""
    arms: bool = True
    """Whether arms must not touch each other."""
    boxes: tuple[BoxSpec, ...] = ()
    margin: float = 0.01
    """Distance that is kept, m."""

    @property
    def any(self) -> bool:
        """Whether there is anything to check."""
        return self.own or self.arms or bool(self.boxes)


@dataclass(frozen=True)
class ViewSpec:
    """Pose of a camera: fixed in the world, or attached to a link of a robot.

    The pose is that of the camera's optical frame (OpenCV's axes: x right, y down, z forward) in the world, or in
    the frame of the link.
    """

    position: Vector3
    orientation: Quaternion
    robot: str | None = None
    link: str | None = None


@dataclass(frozen=True)
class SensorSpec:
    """One stream of a camera as its sensor captures it, from the camera's model."""

    width: int
    height: int
    rate_hz: float
    K: tuple[Vector3, Vector3, Vector3]
    """Camera matrix; the centre of the upper left pixel is (0, 0)."""
    format: str | None = None
    """Format of the real camera; None for its driver's default."""
    position: Vector3 = (0.0, 0.0, 0.0)
    orientation: Quaternion = (0.0, 0.0, 0.0, 1.0)
    """Pose of this sensor's optical frame in that of the colour sensor, m."""


@dataclass(frozen=True)
class DepthSensorSpec:
    """How a camera measures depth; needed to simulate its noise."""

    kind: str
    """``stereo`` or ``lidar``."""
    unit: float
    """m per unit of the raw image."""
    baseline: float = 0.0
    """Distance from the left imager to the right one, m; 0 without a pair."""


@dataclass(frozen=True)
class CameraSpec:
    """One camera on a rig."""

    name: str
    model: str
    driver: str
    capture_width: int
    capture_height: int
    width: int
    """Size of the frames, after the centre crop and the scaling, pixels."""
    height: int
    rate_hz: float
    K: tuple[Vector3, Vector3, Vector3]
    """Camera matrix of the frames; the centre of the upper left pixel is (0, 0)."""
    distortion: Floats
    depth_min: float
    """Nearest and farthest depth that the camera measures, m; outside it reports 0."""
    depth_max: float
    streams: tuple[str, ...]
    """Some of :data:`hal.types.STREAMS`; ``infrared`` is the left one of two."""
    view: ViewSpec | None
    """Pose of the colour sensor's optical frame; None if it is unknown."""
    options: dict[str, Any] = field(default_factory=dict)
    align: str = "color"
    """Stream whose view colour and depth are returned in: ``color`` or ``depth``. Infrared keeps its own."""
    sensors: dict[str, SensorSpec] = field(default_factory=dict)
    """The streams before alignment, crop and scaling, by name; empty if all streams have one view and the captured
    size."""
    K_infrared: tuple[Vector3, Vector3, Vector3] | None = None
    """Camera matrix of both infrared images of a frame; None if they have the view of ``K``."""
    depth_sensor: DepthSensorSpec | None = None
    """None if the model has none."""
    at: str | None = None
    """Address of the computer that serves this camera; None if it is at this one."""

    @property
    def reference(self) -> str:
        """The stream whose view the frames have: ``K`` and ``T_world_camera`` are those of its sensor."""
        unaligned = [name for name, kind in STREAMS.items() if kind.unaligned and name in self.streams]
        if self.align == "depth" or len(unaligned) < len(self.streams):
            return self.align
        return unaligned[0] if unaligned else "color"


@dataclass(frozen=True)
class LeaderSpec:
    """A leader arm: how the angles of its motors become joint positions, gain * (angle - offset), and what leads."""

    title: str
    joints: tuple[str, ...]
    gains: Floats
    offsets: Floats
    """rad"""
    middles: Floats
    """Joint position around which the turn of each motor is chosen when it connects, rad."""
    leads: tuple[str, ...]
    """Models of arms that it leads joint to joint; any other one by poses."""
    kinematics: KinematicsSpec | None
    """Its own kinematics, to lead by poses; None if it leads joint to joint only."""
    pose_scale: float
    """Way of the led tcp for each m of its own, if it leads by poses."""
    engage: str
    """``clutch``: the arm stays where it is and follows what the leader moves from then on. ``approach``: it also comes
    to the leader's position, at its ``move_speed``."""
    lever: str
    """What its lever is: ``gripper``, ``deadman`` or ``none``."""
    deadman: str | None
    """Gamepad of the rig that must be held; None for the lever, or for no dead-man at all."""
    follow: float = 0.0
    """Share of its motors' torque with which it follows the arm while a policy drives it; 0: it never does."""
    feedback: float = 0.0
    """Torque of its joints for each Nm of external torque on the arm's while it leads joint to joint; 0: none."""
    emulated: bool = False

    @property
    def may_drive_real(self) -> bool:
        """Whether it has a dead-man."""
        return self.deadman is not None or self.lever == "deadman"


@dataclass(frozen=True)
class PadSpec:
    """One gamepad, or leader arm, on a rig."""

    name: str
    driver: str
    model: dict[str, Any] | None
    """A pad model as in ``sensors/gamepads``, or None to choose one by the device that is found."""
    models: tuple[dict[str, Any], ...] = ()
    """All known pad models, to choose from."""
    dead_zone: float = 0.08
    drives: str | None = None
    """Arm that it drives where several are driven at once; None for the first that no other pad drives."""
    options: dict[str, Any] = field(default_factory=dict)
    real: bool = False
    """Whether a person must operate it, so that no recording is chosen for it."""
    leader: LeaderSpec | None = None
    """What a leader arm has beyond a gamepad; None for a gamepad."""
    at: str | None = None
    """Address of the computer that serves it; None if it is at this one."""

    @property
    def kind(self) -> str:
        """Kind of its driver: ``gamepad`` or ``leader``."""
        return "gamepad" if self.leader is None else "leader"

    @property
    def hand(self) -> str:
        """Hand of a headset whose controller it is, ``left`` or ``right``; empty for any other pad."""
        return str(self.options.get("hand", ""))


@dataclass(frozen=True)
class GroupSpec:
    """Devices that share one clock and one process: all simulated devices of a rig, or one real arm."""

    name: str
    clock: str
    """``real_time`` or ``lock_step``."""
    rate_hz: float
    robots: tuple[RobotSpec, ...]
    world: WorldSpec | None = None
    grippers: tuple[GripperSpec, ...] = ()
    """Grippers that run in this group: those of its arms, or one that has a process of its own."""
    collisions: CollisionSpec | None = None
    """What its arms must not touch; None if nothing is checked."""
    neighbours: tuple[RobotSpec, ...] = ()
    """Arms of other groups that its arms must not touch."""

    @property
    def at(self) -> str | None:
        """Address of the computer that serves these devices; None if they are at this one."""
        return self.robots[0].at if self.robots else None


@dataclass(frozen=True)
class VariationSpec:
    """A range that a value of the scene is drawn from."""

    key: str
    """Key of the value, as in the section ``simulation.randomize`` of the rig's file."""
    lower: Floats = ()
    """Least values, one for each number of the value."""
    upper: Floats = ()
    choices: tuple[str, ...] = ()
    """What a text is chosen from; empty for numbers."""


@dataclass(frozen=True)
class RandomizeSpec:
    """What varies in a simulated world from episode to episode: see :mod:`hal.randomization`."""

    variations: tuple[VariationSpec, ...]
    distractors: tuple[BodySpec, ...] = ()
    """Objects that are only there if they are drawn."""


@dataclass(frozen=True)
class WorldSpec:
    """The simulated world of a rig."""

    driver: str
    physics_hz: float
    gravity: Vector3
    bodies: tuple[BodySpec, ...]
    robots: tuple[RobotSpec, ...]
    """Every arm in the world."""
    shadows: bool = True
    """Whether pictures have shadows."""
    randomize: RandomizeSpec | None = None
    """What varies; None if nothing does."""


@dataclass(frozen=True)
class Plan:
    """A resolved rig: every device with its driver. ``hal.open`` opens it."""

    sim: bool
    """The rig's flag."""
    clock: str
    """``real_time`` or ``lock_step``."""
    world: WorldSpec | None
    """The simulated world; None without a simulated device."""
    robots: tuple[RobotSpec, ...]
    cameras: tuple[CameraSpec, ...]
    pads: tuple[PadSpec, ...]
    """Gamepads, then leader arms."""
    renderer: str
    """Renderer of simulated images: ``auto``, ``gl`` or ``tiny``."""
    warnings: tuple[str, ...]
    """Messages for the user that are not errors."""
    source: str
    """The rig's file, or ``<dict>``."""
    collisions: CollisionSpec = CollisionSpec()
    """What the arms must not touch."""

    @property
    def engine(self) -> str | None:
        """Name of the engine that simulates the rig's world; None without a world."""
        return self.world.driver if self.world is not None else None

    @property
    def attended(self) -> bool:
        """Whether a real device moves, so that a user must be present."""
        return any(robot.attended for robot in self.robots)

    @property
    def emulated(self) -> bool:
        """Whether all real devices are emulators, so that nothing physical moves."""
        return self.attended and all(robot.emulated for robot in self.robots if robot.attended)


_T = TypeVar("_T")


def to_json(spec: Any) -> dict[str, Any]:
    """Return a spec as plain lists, dicts and numbers."""
    return asdict(spec)


def from_json(cls: type[_T], data: dict[str, Any]) -> _T:
    """Return the spec of class ``cls`` that :func:`to_json` made ``data`` of."""
    hints = typing.get_type_hints(cls)
    return cls(**{f.name: _revive(hints[f.name], data[f.name]) for f in fields(cls) if f.name in data})  # type: ignore[arg-type]


def _revive(hint: Any, value: Any) -> Any:
    if value is None:
        return None
    origin = typing.get_origin(hint)
    if origin in (typing.Union, _types.UnionType):
        return _revive(next(a for a in typing.get_args(hint) if a is not type(None)), value)
    if is_dataclass(hint) and isinstance(hint, type):
        return from_json(hint, value)
    if origin is dict and is_dataclass(typing.get_args(hint)[1]):
        return {key: _revive(typing.get_args(hint)[1], item) for key, item in value.items()}
    if origin is tuple:
        args = typing.get_args(hint)
        inner = args[0] if len(args) == 2 and args[1] is Ellipsis else None
        return tuple(_revive(inner or args[k], item) for k, item in enumerate(value))
    return value
