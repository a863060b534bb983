"""Settings of a Universal Robots arm: the ``real:`` part of a rig file, checked before a device is opened."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Annotated

from pydantic import Field

from hal.config.files import DeviceSettings
from hal.config.schema import Flag, Host, Load, Quantity
from hal.specs import RobotSpec

TOP_SPEED, TOP_ACCELERATION = 3.14, 40.0
"""Limits of ur_rtde for joints, rad/s and rad/s2."""


class UrSettings(DeviceSettings):
    """Settings under ``real:`` of an arm."""

    host: Host
    lookahead_time: Annotated[float, Quantity("s", 0.03, 0.2)] = 0.03
    """Time by which ``servoj`` smooths its targets, s. The default, as that of the gain, is UR's ROS 2 driver's."""
    gain: float = Field(2000.0, ge=100.0, le=2000.0, strict=True)
    """Gain with which ``servoj`` follows its targets."""
    load: Load | None = None
    """Payload, set when a session opens; None: that of the installation."""
    set_tcp: Flag = True
    """Whether the controller gets the model's tcp when a session opens; False: that of the installation."""
    upper_registers: Flag = False
    """Use the registers from 24 on, where a fieldbus or another program has the lower ones."""


def check_arm(spec: RobotSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in an arm's record: key in the arm's entry of the rig file, message and code."""
    for key, message, code in UrSettings.check(spec)[1]:
        if key == "real.host" and "host" not in spec.options:
            message = "is missing: the controller's address, as the pendant shows it (Settings, System, Network)"
        yield key, message, code
    if len(spec.joints) != 6:
        yield "model", f"must have 6 joints for a UR arm, not {len(spec.joints)}", "wrong_count"
    if not 50.0 <= spec.rate_hz <= 500.0:
        yield "rate_hz", f"must be 500 Hz (e-Series) or 125 Hz (CB3), not {spec.rate_hz:g}", "wrong_rate"
    for kind, most in (("velocity", TOP_SPEED), ("acceleration", TOP_ACCELERATION)):
        for joint, value in zip(spec.joints, getattr(spec.limits, kind), strict=False):
            if value > most:
                yield f"limits.{kind}", f"{joint} has {value:g}, above {most:g}, the limit of ur_rtde", "out_of_range"
