"""Collect demonstrations: a person drives, and what happens becomes a dataset; simulated and real, the same program.

python apps/collect.py --sim --episodes 10 --task "lift the cube" --out data/lift
python apps/collect.py --real --config my_rig.yaml --episodes 10 --task "lift the cube" --out data/lift
"""

from __future__ import annotations

import argparse
import os
import sys
from pathlib import Path

from hal.apps._common import ACTION_NEEDED, add_driving_options, add_rig_options, rig_options, run_app

NOT_THERE = (
    "--pad demo reaches to where --seed 0 puts the cube in the first two episodes of a new folder; here it lies "
    "elsewhere, the hand grasps air, and what it does not lift is saved as a failure"
)


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="collect",
        description="Collect demonstrations: everything goes back to where it starts, you drive, and each episode is "
        "saved, marked as a success or a failure, or forgotten.",
        epilog="--pad demo plays two demonstrations, made for the places that --seed 0 gives the first two episodes of "
        "a new folder; one that does not lift the cube is saved as a failure. Ctrl-C stops the arm and ends the run; "
        "an episode that is being recorded is kept, unmarked. The exit status is 1 when fewer episodes were saved than "
        "asked for; one that is marked a failure counts as saved.",
    )
    add_rig_options(made)
    add_driving_options(made)
    what = made.add_argument_group("collecting")
    what.add_argument("--out", default="demonstrations", metavar="DIR", help="dataset that they go into (%(default)s)")
    what.add_argument("--episodes", type=int, default=10, metavar="N", help="how many (%(default)s)")
    what.add_argument("--task", default="", metavar="TEXT", help="what is to be done; kept with each episode")
    what.add_argument("--fps", type=int, default=30, metavar="N", help="rows a second (%(default)s)")
    what.add_argument("--seed", type=int, default=0, metavar="N", help="of where objects start (%(default)s)")
    what.add_argument("--cameras", metavar="NAMES", help="those that are kept, separated by commas (all)")
    what.add_argument(
        "--streams",
        default="color,depth",
        metavar="NAMES",
        help="of each camera: color, depth, infrared, infrared_right, segmentation (%(default)s)",
    )
    what.add_argument("--no-depth", dest="depth", action="store_false", help="leave depth out")
    what.add_argument("--codec", choices=["auto", "h264", "av1"], default="auto", help="of the videos (%(default)s)")
    what.add_argument(
        "--success",
        metavar="MODULE:NAME",
        help="called with the rig and an observation when an episode is saved as a success; False: it is a failure",
    )
    what.add_argument("--report", metavar="FILE", help="write how it went, as JSON")
    return made


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    return run_app(_main, parser(), argv)


def _main(args: argparse.Namespace) -> int:
    import hal
    from hal.apps._common import banner, check_writable, planned
    from hal.apps.check import may_open
    from hal.apps.collecting import DemonstrationSession, lifts_cube
    from hal.apps.driving import check_driving, chosen_devices
    from hal.config.data_files import data_folder
    from hal.errors import CommandError
    from hal.learning.policy import found
    from hal.recording import Recorder, recover
    from hal.recording.layout import require

    check_driving(args)
    if args.episodes < 1:
        raise CommandError(f"--episodes must be 1 or more, not {args.episodes}")
    if args.seed < 0:
        raise CommandError(f"--seed must be 0 or more, not {args.seed}")
    if args.fps < 1:
        raise CommandError(f"--fps must be 1 or more, not {args.fps}")
    if args.pad == "none":
        raise CommandError("--pad none: this program needs something that drives")
    if Path(args.out).exists() and not Path(args.out).is_dir():
        raise CommandError(f"--out {args.out} is no folder")
    if args.report:
        check_writable(args.report)
    if os.getcwd() not in sys.path:
        sys.path.insert(0, os.getcwd())
    judge = found(args.success, "--success") if args.success else None
    cameras = None if args.cameras is None else [name.strip() for name in args.cameras.split(",") if name.strip()]
    what = f"dataset  {args.out}: {args.episodes} episode(s) at {args.fps} rows/s"
    plan = planned(args, what, cameras=cameras or ())
    require()
    if plan is None:
        return 0
    if not may_open(plan):
        return ACTION_NEEDED
    options = rig_options(args)
    demo = args.pad == "demo" or (args.pad == "auto" and plan.clock == "lock_step")  # the tour presses no Cross
    if demo:
        options["pad"] = str(data_folder("config") / "teleop" / "demonstrations.jsonl")
    with hal.open(**options) as rig:
        print(banner(rig), flush=True)
        robot, pad = chosen_devices(rig, args)
        recovered = recover(args.out) if Path(args.out).is_dir() else []
        streams = [name.strip() for name in args.streams.split(",")]
        with Recorder(
            rig, args.out, args.fps, args.task, args.depth, cameras=cameras, streams=streams, codec=args.codec
        ) as recorder:
            notes = [*recovered, *recorder.notes]
            if demo:
                judge = judge or lifts_cube(rig, robot)
                if judge is None:
                    notes.append(f"--pad demo: nothing says whether {robot.name} lifts a cube; see --success")
                if args.seed or recorder.episodes:
                    notes.append(NOT_THERE)
            for note in notes:
                print(f"  note     {note}")
            return DemonstrationSession(rig, robot, pad, recorder, args, judge).run()


if __name__ == "__main__":
    sys.exit(main())
