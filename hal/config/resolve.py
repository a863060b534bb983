"""From a rig's file to a plan: which driver does what, with every name looked up and every number checked."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .. import registry
from ..errors import HalError
from ..specs import CameraSpec, PadSpec, RobotSpec, WorldSpec
from .files import Problems
from .models import Drivers
from .objects import load_objects
from .plan import Plan
from .resolve_cameras import resolve_camera
from .resolve_pads import resolve_pad
from .resolve_robots import resolve_robot
from .rigfile import Device, RigFile
from .urdf import UrdfModel

__all__ = ["Context", "resolve"]


@dataclass
class Context:
    """What resolving needs besides the file's own words."""

    source: str
    """The rig's file, or ``<dict>``."""
    base: Path
    """What its paths are relative to."""
    rig: RigFile
    sim: bool | None
    driver: str | None
    clock: str | None
    broken: Collection[str]
    """Keys such as ``robots.panda`` that were left out because their schema is wrong."""
    problems: Problems
    warnings: list[str] = field(default_factory=list)
    urdfs: dict[str, UrdfModel] = field(default_factory=dict)
    """URDFs of the robots that were resolved, by the robot's name."""

    @property
    def rig_sim(self) -> bool:
        """The rig's flag, after the caller's word."""
        return self.rig.sim if self.sim is None else self.sim

    def simulated(self, device: Device, parent: Device | None = None) -> bool:
        """Is this device simulated? ``parent`` is the arm of a gripper."""
        if self.sim is True or self.driver is not None:
            return True
        for owner in (device, parent):
            if owner is not None and owner.sim is not None:
                return owner.sim
        return self.rig_sim

    def choose_driver(self, kind: str, key: str, simulated: bool, own: Drivers | None, model: Drivers) -> str:
        """Name of the driver; noted as a problem where there is none (and then a placeholder)."""
        if self.driver is not None:
            name = self.driver
        else:
            flag = "sim" if simulated else "real"
            chosen = (getattr(own, flag) if own else None) or getattr(model, flag)
            if chosen is None:
                state = "simulated" if simulated else "real"
                self.problem(key, f"its model has no driver for a {state} {kind}; name one in {key}.drivers.{flag}")
                return "none"
            name = chosen
        self.check_driver(name, kind, key)
        return name

    def check_driver(self, name: str, kind: str, key: str) -> None:
        """Note a problem where no such driver is there, or where it does not do this kind of device."""
        try:
            found = registry.driver(name)
        except HalError as error:
            self.problem(key, str(error))
            return
        if getattr(found, kind) is None:
            self.problem(key, f"driver {name!r} has no {kind}; it has: {', '.join(found.kinds) or 'nothing'}")

    def problem(self, key: str, message: str) -> None:
        """Note a problem in the rig's file."""
        self.problems.add(self.source, key, message)


def resolve(context: Context) -> Plan:
    """The plan. What is wrong stands in ``context.problems`` afterwards; the plan is whole only if nothing does."""
    rig = context.rig
    _check_names(context)
    robots = [r for name, config in rig.robots.items() if (r := resolve_robot(context, name, config)) is not None]
    cameras = [c for name, config in rig.cameras.items() if (c := resolve_camera(context, name, config)) is not None]
    pads = _pads(context)
    clock = _clock(context, robots, cameras)
    return Plan(
        sim=context.rig_sim,
        clock=clock,
        world=_world(context, robots, cameras),
        robots=tuple(robots),
        cameras=tuple(cameras),
        pads=tuple(pads),
        renderer=rig.simulation.renderer,
        warnings=tuple(context.warnings),
        source=context.source,
    )


def _check_names(context: Context) -> None:
    taken: dict[str, str] = {}
    for section in ("robots", "cameras", "gamepads"):
        for name in getattr(context.rig, section):
            if name in taken:
                context.problem(
                    f"{section}.{name}", f"{taken[name]} has the same name; the names of devices must differ"
                )
            taken.setdefault(name, f"{section}.{name}")


def _pads(context: Context) -> list[PadSpec]:
    return [p for name, config in context.rig.gamepads.items() if (p := resolve_pad(context, name, config)) is not None]


def _clock(context: Context, robots: list[RobotSpec], cameras: list[CameraSpec]) -> str:
    default = "lock_step" if context.driver == "mock" else context.rig.simulation.clock or "real_time"
    clock = context.clock or default
    if clock == "lock_step":
        rig = context.rig
        real = [f"robots.{r.name}" for r in robots if r.attended]
        real += [f"cameras.{c.name}" for c in cameras if not context.simulated(rig.cameras[c.name])]
        for key in real:
            context.problem(
                key, "is real, and a real device cannot be stepped: use the clock real_time, or simulate it"
            )
    return clock


def _world(context: Context, robots: list[RobotSpec], cameras: list[CameraSpec]) -> WorldSpec | None:
    rig = context.rig
    users: dict[str, Any] = {}
    for robot in robots:
        users[f"robots.{robot.name}"] = robot.driver
        if robot.gripper is not None:
            users[f"robots.{robot.name}.gripper"] = robot.gripper.driver
    users |= {f"cameras.{camera.name}": camera.driver for camera in cameras}
    worlds = {key: driver for key, driver in users.items() if _has_world(driver)}
    # Objects are looked at in any case, so that their mistakes are found on the real rig too.
    taken = {name: f"robots.{name} in {context.source}" for name in rig.robots}
    bodies = load_objects(rig.objects, context.source, context.base, taken, context.problems, context.warnings)
    if not worlds:
        return None
    first = next(iter(worlds.values()))
    for key, driver in worlds.items():
        if driver != first:
            context.problem(key, f"is simulated by {driver!r}, others by {first!r}; a rig has one simulated world")
    return WorldSpec(
        driver=first,
        physics_hz=rig.simulation.physics_hz,
        gravity=rig.simulation.gravity,
        bodies=bodies,
        robots=tuple(robots),
    )


def _has_world(driver: str) -> bool:
    try:
        return registry.driver(driver).world is not None
    except HalError:
        return False  # noted already
