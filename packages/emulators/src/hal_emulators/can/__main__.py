"""The emulator as a program: ``hal emulate can --config yam_emulator``."""

from __future__ import annotations

import argparse
import contextlib
import sys
import time
from collections.abc import Sequence

try:
    import can
except ModuleNotFoundError:
    sys.exit("error: python-can is not installed: pip install 'robot-hal[can]'")

from hal.errors import ControlTaken, HalError
from hal.lock import DeviceLock
from hal_emulators.control import CommandPort, add_rig_options, note_signals, serve_prompt
from hal_emulators.shared_world import has_world, run_world

from .console import help_text
from .server import CanEmulator

_PATIENCE = 1.0
"""s for which an emulator waits for one that is ending."""
_locks: list[DeviceLock] = []
"""On the buses of this program, until it ends."""


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the program, and return its exit status."""
    parser = argparse.ArgumentParser(
        prog="hal emulate can",
        description="Emulates every arm on a CAN bus in a rig: Damiao motors or a PiPER, with mass, gravity and "
        "friction. What the manuals leave open is assumed; it proves nothing about a real arm.",
        epilog="commands, typed here or sent to the control port; with several arms, the arm's name first:\n"
        + help_text(),
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_rig_options(parser)
    options = parser.parse_args(arguments)
    ends = note_signals()
    try:
        _run(options, ends)
    except (HalError, can.CanError, OSError, ValueError) as error:
        print(f"error: {error}", file=sys.stderr)
        return 1
    return 0


def _run(options: argparse.Namespace, ends: list[int]) -> None:
    with contextlib.ExitStack() as stack:
        in_world = not options.no_world and has_world(options.config, options.set)
        if in_world:
            stack.enter_context(run_world(options.config, options.set))
        built = CanEmulator(options.config, options.set, options.seed, realtime=True, in_world=in_world)
        _lock_buses(built)
        with built as emulator:
            port = CommandPort(emulator.execute, options.port)
            names = ", ".join(f"{arm.name} at {' '.join(arm.bus.key)}" for arm in emulator.arms.values())
            print(f"ready: {names}; control port {port.number}; help lists the commands", flush=True)
            serve_prompt(emulator.execute)
            while not ends:
                time.sleep(0.1)
                for bus in emulator.buses:
                    if bus.error is not None:
                        raise bus.error
            port.close()


def _lock_buses(emulator: CanEmulator) -> None:
    """Refuse a bus that another emulator serves: the answers of both would be mixed, without an error anywhere."""
    for bus in emulator.buses:
        where = " ".join(map(str, bus.settings.key))
        try:
            lock = DeviceLock(f"can-emulator-{where}", f"the emulated bus {where}", _PATIENCE)
        except ControlTaken as error:
            raise ControlTaken(f"{error}; end that emulator, or give this rig another channel") from None
        _locks.append(lock)


if __name__ == "__main__":
    sys.exit(main())
