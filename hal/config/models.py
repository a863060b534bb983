"""Robot models: what is the same for every one of its kind. YAML files in ``robots/``; cameras' are in
:mod:`.camera_models`. A model of your own is a file of the same shape; a rig names it by its path.
"""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, Field, model_validator

from .data_files import data_folder, is_path, list_data, user_path
from .files import Problems, nearest, read_yaml
from .schema import (
    Accelerations,
    CameraRate,
    Distance,
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
    Velocities,
    ViewAngle,
)

__all__ = [
    "CameraModel",
    "Capture",
    "CompleteStream",
    "Depth",
    "DepthSensor",
    "Drivers",
    "FieldOfView",
    "GripperModel",
    "LimitsModel",
    "Mode",
    "PoseConfig",
    "RobotModel",
    "SensorStream",
    "StreamModel",
    "UrdfSource",
    "by_name",
    "find_model",
    "load_pad_models",
]


class Drivers(Strict):
    """Which driver does the work, in simulation and for real; None where there is none."""

    sim: str | None = None
    real: str | None = None


class UrdfSource(Strict):
    """A URDF: a path relative to the file that names it, or a path inside an installed Python package."""

    path: str
    package: str | None = None

    @model_validator(mode="before")
    @classmethod
    def _plain_path(cls, data: Any) -> Any:
        return {"path": data} if isinstance(data, str) else data


class LimitsModel(Strict):
    """Per joint, or one number for all: rad, rad/s, rad/s2, rad/s3, Nm (m and N for joints that slide).

    Position, speed and torque come from the URDF where they are left out; acceleration and jerk must be given.
    """

    lower: JointLimits | None = None
    upper: JointLimits | None = None
    velocity: Velocities | None = None
    acceleration: Accelerations | None = None
    jerk: Jerks | None = None
    torque: Torques | None = None


class TcpModel(Strict):
    """The tool centre point in the frame of a link."""

    link: str
    position: Offset = (0.0, 0.0, 0.0)
    orientation: QuaternionConfig = (0.0, 0.0, 0.0, 1.0)


class GripperModel(Strict):
    """A parallel gripper: fingers that move together, each half the width."""

    joints: tuple[str, ...] = ()
    drivers: Drivers = Drivers()
    width_max: Size
    """m"""
    speed: Speed
    """Of the width, m/s."""
    force: Force
    """N"""
    real: dict[str, Any] = Field(default_factory=dict)
    simulated: dict[str, Any] = Field(default_factory=dict)


class RobotModel(Strict):
    """An arm, and its gripper if it has one."""

    description: str = ""
    urdf: UrdfSource
    drivers: Drivers = Drivers()
    rate_hz: RateHz = 1000.0
    """Of the real arm's control cycle. A simulated one runs at the rig's ``physics_hz``."""
    joints: tuple[Name, ...] = Field(min_length=1)
    """Of the arm, from base to tip; the fingers are the gripper's."""
    base_link: str | None = None
    """The URDF's root when left out."""
    tcp: TcpModel
    home: JointPositions
    """rad"""
    links: dict[Name, str] = Field(default_factory=dict)
    """Other names for links, which a rig can use in ``attached`` whatever the model: ``{hand: panda_hand}``."""
    limits: LimitsModel = LimitsModel()
    """What the arm can do."""
    real_limits: LimitsModel = LimitsModel()
    """Tighter ones, kept where the arm is real; those that are left out are as above."""
    gripper: GripperModel | None = None
    real: dict[str, Any] = Field(default_factory=dict)
    """What only the real driver needs; a rig adds to it."""
    simulated: dict[str, Any] = Field(default_factory=dict)


def find_model(name: str, folder: str, parts: tuple[str, ...], base: Path) -> Path | str:
    """Path of a model: the user's when ``name`` is a path (relative to ``base``), else one that comes with the hal.

    Returns a sentence where there is none.
    """
    if is_path(name):
        return user_path(name, base)
    there = list_data(folder, *parts)
    if name not in there:
        return f"there is no {'/'.join((folder, *parts))} model {name!r}{nearest(name, there)}, or a path to your own"
    return data_folder(folder).joinpath(*parts, f"{name}.yaml")


def load_pad_models(problems: Problems) -> dict[str, dict[str, Any]]:
    """All pad models that come with the hal, by name, as plain data. The pads' driver knows what is in them."""
    models = {}
    for name in list_data("sensors", "gamepads"):
        data = read_yaml(data_folder("sensors") / "gamepads" / f"{name}.yaml", problems)
        if data is not None:
            models[name] = data
    return models


# [camera_models.py] Camera models: what is the same for every camera of its kind. YAML files in
# ``sensors/cameras/``.
#
# A model of your own is a file of the same shape; a rig names it by its path.
#


class Mode(Strict):
    """A size of picture and the rates that it comes at."""

    width: Pixels
    height: Pixels
    rates_hz: tuple[CameraRate, ...] = Field(min_length=1)
    depth_min: Distance | None = None
    """Nearest depth in this mode, m; the model's when left out."""

    def __str__(self) -> str:
        return f"{self.width}x{self.height} at {', '.join(f'{rate:g}' for rate in self.rates_hz)} Hz"


class FieldOfView(Strict):
    """Angles of view of the whole sensor, from edge to edge of its outermost pixels, deg.

    ``width`` and ``height`` are those of the picture that shows the whole sensor; a mode of another shape is its
    centre. Left out, every mode shows the same angles. One angle alone means square pixels.
    """

    horizontal_deg: ViewAngle | None = None
    vertical_deg: ViewAngle | None = None
    width: Pixels | None = None
    height: Pixels | None = None

    @model_validator(mode="after")
    def _complete(self) -> FieldOfView:
        if self.horizontal_deg is None and self.vertical_deg is None:
            raise ValueError("needs horizontal_deg, vertical_deg or both")
        if (self.width is None) != (self.height is None):
            raise ValueError("needs width and height of the whole sensor's picture, or neither")
        return self


class Depth(Strict):
    """What can be measured, m."""

    min: Distance
    max: Annotated[float, Quantity("m", 0.0, 1000.0, above=True)]

    @model_validator(mode="after")
    def _ordered(self) -> Depth:
        if self.min >= self.max:
            raise ValueError(f"min must be less than max, not {self.min:g} and {self.max:g}")
        return self


class Capture(Strict):
    """What a camera takes."""

    width: Pixels
    height: Pixels
    rate_hz: CameraRate

    def __str__(self) -> str:
        return f"{self.width}x{self.height} at {self.rate_hz:g} Hz"


def by_name(value: Any) -> Any:
    """``[color, depth]`` as ``{color: {}, depth: {}}``, and a name with nothing after it likewise."""
    if isinstance(value, (list, tuple)):
        return {str(name): {} for name in value}
    if isinstance(value, dict):
        return {name: {} if item is None else item for name, item in value.items()}
    return value


class StreamModel(Strict):
    """One stream of a camera, where it differs from what the model says for all of them.

    What is left out is for ``infrared_right`` as for ``infrared``, and for that as for ``depth``.
    """

    modes: tuple[Mode, ...] | None = None
    formats: tuple[str, ...] | None = None
    """Names of librealsense (``z16``); None where anything goes."""
    field_of_view: FieldOfView | None = None
    position: Offset | None = None
    orientation: QuaternionConfig | None = None
    """Pose of this sensor's optical frame (x right, y down, z forward) in that of the colour sensor, m."""


class DepthSensor(Strict):
    """How depth is measured: what a simulation of its noise needs to know."""

    kind: Literal["stereo", "lidar"]
    """``stereo``: from ``infrared`` and ``infrared_right``, seen from the former."""
    unit: Size
    """Metres in one unit of the raw picture."""


SensorStream = Literal["color", "depth", "infrared", "infrared_right"]
_MADE_FROM = {"infrared_right": "infrared", "infrared": "depth"}


def _three() -> dict[SensorStream, StreamModel]:
    return {"color": StreamModel(), "depth": StreamModel(), "infrared": StreamModel()}


class CameraModel(Strict):
    """A camera."""

    description: str = ""
    drivers: Drivers = Drivers()
    modes: tuple[Mode, ...] | None = None
    """What every stream can take that has no modes of its own; None where anything goes."""
    capture: Capture
    """What it takes unless a rig says otherwise."""
    field_of_view: FieldOfView | None = None
    """Of every stream that has none of its own."""
    distortion: Annotated[tuple[float, ...], Several(Quantity("", -1e3, 1e3), 5, "k1, k2, p1, p2, k3")] = (
        0.0,
        0.0,
        0.0,
        0.0,
        0.0,
    )
    """k1, k2, p1, p2, k3 (OpenCV's order)."""
    depth: Depth
    streams: Annotated[dict[SensorStream, StreamModel], BeforeValidator(by_name)] = Field(default_factory=_three)
    """What it can give: ``[color, depth]``, or ``{color: {modes: ...}, ...}`` where streams differ."""
    depth_sensor: DepthSensor | None = None
    adjustable: Flag = False
    """May a rig choose the field of view and the range of depth? (A real camera's are what they are.)"""
    real: dict[str, Any] = Field(default_factory=dict)
    simulated: dict[str, Any] = Field(default_factory=dict)

    @model_validator(mode="after")
    def _complete(self) -> CameraModel:
        for name in self.streams:
            if self._of(name, "field_of_view") is None:
                raise ValueError(f"needs field_of_view, or one in streams.{name}")
        if self.depth_sensor is not None and self.depth_sensor.kind == "stereo" and self.baseline <= 0.0:
            raise ValueError("stereo: streams.infrared_right needs a position, to the right of that of streams.depth")
        return self

    @property
    def baseline(self) -> float:
        """From the left imager to the right one, m; 0 where there is no pair."""
        if not {"depth", "infrared_right"} <= set(self.streams):
            return 0.0
        return self.stream("infrared_right").position[0] - self.stream("depth").position[0]

    def stream(self, name: str) -> CompleteStream:
        """All figures of one stream; those of the colour picture for what is none of the camera's own streams."""
        view = self._of(name, "field_of_view")
        if view is None:
            raise Unknown("field_of_view")  # only in a model with mistakes, which were noted
        return CompleteStream(
            self._of(name, "modes"),
            self._of(name, "formats"),
            view,
            self._of(name, "position") or (0.0, 0.0, 0.0),
            self._of(name, "orientation") or (0.0, 0.0, 0.0, 1.0),
        )

    def _of(self, name: str, key: str) -> Any:
        place: str | None = name if name in self.streams else "color"
        while place is not None:
            own = getattr(self.streams.get(place), key, None)  # type: ignore[call-overload]  # any name may be asked for
            if own is not None:
                return own
            place = _MADE_FROM.get(place)
        return getattr(self, key, None)


class CompleteStream(NamedTuple):
    """What a model says of one stream, all told."""

    modes: tuple[Mode, ...] | None
    formats: tuple[str, ...] | None
    field_of_view: FieldOfView
    position: tuple[float, float, float]
    orientation: tuple[float, float, float, float]

    def mode(self, capture: Capture) -> Mode | None:
        """The mode that takes this; None where there is none, or anything goes."""
        for mode in self.modes or ():
            if (mode.width, mode.height) == (capture.width, capture.height) and capture.rate_hz in mode.rates_hz:
                return mode
        return None
