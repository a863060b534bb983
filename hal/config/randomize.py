"""The section ``simulation.randomize`` of a rig's file: ranges that ``rig.world.randomize(seed)`` draws from."""

from __future__ import annotations

from typing import Annotated, Any

from pydantic import AfterValidator, Field

from ..randomization import LIGHTS
from .schema import ENDS, Quantity, Several, Strict, ValueProblem, check_order

EVERY = "*"
"""Stands for every object, robot or camera; what an entry of its own says precedes it."""

_Two = tuple[float, float]


def _check_count(value: Any) -> Any:
    if isinstance(value, (list, tuple)) and any(isinstance(item, bool) or item != int(item) for item in value):
        raise ValueProblem(f"must be two whole numbers, {ENDS}", "wrong_type")
    return value


def _check_colors(value: tuple[_Two, ...]) -> tuple[_Two, ...]:
    for name, least, greatest in zip(("red", "green", "blue"), *value, strict=True):
        if least > greatest:
            text = f"must be {ENDS} [red, green, blue]; {name} {least:g} is above {greatest:g}"
            raise ValueProblem(text, "empty_range")
    return value


def _check_textures(value: tuple[str, ...]) -> tuple[str, ...]:
    if not value:
        raise ValueProblem("must be a list of textures, and has none", "wrong_count")
    return value


_Order = AfterValidator(check_order)
_Rgb = Annotated[tuple[float, float, float], Several(Quantity("", 0.0, 1.0), 3, "red, green, blue")]
Colors = Annotated[tuple[_Rgb, _Rgb], AfterValidator(_check_colors)]
"""The least and the greatest red, green and blue; each is drawn by itself."""
Textures = Annotated[tuple[str, ...], AfterValidator(_check_textures)]
"""What a texture is chosen from: built-in names, paths of pictures, and ``none``."""
Lights = Annotated[_Two, Several(Quantity("", 1.0, LIGHTS), 2, ENDS), _Order, AfterValidator(_check_count)]
Count = Annotated[_Two, Several(Quantity("", 0.0, 100.0), 2, ENDS), _Order, AfterValidator(_check_count)]
Scale = Annotated[_Two, Several(Quantity("", 0.0, 100.0, above=True), 2, ENDS), _Order]
Ambient = Annotated[_Two, Several(Quantity("", 0.0, 100.0), 2, ENDS), _Order]
View = Annotated[_Two, Several(Quantity("", 0.1, 10.0), 2, ENDS), _Order]
Angle = Annotated[_Two, Several(Quantity("deg", -360.0, 360.0), 2, ENDS), _Order]
Elevation = Annotated[_Two, Several(Quantity("deg", 0.0, 90.0), 2, ENDS), _Order]
Shift = Annotated[_Two, Several(Quantity("m", -5.0, 5.0), 2, ENDS), _Order]
Latency = Annotated[_Two, Several(Quantity("s", 0.0, 1.0), 2, ENDS), _Order]
Noise = Annotated[_Two, Several(Quantity("", 0.0, 10.0), 2, ENDS), _Order]
CommandNoise = Annotated[_Two, Several(Quantity("", 0.0, 0.1), 2, ENDS), _Order]
TorqueNoise = Annotated[_Two, Several(Quantity("Nm", 0.0, 1000.0), 2, ENDS), _Order]
ColorNoise = Annotated[_Two, Several(Quantity("", 0.0, 1.0), 2, ENDS), _Order]
DepthNoise = Annotated[_Two, Several(Quantity("m", 0.0, 1.0), 2, ENDS), _Order]


class LightVariation(Strict):
    """The light: what is not given stays as without randomization."""

    count: Lights | None = None
    """Number of lights, which share the intensity; the first one casts shadows."""
    azimuth_deg: Angle | None = None
    """Direction that each light comes from: 0 for the world's x axis, 90 for its y axis."""
    elevation_deg: Elevation | None = None
    """Height that it comes from: 90 for straight from above."""
    intensity: Scale | None = None
    """Factor on the light of all together."""
    color: Colors | None = None
    """Of each light."""
    ambient: Ambient | None = None
    """Factor on the light from everywhere."""


class BackgroundVariation(Strict):
    """What is behind everything."""

    color: Colors | None = None
    texture: Textures | None = None


class LinkVariation(Strict):
    """A link, or all links of a body."""

    color: Colors | None = None
    texture: Textures | None = None
    """Picture that covers it, tinted by the colour."""
    mass_scale: Scale | None = None
    """Factor on the mass, and on the inertia with it."""
    friction_scale: Scale | None = None
    """Factor on the lateral friction."""


class BodyVariation(LinkVariation):
    """An object."""

    links: dict[str, LinkVariation] = Field(default_factory=dict)
    """Single links, in addition."""


class GripperVariation(Strict):
    """The gripper of a simulated arm."""

    command_latency_s: Latency | None = None
    state_latency_s: Latency | None = None
    width_noise: Noise | None = None
    """Standard deviation of the reported width, m."""


class RobotVariation(BodyVariation):
    """A simulated arm."""

    command_latency_s: Latency | None = None
    """Time from the servo to the motors."""
    command_noise: CommandNoise | None = None
    """Standard deviation of what the motors get, rad (m for joints that slide); never beyond a joint's limits."""
    state_latency_s: Latency | None = None
    """Time from the sensors to the servo and to the program."""
    position_noise: Noise | None = None
    """Standard deviation of the measured positions, rad; likewise of the speeds, rad/s, and torques, Nm."""
    velocity_noise: Noise | None = None
    torque_noise: TorqueNoise | None = None
    gripper: GripperVariation = GripperVariation()


class CameraVariation(Strict):
    """A simulated camera."""

    position_m: Shift | None = None
    """Shift along each axis of the picture (right, down, forward)."""
    rotation_deg: Angle | None = None
    """Turn about each of these axes."""
    field_of_view_scale: View | None = None
    """Factor on the width of what is seen."""
    exposure: Scale | None = None
    """Factor on the brightness."""
    color_noise: ColorNoise | None = None
    """Standard deviation of colour and infrared, as a share of white."""
    depth_noise: DepthNoise | None = None
    """Standard deviation of depth at 1 m; it grows with the square of the distance."""
    latency_s: Latency | None = None
    """Time from the exposure to the program."""


class DistractorsConfig(Strict):
    """Objects that are there in some episodes, and are of no use for the task."""

    objects: list[Any] = Field(min_length=1, max_length=100)
    """As ``objects`` of the rig. Give them ``random`` ranges."""
    count: Count
    """Number of them in an episode."""


class RandomizeConfig(Strict):
    """What ``rig.world.randomize(seed)`` draws: ranges ``[least, greatest]``; what is not given does not vary."""

    light: LightVariation = LightVariation()
    background: BackgroundVariation = BackgroundVariation()
    objects: dict[str, BodyVariation] = Field(default_factory=dict)
    """By name; ``"*"`` for every object."""
    robots: dict[str, RobotVariation] = Field(default_factory=dict)
    cameras: dict[str, CameraVariation] = Field(default_factory=dict)
    distractors: DistractorsConfig | None = None
