"""A camera of a rig: model, mode, crop and place into one :class:`~hal.specs.CameraSpec`."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..pose import Pose
from ..specs import CameraSpec, ViewSpec
from .files import nearest, read_yaml, validate
from .intrinsics import Intrinsics, centre_crop, from_field_of_view
from .models import CameraModel, Capture, find_model
from .rigfile import CameraConfig
from .views import view_of

if TYPE_CHECKING:
    from .resolve import Context

__all__ = ["resolve_camera"]


def resolve_camera(context: Context, name: str, config: CameraConfig) -> CameraSpec | None:
    """The camera, or None with the problems noted."""
    key = f"cameras.{name}"
    simulated = context.simulated(config)
    view = _view(context, key, config)
    if view is None and simulated and context.driver is None:
        context.problem(key, "is simulated and stands nowhere: give look_at, pose or attached")
    found = find_model(config.model, "sensors", ("cameras",), context.base)
    if isinstance(found, str):
        context.problem(f"{key}.model", found)
        return None
    data = read_yaml(found, context.problems)
    model = validate(CameraModel, data, found, context.problems) if data is not None else None
    if model is None:
        return None
    capture, mode_depth = _capture(context, key, config, model)
    if not model.adjustable:
        for part in ("field_of_view", "depth"):
            if getattr(config, part) is not None:
                context.problem(
                    f"{key}.{part}", f"belongs to model {config.model!r}; only adjustable models leave it open"
                )
    for stream in config.streams:
        allowed = (*model.streams, "segmentation") if simulated else model.streams
        if stream not in allowed:
            hint = "; only simulated cameras have it" if stream == "segmentation" else ""
            context.problem(f"{key}.streams.{stream}", f"model {config.model!r} has {', '.join(allowed)}{hint}")
    if not config.streams:
        context.problem(f"{key}.streams", f"must name at least one of {', '.join(model.streams)}")
    output = config.output or capture
    K = _intrinsics(config, model, capture).through(
        centre_crop(capture.width, capture.height, output.width, output.height), output.width, output.height
    )
    depth = config.depth or model.depth
    options = {**model.simulated, **config.simulated} if simulated else {**model.real, **config.real}
    formats = {stream: kind.format for stream, kind in config.streams.items() if kind.format is not None}
    if formats and not simulated:
        options["formats"] = formats
    return CameraSpec(
        name=name,
        model=config.model,
        driver=context.choose_driver("camera", key, simulated, config.drivers, model.drivers),
        capture_width=capture.width,
        capture_height=capture.height,
        width=output.width,
        height=output.height,
        rate_hz=capture.rate_hz,
        K=K.matrix(),
        distortion=(0.0,) * 5 if simulated else model.distortion,  # what is drawn has none
        depth_min=depth.min if config.depth else mode_depth or depth.min,
        depth_max=depth.max,
        streams=tuple(config.streams),
        view=view,
        options=options,
    )


def _capture(context: Context, key: str, config: CameraConfig, model: CameraModel) -> tuple[Capture, float | None]:
    """What it takes, and the nearest depth in that mode where the model tells it."""
    capture = config.capture or model.capture
    if model.modes is None:
        return capture, None
    for mode in model.modes:
        if (mode.width, mode.height) == (capture.width, capture.height) and capture.rate_hz in mode.rates_hz:
            return capture, mode.depth_min
    asked = f"{capture.width}x{capture.height} at {capture.rate_hz:g} Hz"
    modes = "; ".join(str(mode) for mode in model.modes)
    context.problem(f"{key}.capture", f"model {config.model!r} has no mode {asked}; it has: {modes}")
    return capture, None


def _intrinsics(config: CameraConfig, model: CameraModel, capture: Capture) -> Intrinsics:
    angles = (config.field_of_view if model.adjustable else None) or model.field_of_view
    sensor = (angles.width, angles.height) if angles.width is not None and angles.height is not None else None
    return from_field_of_view(capture.width, capture.height, angles.horizontal_deg, angles.vertical_deg, sensor)


def _view(context: Context, key: str, config: CameraConfig) -> ViewSpec | None:
    if config.look_at is not None:
        return view_of(config.look_at.pose())
    if config.pose is not None:
        return view_of(Pose(config.pose.position, config.pose.orientation))
    attached = config.attached
    if attached is None:
        return None
    known = {*context.rig.robots, *(k.removeprefix("robots.") for k in context.broken if k.startswith("robots."))}
    if attached.robot not in known:
        context.problem(
            f"{key}.attached.robot", f"this rig has no robot {attached.robot!r}{nearest(attached.robot, known)}"
        )
    urdf = context.urdfs.get(attached.robot)  # None where the robot itself is wrong
    if urdf is not None and attached.link not in urdf.links:
        text = f"robot {attached.robot!r} has no link {attached.link!r}{nearest(attached.link, urdf.links)}"
        context.problem(f"{key}.attached.link", text)
    return view_of(attached.pose(), attached.robot, attached.link)
