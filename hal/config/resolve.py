"""From a rig's file to a plan: which driver does what, with every name looked up and every number checked.

The records that are checked here have holes where a file is wrong. Each check stands in a ``suppress(Unknown)`` of its
own: what needs the value in a hole is left out, everything else is still looked at, and no plan comes of it.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from typing import TypeVar

from .. import registry
from ..specs import BodySpec, Plan, WorldSpec
from .context import Context
from .objects import load_objects
from .resolve_cameras import resolve_camera
from .resolve_pads import resolve_pad
from .resolve_robots import resolve_robot
from .rigfile import Device
from .schema import Unknown

__all__ = ["resolve"]

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
