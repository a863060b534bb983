"""Resolve a rig's file into a plan: which driver runs each device, with every name looked up and every number checked.

A record that is checked here has holes where its file is wrong. Each check is in a ``suppress(Unknown)`` of its own:
what needs the value in a hole is skipped, everything else is still checked, and no plan results.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from dataclasses import replace
from itertools import combinations
from pathlib import Path
from typing import Any, TypeVar

from .. import registry
from ..errors import ConfigError, suggest
from ..geometry import Pose
from ..kinematics.collisions import in_one_place
from ..kinematics.urdf import read_urdf
from ..pads.model import pad_model
from ..specs import BodySpec, BoxSpec, CameraSpec, CollisionSpec, PadSpec, Plan, RandomizeSpec, RobotSpec, WorldSpec
from .context import Context, ServedConfig
from .data_files import user_path
from .files import find_file, read_yaml
from .models import load_pad_models
from .objects import load_objects
from .resolve_cameras import resolve_camera
from .resolve_leaders import resolve_leader
from .resolve_randomize import resolve_randomize
from .resolve_robots import resolve_robot
from .rigfile import Device, PadConfig
from .schema import Unknown

CHOSEN_LATER = "auto"
"""Stands for a pad that is chosen when the rig opens, in place of the name of a driver."""

_SECTIONS = ("robots", "cameras", "leaders", "gamepads")
Config = TypeVar("Config")
Spec = TypeVar("Spec")


def resolve(context: Context) -> Plan:
    """Return the plan. Raises ConfigError with every problem, those that were added before as well."""
    rig = context.rig
    _check_names(context)
    robots = _resolve_all(context, "robots", resolve_robot)
    cameras = _resolve_all(context, "cameras", resolve_camera)
    pads = _resolve_all(context, "gamepads", resolve_pad) + _resolve_all(context, "leaders", resolve_leader)
    with suppress(Unknown):
        _check_clock(context)
    _check_rates(context, robots)
    _check_places(context, robots)
    for section, devices, option in (("robots", robots, "host"), ("cameras", cameras, "serial")):
        _check_addresses(context, section, devices, option)
    driver: str | None = None
    with suppress(Unknown):
        driver = _world_driver(context)
    bodies: tuple[BodySpec, ...] = ()
    taken = {name: f"robots.{name} in {context.source}" for name in getattr(rig, "robots", ())}
    with suppress(Unknown):
        # For a real rig, too, so that mistakes in objects are found there.
        bodies = load_objects(context, rig.objects, "objects", taken)
    randomize: RandomizeSpec | None = None
    with suppress(Unknown):
        randomize = resolve_randomize(context, robots, cameras, bodies, taken)
    boxes: tuple[BoxSpec, ...] = ()
    with suppress(Unknown):
        boxes = tuple(_collect_boxes(context, bodies))
        context.warnings += _warn_of_unguarded(bodies, boxes)
    context.problems.raise_any()
    wanted = rig.collisions
    physics = rig.simulation
    world: WorldSpec | None = None
    if driver is not None:
        here = tuple(robot for robot in robots if robot.at is None)
        scene = bodies, here, physics.shadows, randomize
        world = WorldSpec(driver, physics.physics_hz, physics.gravity, *scene)
    return Plan(
        sim=context.rig_sim,
        clock=context.time,
        world=world,
        robots=robots,
        cameras=cameras,
        pads=pads,
        renderer=rig.simulation.renderer,
        warnings=tuple(context.warnings),
        source=context.source,
        collisions=CollisionSpec(wanted.self, wanted.arms, boxes, wanted.margin),
    )


def _collect_boxes(context: Context, bodies: Iterable[BodySpec]) -> Iterator[BoxSpec]:
    """Yield the boxes that no arm may touch; those of an object of the rig have its name."""
    objects = {body.name: body for body in bodies}
    for k, box in enumerate(context.rig.collisions.boxes):
        key = f"collisions.boxes.{k}"
        if box.position is not None and box.size is not None:
            yield BoxSpec(box.name, box.position, box.orientation, box.size)
        elif box.name in objects:
            yield from _split_object(context, key, objects[box.name])
        elif not context.problems.found:  # else it may be one whose file is wrong
            message = f"there is no object {box.name!r}{suggest(box.name, objects)}; a box needs position and size"
            context.report(key, message, "unknown_object")


def _warn_of_unguarded(bodies: Iterable[BodySpec], boxes: Iterable[BoxSpec]) -> Iterator[str]:
    """Yield a warning for each object that stands fixed in the way and that no box stands for."""
    named = {box.name for box in boxes}
    for body in bodies:
        if _is_fixed(body) and body.collision and body.shape != "plane" and body.name not in named:
            yield f"{body.name} is fixed, and no box of `collisions` has its name: no motion into it is refused"


def _is_fixed(body: BodySpec) -> bool:
    return body.robot is None and (body.fixed or (body.urdf is None and body.mass == 0.0))


def _split_object(context: Context, key: str, body: BodySpec) -> Iterator[BoxSpec]:
    """Yield the boxes of an object, which must be fixed and consist of boxes."""
    pose = Pose(body.position, body.orientation)
    shapes: list[tuple[Pose, tuple[float, ...]]] = []
    if body.half_extents is not None:
        shapes.append((pose, tuple(2.0 * half for half in body.half_extents)))
    elif body.urdf is not None:
        urdf = read_urdf(Path(body.urdf), meshes=False)
        for link, at in urdf.poses({}).items():
            for shape in urdf.links[link].collisions:
                size = tuple(body.scale * side for side in shape.size) if shape.shape == "box" else ()
                own = at @ shape.pose
                shapes.append((pose @ Pose(body.scale * own.position, own.orientation), size))
    if not shapes or not all(size for _, size in shapes):
        message = (
            f"the collision shapes of {body.name!r} are not boxes: give name, position and size of a box around it"
        )
        context.report(key, message, "wrong_shape")
        return
    if not _is_fixed(body):
        context.report(key, f"{body.name!r} can move: only objects that are fixed can be given here", "wrong_shape")
        return
    for at, size in shapes:
        position, orientation = at.position.tolist(), at.orientation.tolist()
        yield BoxSpec(body.name, tuple(position), tuple(orientation), tuple(size))  # type: ignore[arg-type]


def resolve_pad(context: Context, name: str, config: PadConfig) -> PadSpec | None:
    """Return the record of a gamepad; None, with the problems added, if there are any problems so far."""
    key = f"gamepads.{name}"
    model: dict[str, Any] | None = None
    with suppress(Unknown):
        model = _pad_model(context, key, config)
    driver, real = context.driver, False
    if driver is None:
        with suppress(Unknown):
            driver, real = _pad_driver(context, key, config), config.sim is False
            if driver is not None:
                _check_recording(context, f"{key}.file", config, driver)
    with suppress(Unknown):
        if config.drives is not None and config.drives not in context.rig.robots:
            message = f"there is no robot {config.drives!r}{suggest(config.drives, context.rig.robots)}"
            context.report(f"{key}.drives", message, "unknown_robot")
    with suppress(Unknown):
        if context.is_served(config):
            served = context.find_served(PadSpec, key, str(config.at))
            return None if served is None else replace(served, drives=config.drives)
    models = tuple(load_pad_models(context.problems).values())
    if context.problems.found or driver is None:
        return None
    options = dict(config.options)
    if config.file is not None:
        options["file"] = str(user_path(config.file, context.base))
    spec = PadSpec(
        name=name,
        driver=driver,
        model=model,
        models=models,
        dead_zone=config.dead_zone,
        drives=config.drives,
        options=options,
        real=real,
    )
    if spec.driver != CHOSEN_LATER:
        for relative, message, code in registry.check_record(spec.driver, "gamepad", spec):
            context.report(f"{key}.{relative}", message, code)
    return spec


def _pad_driver(context: Context, key: str, config: PadConfig) -> str | None:
    """Return the driver of a gamepad by its ``driver`` and its flag; None, and the problem, if there is no such driver.

    The problem is added, too, if the two contradict each other.
    """
    program, recording = registry.pad_driver("program"), registry.pad_driver("recording")
    if config.driver == CHOSEN_LATER:
        if not config.sim:
            return CHOSEN_LATER
        if config.file is None and config.options:
            context.report(f"{key}.options", "are for a recording, and no file names one", "conflict")
        return program if config.file is None else recording
    if not context.check_driver(config.driver, "gamepad", f"{key}.driver"):
        return None
    known = registry.driver(config.driver).pad_input is not None
    if known and config.sim is not None and config.sim != (config.driver in (program, recording)):
        kind = "a real pad" if config.sim else "a simulated pad"
        message = f"is {str(config.sim).lower()}, and the driver {config.driver!r} is {kind}: leave one of the two out"
        context.report(f"{key}.sim", message, "conflict")
    return config.driver


def _pad_model(context: Context, key: str, config: PadConfig) -> dict[str, Any] | None:
    if config.model == CHOSEN_LATER:
        return None
    found = find_file(config.model, "gamepad model", context.base, "sensors", "gamepads")
    if isinstance(found, str):
        context.report(f"{key}.model", f"{found}, or auto", "unknown_model")
        return None
    data = read_yaml(found, context.problems)
    if data is not None:
        try:
            pad_model(data, str(found))
        except ConfigError as error:
            for problem in error.problems:
                context.problems.add(problem.file, problem.key, problem.message, problem.code)
    return data


def _check_recording(context: Context, key: str, config: PadConfig, driver: str) -> None:
    if driver != registry.pad_driver("recording"):
        if config.file is not None:
            own = "sim is false" if config.sim is False else f"the driver is {driver!r}"
            message = f"is what a simulated pad plays (sim: true), and {own} here"
            context.report(key, message, "conflict")
    elif config.file is None:
        context.report(key, "is missing: the recording to play", "missing_key")
    elif not os.path.isfile(path := user_path(config.file, context.base)):
        context.report(key, f"there is no file {path}", "missing_file")


def _resolve_all(
    context: Context, section: str, make: Callable[[Context, str, Config], Spec | None]
) -> tuple[Spec, ...]:
    configs: dict[str, Config] = getattr(context.rig, section, {})
    specs = [make(context, name, config) for name, config in configs.items()]
    return tuple(spec for spec in specs if spec is not None)


def _check_names(context: Context) -> None:
    taken: dict[str, str] = {}
    for section in _SECTIONS:
        for name in getattr(context.rig, section, ()):
            key = f"{section}.{name}"
            if name in taken:
                message = f"{taken[name]} has the same name; names of devices must be unique"
                context.report(key, message, "duplicate_name")
            taken.setdefault(name, key)


def _check_addresses(context: Context, section: str, devices: Iterable[RobotSpec | CameraSpec], option: str) -> None:
    """Report a device with the address or serial number of another one: two programs of one arm, or of one camera."""
    taken: dict[tuple[str, str], str] = {}
    for device in devices:
        address = device.options.get(option)
        if address is None or device.options.keys() & {"emulated", "play", "port", "device"}:
            continue
        other = taken.setdefault((device.driver, address), device.name)
        if other != device.name:
            message = f"{section}.{other} has the same: name the one of this device"
            context.report(f"{section}.{device.name}.real.{option}", message, "duplicate_address")


def _check_clock(context: Context) -> None:
    if context.time != "lock_step":
        return
    for section in _SECTIONS:
        devices: dict[str, ServedConfig] = getattr(context.rig, section, {})
        for name, config in devices.items():
            with suppress(Unknown):
                key = f"{section}.{name}"
                if context.is_served(config):
                    context.report(
                        key, "is at another computer: use the clock real_time, or --sim", "real_in_lock_step"
                    )
                    continue
                if not isinstance(config, Device) or context.is_simulated(config):
                    continue
                if key in context.real_time_only:
                    text = "is emulated on a bus, where time cannot be stepped: use the clock real_time, or simulate it"
                    context.report(key, text, "emulated_in_lock_step")
                elif key not in context.emulated:
                    text = "is real, and a real device cannot be stepped: use the clock real_time, or simulate it"
                    context.report(key, text, "real_in_lock_step")


def _check_rates(context: Context, robots: Iterable[RobotSpec]) -> None:
    """Check that arms that share a process have one rate."""
    first: dict[str, RobotSpec] = {}
    for robot in robots:
        if robot.group is None:
            continue
        other = first.setdefault(robot.group, robot)
        if other.rate_hz != robot.rate_hz:
            message = (
                f"is {robot.rate_hz:g} Hz, and {other.name!r}, which shares its process, has {other.rate_hz:g} Hz: "
                "they must be equal"
            )
            context.report(f"robots.{robot.name}.rate_hz", message, "unequal_rates")


def _check_places(context: Context, robots: Iterable[RobotSpec]) -> None:
    """Refuse arms of one URDF in one place that are not given as those of one robot: each would bring a whole one."""
    for one, other in combinations(robots, 2):
        several = context.rig.robots[other.name].arm is not None
        if several and one.kinematics.urdf == other.kinematics.urdf and in_one_place(one, other):
            message = f"has the model and the base of robot {one.name!r}: add same: {one.name} if both are arms of one"
            context.report(f"robots.{other.name}.same", f"{message} robot, or give it another base", "robots_overlap")


def _world_driver(context: Context) -> str | None:
    """Return the driver of the simulated world that the devices are in; None if there is no simulated device.

    Objects of a simulated rig without arms and cameras are in a world, too.
    """
    worlds = {key: name for key, name in context.drivers.items() if registry.driver(name).world is not None}
    first = next(iter(worlds.values()), None)
    for key, driver in worlds.items():
        if driver != first:
            message = f"is simulated by {driver!r}, others by {first!r}; a rig has one simulated world"
            context.report(key, message, "two_worlds")
    rig = context.rig
    if rig.objects and not (rig.robots or rig.cameras) and context.rig_sim and context.driver is None:
        return context.engine_driver
    return first
