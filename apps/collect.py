"""Collect demonstrations: drive episode after episode into a dataset; simulated and real, the same program.

hal collect --sim --episodes 10 --task "lift the cube" --out data/lift
hal collect --real --config my_rig.yaml --episodes 10 --task "lift the cube" --out data/lift
"""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import hal
from hal.apps._common import (
    add_driving_options,
    add_recording_options,
    add_rig_options,
    add_stream_options,
    check_driving_options,
    check_report,
    load_named,
    program,
    resolve_plan,
    rig_options,
    select_robots,
    split_names,
)
from hal.apps._display import banner
from hal.errors import CommandError

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence

    from hal.robot import Robot

DEMO_MISPLACED = (
    "--pad demo reaches for the places that --seed 0 gives the cube in the first two episodes of a new folder; here "
    "the cube is elsewhere, so the gripper closes on air, and the episode is saved as a failure"
)

DEMO_DRIVES_HOME = (
    "--pad demo plays at fixed times, and this arm has to be driven home first: its first demonstration passes "
    "meanwhile, so one episode is recorded here, or none; to record more, drive from the page in the browser "
    "(--pad web)"
)


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``collect``."""
    made = argparse.ArgumentParser(
        prog="hal collect",
        description="Collect demonstrations: the scene is reset, you drive, and each episode is saved as a success or "
        "a failure, or discarded.",
        epilog="--pad demo plays two demonstrations for the places that --seed 0 gives the first two episodes of a new "
        "folder; one that does not lift the cube is saved as a failure. Ctrl-C stops the arm and ends the run; an "
        "episode that is being recorded is saved, unmarked. The exit status is 1 if fewer episodes than --episodes "
        "were saved, as successes or failures.",
    )
    add_rig_options(made)
    add_driving_options(made)
    what = made.add_argument_group("collecting")
    what.add_argument("--out", default="demonstrations", metavar="DIR", help="dataset to add to (%(default)s)")
    what.add_argument("--episodes", type=int, default=10, metavar="N", help="number of episodes (%(default)s)")
    add_recording_options(what)
    what.add_argument("--seed", type=int, default=0, metavar="N", help="object placement seed (%(default)s)")
    add_stream_options(what)
    what.add_argument("--no-depth", dest="depth", action="store_false", help="do not record depth")
    what.add_argument(
        "--success",
        metavar="MODULE:NAME",
        help="function of the rig and an observation that confirms a success; False saves the episode as a failure",
    )
    return made


def _check_options(args: argparse.Namespace) -> None:
    """Check the options that need no rig. Raises CommandError, ConfigError or DeviceNotFound."""
    check_driving_options(args)
    for name, least in (("episodes", 1), ("seed", 0), ("fps", 1)):
        if getattr(args, name) < least:
            raise CommandError(f"--{name} must be {least} or more, not {getattr(args, name)}")
    if Path(args.out).exists() and not Path(args.out).is_dir():
        raise CommandError(f"--out {args.out} is not a folder")
    check_report(args.report)


@program(parser)
def main(args: argparse.Namespace) -> int:
    """Run ``collect``; return the exit status."""
    from hal.apps._collecting import CollectRun, lifts_cube
    from hal.config.data_files import data_folder
    from hal.recording import Recorder, recover
    from hal.recording.layout import require_libraries

    _check_options(args)
    judge = load_named(args, "success")
    cameras = split_names(args.cameras)
    dataset = f"dataset  {args.out}: {args.episodes} episode(s) at {args.fps} rows/s"
    require_libraries()
    plan = resolve_plan(args, dataset, cameras=cameras or ())
    options = rig_options(args)
    demo = args.pad == "demo" or (args.pad == "auto" and plan.clock == "lock_step")  # the tour records nothing
    if demo:
        options["pad"] = str(data_folder("config") / "teleop" / "demonstrations.jsonl")
    with hal.open(**options) as rig:
        print(banner(rig), flush=True)
        robots = select_robots(rig, args)
        recovered = recover(args.out) if Path(args.out).is_dir() else []
        chosen = {"cameras": cameras, "streams": split_names(args.streams), "codec": args.codec}
        with Recorder(rig, args.out, args.fps, args.task, args.depth, **chosen) as recorder:
            notes = [*recovered, *recorder.notes]
            if demo:
                judge = judge or lifts_cube(rig, robots[0])
                notes += _list_demo_limits(robots, judged=judge is not None, fresh=not (args.seed or recorder.episodes))
            for note in notes:
                print(f"  note     {note}")
            return CollectRun(rig, robots, recorder, args, judge).run()


def _list_demo_limits(robots: Sequence[Robot], judged: bool, fresh: bool) -> Iterator[str]:
    """Yield what the recorded demonstrations cannot do in this run."""
    if not judged:
        yield f"--pad demo: whether {robots[0].name} lifts a cube is not checked; see --success"
    if any(robot.spec.attended for robot in robots):
        yield DEMO_DRIVES_HOME
    if not fresh:
        yield DEMO_MISPLACED


if __name__ == "__main__":
    sys.exit(main())
