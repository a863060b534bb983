"""Devices that exist only in memory, with fault knobs: for the unit tests of people who write research code.

Everything is deterministic, and time is only what the caller says it is. See ``docs/unit-tests.md``.
"""

from __future__ import annotations

from hal.registry import DriverSpec

__all__ = ["DRIVER"]

DRIVER = DriverSpec(
    name="mock",
    robot="hal.drivers.mock.robot:MockRobot",
    gripper="hal.drivers.mock.gripper:MockGripper",
    camera="hal.drivers.mock.camera:MockCamera",
    gamepad="hal.drivers.mock.gamepad:MockPad",
)
