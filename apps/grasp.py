"""Find an object on the table and grasp it: in simulation and on the real arm, the same program.

hal grasp --sim
hal grasp --sim --object duck --picture plan.png
hal grasp --real --config my_rig.yaml --gentle
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from hal.apps._common import program
from hal.apps._skills import SkillApp, add_skill_options, run_skill
from hal.errors import NotSupported

if TYPE_CHECKING:
    from hal.skills import SkillResult


def parser() -> argparse.ArgumentParser:
    """Return the parser of the command line."""
    made = argparse.ArgumentParser(
        prog="hal grasp",
        description="Find an object on the table, grasp it across its narrowest way, lift it and hold it.",
        epilog="Ctrl-C stops the arm; the fingers keep what they hold. The exit status is 1 if the grasp failed.",
    )
    group = add_skill_options(made)
    group.add_argument("--gentle", action="store_true", help="close until the first touch, centre the hand, then close")
    group.add_argument("--force", type=float, metavar="N", help="force to hold the object with (the gripper's)")
    group.add_argument("--lift", type=float, default=0.1, metavar="M", help="height to lift to, m (%(default)g)")
    group.add_argument("--hold", type=float, default=2.0, metavar="S", help="time to hold it up, s (%(default)g)")
    return made


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run the program; return the exit status."""
    how = "gently" if args.gentle else "firmly"
    return run_skill(args, f"grasp    {args.object or 'the largest object in sight'}, {how}", _grasp)


def _grasp(app: SkillApp) -> SkillResult | None:
    """Find the object and grasp it."""
    from hal.skills import gentle_grasp, grasp, grasp_pose

    arm, args = app.robot, app.args
    if arm.gripper is None:
        raise NotSupported(f"{arm.name} has no gripper", code="no_gripper")
    found = app.find()
    if found is None:
        return None
    pose = grasp_pose(found, arm.gripper)
    start = type(pose)(pose.position + [0.0, 0.0, 0.1], pose.orientation)
    app.save_picture(found, [start, pose], arm.gripper.width_max)
    options = {"force": args.force, "lift": args.lift, "hold": args.hold, **app.motion}
    if args.gentle:
        return gentle_grasp(arm, pose, found.width, **options)
    return grasp(arm, pose, width=found.width, **options)


if __name__ == "__main__":
    sys.exit(main())
