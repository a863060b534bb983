"""Benches of an arm with Damiao motors and of its gripper, against an emulator that is stepped with the checks' time.

The bus is python-can's ``virtual`` one. Driver and emulator run in one thread, so nothing waits and nothing is late.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from types import SimpleNamespace
from unittest.mock import patch

from can_kit import can_overrides

from hal.config.loader import load
from hal.drivers.can import damiao_chain
from hal.drivers.can.damiao import DamiaoArm
from hal.drivers.can.damiao_gripper import DamiaoGripper
from hal.drivers.can.emulator.server import CanEmulator
from hal.specs import RobotSpec
from hal.testing import GripperBench, RobotBench

__all__ = ["SteppedEmulator", "damiao_arm", "damiao_gripper"]

YAW = 0
"""The joint of a YAM whose axis is vertical: no weight turns it while its motor is off."""


class SteppedEmulator:
    """The emulator of a rig's arms, which advances only when it is told to, and its time."""

    def __init__(self, rig: str) -> None:
        overrides = can_overrides("virtual")
        self.emulator = CanEmulator(rig, overrides)
        self.spec: RobotSpec = load(rig, sim=False, overrides=overrides).resolve().robots[0]
        self.arm = self.emulator.arms[self.spec.name]
        self.bus = self.emulator.bus_of(self.arm)
        self._passed = 0.0
        self.time = SimpleNamespace(monotonic=lambda: 1000.0 + self._passed, sleep=self.advance)
        """In place of the module ``time`` where a driver waits for the emulator."""

    def advance(self, seconds: float) -> None:
        """Let time pass; parts of a step are rounded up."""
        seconds = max(seconds, 1e-3)
        self._passed += seconds
        self.bus.advance(seconds)

    def cut(self, state: str) -> None:
        """Let no frame pass (``on``), or all (``off``)."""
        self.emulator.execute(f"cut {state}")

    def __enter__(self) -> SteppedEmulator:
        self.bus.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.bus.stop()


@contextmanager
def damiao_arm() -> Iterator[RobotBench]:
    """A YAM in its raised home position."""
    with SteppedEmulator("yam") as far, patch.object(damiao_chain, "time", far.time):
        driver = DamiaoArm(far.spec)

        def fail() -> str:
            far.emulator.execute(f"status {YAW + 1} A")
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
        far.cut("on")  # so that the arm does not have to sink first
        driver.close()


@contextmanager
def damiao_gripper() -> Iterator[GripperBench]:
    """The gripper of a YAM, open."""
    with SteppedEmulator("yam") as far, patch.object(damiao_chain, "time", far.time):
        assert far.spec.gripper is not None
        fingers = far.arm.gripper  # type: ignore[attr-defined]  # of an arm with Damiao motors
        fingers.q = fingers.upper

        def put_object(width: float) -> None:
            far.emulator.execute(f"object {width}")

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
