"""Benches of a Robotiq gripper on both kinds of line, against an emulator in real time."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from tempfile import gettempdir

from hal_emulators.robotiq.server import RobotiqEmulator, find_grippers

from hal.drivers.robotiq.gripper import RobotiqGripper
from hal.testing import GripperBench

__all__ = ["robotiq_gripper"]


@contextmanager
def robotiq_gripper(line: str) -> Iterator[GripperBench]:
    """A 2F-85 on a serial ``line``, or on the ``text`` port; activated, and open."""
    place = {
        "serial": f"port={Path(gettempdir(), f'{os.getpid()}.emulated')}",
        "text": f"host=127.64.{os.getpid() >> 8 & 255}.{os.getpid() & 255}",
    }
    specs = find_grippers("franka_robotiq", ["robots.arm.gripper.real={}", f"robots.arm.gripper.real.{place[line]}"])
    with RobotiqEmulator(specs) as far, closing(RobotiqGripper(specs[0])) as driver:
        gripper = next(iter(far.ports.values())).gripper
        gripper.request = gripper.request._replace(act=1)
        gripper.state = 3
        yield GripperBench(
            driver=driver,
            dt=0.01,
            real_time=True,
            patience=0.5,
            lose=lambda: far.execute("unplug on") and None,
            restore=lambda: far.execute("unplug off") and None,
            put_object=lambda width: far.execute(f"object {width}") and None,
        )
