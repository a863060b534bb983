"""Camera models: what is the same for every camera of its kind. YAML files in ``sensors/cameras/``.

A model of your own is a file of the same shape; a rig names it by its path.
"""

from __future__ import annotations

from typing import Annotated, Any, Literal, NamedTuple

from pydantic import BeforeValidator, Field, model_validator

from .models import Drivers
from .schema import (
    CameraRate,
    Distance,
    Flag,
    Offset,
    Pixels,
    Quantity,
    QuaternionConfig,
    Several,
    Size,
    Strict,
    Unknown,
    ViewAngle,
)

__all__ = [
    "CameraModel",
    "Capture",
    "CompleteStream",
    "Depth",
    "DepthSensor",
    "FieldOfView",
    "Mode",
    "SensorStream",
    "StreamModel",
    "by_name",
]


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
