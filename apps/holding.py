"""Who must hold a dead-man, in programs that move an arm by themselves."""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from hal.config.mapping import TeleopMapping
    from hal.deadman import Deadman
    from hal.rig import Rig
    from hal.specs import Plan

__all__ = ["held_by", "needs_holding"]


def needs_holding(plan: Plan, args: argparse.Namespace) -> bool:
    """Must somebody hold a dead-man? Where something really moves, unless ``--unattended``; else with ``--deadman``."""
    return bool(args.deadman) or (any(robot.attended for robot in plan.robots) and not args.unattended)


def held_by(rig: Rig) -> tuple[Deadman, TeleopMapping]:
    """The dead-man of the rig's pad, and what the pad's controls are. CommandError where there is no pad."""
    from hal.config.mapping import load_mapping
    from hal.errors import CommandError

    pad = next(iter(rig.gamepads.values()), None)
    if pad is None:
        raise CommandError(f"{rig.plan.source}: no pad is open that could be the dead-man; see --pad, --unattended")
    mapping = load_mapping(pad.mapping or "default")
    return pad.hold(mapping.deadman), mapping
