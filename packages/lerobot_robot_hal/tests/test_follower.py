"""A robot of LeRobot behind ``driver: lerobot``: the contract of drivers, its gripper, and what is said of it."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import pytest
from lerobot.robots import RobotConfig
from lerobot_robot_hal.follower import LeRobotArm, LeRobotGripper, check, make_robot

from hal.config import load
from hal.driver import Setpoint
from hal.errors import ConfigError, ConnectionLost
from hal.testing import RobotBench, RobotContract

JOINTS = ("one", "two")
URDF = """<robot name="two"><link name="base"/><link name="a"/><link name="b"/>
<joint name="one" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 0 1"/>
<limit lower="-2" upper="2" velocity="2" effort="5"/></joint>
<joint name="two" type="revolute"><parent link="a"/><child link="b"/><origin xyz="0.2 0 0"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" velocity="2" effort="5"/></joint></robot>"""
MODEL = """
urdf: two.urdf
drivers: {real: "lerobot_robot_hal.follower:DRIVER"}
rate_hz: 50
joints: [one, two]
tcp: {link: b, position: [0.1, 0, 0]}
home: [0, 0]
limits: {velocity: 1, acceleration: 5, jerk: 100}
gripper: {width_max: 0.08, speed: 0.1, force: 10, drivers: {real: "lerobot_robot_hal.follower:DRIVER"}}
"""


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


def specs(folder: Path, **real: Any) -> Any:
    """Return the record of the arm."""
    (folder / "two.urdf").write_text(URDF)
    (folder / "two.yaml").write_text(MODEL)
    real = {
        "type": "two_joints",
        "config": {"port": str(folder)},
        "numbers": [f"{name}.pos" for name in JOINTS],
        **real,
    }
    return (
        load({"sim": False, "robots": {"arm": {"model": str(folder / "two.yaml"), "real": real}}}).resolve().robots[0]
    )


class TestLeRobotArm(
    RobotContract,
    left_out={
        "fail": "LeRobot has no faults",
        "freeze": "a robot that is silent is lost",
        "torque": "LeRobot has no torques",
    },
):
    @pytest.fixture
    def bench(self, tmp_path: Path) -> Iterator[RobotBench]:
        driver = LeRobotArm(specs(tmp_path))

        def plug(plugged: bool) -> None:
            TwoJoints.newest.unplugged = not plugged

        yield RobotBench(
            driver=driver, real_time=True, patience=3.0, lose=lambda: plug(False), restore=lambda: plug(True)
        )
        driver.close()


def test_arm_and_gripper_are_one_robot_and_each_action_is_whole(tmp_path: Path) -> None:
    spec = specs(tmp_path, signs=[-1.0, 1.0], offsets=[0.1, 0.0])
    arm, gripper = LeRobotArm(spec), LeRobotGripper(spec.gripper)
    arm.open()
    gripper.open()
    try:
        robot = TwoJoints.newest
        assert not robot.config.disable_torque_on_disconnect, "an arm that is closed holds"
        assert arm.read(time.monotonic()).q == pytest.approx([0.1, 0.0])
        arm.write(Setpoint([0.2, 0.3], [0.0] * 2, [0.0] * 2))
        gripper.move(0.04, 0.1, 10.0)
        end = time.monotonic() + 5.0
        last = {"one.pos": math.degrees(-0.1), "two.pos": math.degrees(0.3), "gripper.pos": 50.0}
        while gripper.read(time.monotonic()).moving or robot.actions[-1:] != [pytest.approx(last, abs=1.0)]:
            assert time.monotonic() < end, robot.actions[-1:]
            time.sleep(0.01)  # the fingers may be there but for 1 mm before the last action is sent
        assert arm.read(time.monotonic()).q == pytest.approx([0.2, 0.3])
        arm.close()
        assert robot.is_connected, "the gripper still uses it"
    finally:
        arm.close()
        gripper.close()
    assert not robot.is_connected


def test_the_check_says_how_fast_it_is_and_what_is_not_known(tmp_path: Path) -> None:
    speed, limits = check(specs(tmp_path), 0.1)
    assert (speed.level, limits.level) == ("ok", "unknown")
    assert re.search(r"two_joints answers in \d+\.\d", speed.found)
    assert "what it does when this program dies" in limits.found


def test_mistakes_are_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="must have 2 entries, for one, two"):
        specs(tmp_path, numbers=["one.pos"])
    with pytest.raises(ValueError, match="knows no robot 'three_joints'"):
        make_robot("three_joints", {})
    with pytest.raises(ValueError, match="prot"):
        make_robot("two_joints", {"prot": "/dev/ttyACM0"})
    with pytest.raises(ConnectionLost, match="knows no robot"):
        LeRobotArm(specs(tmp_path, type="three_joints")).open()
