"""Every driver against the contract of its kind (:mod:`hal.testing`). This is the one list of them.

A new driver joins by a bench in a file beside this one and a class here. What a class leaves out, it says why.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import pytest

from hal.testing import (
    CameraBench,
    CameraContract,
    GamepadContract,
    GripperContract,
    RobotBench,
    RobotContract,
    bench_of,
)

from .cameras import Studio, mock_camera, mock_camera_in_lock_step, pybullet_camera_in_lock_step
from .evdev_pads import recorded_pad
from .frankas import FR3, franka_hand
from .grippers import mock_gripper, pybullet_gripper
from .pads import mock_pad, playback_pad, terminal_keys_held, terminal_steps, web_pad
from .realsenses import played_realsense, recording, software_realsense
from .robots import mock_robot, pybullet_robot, three_joints

NO_LINK = dict.fromkeys(("lose", "restore", "freeze"), "it lives in the world's own process: nothing lies between them")

# Arms.


class TestMockRobot(RobotContract):
    bench = bench_of(mock_robot)


class TestArmWithoutUrdf(RobotContract):
    bench = bench_of(three_joints)


class TestPyBulletRobot(RobotContract):
    bench = bench_of(pybullet_robot)


@pytest.fixture(scope="module")
def fr3() -> Iterator[FR3]:
    """An emulated robot."""
    robot = FR3()
    yield robot
    robot.close()


@pytest.mark.slow
class TestEmulatedFr3(
    RobotContract,
    left_out={
        "freeze": "a robot that is silent is lost: its library gives up after 1 s",
        "rest": "an arm that gets no set-point for 20 ms is in reflex, and holds: tests/wire/test_franka_stops.py",
        "torque": "torques begin with a request, so the first one is late: tests/wire/test_franka_torque.py",
    },
):
    """The unmodified driver, and Franka's own client library, against the emulator in lock-step."""

    @pytest.fixture
    def bench(self, fr3: FR3) -> Iterator[RobotBench]:
        with fr3.arm() as bench:
            yield bench


# Grippers.


class TestMockGripper(GripperContract):
    bench = bench_of(mock_gripper)


class TestPyBulletGripper(GripperContract, left_out=NO_LINK):
    bench = bench_of(pybullet_gripper)


@pytest.mark.slow
class TestEmulatedFrankaHand(GripperContract):
    bench = bench_of(franka_hand)


# Cameras.


class TestMockCamera(CameraContract):
    bench = bench_of(mock_camera)


class TestMockCameraInLockStep(CameraContract):
    bench = bench_of(mock_camera_in_lock_step)


class TestPyBulletCameraInLockStep(CameraContract, left_out=NO_LINK):
    bench = bench_of(pybullet_camera_in_lock_step)


@pytest.fixture(scope="module")
def studios() -> Iterator[list[Studio]]:
    """The one in use is the last of them, unless it is broken."""
    studios: list[Studio] = []
    yield studios
    for studio in studios:
        studio.close()


class TestPyBulletCameraInRealTime(
    CameraContract,
    left_out={
        "restore": "the process that draws is the rig's: when it is gone, the rig is opened anew",
        "freeze": "it draws for as long as the world's time goes on",
    },
):
    @pytest.fixture
    def bench(self, studios: list[Studio]) -> Iterator[CameraBench]:
        if not studios or studios[-1].broken:
            studios.append(Studio())
        with studios[-1].camera() as bench:
            yield bench


@pytest.mark.slow
class TestRealSenseInSoftware(CameraContract):
    """The unmodified driver and library, and a camera in software."""

    bench = bench_of(software_realsense)


FILE = dict.fromkeys(("lose", "restore", "freeze"), "a recording is a file: there is no link")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> str:
    """A file."""
    return recording(tmp_path_factory.mktemp("realsense"))


@pytest.mark.slow
class TestRecordedRealSense(CameraContract, left_out=FILE):
    @pytest.fixture
    def bench(self, recorded: str) -> Iterator[CameraBench]:
        with played_realsense(recorded, paced=True) as bench:
            yield bench


class TestRecordedRealSenseOnDemand(CameraContract, left_out=FILE):
    @pytest.fixture
    def bench(self, recorded: str) -> Iterator[CameraBench]:
        with played_realsense(recorded, paced=False) as bench:
            yield bench


# Gamepads.


class TestMockPad(GamepadContract):
    bench = bench_of(mock_pad)


class TestPlaybackPad(
    GamepadContract, left_out={"release": "what is pressed in a recording stays pressed until it says otherwise"}
):
    bench = bench_of(playback_pad)


class TestWebPad(GamepadContract):
    bench = bench_of(web_pad)


class TestTerminalSteps(
    GamepadContract,
    left_out={
        "release": "such a terminal never says when a key is let go of: a press is one step",
        "restore": "a terminal that was closed does not come back",
        "freeze": "nothing is held, so nobody has to prove anything after the press",
    },
):
    bench = bench_of(terminal_steps)


class TestTerminalKeysHeld(GamepadContract):
    bench = bench_of(terminal_keys_held)


class TestRecordedDualShock4(GamepadContract):
    bench = bench_of(partial(recorded_pad, "ds4", motion=True))


class TestRecordedDualSense(
    GamepadContract,
    left_out={"freeze": "by its cable alone, without a motion sensor, a silent pad is one that nobody touches"},
):
    bench = bench_of(partial(recorded_pad, "dualsense", motion=False))
