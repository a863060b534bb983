"""The emulator as a program: ``hal emulate franka --help``."""

from __future__ import annotations

import argparse
import gc
import ipaddress
import sys
from contextlib import ExitStack
from typing import TYPE_CHECKING

from hal.config.data_files import find_data
from hal.drivers.franka.limits import LIMITS
from hal.errors import HalError
from hal_emulators.control import CONTROL_PORT, CommandPort, help_text, make_parser, note_signals, serve_prompt
from hal_emulators.shared_world import ArmInWorld, enter_world, find_arm

from .arm import EmulatedArm, RobotFiles
from .console import COMMANDS, Executor
from .hand import HandServer
from .journal import Journal
from .model_library import write_model_library
from .plant import IdealPlant, LaggingPlant, RigidBody, arm_only
from .protocol import PORT, PROTOCOLS
from .server import ArmServer, Pacing

if TYPE_CHECKING:
    from collections.abc import Sequence

_ROBOTS = {"fr3": ("FR3", "fr3", 10), "panda": ("Panda", "fer", 5)}
"""Choice -> name, key of its limits, protocol."""
_HOME = (0.0, -0.785398163, 0.0, -2.35619449, 0.0, 1.57079633, 0.785398163)


def main(arguments: Sequence[str] | None = None) -> int:
    options = _parser().parse_args(arguments)
    journal = Journal(options.quiet)
    ends = note_signals()
    try:
        with ExitStack() as stack:
            server, greeting = _prepare(options, stack, journal)
            gc.freeze()
            journal.print(greeting)
            server.run(ends)
    except (HalError, OSError, ValueError) as error:
        text = error.strerror if isinstance(error, OSError) and error.strerror else error
        print(f"error: {text}", file=sys.stderr)
        return 1
    journal.print("ended")
    return 0


def _prepare(options: argparse.Namespace, stack: ExitStack, journal: Journal) -> tuple[ArmServer, str]:
    """Return the server, ready to run, and the line that announces it. Raises OSError and ValueError."""
    title, model, version = _ROBOTS[options.robot]
    world = _enter_world(options, stack)
    urdf = find_data("robots", f"{options.robot}.urdf")
    bare = arm_only(urdf.read_text(encoding="utf-8"))
    files = RobotFiles(bare.encode(), write_model_library(bare) if version == 5 else b"")
    plant = (LaggingPlant if options.plant == "lag" else IdealPlant)(RigidBody(urdf), options.q)
    with_hand = options.end_effector == "hand"
    arm = EmulatedArm(PROTOCOLS[version], LIMITS[model], plant, journal, with_hand)
    pacing = Pacing(options.lockstep, not (options.lockstep and options.unpaced), options.patience)
    server = ArmServer(options.host, arm, files, pacing, options.seed)
    stack.callback(server.close)
    server.world = world
    hand = None if options.no_hand else HandServer(options.host, world=world)
    if hand is not None:
        hand.start()
        stack.callback(hand.stop)
    # Fault commands are accepted from this computer only.
    control_host = options.host if ipaddress.ip_address(options.host).is_loopback else "127.0.0.1"
    executor = Executor(server, hand)
    port = CommandPort(executor.execute_line, CONTROL_PORT, control_host)
    stack.callback(port.close)
    serve_prompt(executor.execute_line)
    hands = "no hand" if hand is None else f"hand {PORT + 1}"
    return server, (
        f"ready: {title} at {options.host}, arm {PORT}, {hands}, control {control_host}:{CONTROL_PORT}; "
        f"protocol {version}, {pacing.describe()}, plant {options.plant}"
    )


def _parser() -> argparse.ArgumentParser:
    what = (
        "Emulates a Franka arm and its hand for the vendor's own client libraries. Limits and timing are checked as "
        "documented."
    )
    parser = make_parser("franka", what, help_text(COMMANDS))
    add = parser.add_argument
    add("--robot", choices=sorted(_ROBOTS), default="fr3", help="which arm (%(default)s)")
    add("--host", default="127.0.0.2", type=_address, help="address to listen on; the ports are fixed (%(default)s)")
    add("--plant", choices=("ideal", "lag"), default="ideal", help="motion: exact, or 10 ms late (%(default)s)")
    add("--lockstep", action="store_true", help="during a motion, wait for the answer to each state")
    add(
        "--unpaced",
        action="store_true",
        help="with --lockstep: as fast as the client answers, for clients in simulated time",
    )
    add(
        "--patience",
        type=_positive,
        default=5.0,
        metavar="S",
        help="with --lockstep: longest wait for an answer, s (%(default)s)",
    )
    add("--q", type=float, nargs=7, default=_HOME, metavar="RAD", help="joint positions at the start (home)")
    add("--end-effector", choices=("hand", "none"), default="hand", help="tool on the flange (%(default)s)")
    add(
        "--config",
        metavar="RIG",
        help="put the arm into the simulated world of this rig, whose objects the fingers meet (a name, or a path)",
    )
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="change a value of the rig")
    add("--no-hand", action="store_true", help="serve the arm only")
    add("--seed", type=int, default=0, help="seed of random losses (%(default)s)")
    add("--quiet", action="store_true", help="print no events")
    return parser


def _enter_world(options: argparse.Namespace, stack: ExitStack) -> ArmInWorld | None:
    """Return the arm's place in the simulated world of the rig; None without a rig. Raises ValueError."""
    if options.config is None:
        return None
    if options.unpaced:
        raise ValueError("--config does not go with --unpaced: an app in simulated time has a world of its own")
    arm = find_arm(options.config, options.set, "franka", options.host)
    return enter_world(stack, options.config, options.set, arm)


def _address(text: str) -> str:
    return str(ipaddress.IPv4Address(text))


def _positive(text: str) -> float:
    value = float(text)
    if not 0.0 < value <= 3600.0:
        raise ValueError
    return value


if __name__ == "__main__":
    sys.exit(main())
