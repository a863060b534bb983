"""Which devices share a clock and a process."""

from __future__ import annotations

from typing import TYPE_CHECKING

from ..specs import GroupSpec

if TYPE_CHECKING:
    from ..config.plan import Plan

__all__ = ["groups_of"]


def groups_of(plan: Plan) -> list[GroupSpec]:
    """The groups of a rig: the devices of its simulated world together, and each other arm alone."""
    world = plan.world
    inside = tuple(r for r in plan.robots if world is not None and r.driver == world.driver)
    outside = tuple(r for r in plan.robots if r not in inside)
    if plan.clock == "lock_step":
        rate = world.physics_hz if world else max((r.rate_hz for r in outside), default=240.0)
        return [GroupSpec("simulation", plan.clock, rate, inside + outside, world)]
    groups = [GroupSpec("simulation", plan.clock, world.physics_hz, inside, world)] if world else []
    return groups + [GroupSpec(r.name, plan.clock, r.rate_hz, (r,)) for r in outside]
