"""The emulator as a program: ``hal emulate servo_bus --config so101``."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence

from hal_emulators.control import Started, help_text, run_emulator
from hal_emulators.shared_world import enter_world, has_world

from .server import COMMANDS, ServoBusEmulator, find_arms, find_leaders

_WHAT = (
    "Emulates every arm and leader with Feetech or Dynamixel servos of a rig, on a pseudo terminal with the name of "
    "its port, with mass, gravity and friction."
)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program, and return its exit status."""
    return run_emulator("servo_bus", _WHAT, help_text(COMMANDS), arguments, _start)


def _start(options: argparse.Namespace, stack: contextlib.ExitStack) -> Started:
    arms, leaders = find_arms(options.config, options.set), find_leaders(options.config, options.set)
    if not arms and not leaders:
        raise ValueError("this rig has no arm or leader with Feetech or Dynamixel servos that is not simulated")
    emulator = ServoBusEmulator([*arms, *leaders], options.seed, realtime=True)
    if not options.no_world and has_world(options.config, options.set):
        for spec in arms:
            emulator.arms[spec.name].world = enter_world(stack, options.config, options.set, spec)
    stack.enter_context(emulator)
    return Started(emulator.execute, ", ".join(f"{name} at {arm.port}" for name, arm in emulator.arms.items()))


if __name__ == "__main__":
    sys.exit(main())
