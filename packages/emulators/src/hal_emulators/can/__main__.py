"""The emulator as a program: ``hal emulate can --config yam_emulator``."""

from __future__ import annotations

import argparse
import contextlib
import sys
from collections.abc import Sequence

try:
    import can
except ModuleNotFoundError:
    sys.exit("error: python-can is not installed: pip install 'robot-hal[can]'")

from hal.errors import ControlTaken
from hal.lock import DeviceLock
from hal_emulators.control import Started, help_text, run_emulator
from hal_emulators.shared_world import has_world, run_world

from .console import COMMANDS
from .server import CanEmulator

_WHAT = "Emulates every arm on a CAN bus in a rig: Damiao motors or a PiPER, with mass, gravity and friction."
_PATIENCE = 1.0
"""s for which an emulator waits for one that is ending."""
_locks: list[DeviceLock] = []
"""On the buses of this program, until it ends."""


def main(arguments: Sequence[str] | None = None) -> int:
    return run_emulator("can", _WHAT, help_text(COMMANDS), arguments, _start)


def _start(options: argparse.Namespace, stack: contextlib.ExitStack) -> Started:
    try:
        in_world = not options.no_world and has_world(options.config, options.set)
        if in_world:
            stack.enter_context(run_world(options.config, options.set))
        emulator = CanEmulator(options.config, options.set, options.seed, realtime=True, in_world=in_world)
        _lock_buses(emulator)
        stack.enter_context(emulator)
    except can.CanError as error:
        raise ValueError(str(error)) from None

    def check() -> None:
        for bus in emulator.buses:
            if bus.error is not None:
                raise ValueError(str(bus.error))

    places = ", ".join(f"{arm.name} at {' '.join(arm.bus.key)}" for arm in emulator.arms.values())
    return Started(emulator.execute, places, check)


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
