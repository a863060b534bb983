"""Calibrate a camera with a printed board, its pose or its intrinsics; where a gripper is closed; or an arm.

hal calibrate board --out board.pdf
hal calibrate --sim --config panda_calibration --camera wrist --auto
hal calibrate --real --config my_rig.yaml --camera wrist --auto
hal calibrate intrinsics --real --config my_rig.yaml --camera scene
hal calibrate gripper --real --config my_rig.yaml
hal calibrate arm --real --config my_rig.yaml
"""

from __future__ import annotations

import argparse
import math
import sys
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import hal
from hal.apps._common import (
    ACTION_NEEDED,
    add_config_options,
    add_rig_options,
    check_everything,
    config_options,
    rig_options,
    run_app,
)
from hal.apps._display import banner, list_devices, list_links
from hal.apps._gripper_zero import find_zero, gripper_parser
from hal.apps.setup_motors import arm_parser, calibrate_arm
from hal.errors import CommandError

if TYPE_CHECKING:
    from hal.calibration import Board, Calibration, Collector, LensFit, LensViews, RigFileOutput
    from hal.camera import Camera
    from hal.geometry import Pose
    from hal.rig import Rig
    from hal.specs import CameraSpec

VIEWS = 20


def parser() -> argparse.ArgumentParser:
    """Return the parser of ``calibrate``."""
    made = argparse.ArgumentParser(
        prog="hal calibrate",
        description="Calibrate a camera on the hand or beside the arm, with a printed board.",
        epilog="To print the board: hal calibrate board --out board.pdf. Focal length and distortion of a "
        "webcam: hal calibrate intrinsics. Where a gripper is closed: hal calibrate gripper. Servos on a bus: hal "
        "calibrate arm. Ctrl-C stops the arm.",
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
    add_result_options(made)
    return made


def add_result_options(made: argparse.ArgumentParser) -> None:
    """Add the options of what is done with the result."""
    result = made.add_argument_group("result")
    result.add_argument("--compare", action="store_true", help="show the difference from the rig file; write nothing")
    result.add_argument("--out", metavar="FILE", help="write a copy of the rig file instead of changing it")
    result.add_argument("--yes", action="store_true", help="write without confirmation, unless the result is doubtful")


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


def intrinsics_parser() -> argparse.ArgumentParser:
    """Return the parser of ``calibrate intrinsics``."""
    made = argparse.ArgumentParser(
        prog="hal calibrate intrinsics",
        description="Measure focal length, principal point and lens distortion of a camera that does not report its "
        "own. Hold the board in front of it, tilted to all sides, near the corners of the image, near and far: a view "
        "is taken whenever it differs. No arm moves.",
        epilog="Ctrl-C ends, with the views taken so far.",
    )
    add_config_options(made)
    task = made.add_argument_group("task")
    task.add_argument("--camera", metavar="NAME", help="camera (default: the rig's only one)")
    task.add_argument("--views", type=int, default=VIEWS, metavar="N", help="how many (%(default)s)")
    add_board_options(task)
    add_result_options(made)
    return made


def main(argv: list[str] | None = None) -> int:
    """Run the program; return its exit status."""
    given = sys.argv[1:] if argv is None else argv
    if given[:1] == ["board"]:
        return run_app(_print_board, board_parser(), given[1:])
    if given[:1] == ["intrinsics"]:
        return run_app(_measure_lens, intrinsics_parser(), given[1:])
    if given[:1] == ["gripper"]:
        return run_app(find_zero, gripper_parser(), given[1:])
    if given[:1] == ["arm"]:
        return run_app(calibrate_arm, arm_parser(), given[1:])
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


def _measure_lens(args: argparse.Namespace) -> int:
    from hal import calibration, registry
    from hal.calibration.setup import choose_spec
    from hal.camera import Camera
    from hal.clock import RealClock
    from hal.config import load

    if args.views < calibration.LEAST_PICTURES:
        raise CommandError(f"--views must be at least {calibration.LEAST_PICTURES}, not {args.views}")
    plan = load(**config_options(args)).resolve()
    spec = choose_spec("camera", args.camera, {camera.name: camera for camera in plan.cameras})
    output = None if args.compare else calibration.RigFileOutput.of(plan.source, args.out, spec.name)
    if output is not None:
        size = f"width: {spec.capture_width}, height: {spec.capture_height}"
        output.check("intrinsics", f"{{{size}, fx: 1, fy: 1, cx: 0, cy: 0}}")
    driver = registry.load(spec.driver, "camera")
    if driver.simulated:
        raise CommandError(
            f"camera {spec.name} is simulated, and its intrinsics are exact; add --real", code="simulated"
        )
    views = calibration.LensViews(calibration.Detector(_board(args)))
    options = {name: value for name, value in spec.options.items() if name != "undistort"}
    raw = replace(spec, width=spec.capture_width, height=spec.capture_height, options=options)
    camera = Camera(driver(raw, RealClock()), RealClock(), threaded=True)
    try:
        camera.open()
        _take_pictures(camera, views, args.views)
    except (hal.ConnectionLost, hal.StaleStateError, KeyboardInterrupt) as end:
        print(f"ended: {str(end) or 'Ctrl-C'}. Continuing with {len(views)} views", flush=True)
    finally:
        camera.close()
    found = views.solve()
    print("\n".join(["", *lens_lines(spec, found)]))
    print("\n".join(f"WARNING: {text}" for text in found.doubts))
    return _write(args, output, plan.source, spec.name, ("intrinsics", found.entry()), found.doubts)


def lens_lines(old: CameraSpec, new: LensFit) -> list[str]:
    """Return the new intrinsics, and those that the rig file's captured images have now, for a terminal."""

    def numbers(K: Any, std: Any, distortion: Any) -> str:
        (fx, _, cx), (_, fy, cy), _ = K
        four = ", ".join(f"{value:.1f}{added}" for value, added in zip((fx, fy, cx, cy), std, strict=True))
        return f"fx, fy, cx, cy: {four} px; distortion: {', '.join(f'{value:.4f}' for value in distortion)}"

    K = old.sensors["color"].K if "color" in old.sensors else old.K
    return [
        f"{'rig file':12s}{numbers(K, [''] * 4, old.distortion)}",
        f"{'new':12s}{numbers(new.K, [f' +- {std:.1f}' for std in new.std], new.distortion)}",
        f"corners off by {new.error_px:.2f} px ({new.views} views)",
    ]


def _take_pictures(camera: Camera, views: LensViews, wanted: int) -> None:
    """Take frames until enough of them show the board differently."""
    from hal.calibration import NoView

    last = ""
    while len(views) < wanted:
        try:
            picture = camera.read(timeout=5.0).color
            if picture is None:
                raise CommandError(f"camera {camera.name} has no colour: add it to its streams", code="no_color")
            corners = views.add(picture)
            text = f"view {len(views)} of {wanted}: {corners} corners"
        except NoView as reason:
            text = str(reason)
        if text != last:
            print(f"  {text}", flush=True)
            last = text


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
    if output is not None:
        output.check(*setup.entry(hal.Pose()))
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
    return _write(args, output, plan.source, setup.camera, setup.entry(found.camera), found.doubts)


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


def _write(
    args: argparse.Namespace,
    output: RigFileOutput | None,
    source: str,
    camera: str,
    entry: tuple[str, str],
    doubts: tuple[str, ...],
) -> int:
    """Write the result to the rig's file after confirmation; raise CalibrationFailed for a doubtful one with --yes."""
    from hal.calibration import CalibrationFailed

    key, value = entry
    print(f"\ncameras.{camera} of {source if output is None else output.path}:\n  {key}: {value}", flush=True)
    if output is None:
        if not args.compare:
            print(f"not written: {source} is built in; --out my_rig.yaml writes a copy")
        return 0
    if args.yes and doubts:
        raise CalibrationFailed(
            f"not written: a doubtful result is not written with --yes, run without it to confirm: {'; '.join(doubts)}",
            code="not_confirmed",
        )
    if not args.yes:
        try:
            answer = input("Write it despite the warning? [y/N] " if doubts else "Write it? [y/N] ")
        except EOFError:
            answer = ""
        if not answer.strip().lower().startswith("y"):
            print("not written")
            return 0
    print("\n".join(output.write(key, value)))
    return 0


if __name__ == "__main__":
    sys.exit(main())
