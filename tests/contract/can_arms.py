"""Benches of a PiPER and of its gripper, against an emulator that is stepped with the checks' time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager

from stepped_can import SteppedEmulator

from hal.drivers.can.piper import PiperArm
from hal.drivers.can.piper_gripper import PiperGripper
from hal.testing import GripperBench, RobotBench


@contextmanager
def piper_arm() -> Iterator[RobotBench]:
    """A PiPER at 200 Hz."""
    with SteppedEmulator("piper") as far, closing(PiperArm(far.spec)) as driver:

        def fail() -> str:
            far.execute("status 0 7")
            return "collision"

        yield RobotBench(
            driver=driver,
            advance=lambda: far.advance(1.0 / far.spec.rate_hz),
            patience=0.5,
            lose=lambda: far.cut("on"),
            restore=lambda: far.cut("off"),
            fail=fail,
        )


@contextmanager
def piper_gripper() -> Iterator[GripperBench]:
    """The gripper of a PiPER, open."""
    with SteppedEmulator("piper") as far:
        assert far.spec.gripper is not None
        far.arm.gripper_width = far.spec.gripper.width_max
        far.arm.restart()
        with closing(PiperGripper(far.spec.gripper)) as driver:
            yield GripperBench(
                driver=driver,
                dt=1.0 / far.spec.rate_hz,
                advance=lambda: far.advance(1.0 / far.spec.rate_hz),
                patience=0.5,
                lose=lambda: far.cut("on"),
                restore=lambda: far.cut("off"),
                put_object=lambda width: far.execute(f"object {width}") and None,
            )
