"""The classes that LeRobot makes, used as its loop uses them, with a simulated arm in real time."""

from __future__ import annotations

import time

import lerobot_robot_hal as package
import numpy as np


def test_a_loop_of_lerobot_drives_a_simulated_arm_with_a_recorded_pad() -> None:
    """As ``lerobot-record --robot.type=hal --teleop.type=hal`` does: the teleoperator is made and connected first."""
    teleop = package.HalTeleoperator(package.HalTeleoperatorConfig())
    overrides = ["cameras.wrist.output={width: 64, height: 48}"]
    config = package.HalRobotConfig(sim=True, pad="demo", camera_names=["wrist"], overrides=overrides, rate_hz=10.0)
    robot = package.HalRobot(config)
    assert len(robot.cameras) == 1
    teleop.connect()
    robot.connect()
    try:
        assert robot.is_connected
        assert teleop.is_connected
        assert teleop.action_features == robot.action_features
        start, moved, end = robot.get_observation(), 0.0, time.monotonic() + 30.0
        while moved < 0.1 and time.monotonic() < end:  # the recorded pad holds the dead-man twice in 12 s
            observation = robot.get_observation()
            assert observation.keys() == robot.observation_features.keys()
            action = teleop.get_action()
            assert robot.send_action(action).keys() == action.keys()
            moved = max(abs(observation[name] - start[name]) for name in action)
            time.sleep(0.03)
        assert moved >= 0.1, "the recorded pad has moved the arm"
        assert observation["wrist"].shape == robot.observation_features["wrist"]
        assert observation["wrist"].dtype == np.uint8
    finally:
        robot.disconnect()
        teleop.disconnect()
    assert not robot.is_connected
    robot.disconnect()
