"""Models of arms and cameras (``robots/``, ``sensors/cameras/``): what is the same for every device of one kind.

A model of your own is a file with the same keys, which a rig names by its path.
"""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, NamedTuple

from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from ..geometry import Pose
from ..types import STREAMS
from .data_files import data_folder, list_data, user_path
from .files import Problems, read_yaml
from .schema import (
    Accelerations,
    CameraRate,
    Distance,
    FingerPosition,
    Flag,
    Force,
    Jerks,
    JointLimits,
    JointPositions,
    Name,
    Offset,
    Pixels,
    PoseConfig,
    Quantity,
    QuaternionConfig,
    RateHz,
    Several,
    Size,
    Speed,
    Strict,
    Torques,
    Unknown,
    ValueProblem,
    Velocities,
    ViewAngle,
)


class Drivers(Strict):
    """Names of the drivers, in simulation and for a real device; None if there is none."""

    sim: str | None = None
    """``simulation`` is the rig's engine; the name of an engine means the same."""
    real: str | None = None


class FileSource(Strict):
    """A URDF or a mesh: a path relative to the file that names it, or a path inside an installed Python package."""

    path: str
    package: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _expand_path(cls, data: Any) -> Any:
        return {"path": data} if isinstance(data, str) else data


class LimitsModel(Strict):
    """Limits per joint, or one number for all joints: rad, rad/s, rad/s2, rad/s3, Nm (m and N for joints that slide).

    Position, speed and torque default to those of the URDF; acceleration and jerk must be given.
    """

    lower: JointLimits | None = None
    upper: JointLimits | None = None
    velocity: Velocities | None = None
    acceleration: Accelerations | None = None
    jerk: Jerks | None = None
    torque: Torques | None = None


UNITS = {
    "lower": "rad",
    "upper": "rad",
    "velocity": "rad/s",
    "acceleration": "rad/s2",
    "jerk": "rad/s3",
    "torque": "Nm",
}
"""Key of :class:`LimitsModel` -> its unit."""


class TcpModel(Strict):
    """The tool centre point in the frame of a link."""

    link: str
    position: Offset = (0.0, 0.0, 0.0)
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)


class FingerModel(Strict):
    """One finger joint: a name alone slides (``prismatic``) by half the width; others have both of their ends."""

    name: str
    open: FingerPosition | None = None
    """Position at the greatest width, rad or m."""
    closed: FingerPosition | None = None
    """Position when closed, rad or m."""

    @model_validator(mode="before")
    @classmethod
    def _expand_name(cls, data: Any) -> Any:
        return {"name": data} if isinstance(data, str) else data


def _check_widths(rows: Any) -> Any:
    if rows and len(rows) < 2:
        raise ValueProblem("needs two pairs of a position and a width at least", "wrong_count")
    steps = [(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(rows)]
    if any(0.0 in step for step in steps) or len({(turn > 0.0, more > 0.0) for turn, more in steps}) > 1:
        raise ValueProblem("positions and widths must ascend, or descend, from each pair to the next", "wrong_order")
    return rows


_WidthRow = Annotated[tuple[float, ...], Several(Quantity("rad or m", -10.0, 10.0), 2, "position, width")]


class GripperModel(Strict):
    """A gripper: its fingers move together between open and closed."""

    joints: tuple[FingerModel, ...] = ()
    """Joints that its drive moves; those that a ``<mimic>`` of the URDF couples to them follow by themselves."""
    widths: Annotated[tuple[_WidthRow, ...], AfterValidator(_check_widths)] = ()
    """Pairs of a position of the first joint (rad or m) and the width there (m), from closed to open or the reverse;
    needed where the width is not proportional to the way of the joint, as on fingers that turn."""
    drivers: Drivers = Drivers()
    width_max: Size
    """Greatest width, m."""
    speed: Speed
    """Greatest speed of the width, m/s."""
    force: Force
    """Grip force, N."""
    force_max: Force | None = None
    """Greatest force that a rig or a call may set, N; ``force`` if it is left out."""
    real: dict[str, Any] = Field(default_factory=dict)
    simulated: dict[str, Any] = Field(default_factory=dict)

    @property
    def names(self) -> tuple[str, ...]:
        """Names of the finger joints."""
        return tuple(joint.name for joint in self.joints)

    @property
    def strongest(self) -> float:
        """Greatest grip force, N."""
        return self.force if self.force_max is None else self.force_max

    @model_validator(mode="after")
    def _check_fingers(self) -> GripperModel:
        if self.force > self.strongest:
            raise ValueProblem(f"force must be at most force_max, {self.strongest:g} N", "out_of_range")
        given = [end is not None for joint in self.joints for end in (joint.open, joint.closed)]
        if any(given) and not all(given):
            raise ValueProblem("every joint, or none, needs open and closed", "missing_key")
        if any(joint.open == joint.closed for joint in self.joints if joint.open is not None):
            raise ValueProblem("open and closed of a joint must differ", "empty_range")
        if self.widths and not any(given):
            raise ValueProblem("joints need open and closed where widths are given", "missing_key")
        if self.widths and self._is_turned():
            raise ValueProblem("widths grow where the first joint goes from open to closed", "wrong_order")
        if self.widths and max(width for _, width in self.widths) < self.width_max:
            raise ValueProblem(f"widths end below width_max, {self.width_max:g} m", "out_of_range")
        return self

    def _is_turned(self) -> bool:
        """Return whether the widths grow where the joint closes."""
        first, (near, less), (far, more) = self.joints[0], self.widths[0], self.widths[-1]
        return (first.open - first.closed) * (far - near) * (more - less) < 0.0  # type: ignore[operator]  # both given


class GripperFile(GripperModel):
    """A gripper that is not part of an arm's model; a rig mounts it on the flange of an arm."""

    description: str = ""
    urdf: FileSource
    position: Offset = (0.0, 0.0, 0.0)
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)
    """Pose of the root of the URDF in the frame of the flange."""
    tcp: PoseConfig
    """The tool centre point in the frame of the flange."""

    def mounted_on(self, flange: TcpModel, folder: Path) -> dict[str, Any]:
        """Return the keys of an arm's model that it replaces; ``folder`` is that of its file."""
        tcp = Pose(flange.position, flange.orientation) @ Pose(self.tcp.position, self.tcp.orientation)
        urdf = self.urdf.model_dump()
        if self.urdf.package is None:
            urdf["path"] = str(user_path(self.urdf.path, folder))
        pose = {"position": self.position, "orientation": self.orientation}
        tool = {"urdf": urdf, "link": flange.link, **pose, "flange": flange.model_dump(exclude={"link"})}
        return {
            "tool": tool,
            "tcp": {"link": flange.link, "position": tcp.position.tolist(), "orientation": tcp.orientation.tolist()},
            "gripper": self.model_dump(include=set(GripperModel.model_fields)),
        }


class ToolModel(Strict):
    """A gripper or a tool with a URDF of its own, fixed to a link of the arm.

    A name that the arm has as well gets ``tool_`` in front.
    """

    urdf: FileSource
    link: str
    """Link of the arm."""
    position: Offset = (0.0, 0.0, 0.0)
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)
    """Pose of the root of the tool in the frame of that link, or of its flange."""
    flange: PoseConfig | None = None
    """Pose in that link of the frame ``tool_flange``. What the arm's own URDF has on the link is then left out."""


class RobotModel(Strict):
    """An arm, with its gripper if it has one."""

    description: str = ""
    urdf: FileSource
    tool: ToolModel | None = None
    """What is mounted on the arm and not in its URDF."""
    flange: TcpModel | None = None
    """Where a gripper is mounted that a rig chooses: z points out, x forward, and fingers move along y."""
    freed: tuple[str, ...] = ()
    """Joints that the URDF has fixed, with limits, and that turn."""
    arms: dict[Name, dict[str, Any]] = Field(default_factory=dict)
    """Arms of one URDF that has several: for each, the keys that differ; a rig chooses with ``arm``."""
    drivers: Drivers = Drivers()
    rate_hz: RateHz = 1000.0
    """Rate of the real arm's control cycle. A simulated arm runs at the rig's ``physics_hz``."""
    joints: tuple[Name, ...] = Field(min_length=1)
    """Joints of the arm, from base to tip; those of the fingers belong to the gripper."""
    base_link: str | None = None
    """Link whose frame is the base frame; default: the URDF's root."""
    tcp: TcpModel
    home: JointPositions
    """Home position, rad."""
    links: dict[Name, str] = Field(default_factory=dict)
    """Other names of links, so that a rig can use one name for every model: ``{hand: panda_hand}``."""
    limits: LimitsModel = LimitsModel()
    """Limits of the arm."""
    real_limits: LimitsModel = LimitsModel()
    """Tighter limits of a real arm; those that are left out are as in ``limits``."""
    gripper: GripperModel | None = None
    real: dict[str, Any] = Field(default_factory=dict)
    """Options of the real driver; a rig can add to them."""
    simulated: dict[str, Any] = Field(default_factory=dict)


# Cameras


class Mode(Strict):
    """An image size and its frame rates."""

    width: Pixels
    height: Pixels
    rates_hz: tuple[CameraRate, ...] = Field(min_length=1)
    depth_min: Distance | None = None
    """Nearest depth in this mode, m; default: the model's."""

    def __str__(self) -> str:
        return f"{self.width}x{self.height} at {', '.join(f'{rate:g}' for rate in self.rates_hz)} Hz"


class FieldOfView(Strict):
    """Angles of view of the whole sensor, from edge to edge of its outermost pixels, deg.

    ``width`` and ``height`` are the size of an image of the whole sensor; a mode of another shape is its centre.
    Without them every mode has the same angles. With one angle only, pixels are square.
    """

    horizontal_deg: ViewAngle | None = None
    vertical_deg: ViewAngle | None = None
    width: Pixels | None = None
    height: Pixels | None = None

    @model_validator(mode="after")
    def _check_complete(self) -> FieldOfView:
        if self.horizontal_deg is None and self.vertical_deg is None:
            raise ValueProblem("needs horizontal_deg, vertical_deg or both", "missing_key")
        if (self.width is None) != (self.height is None):
            raise ValueProblem("needs width and height of an image of the whole sensor, or neither", "missing_key")
        return self


class Depth(Strict):
    """Range of depth, m."""

    min: Distance
    max: Annotated[float, Quantity("m", 0.0, 1000.0, above=True)]

    @model_validator(mode="after")
    def _check_order(self) -> Depth:
        if self.min >= self.max:
            raise ValueProblem(f"min must be less than max, not {self.min:g} and {self.max:g}", "empty_range")
        return self


class Capture(Strict):
    """Size and rate of the captured images."""

    width: Pixels
    height: Pixels
    rate_hz: CameraRate

    def __str__(self) -> str:
        return f"{self.width}x{self.height} at {self.rate_hz:g} Hz"


def expand_names(value: Any) -> Any:
    """Return ``[color, depth]`` as ``{color: {}, depth: {}}``; a name without a value becomes ``{}``, too."""
    if isinstance(value, (list, tuple)):
        return {str(name): {} for name in value}
    if isinstance(value, dict):
        return {name: {} if item is None else item for name, item in value.items()}
    return value


class StreamModel(Strict):
    """One stream of a camera, where it differs from the model's common values.

    Its defaults are the values of the stream that :attr:`hal.types.ImageStream.like` names.
    """

    modes: tuple[Mode, ...] | None = None
    formats: tuple[str, ...] | None = None
    """Names of librealsense (``z16``); None allows any."""
    field_of_view: FieldOfView | None = None
    position: Offset | None = None
    orientation: QuaternionConfig | None = None
    """Pose of this sensor's optical frame (x right, y down, z forward) in that of the colour sensor, m."""


class DepthSensor(Strict):
    """Principle and figures of the depth measurement, to simulate its noise."""

    kind: Literal["stereo", "lidar"]
    """``stereo``: from ``infrared`` and ``infrared_right``, in the view of ``infrared``."""
    unit: Size
    """m per unit of the raw image."""


if TYPE_CHECKING:
    SensorStream = str
else:
    SensorStream = Literal[tuple(name for name, kind in STREAMS.items() if not kind.rendered)]
"""Streams that a real camera may have; a simulated one may also have those that are only rendered."""


def _make_streams() -> dict[SensorStream, StreamModel]:
    return {"color": StreamModel(), "depth": StreamModel(), "infrared": StreamModel()}


Distortion = Annotated[tuple[float, ...], Several(Quantity("", -1e3, 1e3), 5, "k1, k2, p1, p2, k3")]


class CameraModel(Strict):
    """A camera."""

    description: str = ""
    drivers: Drivers = Drivers()
    modes: tuple[Mode, ...] | None = None
    """Modes of every stream that has none of its own; None allows any size and rate."""
    capture: Capture
    """Default size and rate."""
    field_of_view: FieldOfView | None = None
    """Angles of every stream that has none of its own."""
    distortion: Distortion = (0.0, 0.0, 0.0, 0.0, 0.0)
    """k1, k2, p1, p2, k3 (OpenCV's order)."""
    depth: Depth
    streams: Annotated[dict[SensorStream, StreamModel], BeforeValidator(expand_names)] = Field(
        default_factory=_make_streams
    )
    """The camera's streams: ``[color, depth]``, or ``{color: {modes: ...}, ...}`` where they differ."""
    depth_sensor: DepthSensor | None = None
    adjustable: Flag = False
    """Whether a rig may choose the field of view and the range of depth."""
    real: dict[str, Any] = Field(default_factory=dict)
    simulated: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _check_complete(self) -> CameraModel:
        for name in self.streams:
            if self._find_value(name, "field_of_view") is None:
                raise ValueProblem(f"needs field_of_view, or one in streams.{name}", "missing_key")
        if self.depth_sensor is not None and self.depth_sensor.kind == "stereo" and self.baseline <= 0.0:
            message = "stereo: streams.infrared_right needs a position, to the right of that of streams.depth"
            raise ValueProblem(message, "missing_key")
        return self

    @property
    def baseline(self) -> float:
        """Distance from the left imager to the right one, m; 0 without a pair."""
        if not {"depth", "infrared_right"} <= set(self.streams):
            return 0.0
        return self.stream("infrared_right").position[0] - self.stream("depth").position[0]

    def stream(self, name: str) -> CompleteStream:
        """Return all values of one stream; those of colour for a stream that the camera lacks. Raises Unknown."""
        view = self._find_value(name, "field_of_view")
        if view is None:
            raise Unknown("field_of_view")  # only in a model with problems
        return CompleteStream(
            self._find_value(name, "modes"),
            self._find_value(name, "formats"),
            view,
            self._find_value(name, "position") or (0.0, 0.0, 0.0),
            self._find_value(name, "orientation") or (0.0, 0.0, 0.0, 1.0),
        )

    def _find_value(self, name: str, key: str) -> Any:
        place: str | None = name if name in self.streams else "color"
        while place is not None:
            own = getattr(self.streams.get(place), key, None)
            if own is not None:
                return own
            place = STREAMS[place].like
        return getattr(self, key, None)


class CompleteStream(NamedTuple):
    """The values of one stream, with all defaults resolved."""

    modes: tuple[Mode, ...] | None
    formats: tuple[str, ...] | None
    field_of_view: FieldOfView
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]

    def mode(self, capture: Capture) -> Mode | None:
        """Return the mode with this size and rate; None if there is none, or if any is allowed."""
        for mode in self.modes or ():
            if (mode.width, mode.height) == (capture.width, capture.height) and capture.rate_hz in mode.rates_hz:
                return mode
        return None


LeverUse = Literal["gripper", "deadman", "none"]
"""What the lever of a leader is."""
_GAINS = Several(Quantity("", 0.0, 10.0, above=True), None, "one for each joint")
_SIGNS = Several(Quantity("", -1.0, 1.0), None, "one for each joint")


class LeaderJoints(Strict):
    """From the motors of a leader to the joints of an arm: position = sign * scale * (angle - offset)."""

    signs: Annotated[tuple[float, ...], _SIGNS] | None = None
    """Direction of each joint, 1 or -1; in a rig instead of the model's, as the keys below."""
    scales: Annotated[tuple[float, ...], _GAINS] | None = None
    """Angle of each joint for a rad of its motor."""
    offsets: JointPositions | None = None
    """Angle of each motor where the joint is at zero, rad."""
    options: dict[str, Any] = Field(default_factory=dict)
    """Options of the driver."""


class LeaderModel(LeaderJoints):
    """A leader arm."""

    title: str
    driver: str
    joints: tuple[str, ...]
    leads: tuple[str, ...]
    """Models of arms that it leads joint to joint; it leads any other one by poses."""
    arm: str | None = None
    """Model in ``robots/`` with its kinematics, to lead other arms by poses."""
    lever: LeverUse = "none"
    middles: JointPositions | None = None
    """Usual position of each joint, rad: the turn of a motor that counts turns is chosen around it."""


# Files


def load_pad_models(problems: Problems) -> dict[str, dict[str, Any]]:
    """Return all built-in models of gamepads as plain data, by name; :mod:`hal.pads.model` has their schema."""
    models = {}
    for name in list_data("sensors", "gamepads"):
        data = read_yaml(data_folder("sensors") / "gamepads" / f"{name}.yaml", problems)
        if data is not None:
            models[name] = data
    return models
