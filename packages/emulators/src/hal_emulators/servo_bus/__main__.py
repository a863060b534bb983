"""The emulator as a program: ``hal emulate servo_bus --config so101``."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Sequence

from hal.errors import HalError
from hal_emulators.control import CommandPort, add_rig_options, note_signals, serve_prompt
from hal_emulators.shared_world import enter_world, has_world

from .server import ServoBusEmulator, find_arms, find_leaders, help_text


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program, and return its exit status."""
    parser = argparse.ArgumentParser(
        prog="hal emulate servo_bus",
        description="Emulates every arm and leader with Feetech or Dynamixel servos of a rig, on a pseudo terminal "
        "with the name of its port, with mass, gravity and friction. What the manuals leave open is assumed; it proves "
        "nothing about a real arm.",
        epilog="commands, typed here or sent to the control port; with several arms, the arm's name first:\n"
        + help_text(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_rig_options(parser)
    options = parser.parse_args(arguments)
    ends = note_signals()
    try:
        with contextlib.ExitStack() as stack:
            arms, leaders = find_arms(options.config, options.set), find_leaders(options.config, options.set)
            if not arms and not leaders:
                raise ValueError("this rig has no arm or leader with Feetech or Dynamixel servos that is not simulated")
            emulator = ServoBusEmulator([*arms, *leaders], options.seed, realtime=True)
            if not options.no_world and has_world(options.config, options.set):
                for spec in arms:
                    emulator.arms[spec.name].world = enter_world(stack, options.config, options.set, spec)
            stack.enter_context(emulator)
            control = CommandPort(emulator.execute, options.port)
            places = ", ".join(f"{name} at {arm.port}" for name, arm in emulator.arms.items())
            print(f"ready: {places}; control port {control.number}; help lists the commands", flush=True)
            serve_prompt(emulator.execute)
            while not ends:
                time.sleep(0.1)
            control.close()
    except (HalError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


if __name__ == "__main__":
    sys.exit(main())
