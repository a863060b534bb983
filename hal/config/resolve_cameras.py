"""A camera of a rig: model, mode, crop and place into one :class:`~hal.specs.CameraSpec`."""

from __future__ import annotations

from contextlib import suppress
from typing import get_args

from ..pose import Pose
from ..specs import CameraSpec, ViewSpec
from .context import Context
from .files import nearest
from .intrinsics import Intrinsics, centre_crop, from_field_of_view
from .models import CameraModel, Capture, Mode
from .rigfile import CameraConfig, Stream
from .schema import Unknown
from .views import view_of

__all__ = ["resolve_camera"]


def resolve_camera(context: Context, name: str, config: CameraConfig) -> CameraSpec | None:
    """The camera, or None with the problems noted."""
    key = f"cameras.{name}"
    model, _ = context.read_model(CameraModel, key, config, "sensors", "cameras")
    for check in (_check_attached, _check_place):
        with suppress(Unknown):
            check(context, key, config)
    for check_with_model in (_check_mode, _check_adjustable, _check_streams):
        with suppress(Unknown):
            check_with_model(context, key, config, model)
    driver = context.choose_driver("camera", key, config, model)
    return None if context.problems.found else _spec(context, name, config, model, driver)


def _spec(context: Context, name: str, config: CameraConfig, model: CameraModel, driver: str) -> CameraSpec:
    simulated = context.simulated(config)
    capture = config.capture or model.capture
    output = config.output or capture
    K = _intrinsics(config, model, capture).through(
        centre_crop(capture.width, capture.height, output.width, output.height), output.width, output.height
    )
    mode = _mode(model, capture)
    depth = config.depth or model.depth
    options = {**model.simulated, **config.simulated} if simulated else {**model.real, **config.real}
    formats = {stream: kind.format for stream, kind in config.streams.items() if kind.format is not None}
    if formats and not simulated:
        options["formats"] = formats
    return CameraSpec(
        name=name,
        model=config.model,
        driver=driver,
        capture_width=capture.width,
        capture_height=capture.height,
        width=output.width,
        height=output.height,
        rate_hz=capture.rate_hz,
        K=K.matrix(),
        distortion=(0.0,) * 5 if simulated else model.distortion,  # what is drawn has none
        depth_min=(mode.depth_min if mode and not config.depth else None) or depth.min,
        depth_max=depth.max,
        streams=tuple(config.streams),
        view=_view(context, config),
        options=options,
    )


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


def _mode(model: CameraModel, capture: Capture) -> Mode | None:
    """The model's mode that takes this, where the model has modes and this is one of them."""
    for mode in model.modes or ():
        if (mode.width, mode.height) == (capture.width, capture.height) and capture.rate_hz in mode.rates_hz:
            return mode
    return None


def _check_mode(context: Context, key: str, config: CameraConfig, model: CameraModel) -> None:
    capture = config.capture or model.capture
    if model.modes is None or _mode(model, capture) is not None:
        return
    asked = f"{capture.width}x{capture.height} at {capture.rate_hz:g} Hz"
    modes = "; ".join(str(mode) for mode in model.modes)
    context.problem(f"{key}.capture", f"model {config.model!r} has no mode {asked}; it has: {modes}")


def _check_adjustable(context: Context, key: str, config: CameraConfig, model: CameraModel) -> None:
    for part in ("field_of_view", "depth"):
        if not model.adjustable and getattr(config, part, None) is not None:
            text = f"belongs to model {config.model!r}; only adjustable models leave it open"
            context.problem(f"{key}.{part}", text)


def _check_streams(context: Context, key: str, config: CameraConfig, model: CameraModel) -> None:
    if not config.streams:
        context.problem(f"{key}.streams", f"must name at least one of {', '.join(model.streams)}")
    simulated = context.simulated(config)
    allowed = (*model.streams, "segmentation") if simulated else model.streams
    for stream in config.streams:
        if stream not in allowed and stream in get_args(Stream):  # others are noted already
            hint = "; only simulated cameras have it" if stream == "segmentation" else ""
            context.problem(f"{key}.streams.{stream}", f"model {config.model!r} has {', '.join(allowed)}{hint}")


def _intrinsics(config: CameraConfig, model: CameraModel, capture: Capture) -> Intrinsics:
    angles = (config.field_of_view if model.adjustable else None) or model.field_of_view
    sensor = (angles.width, angles.height) if angles.width is not None and angles.height is not None else None
    return from_field_of_view(capture.width, capture.height, angles.horizontal_deg, angles.vertical_deg, sensor)


def _view(context: Context, config: CameraConfig) -> ViewSpec | None:
    if config.look_at is not None:
        return view_of(config.look_at.pose())
    if config.pose is not None:
        return view_of(Pose(config.pose.position, config.pose.orientation))
    attached = config.attached
    if attached is None:
        return None
    link = context.links.get(attached.robot, {}).get(attached.link, attached.link)
    return view_of(attached.pose(), attached.robot, link)
