"""Calibrate a camera on the hand or beside the arm, with a printed board; or find where a gripper is closed.

hal calibrate board --out board.pdf
hal calibrate --sim --config panda_calibration --camera wrist --auto
hal calibrate --real --config my_rig.yaml --camera wrist --auto
hal calibrate gripper --real --config my_rig.yaml
"""

from __future__ import annotations

import argparse
import math
import sys
from typing import TYPE_CHECKING

import hal
from hal.apps._common import ACTION_NEEDED, add_rig_options, check_everything, config_options, rig_options, run_app
from hal.apps._display import banner, list_devices, list_links
from hal.apps._gripper_zero import find_zero, gripper_parser
from hal.errors import CommandError

if TYPE_CHECKING:
    from hal.calibration import Board, Calibration, CalibrationSetup, Collector, RigFileOutput
    from hal.geometry import Pose
    from hal.rig import Rig

VIEWS = 20


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``calibrate``."""
    made = argparse.ArgumentParser(
        prog="hal calibrate",
        description="Calibrate a camera on the hand or beside the arm, with a printed board.",
        epilog="To print the board: hal calibrate board --out board.pdf. To find where a gripper is closed: "
        "hal calibrate gripper. Ctrl-C stops the arm.",
    )
    add_rig_options(made)
    task = made.add_argument_group("task")
    task.add_argument("--camera", metavar="NAME", help="camera (default: the rig's only one)")
    task.add_argument("--robot", metavar="NAME", help="arm (default: the one that carries the camera, or the only one)")
    task.add_argument(
        "--eye", choices=["in-hand", "to-hand"], help="camera on the arm, or beside it (default: from the rig file)"
    )
    task.add_argument(
        "--link", metavar="LINK", help="link that carries the camera or the board (default: from the rig file, or tcp)"
    )
    add_board_options(task)
    views = made.add_argument_group("views")
    mode = views.add_mutually_exclusive_group()
    mode.add_argument("--auto", action="store_true", help="the arm moves from view to view by itself")
    mode.add_argument("--record", action="store_true", help="drive it with a gamepad or guide it by hand (default)")
    views.add_argument("--views", type=int, default=VIEWS, metavar="N", help="with --auto: how many (%(default)s)")
    views.add_argument(
        "--unattended", action="store_true", help="with --auto: move a real arm without a dead-man control"
    )
    views.add_argument(
        "--guess",
        metavar="[x,y,z,qx,qy,qz,qw]",
        help="with --auto: approximate pose of the camera (default: from the rig file)",
    )
    views.add_argument("--mapping", metavar="FILE", help="gamepad mapping (default: the pad's own)")
    result = made.add_argument_group("result")
    result.add_argument("--compare", action="store_true", help="show the difference from the rig file; write nothing")
    result.add_argument("--out", metavar="FILE", help="write a copy of the rig file instead of changing it")
    result.add_argument("--yes", action="store_true", help="write without confirmation, unless the result is doubtful")
    return made


def add_board_options(group: argparse._ActionsContainer) -> None:
    """Add the options that choose a board."""
    group.add_argument("--board", default="charuco_board", metavar="FILE", help="board file (%(default)s)")
    group.add_argument("--square", type=float, metavar="M", help="side of a printed square as measured, m")


def board_parser() -> argparse.ArgumentParser:
    """Return the parser of ``calibrate board``."""
    made = argparse.ArgumentParser(prog="hal calibrate board", description="Write a page with the board, to scale.")
    add_board_options(made)
    made.add_argument("--out", required=True, metavar="FILE", help=".pdf or .png to write")
    return made


def main(argv: list[str] | None = None) -> int:
    """Run the program; return its exit status."""
    given = sys.argv[1:] if argv is None else argv
    if given[:1] == ["board"]:
        return run_app(_print_board, board_parser(), given[1:])
    if given[:1] == ["gripper"]:
        return run_app(find_zero, gripper_parser(), given[1:])
    return run_app(_main, parser(), given)


def _board(args: argparse.Namespace) -> Board:
    from hal.calibration import load_board

    board = load_board(args.board)
    return board if args.square is None else board.resize(args.square)


def _print_board(args: argparse.Namespace) -> int:
    from hal.calibration import print_board

    board = _board(args)
    width, height = print_board(board, args.out)
    print(f"{args.out}: {board}, on {1e3 * width:.0f} x {1e3 * height:.0f} mm. Print at 100 %, glue onto a flat plate,")
    print("and measure a square with a calliper; if it differs, add --square when calibrating.")
    return 0


def _main(args: argparse.Namespace) -> int:
    from hal import calibration
    from hal.apps.check import may_open
    from hal.config import load
    from hal.config.mapping import load_mapping
    from hal.pads.choice import check_wanted

    if args.views < calibration.LEAST_VIEWS:
        raise CommandError(f"--views must be at least {calibration.LEAST_VIEWS}, not {args.views}")
    load_mapping(args.mapping or "default")
    check_wanted(args.pad)
    config = load(**config_options(args))
    plan = config.resolve()
    setup = calibration.find_setup(config, plan, args.camera, args.robot, args.eye, args.link)
    guess = calibration.initial_guess(setup, args.guess) if args.auto else None
    board = _board(args)
    output = None if args.compare else calibration.RigFileOutput.of(plan.source, args.out, setup.camera)
    where = f"on {setup.link_name} of" if setup.eye == "in-hand" else "beside"
    task = f"task     camera {setup.camera} {where} {setup.robot}; board of {board}"
    if args.dry_run:
        check_everything(plan, args)
        print(f"{plan.source} is valid; it would open:")
        print("\n".join(f"  {line}" for line in [*list_devices(plan), *plan.warnings, task]))
        return 0
    if not may_open(plan):
        return ACTION_NEEDED
    with hal.open(**rig_options(args)) as rig:
        print(f"{banner(rig)}\n  {task}\n{list_links(rig)}", flush=True)
        collector = calibration.Collector(rig, setup, calibration.Detector(board))
        try:
            _collect(args, rig, collector, guess)
        except (hal.MotionStopped, hal.RobotFault, hal.ConnectionLost, hal.StaleStateError, KeyboardInterrupt) as end:
            print(f"ended: {str(end) or 'Ctrl-C'}. Continuing with {len(collector.views)} views", flush=True)
    found = calibration.solve(collector.views, setup.eye)
    print("\n".join(["", *report_lines(found), "", *difference_lines(setup.known, found.camera, setup.frame)]))
    if output is None:
        print("" if args.compare else f"not written: {plan.source} is built in; --out my_rig.yaml writes a copy")
        return 0
    return _write(args, output, setup, found)


def _collect(args: argparse.Namespace, rig: Rig, collector: Collector, guess: Pose | None) -> None:
    """Take the views: automatically with a guess, else by hand."""
    from hal.calibration import ManualDrive, add_view, collect_views, wait_for_enter

    def report(text: str) -> None:
        print(f"  {text}", flush=True)
        rig.say(text)

    pad = next(iter(rig.gamepads.values()), None)
    own = pad.mapping if pad is not None else None
    teleop = hal.Teleop(collector.robot, mapping=args.mapping or own or "default")
    if guess is not None:
        deadman = None
        if pad is not None and not args.unattended:
            control = teleop.mapping.deadman
            deadman = pad.hold(control)
            print(f"  hold {pad.control_name(control)}: the arm moves only while it is held", flush=True)
        collect_views(collector, guess, args.views, report, deadman=deadman, unattended=args.unattended)
        return
    wait = wait_for_enter
    if pad is not None:
        driver = ManualDrive(rig, collector.robot, pad, teleop, report)
        print("\n".join(f"  {line}" for line in driver.help()), flush=True)
        wait = driver.wait
    while wait():
        add_view(collector, report)


def report_lines(found: Calibration) -> list[str]:
    """Return a table for a terminal: the residuals of every view, their rms, the uncertainty and the warnings."""
    lines = ["view            corners     board differs       without it, the result moves"]
    for one in found.residuals:
        influence = ""
        if one.influence is not None:
            influence = f"{1e3 * one.influence[0]:6.2f} mm {math.degrees(one.influence[1]):6.3f} deg"
        off = f"{one.px:6.2f} px {1e3 * one.distance:7.2f} mm {math.degrees(one.angle):6.3f} deg"
        lines.append(f"{one.name:14s}{off}   {influence if one.used else 'left out'}")
    px, distance, angle = found.rms()
    lines.append(f"{'rms':14s}{px:6.2f} px {1e3 * distance:7.2f} mm {math.degrees(angle):6.3f} deg")
    std = found.uncertainty
    lines.append(
        f"standard deviation of the camera's pose: {1e3 * std.position:.2f} mm and {math.degrees(std.rotation):.3f} "
        f"degrees ({len(found.used)} views)"
    )
    return [*lines, *(f"WARNING: {text}" for text in found.warnings)]


def difference_lines(old: Pose | None, new: Pose, frame: str) -> list[str]:
    """Return the new pose, and its difference from the one in the rig's file if there is one, for a terminal."""

    def numbers(pose: Pose) -> str:
        position = " ".join(f"{1e3 * value:9.2f}" for value in pose.position)
        return f"{position} mm  {' '.join(f'{value:9.5f}' for value in pose.orientation)}"

    lines = [f"{'new':12s}{numbers(new)}   in {frame}"]
    if old is not None:
        distance, angle = old.distance(new)
        lines.insert(0, f"{'rig file':12s}{numbers(old)}")
        lines.append(f"{'difference':12s}{1e3 * distance:.2f} mm and {math.degrees(angle):.3f} degrees")
    return lines


def _write(args: argparse.Namespace, output: RigFileOutput, setup: CalibrationSetup, found: Calibration) -> int:
    """Write the result to the rig's file after confirmation; raise CalibrationFailed for a doubtful one with --yes."""
    from hal.calibration import CalibrationFailed

    key, value = setup.entry(found.camera)
    print(f"\ncameras.{setup.camera} of {output.path}:\n  {key}: {value}", flush=True)
    if args.yes and found.doubts:
        raise CalibrationFailed(
            f"not written: a doubtful result is not written with --yes, run without it to confirm: "
            f"{'; '.join(found.doubts)}",
            code="not_confirmed",
        )
    if not args.yes:
        try:
            answer = input("Write it despite the warning? [y/N] " if found.doubts else "Write it? [y/N] ")
        except EOFError:
            answer = ""
        if not answer.strip().lower().startswith("y"):
            print("not written")
            return 0
    print("\n".join(output.write(key, value)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
