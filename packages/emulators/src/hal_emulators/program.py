"""The program ``hal emulate``: a Franka arm with its hand, or every arm on a CAN bus or Robotiq gripper of a rig.

hal emulate franka --robot fr3
hal emulate can --config yam_emulator
hal emulate robotiq --config franka_robotiq
"""

from __future__ import annotations

import argparse
from collections.abc import Sequence
from importlib import import_module

__all__ = ["main", "parser"]

DEVICES = {
    "can": "every arm on a CAN bus of a rig",
    "franka": "a Franka arm and its hand",
    "robotiq": "every Robotiq gripper of a rig",
}


def parser() -> argparse.ArgumentParser:
    """Return the command line."""
    devices = "\n".join(f"  {name:8s} {what}" for name, what in DEVICES.items())
    made = argparse.ArgumentParser(
        prog="hal emulate",
        formatter_class=argparse.RawDescriptionHelpFormatter,
        description=f"Play a device for its real driver, over the network or a bus of this computer.\n\n{devices}\n\n"
        "A RealSense has no program: `real: {emulated: true}` in the rig's file.",
        epilog="hal emulate DEVICE --help shows a device's own options and the faults that it takes.",
    )
    made.add_argument("device", choices=DEVICES, metavar="DEVICE", help=", ".join(DEVICES))
    made.add_argument("arguments", nargs=argparse.REMAINDER, metavar="...", help="the device's options")
    return made


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; return the exit status."""
    args = parser().parse_args(argv)
    return int(import_module(f"hal_emulators.{args.device}.__main__").main(args.arguments))
