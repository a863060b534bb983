"""A rig of robot-hal as a robot and a teleoperator of LeRobot: ``--robot.type=hal --teleop.type=hal``.

LeRobot imports this package by its name, and finds the classes by those of their configurations.
"""

from .devices import HalRobot, HalRobotConfig, HalTeleoperator, HalTeleoperatorConfig

__all__ = ["HalRobot", "HalRobotConfig", "HalTeleoperator", "HalTeleoperatorConfig"]
