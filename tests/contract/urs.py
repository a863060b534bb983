"""Bench of a UR: the unmodified driver and ur_rtde against an emulator."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from hal.config import load
from hal.testing import RobotBench

from ..wire.network_kit import UrEmulator
from .apart import Apart

__all__ = ["Ur"]


class Ur:
    """An emulated arm that serves many checks, each as after switching on."""

    def __init__(self) -> None:
        self.emulator = UrEmulator()
        # A quarter of the controller's rate: three calls to another process in each cycle take their time.
        self.spec = replace(load(self.emulator.rig()).resolve().robots[0], rate_hz=125.0)

    @contextmanager
    def arm(self) -> Iterator[RobotBench]:
        """Its driver, in a process of its own."""
        control = self.emulator.control
        control.send("refresh")
        driver = Apart("hal.drivers.ur.arm:UrArm", self.spec)
        try:
            yield RobotBench(
                driver=driver,
                patience=10.0,
                lose=lambda: control.send("cut 1000") and None,
                restore=lambda: control.send("cut 0") and None,
                fail=self._stop_protective,
            )
        finally:
            control.send("refresh")
            driver.end()

    def _stop_protective(self) -> str:
        self.emulator.control.send("protective")
        time.sleep(5.1)  # a controller unlocks it no earlier
        return "protective"

    def close(self) -> None:
        self.emulator.close()
