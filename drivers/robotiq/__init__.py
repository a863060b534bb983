"""Driver of the grippers 2F-85, 2F-140 and Hand-E of Robotiq, on a serial line or a UR's controller. See
docs/robotiq.md.
"""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="robotiq",
    gripper="hal.drivers.robotiq.gripper:RobotiqGripper",
    checks={"gripper": "hal.drivers.robotiq.settings:check_gripper"},
    emulated="hal.drivers.robotiq.settings:is_emulated",
    steppable=False,
    gripper_preflight="hal.drivers.robotiq.gripper:check",
    own_process=frozenset({"gripper"}),
)
