"""The emulator as a program: ``hal emulate robotiq --config franka_robotiq``."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence

from hal_emulators.control import Started, help_text, run_emulator
from hal_emulators.shared_world import enter_world, has_world, load_real

from .server import COMMANDS, RobotiqEmulator, find_grippers

_WHAT = (
    "Emulates every Robotiq gripper of a rig, on a pseudo terminal with the name of its port, or on the text port of "
    "its host."
)


def main(arguments: Sequence[str] | None = None) -> int:
    return run_emulator("robotiq", _WHAT, help_text(COMMANDS), arguments, _start)


def _start(options: argparse.Namespace, stack: contextlib.ExitStack) -> Started:
    emulator = RobotiqEmulator(find_grippers(options.config, options.set), options.seed, realtime=True)
    if not options.no_world and has_world(options.config, options.set):
        for robot in load_real(options.config, options.set).robots:
            if robot.name in emulator.lines:
                emulator.lines[robot.name].gripper.in_world = True
                world = enter_world(stack, options.config, options.set, robot, role="fingers")
                emulator.worlds[robot.name] = world
    stack.enter_context(emulator)
    places = ", ".join(f"{arm} at {port.gripper.settings.place}" for arm, port in emulator.lines.items())
    return Started(emulator.execute, places)


if __name__ == "__main__":
    sys.exit(main())
