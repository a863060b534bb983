"""The mock devices: ideal without faults, and with a fault wrong exactly as it describes."""

from __future__ import annotations

import math
from collections.abc import Callable
from math import exp

import numpy as np
import pytest
from errors_kit import raises_code

from hal.clock import LockStepClock, RealClock
from hal.driver import Setpoint
from hal.drivers.mock.camera import STEP, MockCamera, read_picture
from hal.drivers.mock.gamepad import MockPad
from hal.drivers.mock.robot import FRICTION, INERTIA, MockGripper, MockRobot
from hal.errors import CommandError, ConnectionLost
from hal.specs import CameraSpec, GripperSpec, PadSpec, RobotSpec
from hal.types import GripperOutcome

HERE = (0.1, -0.2, 0.3)  # robot_spec.initial
ZERO = (0.0, 0.0, 0.0)


def at(x: float) -> Setpoint:
    """All joints at x rad, moving at 0.5 rad/s."""
    return Setpoint((x,) * 3, (0.5,) * 3, ZERO)


@pytest.fixture
def arm(robot_spec: RobotSpec) -> MockRobot:
    arm = MockRobot(robot_spec)
    arm.open()
    return arm


@pytest.fixture
def gripper(gripper_spec: GripperSpec) -> MockGripper:
    gripper = MockGripper(gripper_spec)
    gripper.open()
    gripper.read(0.0)
    return gripper


@pytest.fixture
def camera(camera_spec: CameraSpec) -> MockCamera:
    camera = MockCamera(camera_spec)
    camera.open()
    return camera


@pytest.fixture
def pad(pad_spec: PadSpec) -> MockPad:
    pad = MockPad(pad_spec)
    pad.open()
    pad.poll(0.0, 0.0)
    return pad


# Robot.


def test_robot_logs_every_set_point(arm: MockRobot) -> None:
    arm.inject(drop=2)
    arm.read(0.0)
    for x in (0.1, 0.2, 0.3):
        arm.write(at(x))
    assert [setpoint.q[0] for setpoint in arm.log] == [0.1, 0.2, 0.3]


def test_robot_delay(arm: MockRobot) -> None:
    arm.inject(delay_s=0.025)
    qs = []
    for k in range(6):
        reading = arm.read(0.01 * k)
        qs.append(reading.q[0])
        arm.write(at(float(k + 1)))
    # Written after the reading at 0.00 s, due at 0.025 s: seen first at 0.03 s.
    assert qs == [0.1, 0.1, 0.1, 1.0, 2.0, 3.0]
    assert arm.read(0.06).q_commanded == (6.0,) * 3, "the commanded position is not delayed"


def test_robot_drop(arm: MockRobot) -> None:
    arm.inject(drop=3)
    taken = []
    for k in range(6):
        arm.write(at(float(k)))
        taken.append(arm.read(0.01 * k).q_commanded[0])
    assert taken == [0.0, 1.0, 1.0, 3.0, 4.0, 4.0]


@pytest.mark.parametrize(
    ("error", "expected"),
    [(0.02, (0.42, 0.42, 0.42)), ((0.0, 0.1, -0.1), (0.4, 0.5, 0.3)), (np.array([0.0, 0.1, -0.1]), (0.4, 0.5, 0.3))],
)
def test_robot_following_error(arm: MockRobot, error: object, expected: tuple[float, ...]) -> None:
    arm.inject(following_error=error)
    arm.read(0.0)
    arm.write(at(0.4))
    reading = arm.read(0.01)
    assert (reading.q, reading.q_commanded) == (pytest.approx(expected), (0.4,) * 3)


@pytest.mark.parametrize("kind", ["nan", "inf", "short"])
def test_robot_garbage(arm: MockRobot, kind: str) -> None:
    arm.inject(garbage=kind)
    q = arm.read(0.0).q
    assert len(q) == (2 if kind == "short" else 3)
    assert all(math.isfinite(x) for x in q) == (kind == "short")
    arm.clear()
    assert arm.read(0.1).q == HERE


def test_robot_reports_injected_forces(arm: MockRobot) -> None:
    assert arm.read(0.0).tau_ext is None
    arm.inject(tau_ext=(1.0, 2.0, 3.0), wrench_ext=(0.0, 0.0, -5.0, 0.0, 0.0, 0.0))
    reading = arm.read(0.1)
    assert reading.tau_ext == (1.0, 2.0, 3.0)
    assert reading.wrench_ext == (0.0, 0.0, -5.0, 0.0, 0.0, 0.0)


def test_robot_halt_drops_what_was_still_due(arm: MockRobot) -> None:
    arm.inject(delay_s=0.1)
    arm.read(0.0)
    arm.write(at(0.4))
    arm.halt()
    assert (arm.read(1.0).q, arm.read(1.1).q_commanded) == (HERE, HERE)


# Faults.


@pytest.mark.parametrize(
    ("faults", "code"),
    [
        ({"frezee": True}, "unknown_fault"),
        ({"freeze": 1}, "bad_fault_value"),
        ({"drop": -1}, "bad_fault_value"),
        ({"drop": 1.5}, "bad_fault_value"),
        ({"delay_s": -0.1}, "bad_fault_value"),
        ({"garbage": "noise"}, "bad_fault_value"),
        ({"following_error": (0.1, 0.1)}, "bad_fault_value"),
        ({"wrench_ext": (0.1, 0.1)}, "bad_fault_value"),
    ],
)
def test_wrong_fault_is_refused_and_changes_nothing(arm: MockRobot, faults: dict[str, object], code: str) -> None:
    before = arm.faults
    with raises_code(CommandError, code):
        arm.inject(**{"delay_s": 0.5, **faults})
    assert arm.faults == before


def test_faults_that_are_not_named_stay(arm: MockRobot) -> None:
    arm.inject(drop=3)
    arm.inject(delay_s=0.1)
    assert (arm.faults.drop, arm.faults.delay_s) == (3, 0.1)


# Gripper.


def test_gripper_clamps_commands(gripper: MockGripper) -> None:
    gripper.move(-1.0, 99.0, 10.0)
    assert gripper.read(0.1).width == pytest.approx(0.07), "at its greatest speed"
    assert gripper.read(10.0).width == 0.0
    gripper.move(1.0, 0.1, 10.0)
    assert gripper.read(20.0).width == 0.08


def test_gripper_closes_further_when_the_object_slips_out(gripper: MockGripper) -> None:
    gripper.inject(object_width=0.03)
    gripper.move(0.0, 0.1, 15.0)
    assert gripper.read(1.0).grasped is True
    gripper.inject(object_width=None)
    assert gripper.read(1.1).width == pytest.approx(0.02)
    assert gripper.read(1.1).grasped is False


def test_failing_gripper_reports_its_fault_and_does_not_move(gripper: MockGripper) -> None:
    gripper.inject(fail="it is too hot")
    gripper.move(0.02, 0.1, 15.0)
    failed = gripper.read(2.0)
    assert (failed.width, failed.moving, failed.outcome) == (0.08, False, GripperOutcome.FAILED)
    assert failed.fault.cause == "it is too hot"
    gripper.inject(fail=None)
    gripper.move(0.02, 0.1, 15.0)
    assert (gripper.read(4.0).width, gripper.read(4.1).outcome) == (0.02, None)


def test_gripper_faults(gripper: MockGripper) -> None:
    gripper.inject(stuck=True)
    gripper.move(0.0, 0.1, 10.0)
    assert gripper.read(1.0).width == 0.08
    gripper.inject(stuck=False, freeze=True)
    frozen = gripper.read(1.2)
    assert frozen is gripper.read(1.3)
    gripper.inject(freeze=False)
    assert gripper.read(1.4).width == pytest.approx(0.04)
    gripper.inject(garbage="nan")
    assert math.isnan(gripper.read(1.5).width)
    gripper.inject(disconnect=True)
    with pytest.raises(ConnectionLost):
        gripper.move(0.0, 0.1, 10.0)
    gripper.close()


# Camera.


def test_camera_pictures_contain_their_number_and_time(camera: MockCamera) -> None:
    frames = [camera.grab(0.0) for _ in range(3)]
    for k, frame in enumerate(frames, start=1):
        assert frame.color is not None
        assert frame.seq == k
        assert read_picture(frame.color) == (k, pytest.approx(frame.t, abs=1e-6))
    assert frames[2].t - frames[0].t == pytest.approx(2 / 30)


def test_camera_streams_agree_and_the_square_moves(camera: MockCamera) -> None:
    lefts = []
    for _ in range(2):
        frame = camera.grab(0.0)
        assert frame.color.shape == (48, 64, 3)
        assert frame.depth.shape == frame.infrared.shape == frame.segmentation.shape == (48, 64)
        square = frame.segmentation == 0
        assert (frame.color[square] == 255).all()
        assert np.allclose(frame.depth[square], 0.9)
        assert np.allclose(frame.depth[~square], 1.0)
        lefts.append(int(np.argmax(square.any(axis=0))))
    assert lefts[1] == lefts[0] + STEP


def test_camera_in_lock_step_shows_the_present(camera_spec: CameraSpec) -> None:
    time = [2.0]
    camera = MockCamera(camera_spec, LockStepClock(lambda: time[0], lambda t: None))
    camera.open()
    times = []
    for now in (2.0, 2.5, 2.5):
        time[0] = now
        frame = camera.grab(1.0)
        times.append((frame.seq, frame.t, frame.t_device))
    assert times == [(1, 2.0, 0.0), (2, 2.5, 0.5), (3, 2.5, 0.5)]


class ClockAt(RealClock):
    """A real clock that a test moves."""

    t = 100.0

    def now(self) -> float:
        return self.t


def test_camera_in_real_time_keeps_its_rate(camera_spec: CameraSpec) -> None:
    clock = ClockAt()
    camera = MockCamera(camera_spec, clock)
    camera.open()
    seen = []
    for k in range(200):  # 2 s in steps of 10 ms
        clock.t = 100.0 + 0.01 * k
        frame = camera.grab(0.0)
        if frame is not None:
            assert 0.0 <= clock.t - frame.t < 1 / 30 + 1e-9
            seen.append(frame.seq)
    assert seen == list(range(1, 61))


def test_camera_faults(camera: MockCamera) -> None:
    camera.inject(drop=3)
    assert [camera.grab(0.0).seq for _ in range(4)] == [1, 2, 4, 5]
    camera.inject(drop=0, freeze=True)
    assert camera.grab(1.0) is None
    camera.inject(freeze=False, garbage="shape")
    frame = camera.grab(0.0)
    assert frame.color.shape == (47, 64, 3)
    camera.inject(garbage="nan")
    frame = camera.grab(0.0)
    assert frame.depth is not None
    assert np.isnan(frame.depth).all()
    camera.inject(garbage=None, disconnect=True)
    with pytest.raises(ConnectionLost):
        camera.grab(0.0)
    camera.inject(disconnect=False)
    assert camera.grab(0.0) is not None


# Pad.


def test_pad_triggers_are_axis_and_button_in_one(pad: MockPad) -> None:
    pad.press("l2")
    assert pad.poll(1.0, 0.0).axes["l2"] == 1.0
    pad.stick("l2", 0.0)
    assert pad.poll(2.0, 0.0).buttons == frozenset()
    pad.stick("r2", 0.6)
    assert pad.poll(3.0, 0.0).buttons == {"r2"}
    pad.set(axes={"left_y": 1.0}, buttons=["east"])
    reading = pad.poll(4.0, 0.0)
    assert (reading.buttons, reading.axes["left_y"], reading.axes["r2"]) == ({"east"}, 1.0, 0.0)


@pytest.mark.parametrize(
    "move",
    [
        lambda pad: pad.press("cross"),
        lambda pad: pad.stick("left", 0.5),
        lambda pad: pad.stick("left_x", 1.5),
        lambda pad: pad.stick("l2", -0.5),
        lambda pad: pad.stick("left_x", float("nan")),
    ],
)
def test_pad_refuses_unknown_controls_and_values(pad: MockPad, move: Callable[[MockPad], None]) -> None:
    with pytest.raises(CommandError):
        move(pad)
    assert pad.poll(1.0, 0.0).buttons == frozenset()


# An arm driven by torques: wheels with friction.

DT = 1e-3


def drive(arm: MockRobot, tau: tuple[float, ...], ticks: int, start: int = 0) -> None:
    for k in range(start, start + ticks):
        reading = arm.read(k * DT)
        arm.write(Setpoint(reading.q, reading.dq, ZERO, tau))


def test_torque_turns_a_wheel_with_friction(arm: MockRobot) -> None:
    drive(arm, (2.0, 0.0, -1.0), 500)
    reading = arm.read(0.5)
    rate = FRICTION / INERTIA
    speed = 2.0 / FRICTION * (1.0 - exp(-0.5 * rate))
    assert reading.dq == pytest.approx((speed, 0.0, -0.5 * speed), rel=2e-3)
    way = 2.0 / FRICTION * (0.5 - (1.0 - exp(-0.5 * rate)) / rate)
    assert np.subtract(reading.q, HERE) == pytest.approx((way, 0.0, -0.5 * way), rel=5e-3)


def test_dropped_torque_repeats_the_one_before(arm: MockRobot) -> None:
    drive(arm, (2.0, 0.0, 0.0), 100)
    arm.inject(drop=1)
    drive(arm, (-50.0, 0.0, 0.0), 5, start=100)
    assert 0.0 < arm.read(105 * DT).dq[0] < 0.25
