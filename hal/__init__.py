"""A hardware-abstraction layer for robot manipulation: one experiment, in simulation and on the arm.

    import hal

    with hal.open("panda_table", sim=True) as rig:
        arm = rig.robots["panda"]
        arm.move_to(arm.home)

Importing this package costs numpy and little else; whatever is heavier loads when it is first used.
"""

from __future__ import annotations

from importlib import import_module
from typing import TYPE_CHECKING, Any

from .commands import CartesianTarget, Command, JointTarget, JointTorque, JointVelocity, Sent, Twist
from .errors import (
    CommandError,
    ConfigError,
    ConnectionLost,
    ControlTaken,
    DeviceNotFound,
    DriverMissing,
    HalError,
    MotionStopped,
    NotSupported,
    RobotFault,
    StaleStateError,
    Unreachable,
)
from .pose import Pose
from .types import Fault, Frame, GripperState, Limited, PadState, RobotState, RobotStatus, Stamp, Trip

if TYPE_CHECKING:
    from .control import Control
    from .rig import Rig
    from .rig import open_rig as open
    from .robot import Robot
    from .specs import BodySpec
    from .teleop import Teleop

__all__ = [
    "BodySpec",
    "CartesianTarget",
    "Command",
    "CommandError",
    "ConfigError",
    "ConnectionLost",
    "Control",
    "ControlTaken",
    "DeviceNotFound",
    "DriverMissing",
    "Fault",
    "Frame",
    "GripperState",
    "HalError",
    "JointTarget",
    "JointTorque",
    "JointVelocity",
    "Limited",
    "MotionStopped",
    "NotSupported",
    "PadState",
    "Pose",
    "Rig",
    "Robot",
    "RobotFault",
    "RobotState",
    "RobotStatus",
    "Sent",
    "StaleStateError",
    "Stamp",
    "Teleop",
    "Trip",
    "Twist",
    "Unreachable",
    "__version__",
    "open",
]

_LAZY = {
    "BodySpec": ("specs", "BodySpec"),
    "Control": ("control", "Control"),
    "Rig": ("rig", "Rig"),
    "Robot": ("robot", "Robot"),
    "Teleop": ("teleop", "Teleop"),
    "open": ("rig", "open_rig"),
}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("robot-hal")
    if name in _LAZY:
        module, attribute = _LAZY[name]
        return getattr(import_module(f".{module}", __name__), attribute)
    raise AttributeError(f"module 'hal' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
