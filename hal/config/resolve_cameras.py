"""A camera of a rig: model, modes, crop and place into one :class:`~hal.specs.CameraSpec`."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

from ..geometry import Pose
from ..images import Intrinsics, centre_crop
from ..specs import CameraSpec, DepthSensorSpec, SensorSpec, ViewSpec
from .camera_models import CameraModel
from .context import Context
from .driver_options import ask_camera_driver, options_of
from .files import nearest
from .resolve_streams import Streams, resolve_streams
from .rigfile import CameraConfig, Output, Stream
from .schema import Unknown
from .views import view_of

__all__ = ["resolve_camera"]


def resolve_camera(context: Context, name: str, config: CameraConfig) -> CameraSpec | None:
    """The camera, or None with the problems noted."""
    key = f"cameras.{name}"
    model, file = context.read_model(CameraModel, key, config, "sensors", "cameras")
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
    if streams is None or not driver or _has_problems(context, key, file):
        return None
    with suppress(Unknown):
        spec = _spec(context, name, config, model, driver, streams, file)
        ask_camera_driver(context, key, spec, config, model, file)
        return spec
    return None


def _has_problems(context: Context, key: str, file: Path) -> bool:
    """Is anything wrong in the camera's entry, or in its model's file?"""
    return any(f"{found.key}.".startswith(f"{key}.") or found.file == str(file) for found in context.problems.found)


def _spec(
    context: Context, name: str, config: CameraConfig, model: CameraModel, driver: str, streams: Streams, file: Path
) -> CameraSpec:
    simulated = context.simulated(config)
    reference = streams.reference
    output = config.output or Output(width=reference.width, height=reference.height)
    sensor = model.depth_sensor
    infrared = [streams.sensors[name] for name in ("infrared", "infrared_right") if name in streams.sensors]
    return CameraSpec(
        name=name,
        model=config.model,
        driver=driver,
        capture_width=reference.width,
        capture_height=reference.height,
        width=output.width,
        height=output.height,
        rate_hz=min((sensor.rate_hz for sensor in streams.sensors.values()), default=reference.rate_hz),
        K=_through(reference, output),
        distortion=(0.0,) * 5 if simulated else model.distortion,  # what is drawn has none
        depth_min=streams.depth_min,
        depth_max=(config.depth or model.depth).max,
        streams=tuple(config.streams),
        view=_view(context, config),
        options=options_of(config, model, simulated, driver, context.base, file),
        align=streams.align,
        sensors=streams.sensors,
        depth_sensor=DepthSensorSpec(sensor.kind, sensor.unit, model.baseline) if sensor is not None else None,
        K_infrared=None if all(_same_view(one, reference) for one in infrared) else _through(infrared[0], output),
    )


def _same_view(one: SensorSpec, other: SensorSpec) -> bool:
    return replace(one, rate_hz=0.0, format=None) == replace(other, rate_hz=0.0, format=None)


def _through(sensor: SensorSpec, output: Output) -> Any:
    """The camera matrix of a sensor's pictures after crop and scaling."""
    (fx, _, cx), (_, fy, cy), _ = sensor.K
    crop = centre_crop(sensor.width, sensor.height, output.width, output.height)
    return Intrinsics(fx, fy, cx, cy).through(crop, output.width, output.height).matrix()


def _check_place(context: Context, key: str, config: CameraConfig) -> None:
    somewhere = config.look_at or config.pose or config.attached
    if somewhere is None and context.driver is None and context.simulated(config):
        context.problem(key, "is simulated and stands nowhere: give look_at, pose or attached")


def _check_attached(context: Context, key: str, config: CameraConfig) -> None:
    if config.attached is None:
        return
    robot, robots = config.attached.robot, context.rig.robots
    if robot not in robots:
        context.problem(f"{key}.attached.robot", f"this rig has no robot {robot!r}{nearest(robot, robots)}")
    urdf = context.urdfs.get(robot)  # None where the robot itself is wrong
    link, aliases = config.attached.link, context.links.get(robot, {})
    if urdf is not None and link not in urdf.links and link not in aliases:
        text = f"robot {robot!r} has no link {link!r}{nearest(link, (*urdf.links, *aliases))}"
        context.problem(f"{key}.attached.link", text)


def _check_adjustable(context: Context, key: str, config: CameraConfig, model: CameraModel) -> None:
    for part in ("field_of_view", "depth"):
        if not model.adjustable and getattr(config, part, None) is not None:
            text = f"belongs to model {config.model!r}; only adjustable models leave it open"
            context.problem(f"{key}.{part}", text)


def _check_streams(context: Context, key: str, config: CameraConfig, model: CameraModel) -> None:
    if not config.streams:
        context.problem(f"{key}.streams", f"must name at least one of {', '.join(model.streams)}")
    simulated = context.simulated(config)
    allowed = (*model.streams, "segmentation") if simulated else tuple(model.streams)
    for stream in config.streams:
        if stream not in allowed and stream in get_args(Stream):  # others are noted already
            hint = "; only simulated cameras have it" if stream == "segmentation" else ""
            context.problem(f"{key}.streams.{stream}", f"model {config.model!r} has {', '.join(allowed)}{hint}")
    drawn = config.streams.get("segmentation")
    if simulated and drawn is not None and drawn.model_fields_set:
        context.problem(f"{key}.streams.segmentation", "is drawn with the frame: there is nothing to choose")


def _view(context: Context, config: CameraConfig) -> ViewSpec | None:
    if config.look_at is not None:
        return view_of(config.look_at.pose())
    if config.pose is not None:
        return view_of(Pose(config.pose.position, config.pose.orientation))
    attached = config.attached
    if attached is None:
        return None
    link = context.links.get(attached.robot, {}).get(attached.link, attached.link)
    return view_of(attached.optical(), attached.robot, link)
