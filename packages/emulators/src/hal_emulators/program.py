"""The program ``hal emulate``: everything that a rig names as real, or one kind of device.

hal emulate --config franka_emulator
hal emulate franka --robot fr3
hal emulate ur --robot ur5e
hal emulate xarm --robot xarm7
hal emulate can --config yam_emulator
hal emulate servo_bus --config so101
hal emulate robotiq --config franka_robotiq
"""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from importlib import import_module

from hal.errors import HalError

DEVICES = {
    "can": "every arm on a CAN bus of a rig",
    "franka": "a Franka arm and its hand",
    "ur": "a UR arm",
    "xarm": "a UFACTORY xArm",
    "servo_bus": "every arm and leader with Feetech or Dynamixel servos of a rig",
    "robotiq": "every Robotiq gripper of a rig",
}


def parser() -> argparse.ArgumentParser:
    devices = "\n".join(f"  {name:9s} {what}" for name, what in DEVICES.items())
    made = argparse.ArgumentParser(
        prog="hal emulate",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description="Play devices for their real drivers, over the network or a bus of this computer: with --config "
        f"all that a rig names as real, or one kind:\n\n{devices}\n\n"
        "A RealSense has no program: `real: {emulated: true}` in the rig's file.",
        epilog="hal emulate DEVICE --help shows a device's own options and the faults that it takes.",
    )
    made.add_argument("--config", metavar="RIG", help="the rig whose devices to play: a name in config/, or a path")
    made.add_argument("--set", action="append", default=[], metavar="KEY=VALUE", help="change a value of the rig")
    made.add_argument("device", nargs="?", choices=DEVICES, metavar="DEVICE", help=", ".join(DEVICES))
    made.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...", help="the device's options")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; return the exit status."""
    args = parser().parse_args(argv)
    if args.device is None and args.config is None:
        parser().error("name a DEVICE, or --config RIG for all that a rig names as real")
    if args.device is None:
        from .lab import run_lab

        try:
            return run_lab(args.config, args.set)
        except (HalError, ValueError) as error:
            print(f"error: {error}", file=sys.stderr)
            return 1
    return int(import_module(f"hal_emulators.{args.device}.__main__").main(args.arguments))
