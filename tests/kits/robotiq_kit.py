"""An emulated 2F-85 in this process, on a serial line or the text port of a UR."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import closing, contextmanager
from dataclasses import dataclass
from pathlib import Path
from tempfile import gettempdir
from time import monotonic, sleep
from typing import Any

from hal.driver import GripperReading
from hal.drivers.robotiq.gripper import RobotiqGripper
from hal.drivers.robotiq.link import Request
from hal_emulators.robotiq.gripper import EmulatedGripper
from hal_emulators.robotiq.server import RobotiqEmulator, find_grippers

__all__ = ["FarGripper", "emulated_robotiq", "robotiq_overrides"]


def robotiq_overrides(line: str = "serial") -> list[str]:
    """Return what names the line of an emulated gripper in ``franka_robotiq``: one for this process."""
    place = {
        "serial": f"port: {Path(gettempdir(), f'{os.getpid()}.emulated')}",
        "text": f"host: 127.64.{os.getpid() >> 8 & 255}.{os.getpid() & 255}",
    }
    return [f"robots.arm.gripper.real={{{place[line]}}}"]


@dataclass
class FarGripper:
    """A driver, and the emulator behind it."""

    driver: RobotiqGripper
    emulator: RobotiqEmulator
    gripper: EmulatedGripper
    paced: bool

    def execute(self, line: str) -> dict[str, Any]:
        """Execute a command of the emulator."""
        return self.emulator.execute(line)

    def run(self, seconds: float) -> GripperReading:
        """Read 100 times a second, and return the last reading."""
        for _ in range(max(1, round(seconds / 0.01))):
            if self.paced:
                sleep(0.01)
            else:
                self.emulator.advance(0.01)
            reading = self.driver.read(monotonic())
        return reading


@contextmanager
def emulated_robotiq(line: str = "serial", paced: bool = True, active: bool = True) -> Iterator[FarGripper]:
    """Run an emulated 2F-85, open, and create its driver.

    Args:
        line: ``serial`` or ``text``.
        paced: Whether its fingers move in real time; otherwise by :meth:`FarGripper.run`.
        active: Whether it is activated.
    """
    (spec,) = find_grippers("franka_robotiq", robotiq_overrides(line))
    with RobotiqEmulator([spec], paced=paced) as emulator, closing(RobotiqGripper(spec)) as driver:
        gripper = emulator.lines["arm"].gripper
        if active:
            gripper.request, gripper.state = Request(1), 3
        yield FarGripper(driver, emulator, gripper, paced)
