"""The emulator as a program: ``hal emulate ur --help``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from hal_emulators.control import help_text, make_parser
from hal_emulators.network_arm import run_program

from .controller import Controller
from .motion import ROBOTS
from .server import COMMANDS, DASHBOARD, RTDE, UrServer

HOME = (0.0, -1.669, 1.659, -1.56, -1.571, 0.0)


def main(arguments: Sequence[str] | None = None) -> int:
    what = "Emulates the controller of a Universal Robots arm for ur_rtde."
    parser = make_parser("ur", what, help_text(COMMANDS))
    add = parser.add_argument
    add("--robot", choices=sorted(ROBOTS), default="ur5e", help="which arm; ur3, ur5, ur10 are CB3 (%(default)s)")
    add("--q", type=float, nargs=6, default=HOME, metavar="RAD", help="joint positions at the start")
    add("--calibrated", action="store_true", help="lengths and angles off from the nominal ones, drawn by the seed")
    ports = f"RTDE {RTDE}, dashboard {DASHBOARD}"
    return run_program(parser, arguments, "ur", _create, lambda arm: f"{1.0 / arm.controller.dt:g} Hz, {ports}")


def _create(options: argparse.Namespace) -> UrServer:
    controller = Controller(options.robot, options.q)
    if options.calibrated:
        controller.calibrate(options.seed)
    return UrServer(options.host, controller, options.seed)


if __name__ == "__main__":
    sys.exit(main())
