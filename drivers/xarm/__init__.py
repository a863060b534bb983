"""Driver of UFACTORY arms (xArm 5, 6 and 7, Lite 6, 850) through xarm-python-sdk. See docs/xarm.md."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="xarm",
    robot="hal.drivers.xarm.arm:XArm",
    checks={"robot": "hal.drivers.xarm.settings:check_arm"},
    emulated="hal.config.schema:is_own_host",
    steppable=False,
    preflight="hal.drivers.xarm.preflight:check",
    requires={"xarm": "pip install 'robot-hal[xarm]'"},
)
