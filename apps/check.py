"""Look before a real arm moves: at this computer, at the arm, and at the network between them. Or at gamepads.

python apps/check.py --real --config my_rig.yaml
python apps/check.py --pads
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Iterable, Sequence
from dataclasses import asdict
from typing import TYPE_CHECKING

from hal.apps.cli import ACTION_NEEDED, add_config_options, run_app

if TYPE_CHECKING:
    from hal.preflight import CheckResult
    from hal.specs import Plan

__all__ = ["main", "may_open", "parser"]

BRIEFLY = 0.5
"""s of measuring before a program opens a rig."""
MEASURED = 2.0
"""s of measuring otherwise."""
_SHOWN = {"ok": "ok", "warn": "WARN", "fail": "FAIL", "unknown": "unknown"}
_INDENT = " " * 10


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="check",
        description="Look before a real arm moves: at this computer, at the arm, and at the network between them.",
        epilog="Nothing moves. The exit status is 2 when something fails, else 0.",
    )
    add_config_options(made)
    how_long = f"measure so long ({MEASURED:g}; --pads: until Ctrl-C)"
    made.add_argument("--duration", type=float, metavar="S", help=how_long)
    made.add_argument("--json", action="store_true", help="print the findings as one JSON object")
    made.add_argument(
        "--pads",
        action="store_true",
        help="instead, show every gamepad that is plugged in, what it says, and whether it may guard a real arm; with "
        "--config or --set, the pads of that rig. The exit status is 2 when there was none",
    )
    made.add_argument(
        "--cameras",
        action="store_true",
        help="instead, list the cameras that are plugged in, with their serial numbers. The exit status is 2 when "
        "there is none",
    )
    return made


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return run_app(_main, parser(), argv)


def _main(args: argparse.Namespace) -> int:
    from hal.config import load
    from hal.errors import CommandError
    from hal.preflight import checked_cameras, preflight, real_arms

    if args.pads:
        return _pads(args)
    if args.cameras:
        from hal.apps.check_cameras import show_cameras

        return 0 if show_cameras() else ACTION_NEEDED
    duration = MEASURED if args.duration is None else args.duration
    if not 0.0 < duration <= 60.0:
        raise CommandError(f"--duration must be above 0 and at most 60, not {duration:g}")
    plan = load(args.config, sim=args.sim, overrides=args.overrides).resolve()
    verdicts = preflight(plan, duration)
    if args.json:
        found = list(verdicts)
        print(json.dumps({"rig": plan.source, "fit": _fit(found), "verdicts": [asdict(v) for v in found]}, indent=2))
    else:
        found = _shown(verdicts)
        if not real_arms(plan) and not checked_cameras(plan):
            print(f"nothing in {plan.source} has a check of its own: only this computer was looked at")
    return 0 if _fit(found) else ACTION_NEEDED


def _pads(args: argparse.Namespace) -> int:
    from hal.apps.check_pads import show_pads
    from hal.config import load
    from hal.errors import CommandError

    if args.json:
        raise CommandError("--json is not for --pads, which goes on until Ctrl-C")
    if args.duration is not None and not args.duration > 0.0:
        raise CommandError(f"--duration must be positive, not {args.duration:g}")
    of_a_rig = args.overrides or args.config != parser().get_default("config")
    pads = load(args.config, sim=args.sim, overrides=args.overrides).resolve().pads if of_a_rig else ()
    return 0 if show_pads(pads, args.duration) else ACTION_NEEDED


def may_open(plan: Plan) -> bool:
    """The same, briefly and in print, for a program that is about to open a rig. True at once without a real arm."""
    from hal.preflight import preflight, real_arms

    arms = real_arms(plan)
    emulated = all(robot.emulated for robot in arms)  # a rehearsal does not depend on how fit this computer is
    return not arms or _fit(_shown(preflight(plan, BRIEFLY, machine=not emulated, cameras=False)))


def _fit(verdicts: Sequence[CheckResult]) -> bool:
    return all(verdict.level != "fail" for verdict in verdicts)


def _shown(verdicts: Iterable[CheckResult]) -> list[CheckResult]:
    """Print each as soon as it is known, and below it what to do, once where it is the same for several."""
    found = []
    remedies = set()
    for verdict in verdicts:
        found.append(verdict)
        print(f"{_SHOWN[verdict.level]:10s}{verdict.name:16s} {verdict.found}")
        if verdict.level != "ok" and verdict.remedy and verdict.remedy not in remedies:
            remedies.add(verdict.remedy)
            print(f"{_INDENT}-> {verdict.remedy}")
        sys.stdout.flush()
    return found


if __name__ == "__main__":
    sys.exit(main())
