"""Benches of an SO-101 and of its gripper: the driver on a pseudo terminal, in step with the checks' time."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager

from feetech_kit import SteppedFeetech

from hal.drivers.feetech.arm import FeetechArm
from hal.drivers.feetech.gripper import FeetechGripper
from hal.testing import GripperBench, RobotBench

__all__ = ["so101_arm", "so101_gripper"]


@contextmanager
def so101_arm() -> Iterator[RobotBench]:
    """An SO-101 at 100 Hz."""
    with SteppedFeetech() as far, closing(FeetechArm(far.spec)) as driver:

        def fail() -> str:
            far.arm.joints[1].overloaded = True
            return "overloaded"

        yield RobotBench(
            driver=driver,
            joint=0,
            advance=lambda: far.advance(0.01),
            patience=0.7,
            lose=lambda: far.execute("unplug on") and None,
            restore=lambda: far.execute("unplug off") and None,
            fail=fail,
        )


@contextmanager
def so101_gripper() -> Iterator[GripperBench]:
    """The gripper of an SO-101, open, as if its width were proportional to the angle of the jaw.

    A jaw that lags has other speeds than the contract's at the knees of the model's table.
    """
    with SteppedFeetech(widths=()) as far:
        assert far.spec.gripper is not None
        assert far.arm.jaw is not None
        far.arm.jaw.q = far.arm.jaw.upper
        far.arm.place(far.spec.initial)
        with closing(FeetechGripper(far.spec.gripper)) as driver:
            yield GripperBench(
                driver=driver,
                dt=0.02,  # so long that the steps of a count, 0.1 mm, matter little for a speed
                advance=lambda: far.advance(0.02),
                patience=0.7,
                lose=lambda: far.execute("unplug on") and None,
                restore=lambda: far.execute("unplug off") and None,
                put_object=lambda width: far.execute(f"object {width}") and None,
            )
