"""Driver of UFACTORY arms (xArm 5, 6 and 7, Lite 6, 850) and the xArm Gripper, by xarm-python-sdk. See docs/xarm.md."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="xarm",
    robot="hal.drivers.xarm.arm:XArm",
    gripper="hal.drivers.xarm.gripper:XArmGripper",
    checks={"robot": "hal.drivers.xarm.settings:check_arm", "gripper": "hal.drivers.xarm.settings:check_gripper"},
    emulated="hal.config.schema:is_own_host",
    steppable=False,
    preflight="hal.drivers.xarm.preflight:check",
    gripper_preflight="hal.drivers.xarm.gripper:check",
    own_process=frozenset({"gripper"}),
    shared_options=("host",),
    requires={"xarm": "pip install 'robot-hal[xarm]'"},
)
