"""The rig's side: actions through the servo, with its limits, its dead-man and its stops. In lock-step."""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
from lerobot_robot_hal import rig_robot
from lerobot_robot_hal.rig_robot import RigOptions, RigRobot, TeleopOptions

import hal
from hal.errors import CommandError, DeviceNotFound, MotionStopped
from hal.types import GripperOutcome

PERIOD = 1.0 / 30.0
Make = Callable[..., RigRobot]


@pytest.fixture
def make() -> Iterator[Make]:
    """Return a function that connects a rig in memory, in lock-step."""
    robots: list[RigRobot] = []

    def connect(rig: str = "panda_table", holds: bool = False, teleop: TeleopOptions | None = None) -> RigRobot:
        overrides = ["cameras={}"]
        robots.append(RigRobot(RigOptions(rig=rig, sim=True, overrides=overrides)))
        robots[-1].use(hal.open(rig, driver="mock", overrides=overrides, clock="lock_step"), holds, teleop)
        return robots[-1]

    yield connect
    for robot in robots:
        robot.close()


def open_rig(robot: RigRobot) -> hal.Rig:
    assert robot.rig is not None
    return robot.rig


def test_the_features_are_those_of_the_rig_before_it_is_open() -> None:
    robot = RigRobot(RigOptions(sim=True, camera_names=["wrist"]))
    joints = [f"panda_joint{k}.pos" for k in range(1, 8)]
    assert list(robot.action_features) == [*joints, "gripper.pos"]
    assert list(robot.observation_features) == [*joints, "gripper.pos", "wrist"]
    assert robot.observation_features["wrist"] == (256, 256, 3)
    with pytest.raises(DeviceNotFound):
        RigRobot(RigOptions(sim=True, arms=["left"]))


def test_the_names_of_several_arms_begin_with_the_arm(make: Make) -> None:
    robot = make(rig="openarm")
    action = robot.observe()
    assert set(robot.action_features) == set(action)
    for _ in range(2):
        assert robot.send(action).keys() == action.keys()
    assert {name.partition(".")[0] for name in robot.action_features} == set(open_rig(robot).robots)


def test_a_random_policy_breaks_no_limit(make: Make) -> None:
    robot, random = make(), np.random.default_rng(1)
    rig = open_rig(robot)
    limits = rig.robots["panda"].limits
    lower, upper = np.array([*limits.lower, 0.0]), np.array([*limits.upper, 0.08])
    action = np.array(list(robot.observe().values()))
    for turn in range(300):
        if turn % 10 == 0 and turn > 0:
            action = random.uniform(lower - 0.5, upper + 0.5)
        sent = robot.send(dict(zip(robot.action_features, action.tolist(), strict=True)))
        assert (np.clip(action, lower, upper) == list(sent.values())).all()
        rig.clock.sleep(PERIOD)
    (group,) = rig.statistics().values()
    peaks = group["robots"]["panda"]["peak"]
    assert max(peaks.values()) <= 1.0 + 1e-6
    assert peaks["velocity"] > 0.2, "it has moved"


def test_after_a_pause_the_arm_moves_to_a_target_that_is_far_away(make: Make) -> None:
    robot = make()
    rig = open_rig(robot)
    action = robot.observe()
    robot.send(action)
    rig.clock.sleep(1.0)
    action["panda_joint1.pos"] += 0.4
    robot.send(action)
    assert abs(robot.observe()["panda_joint1.pos"] - action["panda_joint1.pos"]) < 1e-3
    (group,) = rig.statistics().values()
    assert group["robots"]["panda"]["peak"]["velocity"] <= 0.1 + 1e-6, "as fast as move_to"


def test_fingers_keep_what_they_hold_until_another_width_is_asked_for(make: Make) -> None:
    robot = make()
    gripper, action = open_rig(robot).robots["panda"].gripper, robot.observe()
    assert gripper is not None

    def send(width: float) -> float:
        for _ in range(30):
            robot.send(action | {"gripper.pos": width})
            open_rig(robot).clock.sleep(PERIOD)
        return float(robot.observe()["gripper.pos"])

    send(action["gripper.pos"])
    assert gripper.state().outcome is GripperOutcome.NONE
    for width in (0.02, 0.05):
        assert abs(send(width) - width) < 1e-3


def test_a_stop_ends_the_run(make: Make) -> None:
    robot = make()
    rig = open_rig(robot)
    robot.send(robot.observe())
    rig.stop()
    rig.clock.sleep(0.1)
    for _ in range(2):
        with pytest.raises(MotionStopped, match="rig.stop"):
            robot.send(robot.observe())
    robot.close()
    with pytest.raises(CommandError, match="not connected"):
        robot.send({})


@pytest.mark.parametrize("value", [None, float("nan")])
def test_a_wrong_action_is_refused(make: Make, value: float | None) -> None:
    robot = make()
    action = {**robot.observe(), "panda_joint3.pos": value}
    if value is None:
        del action["panda_joint3.pos"]
    with pytest.raises(CommandError) as refused:
        robot.send(action)
    assert refused.value.code == "bad_action"


def test_an_action_waits_for_the_dead_man(make: Make, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(rig_robot, "PATIENCE", 20.0)
    robot = make(holds=True)
    rig = open_rig(robot)
    pad, before = rig.driver("pad"), rig.clock.now()
    press = threading.Timer(0.1, pad.press, ["l2"])
    press.start()
    robot.send(robot.observe())
    assert rig.clock.now() > before
    pad.release("l2")
    rig.clock.sleep(0.1)
    with pytest.raises(MotionStopped) as stopped:
        robot.send(robot.observe())
    assert stopped.value.code == "deadman_not_pressed"


def test_without_a_pad_nothing_can_be_held() -> None:
    robot = RigRobot(RigOptions(sim=True, deadman=True))
    with (
        hal.open("panda_table", driver="mock", overrides={"cameras": {}, "gamepads": {}}, clock="lock_step") as rig,
        pytest.raises(CommandError) as refused,
    ):
        robot.use(rig, holds=True)
    assert refused.value.code == "no_gamepad"


def test_a_pad_drives_while_its_dead_man_is_held(make: Make) -> None:
    robot = make(holds=True, teleop=TeleopOptions())
    rig = open_rig(robot)
    pad, arm = rig.driver("pad"), rig.robots["panda"]

    def drive(seconds: float) -> np.ndarray[Any, Any]:
        for _ in range(round(seconds / PERIOD)):
            robot.send(robot.read_pad())
            rig.clock.sleep(PERIOD)
        return arm.state().tcp.position

    start = drive(0.2)
    pad.stick("dpad_y", 1.0)
    assert np.abs(drive(0.5) - start).max() < 1e-6, "not held"
    pad.stick("dpad_y", 0.0)
    pad.press("l2")
    drive(0.1)
    pad.stick("dpad_y", 1.0)
    moved = drive(1.0) - start
    assert moved[0] > 0.1
    assert np.abs(moved[1:]).max() < 2e-3
    pad.release("l2")
    drive(0.5)
    rest = arm.state().q
    assert np.abs(arm.state().q_set - list(robot.read_pad().values())[:7]).max() < 1e-9, "it wants to stay"
    drive(0.5)
    assert np.abs(arm.state().q - rest).max() < 1e-6
