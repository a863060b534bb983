"""Every driver against its contract (:mod:`hal.testing`).

To add a driver, write a bench in a file beside this one and a class here.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial

import pytest

from hal.testing import (
    CameraBench,
    CameraContract,
    GamepadContract,
    GripperBench,
    GripperContract,
    LeaderContract,
    RobotBench,
    RobotContract,
    WorldContract,
    bench_of,
)

from ..kits.engines_kit import Engine
from .benches import (
    RenderedWorld,
    mock_camera,
    mock_camera_in_lock_step,
    mock_gripper,
    mock_robot,
    mock_robot_with_drives,
    played_realsense,
    pybullet_camera_in_lock_step,
    recording,
    served_camera,
    simulated_gripper,
    simulated_robot,
    simulated_world,
    software_realsense,
    three_joints,
)
from .can_arms import piper_arm, piper_gripper
from .damiaos import damiao_arm, damiao_gripper
from .evdev_pads import recorded_pad
from .frankas import FR3, franka_hand
from .leaders import feetech_leader, mock_leader
from .pads import mock_pad, playback_pad, terminal_steps, web_pad
from .robotiqs import robotiq_gripper
from .servo_buses import servo_bus_arm, servo_bus_gripper
from .urs import Ur
from .webcams import network_camera, video_file, webcam
from .xarms import XArm7

NO_LINK = dict.fromkeys(("lose", "restore", "freeze"), "it is part of the simulation: there is no link")

PIPER_REPORTS = {"freeze": "it reports by itself: silence for 0.1 s counts as a lost link"}

# Arms.


class TestMockRobot(RobotContract):
    bench = bench_of(mock_robot)


class TestMockRobotWithDrives(RobotContract):
    bench = bench_of(mock_robot_with_drives)


class TestArmWithoutUrdf(RobotContract):
    bench = bench_of(three_joints)


class TestSimulatedRobot(RobotContract):
    @pytest.fixture
    def bench(self, engine: Engine) -> Iterator[RobotBench]:
        with simulated_robot(engine) as bench:
            yield bench


class TestEmulatedPiper(RobotContract, left_out=PIPER_REPORTS | {"torque": "its controller takes positions only"}):
    """In memory, and in step with the bench's clock."""

    bench = bench_of(piper_arm)


class TestEmulatedDamiaoArm(
    RobotContract,
    left_out={
        "freeze": "a motor answers each frame: one that does not for 0.1 s is lost",
        "holds": "it has no brakes: it sinks, damped by its motors (docs/safety.md)",
        "torque": "speed is reported in steps of 5 mrad/s: tests/lock_step/test_can_torque.py",
    },
):
    """A YAM, in memory, and in step with the bench's clock."""

    bench = bench_of(damiao_arm)


ASKED = {"freeze": "a motor answers each question: one that does not for 0.1 s is lost"}


class TestEmulatedSo101(RobotContract, left_out=ASKED | {"torque": "its motors take positions"}):
    """On a pseudo terminal, and in step with the bench's clock."""

    bench = bench_of(partial(servo_bus_arm, "so101"))


class TestEmulatedViperX(TestEmulatedSo101):
    """Two motors at shoulder and elbow, and a watchdog."""

    bench = bench_of(partial(servo_bus_arm, "viperx"))


@pytest.fixture(scope="module")
def fr3() -> Iterator[FR3]:
    """An emulated FR3."""
    robot = FR3()
    yield robot
    robot.close()


@pytest.mark.slow
class TestEmulatedFr3(
    RobotContract,
    left_out={
        "freeze": "a silent robot is lost: its library gives up after 1 s",
        "rest": "an arm without a set-point for 20 ms goes into reflex and holds: tests/wire/test_franka_stops.py",
        "torque": "torque control starts with a request, so the first torque is late: tests/wire/test_franka_torque.py",
    },
):
    """The driver and Franka's own client library against the emulator in lock-step."""

    @pytest.fixture
    def bench(self, fr3: FR3) -> Iterator[RobotBench]:
        with fr3.arm() as bench:
            yield bench


@pytest.fixture(scope="module")
def ur() -> Iterator[Ur]:
    """An emulated UR5e."""
    robot = Ur()
    yield robot
    robot.close()


@pytest.mark.slow
@pytest.mark.pair  # in real time
class TestEmulatedUr5e(
    RobotContract,
    left_out={
        "freeze": "a controller that is silent for 0.12 s counts as lost: tests/wire/test_ur_faults.py",
        "torque": "servoj takes positions",
    },
):
    """The driver and ur_rtde against the emulator, in real time."""

    @pytest.fixture
    def bench(self, ur: Ur) -> Iterator[RobotBench]:
        with ur.arm() as bench:
            yield bench


@pytest.fixture(scope="module")
def xarm7() -> Iterator[XArm7]:
    """An emulated xArm7."""
    robot = XArm7()
    yield robot
    robot.close()


@pytest.mark.slow
@pytest.mark.pair  # in real time
class TestEmulatedXarm7(
    RobotContract,
    left_out={
        "freeze": "a controller that is silent for 0.12 s counts as lost: tests/wire/test_xarm_faults.py",
        "torque": "servo mode takes positions",
    },
):
    """The driver and xarm-python-sdk against the emulator, in real time."""

    @pytest.fixture
    def bench(self, xarm7: XArm7) -> Iterator[RobotBench]:
        with xarm7.arm() as bench:
            yield bench


# Grippers.


class TestMockGripper(GripperContract):
    bench = bench_of(mock_gripper)


class TestSimulatedGripper(GripperContract, left_out=NO_LINK):
    @pytest.fixture
    def bench(self, engine: Engine) -> Iterator[GripperBench]:
        with simulated_gripper(engine) as bench:
            yield bench


class TestEmulatedPiperGripper(GripperContract, left_out=PIPER_REPORTS):
    bench = bench_of(piper_gripper)


class TestEmulatedDamiaoGripper(GripperContract, left_out={"freeze": "a silent motor is lost"}):
    bench = bench_of(damiao_gripper)


class TestEmulatedSo101Gripper(GripperContract, left_out=ASKED):
    bench = bench_of(partial(servo_bus_gripper, "so101"))


class TestEmulatedViperXGripper(GripperContract, left_out=ASKED):
    bench = bench_of(partial(servo_bus_gripper, "viperx"))


@pytest.mark.slow
class TestEmulatedRobotiq(GripperContract, left_out={"freeze": "a gripper that does not answer is lost"}):
    """Both ways to a gripper: Modbus RTU on a serial line, and the text port of a UR."""

    @pytest.fixture(params=["serial", "text"])
    def bench(self, request: pytest.FixtureRequest) -> Iterator[GripperBench]:
        with robotiq_gripper(request.param) as bench:
            yield bench


@pytest.mark.slow
@pytest.mark.pair
class TestEmulatedXarmGripper(GripperContract, left_out={"freeze": "a gripper that does not answer is lost"}):
    """The driver and xarm-python-sdk against the emulator, in real time."""

    @pytest.fixture
    def bench(self, xarm7: XArm7) -> Iterator[GripperBench]:
        with xarm7.gripper() as bench:
            yield bench


@pytest.mark.slow
class TestEmulatedFrankaHand(GripperContract):
    bench = bench_of(franka_hand)


# Simulated worlds.


class TestPyBulletWorld(WorldContract):
    bench = bench_of(partial(simulated_world, "pybullet"))


class TestMujocoWorld(WorldContract):
    bench = bench_of(partial(simulated_world, "mujoco"))


# Cameras.


class TestMockCamera(CameraContract):
    bench = bench_of(mock_camera)


class TestMockCameraInLockStep(CameraContract):
    bench = bench_of(mock_camera_in_lock_step)


class TestSimulatedCameraInLockStep(CameraContract, left_out=NO_LINK):
    bench = bench_of(pybullet_camera_in_lock_step)


@pytest.fixture(scope="module")
def worlds() -> Iterator[list[RenderedWorld]]:
    """The last one is in use, unless it is broken."""
    worlds: list[RenderedWorld] = []
    yield worlds
    for world in worlds:
        world.close()


class TestSimulatedCameraInRealTime(
    CameraContract,
    left_out={
        "restore": "the render process belongs to the rig: without it the rig must be opened again",
        "freeze": "it renders for as long as simulated time passes",
    },
):
    @pytest.fixture
    def bench(self, worlds: list[RenderedWorld]) -> Iterator[CameraBench]:
        if not worlds or worlds[-1].broken:
            worlds.append(RenderedWorld())
        with worlds[-1].camera() as bench:
            yield bench


class TestWebcam(CameraContract):
    """In memory; tests/kernel has the same contract on the kernel's own test camera."""

    bench = bench_of(webcam)


class TestVideoFile(CameraContract, left_out=dict.fromkeys(("lose", "restore", "freeze"), "a file has no link")):
    bench = bench_of(video_file)


class TestNetworkCamera(CameraContract):
    bench = bench_of(network_camera)


class TestServedCamera(CameraContract):
    """A camera of another computer, through ``hal serve``."""

    bench = bench_of(served_camera)


@pytest.mark.slow
class TestRealSenseInSoftware(CameraContract):
    """The driver and the library with an emulated camera."""

    bench = bench_of(software_realsense)


FILE = dict.fromkeys(("lose", "restore", "freeze"), "a recording is a file: there is no link")


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> str:
    """Path of a recording."""
    return recording(tmp_path_factory.mktemp("realsense"))


@pytest.mark.slow
class TestRecordedRealSense(CameraContract, left_out=FILE):
    @pytest.fixture
    def bench(self, recorded: str) -> Iterator[CameraBench]:
        with played_realsense(recorded, paced=True) as bench:
            yield bench


@pytest.mark.slow
class TestRecordedRealSenseOnDemand(CameraContract, left_out=FILE):
    @pytest.fixture
    def bench(self, recorded: str) -> Iterator[CameraBench]:
        with played_realsense(recorded, paced=False) as bench:
            yield bench


# Gamepads.


class TestMockLeader(LeaderContract):
    bench = bench_of(mock_leader)


class TestFeetechLeader(LeaderContract):
    bench = bench_of(feetech_leader)


class TestMockPad(GamepadContract):
    bench = bench_of(mock_pad)


class TestPlaybackPad(
    GamepadContract, left_out={"release": "a button in a recording stays pressed until the recording releases it"}
):
    bench = bench_of(playback_pad)


class TestWebPad(GamepadContract):
    bench = bench_of(web_pad)


class TestTerminalSteps(
    GamepadContract,
    left_out={
        "release": "a terminal reports no key release: a press is one step",
        "restore": "a closed terminal does not come back",
        "freeze": "nothing is held, so nothing needs to stay alive after the press",
    },
):
    bench = bench_of(terminal_steps)


class TestRecordedDualShock4(GamepadContract):
    bench = bench_of(partial(recorded_pad, "ds4", motion=True))


class TestRecordedDualSense(
    GamepadContract, left_out={"freeze": "on a cable and without a motion sensor, a silent pad is an untouched one"}
):
    bench = bench_of(partial(recorded_pad, "dualsense", motion=False))
