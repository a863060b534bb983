"""Which devices share a clock and a process."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING

from .. import registry
from ..specs import GripperSpec, GroupSpec, RobotSpec

if TYPE_CHECKING:
    from ..specs import Plan

__all__ = ["GRIPPER_HZ", "groups_of"]

GRIPPER_HZ = 100.0
"""Rate of a gripper that has a process of its own."""


def groups_of(plan: Plan) -> list[GroupSpec]:
    """The groups of a rig: the devices of its simulated world together, and each other arm alone.

    In lock-step the first one runs in the caller's process, and the others, if there are any, keep in step with it. A
    gripper is in the group of its arm, except for one whose driver needs a process of its own.
    """
    world, clock = plan.world, plan.clock
    inside = tuple(r for r in plan.robots if world is not None and r.driver == world.driver)
    outside = tuple(r for r in plan.robots if r not in inside)
    apart = [
        GroupSpec(f"{r.name}.gripper", clock, GRIPPER_HZ, (), grippers=(r.gripper,))
        for r in plan.robots
        if r.gripper is not None and _is_apart(r.gripper)
    ]
    alone = [
        GroupSpec(r.name, clock, r.rate_hz, (r,), grippers=_grippers((r,))) for r in outside if _is_alone(r, clock)
    ]
    if clock == "lock_step":
        robots = inside + tuple(r for r in outside if not r.emulated)
        rate = world.physics_hz if world else max((r.rate_hz for r in outside), default=240.0)
        return [GroupSpec("simulation", clock, rate, robots, world, _grippers(robots)), *alone, *apart]
    groups = [GroupSpec("simulation", clock, world.physics_hz, inside, world, _grippers(inside))] if world else []
    return groups + alone + apart


def _is_alone(robot: RobotSpec, clock: str) -> bool:
    """Does this arm, which does not stand in the simulated world, need a process of its own?"""
    return clock != "lock_step" or robot.emulated


def _is_apart(gripper: GripperSpec) -> bool:
    return "gripper" in registry.driver(gripper.driver).own_process


def _grippers(robots: Iterable[RobotSpec]) -> tuple[GripperSpec, ...]:
    """Those that run beside their arms."""
    return tuple(r.gripper for r in robots if r.gripper is not None and not _is_apart(r.gripper))
