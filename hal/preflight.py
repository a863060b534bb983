"""Before a real arm moves: is this computer fit for it, is the arm there, and is the way to it fast enough?

Nothing moves, and nothing stays open.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING

from . import registry
from .errors import HalError
from .machine import check_machine
from .specs import RobotSpec
from .verdict import Level, Verdict

if TYPE_CHECKING:
    from .config.plan import Plan

__all__ = ["Check", "Level", "Verdict", "preflight", "real_arms"]

Check = Callable[[RobotSpec, float], Iterator[Verdict]]
"""What a driver offers as ``DriverSpec.preflight``: it is given the arm, and how long it may measure, s."""


def real_arms(plan: Plan) -> tuple[RobotSpec, ...]:
    """The arms of a rig that have somebody at the other end: a robot, or a program that stands in for one."""
    return tuple(robot for robot in plan.robots if robot.attended or robot.emulated)


def preflight(plan: Plan, duration: float = 2.0) -> Iterator[Verdict]:
    """Look at the machine, then at every real arm; each verdict comes as soon as it is known.

    ``duration`` is how long each arm's network is measured, s. Raises nothing that a driver's check raises: that is a
    verdict, too.
    """
    yield from check_machine()
    for robot in real_arms(plan):
        for verdict in _check_arm(robot, duration):
            yield replace(verdict, name=f"{robot.name}: {verdict.name}")


def _check_arm(robot: RobotSpec, duration: float) -> Iterator[Verdict]:
    try:
        spec = registry.driver(robot.driver)
        check: Check | None = registry.function(robot.driver, spec.preflight)
        if check is None:
            yield Verdict("arm", "unknown", f"its driver {robot.driver!r} has no check of its own")
            return
        yield from check(robot, duration)
    except (HalError, OSError) as error:
        yield Verdict("check", "fail", f"{type(error).__name__}: {error}", "mend this first, then check again")
