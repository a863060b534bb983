"""Driver of Franka arms and the Franka Hand: FR3 by pylibfranka, Panda (FER) by panda-python. See docs/franka.md."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="franka",
    robot="hal.drivers.franka.arm:FrankaArm",
    gripper="hal.drivers.franka.hand:FrankaHand",
    checks={
        "robot": "hal.drivers.franka.settings:check_arm",
        "gripper": "hal.drivers.franka.settings:check_hand",
    },
    emulated="hal.config.schema:is_own_host",
    preflight="hal.drivers.franka.preflight:check",
    own_process=frozenset({"gripper"}),
    shared_options=("host",),
    libraries="hal.drivers.franka.settings:libraries",
    requires={
        "pylibfranka": "pip install 'robot-hal[franka]' (Python 3.10 to 3.12; there is no wheel for newer ones)",
        "panda_py": "pip install 'robot-hal[panda]'",
    },
)
