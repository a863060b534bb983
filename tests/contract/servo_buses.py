"""Benches of arms on servo buses and of their grippers: the driver on a pseudo terminal, in step with the checks."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import closing, contextmanager

from servo_bus_kit import SteppedServos

from hal import registry
from hal.testing import GripperBench, RobotBench

__all__ = ["servo_bus_arm", "servo_bus_gripper"]


@contextmanager
def servo_bus_arm(rig: str) -> Iterator[RobotBench]:
    """The arm of a rig at 100 Hz."""
    with SteppedServos(rig) as far, closing(registry.load(far.spec.driver, "robot")(far.spec)) as driver:

        def fail() -> str:
            servo = far.arm.joints[1][-1]
            servo.overload()
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
def servo_bus_gripper(rig: str) -> Iterator[GripperBench]:
    """The gripper of an arm, open, an SO-101's as if its width were proportional to the angle of the jaw.

    A jaw that lags has other speeds than the contract's at the knees of the model's table.
    """
    with SteppedServos(rig, **({"widths": ()} if rig == "so101" else {})) as far:
        assert far.spec.gripper is not None
        assert far.arm.jaw is not None
        far.arm.jaw.q = far.arm.jaw.upper
        far.arm.place(far.spec.initial)
        with closing(registry.load(far.spec.driver, "gripper")(far.spec.gripper)) as driver:
            yield GripperBench(
                driver=driver,
                dt=0.02,  # so long that the steps of a count, 0.1 mm, matter little for a speed
                advance=lambda: far.advance(0.02),
                patience=0.7,
                lose=lambda: far.execute("unplug on") and None,
                restore=lambda: far.execute("unplug off") and None,
                put_object=lambda width: far.execute(f"object {width}") and None,
            )
