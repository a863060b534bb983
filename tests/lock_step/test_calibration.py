"""Calibration of simulated cameras against their true poses.

The truth is hidden: frames come without the camera's pose, the setup without the rig's, and the initial guess is off by
3 cm and 5 degrees.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from calibration_kit import CalibrationBench

import hal
from hal.calibration import CalibrationFailed, ManualDrive, add_view
from hal.deadman import Deadman

pytest.importorskip("cv2", reason="pip install opencv-python-headless")

pytestmark = pytest.mark.slow

MOST_MM, MOST_DEGREES = 2.0, 0.3
RIGS = ("panda_calibration", "panda_calibration_held")


@pytest.fixture(params=RIGS)
def name(request: pytest.FixtureRequest) -> str:
    return str(request.param)


@pytest.fixture
def bench(name: str) -> Iterator[CalibrationBench]:
    with hal.open(name, sim=True, clock="lock_step", pad="none") as rig:
        rig.clock.sleep(0.2)
        yield CalibrationBench(rig, name)


@pytest.mark.parametrize("seed", range(3 if os.environ.get("HAL_SOAK") == "1" else 1))
def test_the_camera_is_found(bench: CalibrationBench, seed: int) -> None:
    arm = bench.collector.robot
    start = arm.state().q
    watched = watch_distances(bench)
    found = bench.drive(15, seed)
    millimetres, degrees = bench.off(found)
    assert millimetres <= MOST_MM
    assert degrees <= MOST_DEGREES
    assert millimetres < 0.5, "it is well inside of what was asked for, and shall stay so"
    assert len(found.used) == 15
    links = np.array([view.T_world_link.position for view in bench.collector.views])
    assert np.ptp(links, axis=0).max() > 0.1, "the arm went somewhere"
    assert any("30 mm and 5.0 degrees from the initial guess" in line for line in bench.told)
    assert np.abs(arm.state().q - start).max() < 0.01, "and came back"
    nearest, lowest = np.min(watched, axis=0)
    assert nearest > 0.3, "it kept its distance from the board"
    assert lowest > 0.0, "and its workspace"


def watch_distances(bench: CalibrationBench) -> list[tuple[float, float]]:
    """Return where every view adds how far the camera is from the board, and the tcp above its workspace's floor."""
    world, arm, take = bench.rig.world, bench.collector.robot, bench.collector.take_view
    found: list[tuple[float, float]] = []

    def watched() -> Any:
        in_hand = bench.collector.setup.eye == "in-hand"
        camera = world.pose("panda", "panda_hand") @ bench.truth if in_hand else bench.truth
        away = float(np.linalg.norm(camera.position - world.pose("charuco_board").position))
        found.append((away, float(arm.state().tcp.position[2] - arm.spec.workspace.lower[2])))
        return take()

    bench.collector.take_view = watched
    return found


@pytest.mark.parametrize(
    "options",
    [["cameras.wrist.streams=[color,depth]", "cameras.wrist.align=depth"], ["cameras.wrist.streams=[infrared]"]],
)
def test_images_of_another_sensor_give_the_pose_of_the_colour_sensor(options: list[str]) -> None:
    """Between the two are 15 mm."""
    with hal.open("panda_calibration", sim=True, clock="lock_step", pad="none", overrides=options) as rig:
        rig.clock.sleep(0.2)
        bench = CalibrationBench(rig, "panda_calibration")
        found = bench.drive(10)
        assert np.linalg.norm(bench.collector.views[0].T_color_eye.position) > 0.01
        millimetres, degrees = bench.off(found)
        assert millimetres <= MOST_MM
        assert degrees <= MOST_DEGREES
        assert any("30 mm and 5.0 degrees from the initial guess" in line for line in bench.told)


def test_with_pybullets_own_renderer() -> None:
    name, options = "panda_calibration", ["simulation.renderer=tiny"]
    with hal.open(name, sim=True, clock="lock_step", pad="none", overrides=options) as rig:
        rig.clock.sleep(0.2)
        bench = CalibrationBench(rig, name)
        millimetres, degrees = bench.off(bench.drive(8))
        assert millimetres <= MOST_MM
        assert degrees <= MOST_DEGREES


def test_without_the_dead_man_nothing_moves(bench: CalibrationBench) -> None:
    deadman = Deadman("nobody")
    deadman.update(pressed=False, connected=True, t_alive=0.0)
    before = bench.collector.robot.state().q_set
    with pytest.raises(hal.MotionStopped) as stop:
        bench.drive(10, deadman=deadman)
    assert stop.value.code == "deadman_released"
    assert np.abs(bench.collector.robot.state().q_set - before).max() < 1e-4
    assert len(bench.collector.views) == 1, "the picture from where it stood"


def test_a_board_out_of_sight_is_refused_before_the_arm_moves(bench: CalibrationBench) -> None:
    arm = bench.collector.robot
    arm.move_to(arm.home + np.array([0.9, 0, 0, 0, 0, 0, -1.6]), speed=0.5)
    before = arm.state().q_set
    with pytest.raises(CalibrationFailed) as caught:
        bench.drive(10)
    assert caught.value.code == "no_board"
    assert np.abs(arm.state().q_set - before).max() < 1e-4
    assert bench.collector.rejected


def test_a_view_similar_to_another_is_rejected(bench: CalibrationBench) -> None:
    assert add_view(bench.collector, bench.told.append) is not None
    assert add_view(bench.collector, bench.told.append) is None
    assert len(bench.collector.views) == 1
    assert len(bench.collector.rejected) == 1


class Presses(hal.Teleop):
    """A person who tilts the hand for a while, lets go, and presses a button: again and again."""

    def __init__(self, robot: hal.Robot, hand: Any) -> None:
        super().__init__(robot)
        self.hand, self.turn, self.calls = hand, 0, 0

    def step(self, pad: hal.PadState, dt: float) -> tuple[hal.Twist, float | None]:
        self.calls += 1
        if self.calls == 10:
            self.hand.press("l2")
        if self.calls == 40:
            self.hand.release("l2")
        if self.calls == 60:
            self.hand.press("south" if self.turn < 2 else "home")
        if self.calls == 65:
            raise AssertionError("the button was not seen")
        return hal.Twist([0.0, 0.0, 0.0], [0.3, 0.0, 0.0]), 1.0


def test_the_arm_is_driven_between_views_with_a_pad() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        arm, pad, hand = rig.robots["panda"], rig.gamepads["pad"], rig.driver("pad")
        teleop = Presses(arm, hand)
        driver = ManualDrive(rig, arm, pad, teleop, print)
        assert "south: take a view, home: finish" in driver.help()
        width = arm.gripper.state().width
        answers, places = [], [arm.state().q_set]
        for turn in range(3):
            teleop.turn, teleop.calls = turn, 0
            answers.append(driver.wait())
            hand.release("south")
            rig.clock.sleep(0.1)
            places.append(arm.state().q_set)
        assert answers == [True, True, False]
        assert all(np.abs(a - b).max() > 0.02 for a, b in pairwise(places)), "it moved each time"
        assert arm.gripper.state().width == width, "the gripper was never told anything: it may hold the board"
