"""Driver of arms and leaders with Feetech STS3215 servos on a serial bus, such as the SO-101. See docs/so101.md."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="feetech",
    robot="hal.drivers.feetech.arm:FeetechArm",
    gripper="hal.drivers.feetech.gripper:FeetechGripper",
    leader="hal.drivers.feetech.leader:FeetechLeader",
    checks={
        "robot": "hal.drivers.feetech.settings:check_arm",
        "gripper": "hal.drivers.feetech.settings:check_gripper",
        "leader": "hal.drivers.feetech.leader:check_leader",
    },
    emulated="hal.serial_line:is_emulated",
    steppable=False,
    group="hal.drivers.feetech.settings:group_key",
    shared_options=("port", "calibration"),
    path_options=frozenset({"calibration"}),
    preflight="hal.drivers.feetech.preflight:check",
    payload=True,
)
