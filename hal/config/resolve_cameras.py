"""Resolve a camera of a rig: model, modes, crop and place become one :class:`~hal.specs.CameraSpec`."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from ..errors import suggest
from ..geometry import Pose
from ..images import Intrinsics, centre_crop, from_field_of_view
from ..specs import CameraSpec, DepthSensorSpec, SensorSpec, ViewSpec
from ..types import STREAMS
from .context import Context, check_camera_spec, merge_options
from .models import CameraModel, Capture
from .rigfile import CameraConfig, Output, Stream, StreamConfig, make_view
from .schema import Unknown

_ONE_SENSOR = ("depth", *(name for name, kind in STREAMS.items() if kind.like))
"""Streams that a depth camera computes from the same images: of one size, at one rate."""


def resolve_camera(context: Context, name: str, config: CameraConfig) -> CameraSpec | None:
    """Return the record of a camera; None, with the problems added, if there are any."""
    key = f"cameras.{name}"
    with suppress(Unknown):
        if context.is_served(config):
            return _find_served(context, key, str(config.at))
    model, file = context.read_model(CameraModel, key, config, "sensors", "cameras")
    if "streams" not in config.model_fields_set:
        with suppress(Unknown):
            default = {name: stream for name, stream in config.streams.items() if name in model.streams}
            config = config.model_copy(update={"streams": default or config.streams})
    for check in (_check_attached, _check_place):
        with suppress(Unknown):
            check(context, key, config)
    for check_with_model in (_check_adjustable, _check_streams):
        with suppress(Unknown):
            check_with_model(context, key, config, model)
    streams: Streams | None = None
    with suppress(Unknown):
        streams = resolve_streams(context, key, config, model)
    driver = context.choose_driver("camera", key, config, model)
    if streams is None or not driver:
        return None
    if any(f"{found.key}.".startswith(f"{key}.") or found.file == str(file) for found in context.problems.found):
        return None
    with suppress(Unknown):
        spec = _make_spec(context, name, config, model, driver, streams, file)
        check_camera_spec(context, key, spec, config, model, file)
        return spec
    return None


def _find_served(context: Context, key: str, at: str) -> CameraSpec | None:
    """Return the record of a camera at another computer, whose frames have their pose; None, with the problem added."""
    spec = context.find_served(CameraSpec, key, at)
    here = spec is not None and spec.view is not None and spec.view.robot in (None, *context.urdfs)
    return spec if spec is None or here else replace(spec, view=None)


def _make_spec(
    context: Context, name: str, config: CameraConfig, model: CameraModel, driver: str, streams: Streams, file: Path
) -> CameraSpec:
    simulated = context.is_simulated(config)
    reference = streams.reference
    output = config.output or Output(width=reference.width, height=reference.height)
    sensor = model.depth_sensor
    infrared = [streams.sensors[name] for name, kind in STREAMS.items() if kind.unaligned and name in streams.sensors]
    return CameraSpec(
        name=name,
        model=config.model,
        driver=driver,
        capture_width=reference.width,
        capture_height=reference.height,
        width=output.width,
        height=output.height,
        rate_hz=min((sensor.rate_hz for sensor in streams.sensors.values()), default=reference.rate_hz),
        K=_crop_matrix(reference, output),
        distortion=_find_distortion(config, model, simulated),
        depth_min=streams.depth_min,
        depth_max=(config.depth or model.depth).max,
        streams=tuple(config.streams),
        view=_find_view(context, config),
        options=merge_options(config, model, simulated, driver, context.base, file),
        align=streams.align,
        sensors=streams.sensors,
        depth_sensor=DepthSensorSpec(sensor.kind, sensor.unit, model.baseline) if sensor is not None else None,
        K_infrared=None if all(_share_view(one, reference) for one in infrared) else _crop_matrix(infrared[0], output),
    )


def _find_distortion(config: CameraConfig, model: CameraModel, simulated: bool) -> tuple[float, ...]:
    if simulated:
        return (0.0,) * 5  # rendered images have none
    return model.distortion if config.intrinsics is None else config.intrinsics.distortion


def _share_view(one: SensorSpec, other: SensorSpec) -> bool:
    return replace(one, rate_hz=0.0, format=None) == replace(other, rate_hz=0.0, format=None)


def _crop_matrix(sensor: SensorSpec, output: Output) -> Any:
    """Return the camera matrix (3, 3) of a sensor's images after crop and scaling."""
    (fx, _, cx), (_, fy, cy), _ = sensor.K
    crop = centre_crop(sensor.width, sensor.height, output.width, output.height)
    return Intrinsics(fx, fy, cx, cy).crop_and_scale(crop, output.width, output.height).matrix()


def _check_place(context: Context, key: str, config: CameraConfig) -> None:
    somewhere = config.look_at or config.pose or config.attached
    if somewhere is None and context.driver is None and context.is_simulated(config):
        context.report(key, "is simulated and has no pose: give look_at, pose or attached", "missing_key")


def _check_attached(context: Context, key: str, config: CameraConfig) -> None:
    if config.attached is not None:
        context.check_link(context.source, f"{key}.attached", config.attached.robot, config.attached.link)


def _check_adjustable(context: Context, key: str, config: CameraConfig, model: CameraModel) -> None:
    for part in ("field_of_view", "depth", "intrinsics"):
        if not model.adjustable and getattr(config, part, None) is not None:
            text = f"is fixed by model {config.model!r}; only adjustable models leave it to the rig"
            context.report(f"{key}.{part}", text, "not_adjustable")


def _check_streams(context: Context, key: str, config: CameraConfig, model: CameraModel) -> None:
    if not config.streams:
        context.report(f"{key}.streams", f"must name at least one of {', '.join(model.streams)}", "missing_key")
    simulated = context.is_simulated(config)
    rendered = [name for name, kind in STREAMS.items() if kind.rendered]
    allowed = (*model.streams, *rendered) if simulated else tuple(model.streams)
    for stream in config.streams:
        if stream not in allowed and stream in STREAMS:  # others are already problems
            hint = "; only simulated cameras have it" if stream in rendered else ""
            message = f"model {config.model!r} has only {', '.join(allowed)}{hint}"
            context.report(f"{key}.streams.{stream}", message, "unknown_stream")
    for stream in rendered:
        if simulated and stream in config.streams and config.streams[stream].model_fields_set:
            context.report(f"{key}.streams.{stream}", "is rendered with the frame and has no options", "conflict")


def _find_view(context: Context, config: CameraConfig) -> ViewSpec | None:
    if config.look_at is not None:
        return make_view(config.look_at.pose())
    if config.pose is not None:
        return make_view(Pose(config.pose.position, config.pose.orientation))
    attached = config.attached
    if attached is None:
        return None
    link = context.links.get(attached.robot, {}).get(attached.link, attached.link)
    return make_view(attached.optical_pose(), attached.robot, link)


# Streams: the mode that each one is captured in, and the view of its sensor


class Streams(NamedTuple):
    """The streams of a camera."""

    sensors: dict[str, SensorSpec]
    align: str
    """Stream whose view colour and depth are returned in: ``color`` or ``depth``."""
    reference: SensorSpec
    """That view, as its sensor captures it; infrared's where there is neither colour nor depth."""
    depth_min: float
    """Nearest depth, m."""


def resolve_streams(context: Context, key: str, config: CameraConfig, model: CameraModel) -> Streams | None:
    """Return the streams and the view of the frames; None, with the problems added, if there are any."""
    before = len(context.problems.found)
    on = [name for name in config.streams if name in model.streams]
    captures = _set_captures(on, config.streams, config.capture or model.capture)
    _check_modes(context, key, config, model, captures)
    _check_formats(context, key, config, model, on)
    _check_together(context, key, model, captures)
    align = config.align or ("color" if "color" in on or "depth" not in on else "depth")
    if config.align not in (None, *on):
        message = f"is {align}, which is not one of the enabled streams: {', '.join(on)}"
        context.report(f"{key}.align", message, "conflict")
    known, color = config.intrinsics, captures.get("color")
    if known is not None and color is not None and (known.width, known.height) != (color.width, color.height):
        size = f"{known.width}x{known.height}, not of {color.width}x{color.height}, which is captured"
        context.report(
            f"{key}.intrinsics",
            f"are those of {size}: remove them, and calibrate this size",
            "conflict",
        )
    if len(context.problems.found) > before:
        return None
    sensors: dict[str, SensorSpec] = {
        name: _make_sensor(config, model, name, capture) for name, capture in captures.items()
    }
    reference = sensors.get(align) or next(iter(sensors.values()), None)
    if reference is None:
        reference = _make_sensor(config, model, "color", config.capture or model.capture)
    return Streams(sensors, align, reference, _find_nearest_depth(config, model, captures.get("depth")))


def _find_nearest_depth(config: CameraConfig, model: CameraModel, capture: Capture | None) -> float:
    """Return the nearest depth, m: the rig's, else that of the mode, else the model's."""
    if config.depth is not None:
        return config.depth.min
    mode = model.stream("depth").mode(capture) if capture is not None else None
    return (mode.depth_min if mode is not None else None) or model.depth.min


def _set_captures(
    on: Sequence[Stream], configs: Mapping[Stream, StreamConfig], default: Capture
) -> dict[Stream, Capture]:
    """Return size and rate of each stream. Infrared has those of depth, unless the rig gives it its own."""
    found: dict[Stream, Capture] = {}
    for name in sorted(on, key=[*_ONE_SENSOR, *STREAMS].index):
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
        context.report(place, f"model {config.model!r} has no mode {'. And no mode '.join(texts)}", "unknown_mode")


def _check_formats(context: Context, key: str, config: CameraConfig, model: CameraModel, on: Sequence[Stream]) -> None:
    for name in on:
        wanted, formats = config.streams[name].format, model.stream(name).formats
        if wanted is not None and formats is not None and wanted not in formats:
            text = f"model {config.model!r} has no {name} format {wanted!r}{suggest(wanted, formats)}"
            context.report(f"{key}.streams.{name}.format", text, "unknown_format")


def _check_together(context: Context, key: str, model: CameraModel, captures: Mapping[Stream, Capture]) -> None:
    made = {name: captures[name] for name in _ONE_SENSOR if name in captures}
    if model.depth_sensor is not None and len(set(made.values())) > 1:
        texts = ", ".join(f"{name} {capture}" for name, capture in made.items())
        message = f"one sensor makes all of these, so they must have one size and one rate: {texts}"
        context.report(f"{key}.streams", message, "conflict")
        return
    slowest = min((capture.rate_hz for capture in captures.values()), default=0.0)
    if any(abs(capture.rate_hz / slowest - round(capture.rate_hz / slowest)) > 1e-6 for capture in captures.values()):
        texts = ", ".join(f"{name} at {capture.rate_hz:g} Hz" for name, capture in captures.items())
        text = f"{texts}: each rate must be a whole multiple of the slowest, which is that of the frames"
        context.report(f"{key}.streams", text, "conflict")


def _make_sensor(config: CameraConfig, model: CameraModel, name: Stream, capture: Capture) -> SensorSpec:
    stream = model.stream(name)
    own = config.streams.get(name)  # None for colour that is off: the view of a segmentation alone
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
    known = config.intrinsics if model.adjustable and name == "color" else None
    if known is not None:
        return Intrinsics(known.fx, known.fy, known.cx, known.cy)
    angles = (config.field_of_view if model.adjustable else None) or model.stream(name).field_of_view
    sensor = (angles.width, angles.height) if angles.width is not None and angles.height is not None else None
    return from_field_of_view(capture.width, capture.height, angles.horizontal_deg, angles.vertical_deg, sensor)
