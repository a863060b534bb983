"""Where is my camera? On the hand or beside the arm, found out with a printed board.

python apps/calibrate.py board --out board.pdf
python apps/calibrate.py --sim --config panda_calibration --camera wrist --auto
python apps/calibrate.py --real --config my_rig.yaml --camera wrist --auto
"""

from __future__ import annotations

import argparse
import sys
from typing import TYPE_CHECKING

from hal.apps._common import ACTION_NEEDED, add_rig_options, rig_options, run_app

if TYPE_CHECKING:
    from hal.calibration import Board, Calibration
    from hal.calibration.collecting import Collector
    from hal.calibration.output import Output
    from hal.calibration.setting import Setting
    from hal.geometry import Pose
    from hal.rig import Rig

VIEWS = 20


def parser() -> argparse.ArgumentParser:
    """The command line."""
    made = argparse.ArgumentParser(
        prog="calibrate",
        description="Find out where a camera is, on the hand or beside the arm, with a printed board.",
        epilog="The board comes first: calibrate board --out board.pdf. Ctrl-C stops the arm.",
    )
    add_rig_options(made)
    what = made.add_argument_group("what")
    what.add_argument("--camera", metavar="NAME", help="which camera, where the rig has several")
    what.add_argument("--robot", metavar="NAME", help="which arm, where the rig has several")
    what.add_argument("--eye", choices=["in-hand", "to-hand"], help="camera on the arm, or beside it (as the rig says)")
    what.add_argument(
        "--link", metavar="LINK", help="what carries the camera or the board (as the rig says, or the tcp's)"
    )
    add_board_options(what)
    how = made.add_argument_group("how")
    mode = how.add_mutually_exclusive_group()
    mode.add_argument("--auto", action="store_true", help="the arm goes from view to view by itself")
    mode.add_argument("--record", action="store_true", help="a person does, with a pad or by guiding it (the default)")
    how.add_argument("--views", type=int, default=VIEWS, metavar="N", help="how many, with --auto (%(default)s)")
    how.add_argument("--unattended", action="store_true", help="with --auto: move a real arm without a dead-man")
    how.add_argument(
        "--guess", metavar="[x,y,z,qx,qy,qz,qw]", help="with --auto: where the camera is, roughly (as the rig says)"
    )
    how.add_argument("--mapping", default="default", metavar="FILE", help="what the pad's controls do (%(default)s)")
    result = made.add_argument_group("result")
    result.add_argument("--compare", action="store_true", help="only show how far off the rig's file is; write nothing")
    result.add_argument("--out", metavar="FILE", help="write the rig there instead of over its own file")
    result.add_argument("--yes", action="store_true", help="write without asking, unless the answer is doubtful")
    return made


def add_board_options(group: argparse._ActionsContainer) -> None:
    """Which board."""
    group.add_argument("--board", default="charuco_board", metavar="FILE", help="the board's file (%(default)s)")
    group.add_argument("--square", type=float, metavar="M", help="side of a square as measured on the paper, m")


def board_parser() -> argparse.ArgumentParser:
    """The command line of ``calibrate board``."""
    made = argparse.ArgumentParser(prog="calibrate board", description="Write a board to print, to scale.")
    add_board_options(made)
    made.add_argument("--out", required=True, metavar="FILE", help="a .pdf or a .png")
    return made


def main(argv: list[str] | None = None) -> int:
    """Entry point."""
    given = sys.argv[1:] if argv is None else argv
    if given[:1] == ["board"]:
        return run_app(_print_board, board_parser(), given[1:])
    return run_app(_main, parser(), given)


def _board(args: argparse.Namespace) -> Board:
    from hal.calibration import load_board

    board = load_board(args.board)
    return board if args.square is None else board.measured(args.square)


def _print_board(args: argparse.Namespace) -> int:
    from hal.calibration.printing import print_board

    board = _board(args)
    width, height = print_board(board, args.out)
    print(f"{args.out}: {board}, on {1e3 * width:.0f} x {1e3 * height:.0f} mm. Print it at 100 %, glue it to something")
    print("flat, measure a square with a calliper and say --square if it is not what was asked for.")
    return 0


def _main(args: argparse.Namespace) -> int:
    import hal
    from hal.apps._common import banner, check_everything, invitation, listing
    from hal.apps.check import may_open
    from hal.calibration import solve
    from hal.calibration.checks import LEAST_VIEWS
    from hal.calibration.collecting import Collector
    from hal.calibration.detection import Detector
    from hal.calibration.output import Output
    from hal.calibration.report import difference_lines, report_lines
    from hal.calibration.setting import guess_of, setting_of
    from hal.config import load
    from hal.config.mapping import load_mapping
    from hal.errors import CommandError
    from hal.pads.choice import check_wanted

    if args.views < LEAST_VIEWS:
        raise CommandError(f"--views must be at least {LEAST_VIEWS}, not {args.views}")
    load_mapping(args.mapping)
    check_wanted(args.pad)
    config = load(args.config, sim=args.sim, overrides=args.overrides)
    plan = config.resolve()
    setting = setting_of(config, plan, args.camera, args.robot, args.eye, args.link)
    guess = guess_of(setting, args.guess) if args.auto else None
    board = _board(args)
    output = None if args.compare else Output.of(plan.source, args.out, setting.camera)
    where = f"on {setting.link_name} of" if setting.eye == "in-hand" else "beside"
    task = f"task     camera {setting.camera} {where} {setting.robot}; board of {board}"
    if args.dry_run:
        check_everything(plan, args)
        print(f"{plan.source} is in order; it would open:")
        print("\n".join(f"  {line}" for line in [*listing(plan), *plan.warnings, task]))
        return 0
    if not may_open(plan):
        return ACTION_NEEDED
    with hal.open(**rig_options(args)) as rig:
        print(f"{banner(rig)}\n  {task}\n{invitation(rig)}", flush=True)
        collector = Collector(rig, setting, Detector(board))
        try:
            _collect(args, rig, collector, guess)
        except (hal.MotionStopped, hal.RobotFault, hal.ConnectionLost, hal.StaleStateError, KeyboardInterrupt) as end:
            print(f"ended: {str(end) or 'Ctrl-C'}. Going on with {len(collector.views)} views", flush=True)
    found = solve(collector.views, setting.eye)
    print("\n".join(["", *report_lines(found), "", *difference_lines(setting.known, found.camera, setting.frame)]))
    if output is None:
        print("" if args.compare else f"not written: {plan.source} comes with the hal; --out my_rig.yaml writes a copy")
        return 0
    return _write(args, output, setting, found)


def _collect(args: argparse.Namespace, rig: Rig, collector: Collector, guess: Pose | None) -> None:
    """Views, by the arm itself or by a person."""
    import hal
    from hal.calibration.byhand import PadDriver, enter
    from hal.calibration.recording import drive, take_and_tell

    def say(text: str) -> None:
        print(f"  {text}", flush=True)
        rig.say(text)

    pad = next(iter(rig.gamepads.values()), None)
    teleop = hal.Teleop(collector.robot, mapping=args.mapping)
    if guess is not None:
        deadman = None if pad is None or args.unattended else pad.hold(teleop.mapping.deadman)
        if deadman is not None:
            print(f"  hold {teleop.mapping.deadman}: the arm moves only while it is held", flush=True)
        drive(collector, guess, args.views, say, deadman=deadman, unattended=args.unattended)
        return
    wait = enter
    if pad is not None:
        driver = PadDriver(rig, collector.robot, pad, teleop, say)
        print("\n".join(f"  {line}" for line in driver.help()), flush=True)
        wait = driver.wait
    while wait():
        take_and_tell(collector, say)


def _write(args: argparse.Namespace, output: Output, setting: Setting, found: Calibration) -> int:
    """Into the rig's file, if that is wanted. Raises CalibrationFailed for a doubtful answer and nobody to ask."""
    from hal.calibration import CalibrationFailed

    key, value = setting.entry(found.camera)
    print(f"\ncameras.{setting.camera} of {output.path}:\n  {key}: {value}", flush=True)
    if args.yes and found.doubtful:
        why = "; ".join(found.doubtful)
        raise CalibrationFailed(f"not written, for --yes writes no doubtful answer (without it you are asked): {why}")
    if not args.yes:
        try:
            answer = input("Write it all the same? [y/N] " if found.doubtful else "Write it? [y/N] ")
        except EOFError:
            answer = ""
        if not answer.strip().lower().startswith("y"):
            print("not written")
            return 0
    print("\n".join(output.write(key, value)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
