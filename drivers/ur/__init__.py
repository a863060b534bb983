"""Driver of Universal Robots arms (e-Series, CB3) through ur_rtde. See docs/ur.md."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="ur",
    robot="hal.drivers.ur.arm:UrArm",
    checks={"robot": "hal.drivers.ur.settings:check_arm"},
    emulated="hal.config.schema:is_own_host",
    steppable=False,
    preflight="hal.drivers.ur.preflight:check",
    requires={"rtde_control": "pip install 'robot-hal[ur]'"},
)
