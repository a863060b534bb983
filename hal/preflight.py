"""Before a real arm moves: is this computer fit for it, is the arm there, and is the way to it fast enough? And the
cameras: are they plugged in, by which link, and do they keep their rate?

Nothing moves, and nothing stays open.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import TYPE_CHECKING, Any

from . import registry
from .errors import HalError
from .machine import check_machine
from .specs import CameraSpec, RobotSpec
from .verdict import Level, Verdict

if TYPE_CHECKING:
    from .config.plan import Plan

__all__ = ["CameraCheck", "Check", "Level", "Verdict", "checked_cameras", "preflight", "real_arms"]

Check = Callable[[RobotSpec, float], Iterator[Verdict]]
"""What a driver offers as ``DriverSpec.preflight``: it is given the arm, and how long it may measure, s."""
CameraCheck = Callable[[CameraSpec, float], Iterator[Verdict]]
"""And as ``DriverSpec.camera_preflight``."""


def real_arms(plan: Plan) -> tuple[RobotSpec, ...]:
    """The arms of a rig that have somebody at the other end: a robot, or a program that stands in for one."""
    return tuple(robot for robot in plan.robots if robot.attended or robot.emulated)


def checked_cameras(plan: Plan) -> tuple[CameraSpec, ...]:
    """The cameras of a rig whose driver can look at them before they are opened."""
    return tuple(camera for camera in plan.cameras if registry.driver(camera.driver).camera_preflight is not None)


def preflight(plan: Plan, duration: float = 2.0, *, machine: bool = True, cameras: bool = True) -> Iterator[Verdict]:
    """Check the machine, then every real arm and camera; each verdict comes as soon as it is known.

    Errors of a driver's check are verdicts, too, and are not raised.

    Args:
        plan: The rig.
        duration: How long each arm's network, and each camera's rate, is measured, s.
        machine: Whether to check this computer.
        cameras: Whether to check the cameras.
    """
    if machine:
        yield from check_machine()
    devices: list[RobotSpec | CameraSpec] = [*real_arms(plan), *(checked_cameras(plan) if cameras else ())]
    for device in devices:
        for verdict in _check(device, duration):
            yield replace(verdict, name=f"{device.name}: {verdict.name}")


def _check(device: RobotSpec | CameraSpec, duration: float) -> Iterator[Verdict]:
    arm = isinstance(device, RobotSpec)
    try:
        spec = registry.driver(device.driver)
        check: Callable[[Any, float], Iterator[Verdict]] | None = registry.function(
            device.driver, spec.preflight if arm else spec.camera_preflight
        )
        if check is None:
            kind = "arm" if arm else "camera"
            yield Verdict(kind, "unknown", f"its driver {device.driver!r} has no check of its own")
            return
        yield from check(device, duration)
    except (HalError, OSError) as error:
        yield Verdict("check", "fail", f"{type(error).__name__}: {error}", "mend this first, then check again")
