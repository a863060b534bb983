"""Bench of an xArm7: the unmodified driver and xarm-python-sdk against an emulator."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace

from hal.config import load
from hal.testing import GripperBench, RobotBench

from ..wire.network_kit import XArmEmulator

__all__ = ["XArm7"]


class XArm7:
    """An emulated arm that serves many checks, each as after switching on."""

    def __init__(self) -> None:
        self.emulator = XArmEmulator()
        # Half the rate of the reports, so that each cycle has a new one.
        self.spec = replace(load(self.emulator.rig()).resolve().robots[0], rate_hz=50.0)

    @contextmanager
    def arm(self) -> Iterator[RobotBench]:
        """Its driver."""
        from hal.drivers.xarm.arm import XArm

        control = self.emulator.control
        control.send("refresh")
        driver = XArm(self.spec)
        try:
            yield RobotBench(
                driver=driver,
                patience=10.0,
                real_time=True,
                lose=lambda: control.send("cut 1000") and None,
                restore=lambda: control.send("cut 0") and None,
                fail=self._collide,
            )
        finally:
            control.send("refresh")
            driver.close()

    @contextmanager
    def gripper(self) -> Iterator[GripperBench]:
        """The driver of its gripper."""
        from hal.drivers.xarm.gripper import XArmGripper

        rig, control = self.emulator.rig(), self.emulator.control
        rig["robots"]["arm"]["gripper"] = {"model": "xarm_gripper"}
        spec = load(rig).resolve().robots[0].gripper
        assert spec is not None
        control.send("refresh")
        driver = XArmGripper(spec)
        try:
            yield GripperBench(
                driver=driver,
                dt=0.01,
                real_time=True,
                patience=2.0,
                lose=lambda: control.send("cut 1000") and None,
                restore=lambda: control.send("cut 0") and None,
                put_object=lambda width: control.send(f"object {width}") and None,
            )
        finally:
            control.send("refresh")
            driver.close()

    def _collide(self) -> str:
        self.emulator.control.send("error 31")
        return "collision"

    def close(self) -> None:
        self.emulator.close()
