"""From a rig's file to a plan: which driver does what, with every name looked up and every number checked.

The records that are checked here have holes where a file is wrong. Each check stands in a ``suppress(Unknown)`` of its
own: what needs the value in a hole is left out, everything else is still looked at, and no plan comes of it.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Any, TypeVar

from .. import registry
from ..errors import ConfigError
from ..pads.model import pad_model
from ..specs import BodySpec, PadSpec, Plan, WorldSpec
from .context import Context
from .data_files import user_path
from .files import read_yaml
from .models import find_model, load_pad_models
from .objects import load_objects
from .resolve_cameras import resolve_camera
from .resolve_robots import resolve_robot
from .rigfile import Device, PadConfig
from .schema import Unknown

__all__ = [
    "resolve",
    "resolve_pad",
]

# [resolve_pads.py] A gamepad of a rig into a :class:`~hal.specs.PadSpec`. Which pad ``auto`` is, is decided when
# the rig opens.

CHOSEN_LATER = "auto"
"""Not the name of a driver: the pad is chosen when the rig opens."""


def resolve_pad(context: Context, name: str, config: PadConfig) -> PadSpec | None:
    """The pad, or None with the problems noted."""
    key = f"gamepads.{name}"
    model: dict[str, Any] | None = None
    with suppress(Unknown):
        model = _model(context, key, config)
    if context.driver is None:
        with suppress(Unknown):
            if config.driver == CHOSEN_LATER or context.check_driver(config.driver, "gamepad", f"{key}.driver"):
                _check_recording(context, f"{key}.file", config)
    models = tuple(load_pad_models(context.problems).values())
    if context.problems.found:
        return None
    options = dict(config.options)
    if config.file is not None:
        options["file"] = str(_recording(context, config.file))
    spec = PadSpec(
        name=name,
        driver=context.driver or config.driver,
        model=model,
        models=models,
        dead_zone=config.dead_zone,
        options=options,
    )
    if spec.driver != CHOSEN_LATER:
        for relative, message in registry.checked(spec.driver, "gamepad", spec):
            context.problem(f"{key}.{relative}", message)
    return spec


def _model(context: Context, key: str, config: PadConfig) -> dict[str, Any] | None:
    if config.model == "auto":
        return None
    found = find_model(config.model, "sensors", ("gamepads",), context.base)
    if isinstance(found, str):
        context.problem(f"{key}.model", f"{found}, or auto")
        return None
    data = read_yaml(found, context.problems)
    if data is not None:
        try:
            pad_model(data, str(found))
        except ConfigError as error:
            for problem in error.problems:
                context.problems.add(problem.file, problem.key, problem.message)
    return data


def _recording(context: Context, file: str) -> Path:
    return user_path(file, context.base)


def _check_recording(context: Context, key: str, config: PadConfig) -> None:
    plays = config.driver != CHOSEN_LATER and registry.driver(config.driver).pad_input == "recording"
    if not plays:
        if config.file is not None:
            context.problem(key, f"is for the driver {registry.pad_driver('recording')}, not {config.driver!r}")
    elif config.file is None:
        context.problem(key, "is missing: the recording that is to be played")
    elif not os.path.isfile(_recording(context, config.file)):
        context.problem(key, f"there is no file {_recording(context, config.file)}")


Config = TypeVar("Config")
Spec = TypeVar("Spec")


def resolve(context: Context) -> Plan:
    """The plan. Raises ConfigError with every problem, those that were noted before as well."""
    rig = context.rig
    _check_names(context)
    robots = _each(context, "robots", resolve_robot)
    cameras = _each(context, "cameras", resolve_camera)
    pads = _each(context, "gamepads", resolve_pad)
    with suppress(Unknown):
        _check_clock(context)
    driver = _world_driver(context)
    bodies: tuple[BodySpec, ...] = ()
    with suppress(Unknown):
        # Objects are looked at in any case, so that their mistakes are found on the real rig too.
        taken = {name: f"robots.{name} in {context.source}" for name in getattr(rig, "robots", ())}
        bodies = load_objects(
            rig.objects,
            context.source,
            context.base,
            taken,
            context.problems,
            context.warnings,
            urdfs=context.urdfs,
            links=context.links,
        )
    context.problems.raise_any()
    physics = rig.simulation
    world = WorldSpec(driver, physics.physics_hz, physics.gravity, bodies, robots) if driver is not None else None
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
    )


def _each(context: Context, section: str, make: Callable[[Context, str, Config], Spec | None]) -> tuple[Spec, ...]:
    configs: dict[str, Config] = getattr(context.rig, section, {})
    specs = [make(context, name, config) for name, config in configs.items()]
    return tuple(spec for spec in specs if spec is not None)


def _check_names(context: Context) -> None:
    taken: dict[str, str] = {}
    for section in ("robots", "cameras", "gamepads"):
        for name in getattr(context.rig, section, ()):
            if name in taken:
                context.problem(
                    f"{section}.{name}", f"{taken[name]} has the same name; the names of devices must differ"
                )
            taken.setdefault(name, f"{section}.{name}")


def _check_clock(context: Context) -> None:
    if context.time != "lock_step":
        return
    for section in ("robots", "cameras"):
        devices: dict[str, Device] = getattr(context.rig, section, {})
        for name, config in devices.items():
            with suppress(Unknown):
                key = f"{section}.{name}"
                if not context.simulated(config) and key not in context.emulated:
                    text = "is real, and a real device cannot be stepped: use the clock real_time, or simulate it"
                    context.problem(key, text)


def _world_driver(context: Context) -> str | None:
    """The driver whose simulated world the devices stand in; None where none does."""
    worlds = {key: name for key, name in context.drivers.items() if registry.driver(name).world is not None}
    first = next(iter(worlds.values()), None)
    for key, driver in worlds.items():
        if driver != first:
            context.problem(key, f"is simulated by {driver!r}, others by {first!r}; a rig has one simulated world")
    return first
