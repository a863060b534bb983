"""The streams of a camera: which of its model's modes each one is taken in, and how its sensor sees."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import NamedTuple

from ..images import Intrinsics, from_field_of_view
from ..specs import SensorSpec
from .camera_models import CameraModel, Capture
from .context import Context
from .files import nearest
from .rigfile import CameraConfig, Stream, StreamConfig

__all__ = ["Streams", "resolve_streams"]

_ONE_SENSOR: tuple[Stream, ...] = ("depth", "infrared", "infrared_right")
"""Streams that a depth camera makes of the same pictures: of one size, at one rate."""
_DRAWN = "segmentation"
"""The stream that no camera has."""


class Streams(NamedTuple):
    """How a camera takes its pictures."""

    sensors: dict[str, SensorSpec]
    align: str
    """Whose view colour and depth are handed out in: ``color`` or ``depth``."""
    reference: SensorSpec
    """That view, as its sensor takes it; infrared's where there is neither colour nor depth."""
    depth_min: float
    """m"""


def resolve_streams(context: Context, key: str, config: CameraConfig, model: CameraModel) -> Streams | None:
    """The streams, or None with the problems noted."""
    before = len(context.problems.found)
    on = [name for name in config.streams if name != _DRAWN and name in model.streams]
    captures = _captures(on, config.streams, config.capture or model.capture)
    _check_modes(context, key, config, model, captures)
    _check_formats(context, key, config, model, on)
    _check_together(context, key, model, captures)
    align = config.align or ("color" if "color" in on or "depth" not in on else "depth")
    if config.align is not None and align not in on:
        context.problem(f"{key}.align", f"is {align}, which is none of the streams that are on: {', '.join(on)}")
    if len(context.problems.found) > before:
        return None
    sensors: dict[str, SensorSpec] = {name: _sensor(config, model, name, took) for name, took in captures.items()}
    reference = sensors.get(align) or next(iter(sensors.values()), None)
    if reference is None:
        reference = _sensor(config, model, "color", config.capture or model.capture)
    depth = captures.get("depth")
    mode = model.stream("depth").mode(depth) if depth is not None and config.depth is None else None
    nearest_depth = mode.depth_min if mode is not None else None
    return Streams(sensors, align, reference, nearest_depth or (config.depth or model.depth).min)


def _captures(on: Sequence[Stream], configs: Mapping[Stream, StreamConfig], default: Capture) -> dict[Stream, Capture]:
    """What each stream takes. Infrared takes what depth does, unless it says otherwise."""
    found: dict[Stream, Capture] = {}
    for name in sorted(on, key=[*_ONE_SENSOR, "color"].index):
        own = configs[name]
        alike = next((found[other] for other in _ONE_SENSOR if other in found and name in _ONE_SENSOR), default)
        width, height = (own.width, own.height) if own.width and own.height else (alike.width, alike.height)
        found[name] = Capture(width=width, height=height, rate_hz=own.rate_hz or alike.rate_hz)
    return {name: found[name] for name in on}


def _check_modes(
    context: Context, key: str, config: CameraConfig, model: CameraModel, captures: Mapping[Stream, Capture]
) -> None:
    wrong: dict[str, list[str]] = {}
    for name, capture in captures.items():
        modes = model.stream(name).modes
        if modes is not None and model.stream(name).mode(capture) is None:
            own = config.streams[name].model_fields_set & {"width", "height", "rate_hz"}
            text = f"{capture} of {name}; it has: {'; '.join(map(str, modes))}"
            wrong.setdefault(f"{key}.streams.{name}" if own else f"{key}.capture", []).append(text)
    for place, texts in wrong.items():
        context.problem(place, f"model {config.model!r} has no mode {'. And no mode '.join(texts)}")


def _check_formats(context: Context, key: str, config: CameraConfig, model: CameraModel, on: Sequence[Stream]) -> None:
    for name in on:
        asked, formats = config.streams[name].format, model.stream(name).formats
        if asked is not None and formats is not None and asked not in formats:
            text = f"model {config.model!r} gives no {name} as {asked!r}{nearest(asked, formats)}"
            context.problem(f"{key}.streams.{name}.format", text)


def _check_together(context: Context, key: str, model: CameraModel, captures: Mapping[Stream, Capture]) -> None:
    made = {name: captures[name] for name in _ONE_SENSOR if name in captures}
    if model.depth_sensor is not None and len(set(made.values())) > 1:
        texts = ", ".join(f"{name} {capture}" for name, capture in made.items())
        context.problem(f"{key}.streams", f"one sensor makes all of these, of one size and at one rate: {texts}")
        return
    slowest = min((capture.rate_hz for capture in captures.values()), default=0.0)
    if any(abs(capture.rate_hz / slowest - round(capture.rate_hz / slowest)) > 1e-6 for capture in captures.values()):
        texts = ", ".join(f"{name} at {capture.rate_hz:g} Hz" for name, capture in captures.items())
        text = f"{texts}: each rate must be a whole multiple of the slowest, at which frames are handed out"
        context.problem(f"{key}.streams", text)


def _sensor(config: CameraConfig, model: CameraModel, name: Stream, capture: Capture) -> SensorSpec:
    stream = model.stream(name)
    own = config.streams.get(name)  # None for colour where it is not on: the view of a segmentation alone
    return SensorSpec(
        width=capture.width,
        height=capture.height,
        rate_hz=capture.rate_hz,
        K=_intrinsics(config, model, name, capture).matrix(),
        format=own.format if own is not None else None,
        position=stream.position,
        orientation=stream.orientation,
    )


def _intrinsics(config: CameraConfig, model: CameraModel, name: str, capture: Capture) -> Intrinsics:
    angles = (config.field_of_view if model.adjustable else None) or model.stream(name).field_of_view
    sensor = (angles.width, angles.height) if angles.width is not None and angles.height is not None else None
    return from_field_of_view(capture.width, capture.height, angles.horizontal_deg, angles.vertical_deg, sensor)
