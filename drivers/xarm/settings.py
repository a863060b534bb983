"""Settings of a UFACTORY arm: the ``real:`` part of a rig file, checked before a device is opened."""

from __future__ import annotations

from collections.abc import Iterator
from math import pi

from hal.config.files import DeviceSettings
from hal.config.schema import Host, Load
from hal.specs import GripperSpec, RobotSpec

TOP_SPEED, TOP_TCP_SPEED = pi, 1.0
"""Limits of servo mode, rad/s and m/s: 180 degrees/s and 1000 mm/s (UFACTORY's servo mode guide)."""
RATES = 50.0, 250.0
"""Slowest and fastest stream of set-points, Hz: the controller takes at most 250 in a second."""


class XArmSettings(DeviceSettings):
    """Settings under ``real:`` of an arm."""

    host: Host
    load: Load | None = None
    """Payload, set when a session opens; None: that of the controller."""


class XArmGripperSettings(DeviceSettings):
    """Settings under ``real:`` of an xArm Gripper."""

    host: Host
    """The control box; the arm's, unless it is given."""


def check_gripper(spec: GripperSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in a gripper's record: key in the gripper's entry of the rig file, message and code."""
    yield from XArmGripperSettings.check(spec)[1]


def check_arm(spec: RobotSpec) -> Iterator[tuple[str, str, str]]:
    """Yield the problems in an arm's record: key in the arm's entry of the rig file, message and code."""
    for key, message, code in XArmSettings.check(spec)[1]:
        if key == "real.host" and "host" not in spec.options:
            message = "is missing: the control box's address, which is on its label"
        yield key, message, code
    if not 5 <= len(spec.joints) <= 7:
        yield "model", f"must have 5, 6 or 7 joints for a UFACTORY arm, not {len(spec.joints)}", "wrong_count"
    if not RATES[0] <= spec.rate_hz <= RATES[1]:
        yield "rate_hz", f"must be {RATES[0]:g} to {RATES[1]:g} Hz, not {spec.rate_hz:g}", "wrong_rate"
    if spec.tcp_speed > TOP_TCP_SPEED:
        yield "tcp_speed", f"must be at most {TOP_TCP_SPEED:g} m/s: the controller stops above it", "out_of_range"
    for joint, value in zip(spec.joints, spec.limits.velocity, strict=False):
        if value > TOP_SPEED:
            yield "limits.velocity", f"{joint} has {value:g} rad/s, above 180 degrees/s, its limit", "out_of_range"
