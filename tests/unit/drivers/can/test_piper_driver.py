"""The driver of a PiPER on an emulator that advances with the test: faults, losses, and every frame that it sends."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from unittest.mock import patch

import can
import pytest
from stepped_can import SteppedEmulator

from hal.driver import Reading, Setpoint
from hal.drivers.can import piper_protocol as protocol
from hal.drivers.can.piper import PiperArm
from hal.drivers.can.piper_gripper import PiperGripper
from hal.errors import ConnectionLost, DeviceNotFound, RobotFault
from hal.types import GripperOutcome
from hal_emulators.can.piper_frames import EmergencyRequest, decode_command, encode_report

DT = 0.005
ZEROS = (0.0,) * 6


class Bench:
    """A driver on an emulated PiPER, and what it sends."""

    def __init__(self, far: SteppedEmulator) -> None:
        self.far = far
        self.driver = PiperArm(far.spec)
        self.now = 100.0
        self._tap = can.Bus(interface="virtual", channel=far.spec.options["channel"])

    def cycle(self) -> Reading:
        """Let a cycle pass, and read."""
        self.far.advance(DT)
        self.now += DT
        return self.driver.read(self.now)

    def run(self, seconds: float) -> Reading:
        """Read for a while, and return the last reading."""
        return [self.cycle() for _ in range(round(seconds / DT))][-1]

    def engage(self) -> Reading:
        """Switch the motors on, as the host does."""
        for _ in range(200):
            if self.driver.engaged:
                return self.cycle()
            self.driver.engage()
            self.cycle()
        raise AssertionError("not engaged")

    def move(self, rise: float, cycles: int = 40) -> Reading:
        """Move joint 4 by ``rise`` rad."""
        reading = self.cycle()
        start = list(reading.q_commanded or reading.q)
        for k in range(cycles):
            q = [*start[:3], start[3] + rise * (k + 1) / cycles, *start[4:]]
            assert self.driver.write(Setpoint(q, ZEROS, ZEROS))
            reading = self.cycle()
        return reading

    def sent(self) -> list[tuple[int, bytes]]:
        """Return the commands on the bus since the last call."""
        frames = []
        while (message := self._tap.recv(0.0)) is not None:
            if message.arbitration_id in (*protocol.COMMAND_IDS, 0x150):
                frames.append((message.arbitration_id, bytes(message.data)))
        return frames

    def close(self) -> None:
        self.driver.close()
        self._tap.shutdown()


@pytest.fixture
def bench() -> Iterator[Bench]:
    """An open driver."""
    with SteppedEmulator("piper") as far:
        made = Bench(far)
        made.driver.open()
        yield made
        made.close()


def test_opening_and_reading_send_nothing(bench: Bench) -> None:
    reading = bench.run(0.1)
    assert (reading.fault, reading.q_commanded, bench.driver.engaged) == (None, None, False)
    assert bench.driver.write(Setpoint(reading.q, ZEROS, ZEROS)) is False
    assert bench.sent() == []


def test_no_frame_could_let_the_arm_fall(bench: Bench) -> None:
    """Neither halt, close, a fault nor recover switches a motor off, and the vendor's reset is never sent."""
    bench.engage()
    bench.move(0.1)
    bench.driver.halt()
    bench.far.execute("status 0 7")
    bench.run(0.05)
    bench.driver.recover()
    bench.run(0.2)
    bench.engage()
    bench.driver.close()
    sent = [decode_command(*frame) for frame in bench.sent()]
    assert not any(isinstance(command, EmergencyRequest) for command in sent)
    enables = [command for command in sent if isinstance(command, protocol.EnableRequest)]
    assert enables
    assert all(command.enabled for command in enables)
    bench.far.advance(1.0)
    assert bench.far.arm.enabled == [True] * 6


def test_the_first_target_after_engaging_is_where_the_arm_is(bench: Bench) -> None:
    """Even if another program left one elsewhere, in control mode."""
    arm = bench.far.arm
    before = list(bench.run(0.05).q)
    arm.control, arm.target = protocol.CAN_CONTROL, [x + 0.3 for x in before]
    reading = bench.engage()
    assert reading.q == pytest.approx(before, abs=1e-3)
    assert reading.q_commanded == pytest.approx(before, abs=1e-3)
    first = next(data for id, data in bench.sent() if id == 0x155)
    assert first == protocol.encode_joint_targets(before)[0][1]
    assert bench.run(0.5).q == pytest.approx(before, abs=1e-3)


@pytest.mark.parametrize(
    "status",
    [
        0x1,
        0x6,
        0xF,
        *(pytest.param(k, marks=pytest.mark.slow) for k in (0x2, 0x3, 0x4, 0x5, 0x7, 0x8, 0x9, 0xA, 0xE)),
    ],
)
def test_every_error_stops_the_stream_until_recover(bench: Bench, status: int) -> None:
    bench.engage()
    bench.move(0.1)
    bench.sent()
    bench.far.execute(f"status 0 {status:x}")
    reading = bench.run(0.02)
    assert reading.fault is not None
    assert reading.fault.code == protocol.ARM_STATUS[status]
    assert reading.fault.remedy
    assert (reading.q_commanded, bench.driver.engaged) == (None, False)
    assert bench.driver.write(Setpoint(reading.q, ZEROS, ZEROS)) is False
    with pytest.raises(RobotFault) as caught:
        bench.driver.engage()
    assert caught.value.code == reading.fault.code
    assert bench.sent() == []
    bench.far.execute("status 0 0")  # gone by itself: the fault stays until the user agrees
    assert bench.run(0.3).fault == reading.fault
    bench.driver.recover()
    assert bench.run(0.2).fault is None
    assert not bench.driver.engaged
    bench.engage()
    bench.move(-0.1)


@pytest.mark.parametrize("flag", [0x01, 0x02, 0x04, 0x08, 0x10, 0x20, 0x80])
def test_the_flag_of_a_joint_is_a_fault_that_names_it(bench: Bench, flag: int) -> None:
    bench.engage()
    bench.far.execute(f"status 5 {flag:x}")
    reading = bench.run(0.04)
    assert reading.fault is not None
    assert "joint 5" in reading.fault.cause
    assert not bench.driver.engaged
    bench.driver.recover()
    assert bench.run(0.2).fault is None


def switch_joint_off(bench: Bench) -> None:
    bench.far.arm.enabled[1] = False


def start_teaching(bench: Bench) -> None:
    bench.far.arm.control = 2


def change_mode(bench: Bench) -> None:
    bench.far.arm.move = 0


@pytest.mark.parametrize(
    ("act", "code"),
    [(switch_joint_off, "switched_off"), (start_teaching, "not_in_control"), (change_mode, "not_in_control")],
)
def test_an_arm_that_no_longer_follows_is_not_engaged(bench: Bench, act: Callable[[Bench], None], code: str) -> None:
    bench.engage()
    act(bench)
    reading = bench.run(0.04)
    assert reading.fault is not None
    assert reading.fault.code == code
    assert not bench.driver.engaged
    bench.driver.recover()
    if act is start_teaching:  # a hand may hold it
        with pytest.raises(RobotFault):
            bench.engage()
        bench.far.arm.control = protocol.STANDBY
        bench.run(0.05)
    bench.engage()
    assert bench.run(0.05).fault is None


def test_a_motor_that_stays_off_is_named(bench: Bench) -> None:
    enable = bench.far.arm._enable

    def all_but_the_third(motor: int, enabled: bool) -> None:
        enable(motor, enabled)
        bench.far.arm.enabled[2] = False

    bench.run(0.05)
    with (
        patch.object(bench.far.arm, "_enable", all_but_the_third),
        pytest.raises(RobotFault, match="joint 3") as caught,
    ):
        bench.engage()
    assert caught.value.code == "switched_off"


def test_silence_is_a_loss_after_which_nothing_moves_by_itself(bench: Bench) -> None:
    bench.engage()
    bench.move(0.1)
    at = list(bench.run(0.3).q)
    bench.far.cut("on")
    with pytest.raises(ConnectionLost) as caught:
        bench.run(0.125)
    assert caught.value.code == "silent"
    for call in (bench.driver.recover, bench.driver.engage, lambda: bench.driver.write(Setpoint(at, ZEROS, ZEROS))):
        with pytest.raises(ConnectionLost):
            call()
    bench.far.cut("off")
    bench.sent()
    for _ in range(5):
        try:
            bench.cycle()
        except ConnectionLost:
            continue
    reading = bench.run(0.2)
    assert (reading.fault, reading.q_commanded, bench.driver.engaged) == (None, None, False)
    assert reading.q == pytest.approx(at, abs=1e-3)
    assert bench.sent() == []
    bench.engage()
    bench.move(-0.1)


@pytest.mark.parametrize("lost", [0x2A5, 0x2A6, 0x2A7])
def test_a_reading_is_never_made_of_frames_of_different_times(bench: Bench, lost: int) -> None:
    bench.run(0.05)
    send = bench.far.bus.send
    with patch.object(bench.far.bus, "send", lambda id, data: None if id == lost else send(id, data)):
        first = bench.run(0.02)
        last = bench.run(0.04)
    assert (last.t, last.seq) == (first.t, first.seq)
    after = bench.cycle()
    assert (after.t, after.seq) == (bench.now, first.seq + 1)


def test_an_error_that_stays_is_reported_by_recover(bench: Bench) -> None:
    """An emergency stop ends only with the vendor's reset, which is never sent."""
    bench.engage()
    bench.far.execute("status 0 1")
    bench.run(0.02)
    with patch.object(bench.far.arm, "take", lambda *_: None), pytest.raises(RobotFault) as caught:
        bench.driver.recover()
    assert caught.value.code == "emergency_stop"
    assert "support the arm" in caught.value.remedy


@pytest.mark.parametrize(("first", "seconds"), [(0x251, 0.12), (0x261, 0.55)])
def test_a_motor_that_falls_silent_is_named(bench: Bench, first: int, seconds: float) -> None:
    bench.run(0.05)
    send = bench.far.bus.send
    with patch.object(bench.far.bus, "send", lambda id, data: None if id == first + 3 else send(id, data)):
        with pytest.raises(ConnectionLost) as caught:
            bench.run(seconds)
        assert "joint 4" in str(caught.value)
    bench.far.advance(0.05)
    assert bench.cycle().fault is None


def test_a_target_that_is_no_number_is_not_sent(bench: Bench) -> None:
    bench.engage()
    bench.sent()
    with pytest.raises(ValueError, match="frame"):
        bench.driver.write(Setpoint((0.0, 0.0, 0.0, float("nan"), 0.0, 0.0), ZEROS, ZEROS))
    assert bench.sent() == []


def test_an_arm_that_is_not_there_is_named(bench: Bench) -> None:
    bench.driver.close()
    bench.far.cut("on")
    with pytest.raises(DeviceNotFound) as caught:
        bench.driver.open()
    assert caught.value.code == "no_answer"
    bench.far.cut("off")
    send = bench.far.bus.send
    with (
        patch.object(bench.far.bus, "send", lambda id, data: None if id == 0x264 else send(id, data)),
        pytest.raises(DeviceNotFound) as caught,
    ):
        bench.driver.open()
    assert "joint 4" in str(caught.value)
    bench.driver.open()


def test_frames_from_before_the_connect_are_not_believed(bench: Bench) -> None:
    """The bus was open for the gripper: what waits there is old."""
    assert bench.far.spec.gripper is not None
    gripper = PiperGripper(bench.far.spec.gripper)
    gripper.open()
    bench.driver.close()
    bench.far.advance(0.1)
    bench.far.arm.plant.place([x + 0.1 for x in bench.far.arm.plant.q.tolist()])
    bench.driver.open()
    assert bench.cycle().q == pytest.approx(bench.far.arm.plant.q.tolist(), abs=1e-4)
    gripper.close()


def test_a_slow_opening_of_other_devices_is_no_silence(bench: Bench) -> None:
    """The first reading has the time before the opening, the second one the first cycle's."""
    assert bench.far.spec.gripper is not None
    gripper = PiperGripper(bench.far.spec.gripper)
    gripper.open()
    for device in (bench.driver, gripper):
        device.read(200.0)
        assert device.read(200.5).t == 200.5
        with pytest.raises(ConnectionLost):
            device.read(200.7)
    gripper.close()


def test_a_grippers_error_fails_its_command_and_the_next_one_clears_it(bench: Bench) -> None:
    assert bench.far.spec.gripper is not None
    gripper = PiperGripper(bench.far.spec.gripper)
    gripper.open()

    def run(seconds: float) -> float:
        for _ in range(round(seconds / DT)):
            bench.far.advance(DT)
            bench.now += DT
            width = gripper.read(bench.now).width
        return width

    run(0.05)
    gripper.move(0.05, 0.1, 20.0)
    assert run(1.0) == pytest.approx(0.05, abs=1e-3)
    send, status = bench.far.bus.send, protocol.GripperStatus(0.05, 0.0, protocol.ENABLED | protocol.OVER_CURRENT)
    report = encode_report(status)[1]
    with patch.object(bench.far.bus, "send", lambda id, data: send(id, report if id == 0x2A8 else data)):
        run(0.02)
        fault = gripper.read(bench.now).fault
        assert fault is not None
        assert fault.code == "over_current"
        bench.sent()
        gripper.move(0.03, 0.1, 20.0)
        command = decode_command(*bench.sent()[0])
        assert isinstance(command, protocol.GripperRequest)
        assert command.clear_error
        assert command.torque == pytest.approx(0.5)
    gripper.move(0.03, 0.1, 20.0)
    assert run(1.0) == pytest.approx(0.03, abs=1e-3)
    assert gripper.read(bench.now).fault is None
    bench.far.execute("power")
    run(0.1)
    reading = gripper.read(bench.now)
    assert reading.fault is not None
    assert (reading.fault.code, reading.outcome, reading.grasped) == ("switched_off", GripperOutcome.FAILED, False)
    gripper.move(0.05, 0.1, 20.0)
    assert run(1.0) == pytest.approx(0.05, abs=1e-3)
    assert gripper.read(bench.now).outcome is None
    gripper.close()
