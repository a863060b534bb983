"""Drivers of arms and leaders with servos on a bus: Feetech (SO-101), Dynamixel (ViperX). See docs/servo-bus.md."""

from __future__ import annotations

from dataclasses import replace

from hal.registry import DriverSpec

FEETECH = DriverSpec(
    name="feetech",
    robot="hal.drivers.servo_bus.arm:ServoArm",
    gripper="hal.drivers.servo_bus.gripper:ServoGripper",
    leader="hal.drivers.servo_bus.leader:ServoLeader",
    checks={
        "robot": "hal.drivers.servo_bus.settings:check_arm",
        "gripper": "hal.drivers.servo_bus.settings:check_gripper",
        "leader": "hal.drivers.servo_bus.leader:check_leader",
    },
    emulated="hal.serial_line:is_emulated",
    steppable=False,
    group="hal.drivers.servo_bus.settings:group_key",
    shared_options=("port", "baud", "calibration"),
    path_options=frozenset({"calibration"}),
    preflight="hal.drivers.servo_bus.preflight:check",
    motors="hal.drivers.servo_bus.service:MotorService",
    payload=True,
)

DYNAMIXEL = replace(FEETECH, name="dynamixel")
