"""The emulator as a program: ``hal emulate xarm --help``."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence

from hal_emulators.control import help_text, make_parser
from hal_emulators.network_arm import run_program

from .controller import ROBOTS, Controller
from .server import COMMANDS, ORDERS, XArmServer

HOMES = {
    "xarm7": (0.0, -0.2, 0.0, 0.806, 0.0, 1.007, 0.0),
    "xarm6": (0.0, -0.3, -1.2, 0.0, 1.5, 0.0),
    "xarm5": (0.0, -0.3, -1.2, 1.5, 0.0),
    "lite6": (0.0, 0.3, 1.2, 0.0, 0.9, 0.0),
}


def main(arguments: Sequence[str] | None = None) -> int:
    what = "Emulates the control box of a UFACTORY arm for xarm-python-sdk."
    parser = make_parser("xarm", what, help_text(COMMANDS))
    parser.add_argument("--robot", choices=sorted(ROBOTS), default="xarm7", help="which arm (%(default)s)")
    parser.add_argument("--q", type=float, nargs="+", metavar="RAD", help="joint positions at the start")
    ports = f"commands {ORDERS}, reports 30001 to 30003"
    return run_program(parser, arguments, "xarm", _create, lambda _: ports)


def _create(options: argparse.Namespace) -> XArmServer:
    controller = Controller(options.robot, options.q or HOMES[options.robot])
    return XArmServer(options.host, controller, options.seed)


if __name__ == "__main__":
    sys.exit(main())
