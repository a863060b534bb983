"""Benches of an arm with Damiao motors and of its gripper, against an emulator that is stepped with the checks' time.

The bus is python-can's ``virtual`` one. Driver and emulator run in one thread, so nothing waits and nothing is late.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from stepped_can import SteppedEmulator, take_for_off

from hal.drivers.can.damiao import DamiaoArm
from hal.drivers.can.damiao_gripper import DamiaoGripper
from hal.testing import GripperBench, RobotBench

YAW = 0
"""The joint of a YAM whose axis is vertical: no weight turns it while its motor is off."""


@contextmanager
def damiao_arm() -> Iterator[RobotBench]:
    """A YAM in its raised home position."""
    with SteppedEmulator("yam") as far:
        driver = DamiaoArm(far.spec)

        def fail() -> str:
            far.execute(f"status {YAW + 1} A")
            return "current"

        yield RobotBench(
            driver=driver,
            advance=lambda: far.advance(1.0 / far.spec.rate_hz),
            joint=YAW,
            patience=0.5,
            lose=lambda: far.cut("on"),
            restore=lambda: far.cut("off"),
            fail=fail,
        )
        take_for_off(driver)
        driver.close()


@contextmanager
def damiao_gripper() -> Iterator[GripperBench]:
    """The gripper of a YAM, open."""
    with SteppedEmulator("yam") as far:
        assert far.spec.gripper is not None
        fingers = far.arm.gripper
        fingers.q = fingers.upper

        def put_object(width: float) -> None:
            far.execute(f"object {width}")

        driver = DamiaoGripper(far.spec.gripper)
        yield GripperBench(
            driver=driver,
            dt=1.0 / far.spec.rate_hz,
            advance=lambda: far.advance(1.0 / far.spec.rate_hz),
            patience=0.5,
            lose=lambda: far.cut("on"),
            restore=lambda: far.cut("off"),
            put_object=put_object,
        )
        driver.close()
