"""The emulator as a program: ``hal emulate xarm --help``."""

from __future__ import annotations

import argparse
import contextlib
import gc
import sys
from collections.abc import Sequence

from hal.errors import HalError
from hal_emulators.control import CONTROL_PORT, EmulatorControl, note_signals, read_loopback, serve_prompt
from hal_emulators.shared_world import enter_world, find_arm

from .controller import ROBOTS, Controller
from .server import ORDERS, XArmServer, help_text

HOMES = {"xarm7": (0.0, -0.2, 0.0, 0.806, 0.0, 1.007, 0.0), "xarm6": (0.0, -0.3, -1.2, 0.0, 1.5, 0.0)}


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program, and return its exit status."""
    parser = argparse.ArgumentParser(
        prog="hal emulate xarm",
        description="Emulates the control box of a UFACTORY arm for xarm-python-sdk. What UFACTORY does not publish is "
        "assumed; it proves nothing about a real arm.",
        epilog="commands, typed here or sent to the control port:\n" + help_text(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add = parser.add_argument
    add("--robot", choices=sorted(ROBOTS), default="xarm7", help="which arm (%(default)s)")
    add(
        "--host",
        default="127.0.0.1",
        type=read_loopback,
        help="address to listen on; the ports are fixed (%(default)s)",
    )
    add("--q", type=float, nargs="+", metavar="RAD", help="joint positions at the start")
    add("--config", metavar="RIG", help="put the arm into the simulated world of this rig (a name, or a path)")
    add("--set", action="append", default=[], metavar="KEY=VALUE", help="change a value of the rig")
    add("--seed", type=int, default=0, help="seed of random losses (%(default)s)")
    options = parser.parse_args(arguments)
    try:
        with contextlib.ExitStack() as stack:
            _serve(options, stack)
    except PermissionError:
        print(
            f"error: port {ORDERS} of {options.host}: ports below 1024 are not allowed to you; allow them with "
            f"`sudo sysctl net.ipv4.ip_unprivileged_port_start={ORDERS}`",
            file=sys.stderr,
        )
        return 1
    except (HalError, OSError, ValueError) as error:
        text = f"{options.host}: {error.strerror}" if isinstance(error, OSError) and error.strerror else error
        print(f"error: {text}", file=sys.stderr)
        return 1
    return 0


def _serve(options: argparse.Namespace, stack: contextlib.ExitStack) -> None:
    ends = note_signals()
    server = XArmServer(options.host, Controller(options.robot, options.q or HOMES[options.robot]), options.seed)
    stack.callback(server.close)
    if options.config is not None:
        arm = find_arm(options.config, options.set, "xarm", options.host)
        server.world = enter_world(stack, options.config, options.set, arm)
    gc.freeze()
    print(
        f"ready: {options.robot} at {options.host}, commands {ORDERS}, reports 30001 to 30003, "
        f"control {options.host}:{CONTROL_PORT}",
        flush=True,
    )
    serve_prompt(stack.enter_context(EmulatorControl(options.host)).send)
    server.run(ends)


if __name__ == "__main__":
    sys.exit(main())
