"""An emulator of a CAN arm that advances only when it is told to, so that nothing waits and nothing is late.

Driver and emulator run in one thread, on python-can's ``virtual`` bus. Where a driver waits for the emulator, which it
does only while it opens, closes or clears errors, a clock of the kit takes the place of the module ``time``.

with SteppedEmulator("yam") as far:
    driver = DamiaoArm(far.spec)
    driver.open()
    far.advance(0.004)
"""

from __future__ import annotations

import contextlib
from types import SimpleNamespace
from typing import Any
from unittest.mock import patch

from can_kit import can_overrides

from hal.config.loader import load
from hal.drivers.can import damiao_chain, piper_link
from hal.drivers.can.emulator import console, server
from hal.specs import RobotSpec

__all__ = ["SteppedEmulator"]


class SteppedEmulator:
    """The emulator of a rig's first arm, and its time.

    Attributes:
        spec: The arm's record, for a driver.
        arm: The emulated arm.
        bus: Its bus.
        passed: Time that has passed, s.
    """

    def __init__(self, rig: str) -> None:
        overrides = can_overrides("virtual")
        self.emulator = server.CanEmulator(rig, overrides)
        self.spec: RobotSpec = load(rig, sim=False, overrides=overrides).resolve().robots[0]
        self.arm: Any = self.emulator.arms[self.spec.name]
        self.bus = self.emulator.bus_of(self.arm)
        self.passed = 0.0
        self._patches = contextlib.ExitStack()

    def advance(self, seconds: float) -> None:
        """Let time pass; parts of a millisecond are rounded up."""
        seconds = max(seconds, 1e-3)
        self.passed += seconds
        self.bus.advance(seconds)

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command of the emulator's console."""
        return self.emulator.execute(line)

    def cut(self, state: str) -> None:
        """Let no frame pass (``on``), or all (``off``)."""
        self.execute(f"cut {state}")

    def __enter__(self) -> SteppedEmulator:
        clock = SimpleNamespace(monotonic=lambda: 1000.0 + self.passed, sleep=self.advance)
        for module in (damiao_chain, piper_link, server, console):
            self._patches.enter_context(patch.object(module, "time", clock))
        self.bus.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.bus.stop()
        self._patches.close()
