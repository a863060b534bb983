"""The emulator as a program: ``hal emulate ur --help``."""

from __future__ import annotations

import argparse
import contextlib
import gc
import sys
from collections.abc import Sequence

from hal.errors import HalError
from hal_emulators.control import CONTROL_PORT, EmulatorControl, note_signals, read_loopback, serve_prompt
from hal_emulators.shared_world import enter_world, find_arm

from .controller import Controller
from .motion import ROBOTS
from .server import DASHBOARD, RTDE, UrServer, help_text

HOME = (0.0, -1.669, 1.659, -1.56, -1.571, 0.0)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program, and return its exit status."""
    parser = argparse.ArgumentParser(
        prog="hal emulate ur",
        description="Emulates the controller of a Universal Robots arm for ur_rtde. What UR does not publish is "
        "assumed; it proves nothing about a real arm.",
        epilog="commands, typed here or sent to the control port:\n" + help_text(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--robot", choices=sorted(ROBOTS), default="ur5e", help="which arm; ur3, ur5, ur10 are CB3 (%(default)s)")
    add(
        "--host",
        default="127.0.0.1",
        type=read_loopback,
        help="address to listen on; the ports are fixed (%(default)s)",
    )
    add("--q", type=float, nargs=6, default=HOME, metavar="RAD", help="joint positions at the start")
    add("--payload", type=float, default=0.0, metavar="KG", help="payload of the installation")
    add(
        "--tcp",
        type=float,
        nargs=6,
        default=(0.0,) * 6,
        metavar="M",
        help="tcp of the installation: m, rotation vector",
    )
    add("--calibrated", action="store_true", help="lengths and angles off from the nominal ones, drawn by the seed")
    add(
        "--config",
        metavar="RIG",
        help="put the arm into the simulated world of this rig, whose objects its gripper meets (a name, or a path)",
    )
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="change a value of the rig")
    add("--seed", type=int, default=0, help="seed of random losses, and of a calibration (%(default)s)")
    options = parser.parse_args(arguments)
    try:
        with contextlib.ExitStack() as stack:
            _serve(options, stack)
    except (HalError, OSError, ValueError) as error:
        text = f"{options.host}: {error.strerror}" if isinstance(error, OSError) and error.strerror else error
        print(f"error: {text}", file=sys.stderr)
        return 1
    return 0


def _serve(options: argparse.Namespace, stack: contextlib.ExitStack) -> None:
    ends = note_signals()
    controller = Controller(options.robot, options.q, options.payload, options.tcp)
    if options.calibrated:
        controller.calibrate(options.seed)
    server = UrServer(options.host, controller, options.seed)
    stack.callback(server.close)
    if options.config is not None:
        arm = find_arm(options.config, options.set, "ur", options.host)
        server.world = enter_world(stack, options.config, options.set, arm)
    gc.freeze()
    print(
        f"ready: {options.robot} at {options.host}, RTDE {RTDE} ({controller.rate} Hz), dashboard {DASHBOARD}, "
        f"control {options.host}:{CONTROL_PORT}",
        flush=True,
    )
    serve_prompt(stack.enter_context(EmulatorControl(options.host)).send)
    server.run(ends)


if __name__ == "__main__":
    sys.exit(main())
