"""Drivers of arms on a CAN bus, through python-can: chains of Damiao motors, and AgileX PiPER. See docs/can.md."""

from __future__ import annotations

from hal.registry import DriverSpec

_BUS_OPTIONS = ("interface", "channel", "fd", "bus", "bit_rate", "data_bit_rate")
_REQUIRES = {"can": "pip install 'robot-hal[can]'"}

DAMIAO = DriverSpec(
    name="damiao",
    robot="hal.drivers.can.damiao:DamiaoArm",
    gripper="hal.drivers.can.damiao_gripper:DamiaoGripper",
    checks={
        "robot": "hal.drivers.can.settings:check_damiao_arm",
        "gripper": "hal.drivers.can.settings:check_damiao_gripper",
    },
    emulated="hal.drivers.can.settings:is_emulated",
    steppable=False,
    group="hal.drivers.can.settings:group_key",
    shared_options=_BUS_OPTIONS,
    preflight="hal.drivers.can.preflight:check_damiao",
    buses="hal.drivers.can.interfaces:list_buses",
    payload=True,
    requires=_REQUIRES,
)

PIPER = DriverSpec(
    name="piper",
    robot="hal.drivers.can.piper:PiperArm",
    gripper="hal.drivers.can.piper_gripper:PiperGripper",
    checks={
        "robot": "hal.drivers.can.settings:check_piper_arm",
        "gripper": "hal.drivers.can.settings:check_piper_gripper",
    },
    emulated="hal.drivers.can.settings:is_emulated",
    steppable=False,
    group="hal.drivers.can.settings:group_key",
    shared_options=_BUS_OPTIONS,
    preflight="hal.drivers.can.preflight:check_piper",
    buses="hal.drivers.can.interfaces:list_buses",
    requires=_REQUIRES,
)
