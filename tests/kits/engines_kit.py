"""The engines of the simulated world, for tests that run on each of them."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any

import pytest
from specs import world_spec

from hal import registry
from hal.driver import GripperDriver, RobotDriver
from hal.errors import DriverMissing
from hal.specs import BodySpec, RobotSpec, WorldSpec
from hal.world import WorldDriver

AUTO = registry.choose_engine("auto")
"""The engine of a rig that names none, on this computer."""

REPLACED = (registry.SIMULATION, *registry.ENGINES)
"""Drivers of records that become the engine's; others (``franka``) stay."""


@dataclass(frozen=True)
class Engine:
    """A simulation engine, and what a test makes of it."""

    name: str

    def spec(self, *things: BodySpec | RobotSpec, **values: Any) -> WorldSpec:
        """Return the record of a world of these objects and arms, which this engine simulates."""
        made = world_spec(*self.simulated(things), **values)
        return replace(made, driver=self.name)

    def simulated(self, things: Iterable[BodySpec | RobotSpec]) -> tuple[BodySpec | RobotSpec, ...]:
        """Return the records with this engine as the driver of simulated arms and grippers."""
        return tuple(self.arm(thing) if isinstance(thing, RobotSpec) else thing for thing in things)

    def arm(self, arm: RobotSpec) -> RobotSpec:
        """Return the record of an arm with this engine as its driver, and as its gripper's."""
        gripper = arm.gripper
        if gripper is not None and gripper.driver in REPLACED:
            gripper = replace(gripper, driver=self.name)
        return replace(arm, driver=self.name if arm.driver in REPLACED else arm.driver, gripper=gripper)

    def world(self, *things: BodySpec | RobotSpec, **values: Any) -> Any:
        """Return a world of these objects and arms; ``values`` are those of :func:`specs.world_spec`."""
        return self.world_of(self.spec(*things, **values))

    def world_of(self, spec: WorldSpec) -> Any:
        """Return the world of a record."""
        driver: type[WorldDriver] = registry.load(self.name, "world")
        return driver(spec)

    def robot(self, world: Any, name: str | None = None) -> Any:
        """Return the driver of an arm of a world; of the first one by default."""
        driver: type[RobotDriver] = registry.load(self.name, "robot")
        return driver(self._arm_of(world, name), world)

    def gripper(self, world: Any, name: str | None = None) -> Any:
        """Return the driver of the gripper of an arm of a world."""
        spec = self._arm_of(world, name).gripper
        assert spec is not None
        driver: type[GripperDriver] = registry.load(self.name, "gripper")
        return driver(spec, world)

    @staticmethod
    def _arm_of(world: Any, name: str | None) -> RobotSpec:
        arms: tuple[RobotSpec, ...] = world.spec.robots
        return next(arm for arm in arms if name in (None, arm.name))


def has_engine(name: str) -> bool:
    """Return whether an engine is installed and can be loaded."""
    try:
        registry.check_engine(name)
        registry.load(name, "world")
    except DriverMissing:
        return False
    return True


def need_engine(name: str) -> Engine:
    """Return an engine; skip the test where it is not installed."""
    if not has_engine(name):
        pytest.skip(f"the engine {name} is not installed")
    return Engine(name)


def joint_positions(world: Any, name: str) -> dict[str, float]:
    """Return the positions of all movable joints of a body, rad or m, from the world's snapshot."""
    bodies = world.bodies.values()
    place = 7 * sum(not body.roams for body in bodies)
    for body in bodies:
        place += 7 * body.roams
        if body.name == name:
            names = {number: joint for joint, number in body.joints.items()}
            values = world.snapshot()[place : place + len(body.movable)]
            return {names[number]: value for number, value in zip(body.movable, values, strict=True)}
        place += len(body.movable) if body.moves else 0
    raise KeyError(name)
