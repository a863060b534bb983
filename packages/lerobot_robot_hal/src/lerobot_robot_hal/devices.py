"""The classes that LeRobot makes for ``--robot.type=hal`` and ``--teleop.type=hal``.

Both are of one program and use one rig, which the robot opens.
"""

from dataclasses import dataclass
from typing import Any

from lerobot.robots import Robot, RobotConfig
from lerobot.teleoperators import Teleoperator, TeleoperatorConfig

from hal.errors import CommandError

from .rig_robot import RigOptions, RigRobot, TeleopOptions


@RobotConfig.register_subclass("hal")
@dataclass(kw_only=True)
class HalRobotConfig(RigOptions, RobotConfig):
    """Options of ``--robot.type=hal``."""


@TeleoperatorConfig.register_subclass("hal")
@dataclass(kw_only=True)
class HalTeleoperatorConfig(TeleopOptions, TeleoperatorConfig):
    """Options of ``--teleop.type=hal``: the pad of the robot's rig."""


class _Program:
    """The robot and the teleoperator of this process; each may be made and connected first."""

    robot: "HalRobot | None" = None
    teleop: HalTeleoperatorConfig | None = None


class _Calibrated:
    """What is calibrated and configured by the rig's file."""

    is_calibrated = True

    def calibrate(self) -> None:
        pass

    def configure(self) -> None:
        pass


class HalRobot(_Calibrated, Robot):
    """The arms, grippers and cameras of a rig."""

    config_class = HalRobotConfig
    name = "hal"

    def __init__(self, config: HalRobotConfig) -> None:
        super().__init__(config)
        self.inner = RigRobot(config)
        self.cameras = self.inner.cameras
        """LeRobot counts them."""
        _Program.robot = self

    @property
    def observation_features(self) -> dict[str, Any]:
        return self.inner.observation_features

    @property
    def action_features(self) -> dict[str, Any]:
        return self.inner.action_features

    @property
    def is_connected(self) -> bool:
        return self.inner.rig is not None

    def connect(self, calibrate: bool = True) -> None:
        self.inner.connect(_Program.teleop)

    def get_observation(self) -> dict[str, Any]:
        return self.inner.observe()

    def send_action(self, action: dict[str, Any]) -> dict[str, Any]:
        return self.inner.send(action)

    def disconnect(self) -> None:
        self.inner.close()


class HalTeleoperator(_Calibrated, Teleoperator):
    """The pad, the console or a recorded pad of the robot's rig."""

    config_class = HalTeleoperatorConfig
    name = "hal"

    def __init__(self, config: HalTeleoperatorConfig) -> None:
        super().__init__(config)
        self._connected = False
        _Program.teleop = config

    @property
    def _robot(self) -> HalRobot:
        if _Program.robot is None:
            raise CommandError("--teleop.type=hal drives --robot.type=hal only", code="no_robot")
        return _Program.robot

    @property
    def action_features(self) -> dict[str, Any]:
        return self._robot.action_features

    @property
    def feedback_features(self) -> dict[str, Any]:
        return {}

    @property
    def is_connected(self) -> bool:
        return self._connected

    def connect(self, calibrate: bool = True) -> None:
        self._connected = True

    def get_action(self) -> dict[str, Any]:
        return self._robot.inner.read_pad()

    def send_feedback(self, feedback: dict[str, Any]) -> None:
        pass

    def disconnect(self) -> None:
        self._connected = False
