"""A hardware-abstraction layer for robot manipulation: one experiment, in simulation and on the arm.

    import hal

    with hal.open("panda_table", sim=True) as rig:
        arm = rig.robots["panda"]
        arm.move_to(arm.home)

Importing this package is cheap: every name is loaded on first use.
"""

from __future__ import annotations

import os
from importlib import import_module
from typing import TYPE_CHECKING, Any

if os.path.isfile(os.path.join(__path__[0], "drivers")):  # a link in a checkout, a folder in a wheel
    raise ImportError(
        f"{__path__[0]} has text files in place of links: git made this checkout without symbolic links. Run in it: "
        "git config core.symlinks true && git restore hal src (on Windows in developer mode or as administrator)"
    )

__path__ = [os.path.realpath(folder) for folder in __path__]
"""Where its modules are, without links, so that debuggers stop at breakpoints set in a checkout; in its ``drivers`` and
``apps``, too."""

if TYPE_CHECKING:
    from . import gym as gym
    from .camera import Camera
    from .commands import (
        CartesianTarget,
        Command,
        JointChunk,
        JointTarget,
        JointTorque,
        JointVelocity,
        Sent,
        Twist,
    )
    from .control import Control
    from .deadman import Deadman
    from .driver import CameraInfo
    from .errors import (
        CollisionError,
        CommandError,
        ConfigError,
        ConnectionLost,
        ControlTaken,
        DatasetError,
        DeviceNotFound,
        DriverMissing,
        Fault,
        HalError,
        MotionStopped,
        NotSupported,
        PolicyError,
        RobotFault,
        StaleStateError,
        Unreachable,
    )
    from .gamepad import Gamepad
    from .geometry import Pose
    from .gripper import Gripper, GripperMotion, GripperResult
    from .motion.handle import ArmMotion, ArmMotionResult
    from .observation import Observation
    from .rig import Rig, open_rig
    from .robot import Robot
    from .servo.controllers import JointImpedance, OperationalSpace, Position
    from .session import SessionEvent, TeleopSession
    from .specs import BodySpec
    from .teleop import Teleop
    from .types import (
        ControlMode,
        Frame,
        GripperOutcome,
        GripperState,
        Limited,
        MotionOutcome,
        PadState,
        RobotState,
        RobotStatus,
        Stamp,
        Trip,
    )

    open = open_rig

__all__ = [
    "ArmMotion",
    "ArmMotionResult",
    "BodySpec",
    "Camera",
    "CameraInfo",
    "CartesianTarget",
    "CollisionError",
    "Command",
    "CommandError",
    "ConfigError",
    "ConnectionLost",
    "Control",
    "ControlMode",
    "ControlTaken",
    "DatasetError",
    "Deadman",
    "DeviceNotFound",
    "DriverMissing",
    "Fault",
    "Frame",
    "Gamepad",
    "Gripper",
    "GripperMotion",
    "GripperOutcome",
    "GripperResult",
    "GripperState",
    "HalError",
    "JointChunk",
    "JointImpedance",
    "JointTarget",
    "JointTorque",
    "JointVelocity",
    "Limited",
    "MotionOutcome",
    "MotionStopped",
    "NotSupported",
    "Observation",
    "OperationalSpace",
    "PadState",
    "PolicyError",
    "Pose",
    "Position",
    "Rig",
    "Robot",
    "RobotFault",
    "RobotState",
    "RobotStatus",
    "Sent",
    "SessionEvent",
    "StaleStateError",
    "Stamp",
    "Teleop",
    "TeleopSession",
    "Trip",
    "Twist",
    "Unreachable",
    "__version__",
]
# Without `open`: a star import must not shadow the builtin.

_MODULES = {
    "camera": ("Camera",),
    "driver": ("CameraInfo",),
    "commands": (
        "CartesianTarget",
        "Command",
        "JointChunk",
        "JointTarget",
        "JointTorque",
        "JointVelocity",
        "Sent",
        "Twist",
    ),
    "control": ("Control",),
    "deadman": ("Deadman",),
    "errors": (
        "CollisionError",
        "CommandError",
        "ConfigError",
        "ConnectionLost",
        "ControlTaken",
        "DatasetError",
        "DeviceNotFound",
        "DriverMissing",
        "HalError",
        "MotionStopped",
        "NotSupported",
        "PolicyError",
        "RobotFault",
        "StaleStateError",
        "Unreachable",
    ),
    "gamepad": ("Gamepad",),
    "gripper": ("Gripper", "GripperMotion", "GripperResult"),
    "motion.handle": ("ArmMotion", "ArmMotionResult"),
    "observation": ("Observation",),
    "geometry": ("Pose",),
    "rig": ("Rig",),
    "robot": ("Robot",),
    "servo.controllers": ("JointImpedance", "OperationalSpace", "Position"),
    "session": ("SessionEvent", "TeleopSession"),
    "specs": ("BodySpec",),
    "teleop": ("Teleop",),
    "types": (
        "ControlMode",
        "Fault",
        "Frame",
        "GripperOutcome",
        "GripperState",
        "Limited",
        "MotionOutcome",
        "PadState",
        "RobotState",
        "RobotStatus",
        "Stamp",
        "Trip",
    ),
}
_HOME = {name: module for module, names in _MODULES.items() for name in names}


def __getattr__(name: str) -> Any:
    if name == "__version__":
        from importlib.metadata import version

        return version("robot-hal")
    if name == "open":
        value = import_module(".rig", __name__).open_rig
    elif name == "gym":
        value = import_module(".gym", __name__)
    elif name in _HOME:
        value = getattr(import_module(f".{_HOME[name]}", __name__), name)
    else:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*__all__, "open"])
