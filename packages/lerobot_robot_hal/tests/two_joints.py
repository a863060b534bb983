"""A robot and a camera of LeRobot, in a module of their own: LeRobot looks for their classes there."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from lerobot.cameras import CameraConfig
from lerobot.robots import RobotConfig


@RobotConfig.register_subclass("two_joints")
@dataclass(kw_only=True)
class TwoJointsConfig(RobotConfig):
    port: str
    id: str | None = None
    disable_torque_on_disconnect: bool = True


class TwoJoints:
    """An arm of two joints, in degrees, and a gripper from 0 to 100: they follow at once, and hold."""

    newest: ClassVar[Any] = None
    places: ClassVar[dict[str, dict[str, float]]] = {}
    names = ("one.pos", "two.pos", "gripper.pos")

    def __init__(self, config: TwoJointsConfig) -> None:
        self.config, self.is_connected, self.unplugged = config, False, False
        self.numbers = self.places.setdefault(config.port, dict.fromkeys(self.names, 0.0))
        self.actions: list[dict[str, float]] = []
        self.action_features = dict.fromkeys(self.names, float)
        TwoJoints.newest = self

    def connect(self, calibrate: bool = True) -> None:
        assert not calibrate, "calibration would ask a person"
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def get_observation(self) -> dict[str, Any]:
        time.sleep(0.002)
        if self.unplugged:
            raise ConnectionError("no status packet")
        return dict(self.numbers)

    def send_action(self, action: dict[str, float]) -> dict[str, float]:
        assert set(action) == set(self.names)
        self.numbers.update(action)
        self.actions.append(action)
        return action


@CameraConfig.register_subclass("plain")
@dataclass(kw_only=True)
class PlainConfig(CameraConfig):
    fps: int | None = None
    width: int | None = None
    height: int | None = None
    grey: int = 0


class Plain:
    """A camera of one colour, at its rate, as long as it is plugged in."""

    unplugged: ClassVar[bool] = False

    def __init__(self, config: PlainConfig) -> None:
        self.config, self.is_connected, self.due = config, False, 0.0

    def connect(self, warmup: bool = True) -> None:
        if self.unplugged:
            raise ConnectionError("no such camera")
        self.is_connected = True

    def disconnect(self) -> None:
        self.is_connected = False

    def async_read(self, timeout_ms: float = 200) -> Any:
        wait = max(0.0, self.due - time.monotonic())
        time.sleep(min(wait, 1e-3 * timeout_ms))
        if self.unplugged:
            raise RuntimeError("it is gone")
        if wait > 1e-3 * timeout_ms:
            raise TimeoutError("no frame")
        self.due = time.monotonic() + 1.0 / self.config.fps
        return np.full((self.config.height, self.config.width, 3), self.config.grey, np.uint8)
