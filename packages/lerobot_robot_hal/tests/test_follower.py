"""A robot of LeRobot behind ``driver: lerobot``: the contract of drivers, its gripper, and what is said of it."""

from __future__ import annotations

import math
import re
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import pytest
from lerobot_robot_hal import follower
from lerobot_robot_hal.follower import LeRobotArm, LeRobotGripper, check, make_robot
from two_joints import TwoJoints

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


@pytest.fixture(autouse=True)
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """No observation is late because this computer is busy."""
    monkeypatch.setattr(follower, "_SILENCE", 1.0)


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
        wanted = {"one.pos": math.degrees(-0.1), "two.pos": math.degrees(0.3), "gripper.pos": 50.0}
        end = time.monotonic() + 20.0
        while robot.numbers != pytest.approx(wanted, abs=1.0):
            assert time.monotonic() < end, robot.numbers
            with suppress(ConnectionLost):  # a busy computer
                gripper.read(time.monotonic())
            time.sleep(0.01)
        assert all(set(action) == set(robot.names) for action in robot.actions)
        arm.close()
        assert robot.is_connected, "the gripper still uses it"
    finally:
        arm.close()
        gripper.close()
    assert not robot.is_connected


def test_the_check_says_how_fast_it_is_and_what_is_not_known(tmp_path: Path) -> None:
    speed, limits = check(specs(tmp_path), 0.1)
    assert speed.level in ("ok", "warn")  # on a busy computer it is slow
    assert re.match(r"two_joints answers in \d+\.\d ms, at most", speed.found)
    assert limits.level == "unknown"
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
