"""Find an object on the table and push it to a goal: in simulation and on the real arm, the same program.

hal push --sim --object cube --goal 0.5 0.0
hal push --real --config my_rig.yaml --by 0.1 0.0 --picture plan.png
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from hal.apps._common import program
from hal.apps._skills import SkillApp, add_skill_options, run_skill

if TYPE_CHECKING:
    from hal.skills import SkillResult

OPENING = 0.02
"""Distance between the fingers while they push, m."""


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal push",
        description="Find an object on the table and push it to a goal; what is left is corrected by further pushes.",
        epilog="Ctrl-C stops the arm. The exit status is 1 if the object is not at its goal in the end.",
    )
    group = add_skill_options(made)
    goal = group.add_mutually_exclusive_group(required=True)
    goal.add_argument(
        "--goal", nargs=2, type=float, metavar=("X", "Y"), help="goal of the object's middle, in the base frame, m"
    )
    goal.add_argument(
        "--by", nargs=2, type=float, metavar=("X", "Y"), help="way of the object, along the axes of the base frame, m"
    )
    group.add_argument("--tries", type=int, default=4, metavar="N", help="greatest number of pushes (%(default)s)")
    group.add_argument(
        "--tolerance", type=float, default=0.005, metavar="M", help="distance that will do, m (%(default)g)"
    )
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    return run_skill(args, f"push     {args.object or 'the largest object in sight'}", _push)


def _push(app: SkillApp) -> SkillResult | None:
    """Find the object and push it."""
    from hal.skills import push_path, push_to

    args = app.args
    found = app.find()
    if found is None:
        return None
    goal = args.goal or (found.pose.position[:2] + args.by).tolist()
    app.save_picture(found, push_path(found, goal), OPENING)
    return push_to(app.robot, app.find, goal, tolerance=args.tolerance, tries=args.tries, opening=OPENING, **app.motion)


if __name__ == "__main__":
    sys.exit(main())
