"""A camera of LeRobot behind ``driver: lerobot``: the contract of cameras, and its mistakes."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from lerobot_robot_hal.camera import LeRobotCamera
from two_joints import Plain

from hal.config import load
from hal.errors import ConfigError, ConnectionLost
from hal.specs import CameraSpec
from hal.testing import CameraBench, CameraContract


def spec(type_: str = "plain", **entry: Any) -> CameraSpec:
    """Return the record of the camera."""
    real = {"type": type_, "config": {"grey": 77}}
    camera = {"model": "webcam", "drivers": {"real": "lerobot_robot_hal.follower:DRIVER"}, "real": real, **entry}
    return load({"sim": False, "cameras": {"top": camera}}).resolve().cameras[0]


class TestLeRobotCamera(CameraContract, left_out={"freeze": "it has no state that is silent"}):
    @pytest.fixture
    def bench(self, monkeypatch: pytest.MonkeyPatch) -> Iterator[CameraBench]:
        driver = LeRobotCamera(spec())

        def plug(plugged: bool) -> None:
            monkeypatch.setattr(Plain, "unplugged", not plugged)

        yield CameraBench(driver=driver, patience=3.0, lose=lambda: plug(False), restore=lambda: plug(True))
        driver.close()


def test_its_pictures_are_scaled_to_the_output() -> None:
    camera = LeRobotCamera(spec(output={"width": 128, "height": 96}))
    camera.open()
    frame = camera.grab(1.0)
    assert frame is not None
    assert (frame.color.shape, frame.color.min(), frame.color.max()) == ((96, 128, 3), 77, 77)
    camera.close()


def test_mistakes_are_named() -> None:
    with pytest.raises(ConfigError, match="this camera has only color"):
        spec(model="realsense_d435", streams={"color": {"format": "rgb8"}, "depth": {"format": "z16"}})
    with pytest.raises(ConnectionLost, match="LeRobot knows no camera 'round'"):
        LeRobotCamera(spec("round")).open()
