"""What an app does between its command line and an open rig."""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hal.specs import Plan

__all__ = ["check_everything", "planned"]


def planned(args: argparse.Namespace, *more: str, cameras: Iterable[str] = ()) -> Plan | None:
    """The plan of the rig that the options name. None after ``--dry-run``, which has told what would be opened.

    ``more`` are lines that follow. Raises ConfigError, and DeviceNotFound for a ``--robot``, or one of ``cameras``,
    that is not there.
    """
    from hal.apps.banner import listing
    from hal.config import load
    from hal.config.files import nearest
    from hal.errors import DeviceNotFound

    plan = load(args.config, sim=args.sim, overrides=args.overrides).resolve()
    names = [robot.name for robot in plan.robots]
    if args.robot and args.robot not in names:
        raise DeviceNotFound(f"--robot: this rig has no robot {args.robot!r}{nearest(args.robot, names)}")
    known = [camera.name for camera in plan.cameras]
    for name in cameras:
        if name not in known:
            raise DeviceNotFound(f"--cameras: this rig has no camera {name!r}{nearest(name, known)}")
    if not args.dry_run:
        return plan
    check_everything(plan, args)
    notes = [*plan.warnings, *_world_warnings(plan)]
    print(f"{plan.source} is in order; it would open:")
    print("\n".join(f"  {line}" for line in [*listing(plan), *(f"note     {note}" for note in notes), *more]))
    return None


def check_everything(plan: Plan, args: argparse.Namespace) -> None:
    """Raise what opening the rig would raise, as far as it is known without a device or a process."""
    from hal import registry
    from hal.rig import check_opening
    from hal.views import Listen

    if args.listen is not None:
        Listen.parse(args.listen).check()
    console = args.console or args.listen is not None
    for robot in plan.robots:
        registry.load(robot.driver, "robot")
        if robot.gripper is not None:
            registry.load(robot.gripper.driver, "gripper")
    for camera in plan.cameras:
        registry.load(camera.driver, "camera")
    for chosen in check_opening(plan, args.pad, args.viewer, console):
        registry.load(chosen.spec.driver, "gamepad")(chosen.spec)  # checks its options; opens nothing


def _world_warnings(plan: Plan) -> list[str]:
    """Load the simulated world, which touches no device, and return its warnings.

    Raises:
        ConfigError: It cannot be loaded, or arms start inside each other.
    """
    from hal import registry

    if plan.world is None:
        return []
    world = registry.load(plan.world.driver, "world")(plan.world)
    try:
        return list(getattr(world, "warnings", ()))
    finally:
        world.close()
