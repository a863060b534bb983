"""Devices in memory with fault injection, for unit tests of research code.

Everything is deterministic, and time is what the caller passes. See ``docs/unit-tests.md``.
"""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="mock",
    robot="hal.drivers.mock.robot:MockRobot",
    gripper="hal.drivers.mock.robot:MockGripper",
    camera="hal.drivers.mock.camera:MockCamera",
    gamepad="hal.drivers.mock.gamepad:MockPad",
    leader="hal.drivers.mock.leader:MockLeader",
    pad_input="program",
    pad_title="the program",
    stands_in=True,
)
