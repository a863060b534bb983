"""What the CAN drivers put on the bus when something is wrong: nothing falls, jumps or starts by itself.

Drivers and emulators share a bus in memory and one thread. Time passes only when a test lets it.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import can
import pytest

from hal.config.loader import load
from hal.driver import Setpoint
from hal.drivers.can import damiao_chain, piper_link
from hal.drivers.can.bus import CanBus
from hal.drivers.can.damiao import DamiaoArm
from hal.drivers.can.damiao_motor import ChainMotor, register_problems
from hal.drivers.can.damiao_protocol import MotorRegister, MotorStatus
from hal.drivers.can.piper import PiperArm
from hal.drivers.can.piper_gripper import PiperGripper
from hal.drivers.can.piper_protocol import GripperRequest, JointTargets
from hal.drivers.can.settings import BusSettings, DamiaoMotorSettings
from hal.errors import ConfigError, ConnectionLost, ControlTaken, RobotFault
from hal.host.cycle import ArmUnit
from hal.types import RobotStatus
from hal_emulators.can.damiao_frames import MotorSide
from hal_emulators.can.piper_frames import decode_command
from hal_emulators.can.server import CanEmulator

from ....kits.can_kit import can_overrides

OUTSTRETCHED = (0.0, 1.57, 0.05, 0.0, 0.0, 0.0)
"""Pose of a YAM that takes the greatest torques."""
NO_MOTION = [0.0] * 6


class Bench:
    """A rig's emulated arm with a driver, both stepped by the test."""

    def __init__(self, rig: str, monkeypatch: pytest.MonkeyPatch) -> None:
        overrides = can_overrides("virtual")
        self.emulator = CanEmulator(rig, overrides)
        self.spec = load(rig, sim=False, overrides=overrides).resolve().robots[0]
        self.arm: Any = self.emulator.arms[self.spec.name]
        self.bus = self.emulator.bus_of(self.arm)
        self.bus.open()
        self.passed = 0.0
        self.driver: Any = None
        self.reading: Any = None
        clock = SimpleNamespace(monotonic=lambda: 1000.0 + self.passed, sleep=self.advance)
        for module in (damiao_chain, piper_link):
            monkeypatch.setattr(module, "time", clock)

    @property
    def now(self) -> float:
        return 1000.0 + self.passed

    def advance(self, seconds: float) -> None:
        """Let time pass for the arm, while the driver is not called."""
        for _ in range(max(1, round(seconds / 1e-3))):
            self.passed += 1e-3
            self.bus.advance(1e-3)

    def open(self, driver: Any) -> Any:
        """Open a driver, and read it twice."""
        self.driver = driver
        driver.open()
        self.cycle(2)
        return driver

    def cycle(self, count: int = 1) -> Any:
        """Read the driver ``count`` times at the arm's rate, and return the last reading."""
        for _ in range(count):
            self.advance(1.0 / self.spec.rate_hz)
            self.reading = self.driver.read(self.now)
        return self.reading

    def engage(self) -> None:
        """Switch the arm on."""
        for _ in range(300):
            if self.driver.engaged:
                return
            self.driver.engage()
            self.cycle()
        raise AssertionError("the drives do not switch on")

    def fastest(self, seconds: float) -> float:
        """Return the greatest speed of a joint, rad/s, while ``seconds`` pass without the driver."""
        self.arm.peak = [0.0] * len(self.arm.peak)
        self.advance(seconds)
        return max(self.arm.peak)

    def close(self) -> None:
        self.emulator.execute("cut on")
        if self.driver is not None:
            self.driver.close()
        self.bus.stop()


@pytest.fixture
def yam(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    bench = Bench("yam", monkeypatch)
    yield bench
    bench.close()


@pytest.fixture
def piper(monkeypatch: pytest.MonkeyPatch) -> Iterator[Bench]:
    bench = Bench("piper", monkeypatch)
    yield bench
    bench.close()


def engaged_yam(yam: Bench, pose: tuple[float, ...] = OUTSTRETCHED) -> DamiaoArm:
    yam.arm.plant.place(pose)
    driver: DamiaoArm = yam.open(DamiaoArm(yam.spec))
    yam.engage()
    yam.cycle(20)
    return driver


# Damiao motors: the end.


def test_closing_lowers_an_outstretched_arm_slowly_and_never_drops_it(yam: Bench) -> None:
    driver = engaged_yam(yam)
    yam.arm.peak = list(NO_MOTION)
    driver.close()
    assert max(yam.arm.peak) < 0.5
    assert yam.fastest(1.0) < 0.5


def test_closing_does_not_switch_off_motors_whose_replies_are_lost(yam: Bench) -> None:
    driver = engaged_yam(yam)
    yam.emulator.execute("lose 1")
    driver.close()
    assert all(yam.arm.motors[k].status != MotorStatus.DISABLED for k in range(1, 7))
    assert yam.fastest(1.0) < 0.5


def test_closing_switches_off_motors_at_rest(yam: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    yam.arm.plant.place(OUTSTRETCHED)
    driver = yam.open(DamiaoArm(yam.spec))
    yam.engage()
    monkeypatch.setattr(yam.arm, "_release", lambda: None)
    yam.arm.plant.held = True  # on a stand
    before = yam.passed
    driver.close()
    assert all(yam.arm.motors[k].status == MotorStatus.DISABLED for k in range(1, 7))
    assert yam.passed - before < 1.0


# Damiao motors: set-points.


def test_a_set_point_that_is_not_finite_puts_nothing_on_the_bus(yam: Bench) -> None:
    driver = engaged_yam(yam)
    assert driver.chain.bus is not None
    before = driver.chain.bus.sent
    sound = Setpoint(yam.reading.q, NO_MOTION, NO_MOTION)
    for field, wrong in itertools.product(("q", "dq", "ddq", "tau"), (math.nan, math.inf, -math.inf)):
        with pytest.raises(ValueError):  # noqa: PT011
            driver.write(sound._replace(**{field: [wrong, *NO_MOTION[1:]]}))
        assert driver.chain.bus.sent == before


@pytest.mark.parametrize("tau", [(0.0, 3.0, 0.0, 0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 0.0, 0.0, 0.5)])
def test_motors_do_not_race_when_a_program_is_killed_in_torque_mode(yam: Bench, tau: tuple[float, ...]) -> None:
    driver = engaged_yam(yam, (0.0, 1.57, 1.35, -1.42, 0.0, 0.0))
    for _ in range(5):
        driver.write(Setpoint(yam.reading.q, yam.reading.dq, NO_MOTION, tau))
        yam.cycle()
    assert yam.fastest(0.6) < 3.0  # TIMEOUT is 0.4 s; undamped it is 10 to 15 rad/s


@pytest.mark.parametrize("direction", [1.0, -1.0])
def test_direction_and_offset_turn_position_velocity_and_torque_alike(direction: float) -> None:
    settings = DamiaoMotorSettings(id=1, type="DM4310", kp=10.0, kd=1.0, direction=direction, offset=0.3)
    motor = ChainMotor(settings, "joint1")
    codec = MotorSide(motor.codec.limits)
    q, dq, kp, kd, tau = codec.decode_command(motor.command(0.8, 2.0, 10.0, 1.0, -4.0))
    assert (q, dq, tau) == pytest.approx((direction * 0.5, direction * 2.0, direction * -4.0), abs=0.015)
    assert (kp, kd) == pytest.approx((10.0, 1.0), abs=0.13)
    motor.receive(bytearray(codec.encode_feedback(1, 1, direction * 0.5, direction * 2.0, direction * -4.0)))
    motor.decode()
    assert (motor.q, motor.dq, motor.tau) == pytest.approx((0.8, 2.0, -4.0), abs=0.015)


def test_a_bus_that_takes_no_frames_is_noticed(yam: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = engaged_yam(yam)
    monkeypatch.setattr(driver.chain.bus, "send", lambda id, data: False)
    began, q = yam.now, yam.reading.q
    with pytest.raises(ConnectionLost):
        while True:
            driver.write(Setpoint(q, NO_MOTION, NO_MOTION))
            yam.cycle()
    assert yam.now - began <= 0.15
    assert not driver.engaged


# Damiao motors: restarts and registers.


def test_registers_of_a_motor_that_restarted_are_checked_before_it_is_switched_on(yam: Bench) -> None:
    driver = engaged_yam(yam)
    motor = yam.arm.motors[2]
    motor.restart()
    motor.registers[MotorRegister.TIMEOUT] = 0
    assert yam.cycle(20).fault.code == "switched_off"
    driver.recover()
    yam.cycle(5)
    with pytest.raises(RobotFault) as caught:
        yam.engage()
    assert caught.value.code == "no_timeout"
    assert motor.status == MotorStatus.DISABLED


@pytest.mark.parametrize(
    ("seconds", "code"), [(0.0, "no_timeout"), (0.04, "short_timeout"), (0.4, None), (1.0, None), (60.0, "no_timeout")]
)
def test_a_time_out_that_is_too_short_or_too_long_is_refused(yam: Bench, seconds: float, code: str | None) -> None:
    motor = DamiaoArm(yam.spec).settings.motors[0]
    found = [problem[2] for problem in register_problems(motor, {MotorRegister.TIMEOUT: round(seconds / 50e-6)})]
    assert found == ([code] if code else [])


def test_an_arm_whose_replies_would_command_another_one_is_refused(yam: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    """Also one in another process: ids 17 to 22 are those at which the first arm answers."""
    engaged_yam(yam)
    monkeypatch.setattr(damiao_chain, "_LOCK_PATIENCE", 0.0)
    motors = [{**motor, "id": motor["id"] + 0x10} for motor in yam.spec.options["motors"]]
    other = DamiaoArm(replace(yam.spec, options={**yam.spec.options, "motors": motors}))
    with pytest.raises(ControlTaken):
        other.open()


# Switching on.


class NoMail:
    """A mailbox without content."""


@pytest.mark.parametrize("session", [False, True], ids=["when_a_session_opens", "in_a_session"])
def test_an_arm_that_was_moved_while_this_process_was_paused_is_held_where_it_is_now(yam: Bench, session: bool) -> None:
    unit = ArmUnit(yam.spec, 1.0 / yam.spec.rate_hz, NoMail(), None)  # type: ignore[arg-type]
    yam.driver = unit.driver

    def turn() -> None:
        yam.advance(unit.dt)
        unit.read(yam.now)

    unit.driver.open()
    turn()
    turn()
    yam.arm.plant.place((0.5, *OUTSTRETCHED[1:]))  # by hand, for as long as this process is paused
    yam.passed += 10.0
    yam.arm.peak = list(NO_MOTION)
    if session:
        unit.servo.report.status = RobotStatus.FOLLOWING
        unit._setpoint = Setpoint(OUTSTRETCHED, NO_MOTION, NO_MOTION)
        for _ in range(100):
            unit.read(yam.now)
            if not unit.driver.engaged:
                unit.write(yam.now)
            yam.advance(unit.dt)
    else:
        unit._engage(turn)
    assert unit.driver.engaged
    for _ in range(50):
        turn()
    assert max(yam.arm.peak) < 0.1
    assert yam.arm.plant.q[0] == pytest.approx(0.5, abs=0.005)


# PiPER.


def targets_of(sent: list[can.Message]) -> list[JointTargets]:
    commands = [decode_command(message.arbitration_id, bytes(message.data)) for message in sent]
    return [command for command in commands if isinstance(command, JointTargets)]


def test_a_piper_notices_a_bus_that_takes_no_frames(piper: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = piper.open(PiperArm(piper.spec))
    piper.engage()
    q = piper.cycle(10).q
    driver.write(Setpoint(q, NO_MOTION, NO_MOTION))
    monkeypatch.setattr(driver._link.bus, "send", lambda id, data: False)
    began = piper.now
    with pytest.raises(ConnectionLost):
        for k in itertools.count(1):
            ahead = [q[0] + 0.002 * k, *q[1:]]
            assert driver.write(Setpoint(ahead, NO_MOTION, NO_MOTION)) is False
            assert piper.cycle().q_commanded == tuple(q)
    assert piper.now - began <= 0.15
    assert not driver.engaged


def test_a_piper_that_gets_no_targets_does_not_race_to_a_far_one_later(piper: Bench) -> None:
    driver = piper.open(PiperArm(piper.spec))
    piper.engage()
    q = list(piper.cycle(10).q)
    take, piper.arm.take = piper.arm.take, lambda *_: None  # its reports still come
    fault = None
    for _ in range(200):
        q[0] += 0.005  # 1 rad/s
        if driver.write(Setpoint(q, NO_MOTION, NO_MOTION)) is False:
            break
        fault = piper.cycle().fault
    assert fault is not None
    assert fault.code == "not_following"
    assert not driver.engaged
    piper.arm.take = take
    assert piper.fastest(0.5) < 0.01
    before = piper.arm.commands
    piper.cycle(5)
    assert piper.arm.commands > before, "it is told to stay where it is"
    piper.arm.control = 2  # a hand takes it over
    piper.cycle(3)
    before = piper.arm.commands
    piper.cycle(5)
    assert piper.arm.commands == before


def test_a_piper_is_not_taken_over_while_a_hand_or_another_program_moves_it(piper: Bench) -> None:
    driver = piper.open(PiperArm(piper.spec))
    piper.arm.control = 2  # teaching
    piper.cycle(3)
    before = piper.arm.commands
    with pytest.raises(RobotFault) as caught:
        driver.engage()
    piper.cycle(3)
    assert caught.value.code == "not_in_control"
    assert piper.arm.commands == before


def test_a_pipers_first_frame_is_the_target_where_it_is(piper: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    driver = piper.open(PiperArm(piper.spec))
    piper.arm.enabled = [True] * 6
    piper.cycle(10)
    sent: list[int] = []
    send = driver._link.bus.send
    monkeypatch.setattr(driver._link.bus, "send", lambda id, data: (sent.append(id), send(id, data))[1])
    piper.engage()
    assert sent[:4] == [0x155, 0x156, 0x157, 0x151]
    assert sent[-3:] == [0x155, 0x156, 0x157]


def test_the_first_command_to_a_pipers_gripper_starts_where_its_fingers_are(
    piper: Bench, monkeypatch: pytest.MonkeyPatch
) -> None:
    piper.arm.gripper_width = 0.07
    piper.arm.restart()
    piper.arm._gripper = piper.arm._gripper._replace(enabled=True)  # by an earlier program
    driver = piper.open(PiperGripper(piper.spec.gripper))
    widths: list[float] = []
    send = driver._link.bus.send

    def note(id: int, data: bytes) -> bool:
        command = decode_command(id, data)
        assert isinstance(command, GripperRequest)
        widths.append(command.width)
        return bool(send(id, data))

    monkeypatch.setattr(driver._link.bus, "send", note)
    driver.move(0.02, 0.05, 10.0)
    piper.cycle(10)
    assert widths[0] == pytest.approx(0.07, abs=1e-5)
    assert max(a - b for a, b in itertools.pairwise(widths)) <= 0.05 / piper.spec.rate_hz + 1e-6


@pytest.mark.parametrize("block", [None, 0.05])
def test_a_stop_of_a_pipers_fingers_that_lag_behind_their_target(
    piper: Bench, monkeypatch: pytest.MonkeyPatch, block: float | None
) -> None:
    """Fingers slower than the command stop where they are; those that an object blocks press on with the same force."""
    monkeypatch.setattr("hal_emulators.can.piper._FINGER_SPEED", 0.02)
    piper.arm.gripper_width = 0.07
    piper.arm.restart()
    if block is not None:
        piper.emulator.execute(f"object {block}")
    driver = piper.open(PiperGripper(piper.spec.gripper))
    driver.move(0.0, 0.1, 10.0)
    at = piper.cycle(round(1.5 * piper.spec.rate_hz)).width
    driver.stop()
    piper.cycle(round(0.5 * piper.spec.rate_hz))
    assert piper.reading.width == pytest.approx(at if block is None else block, abs=1e-3)
    assert piper.reading.force == pytest.approx(0.0 if block is None else 10.0, abs=0.2)


# The bus.


@pytest.fixture
def bus() -> Iterator[tuple[CanBus, can.BusABC]]:
    settings = BusSettings(interface="virtual", channel=can_overrides("virtual")[-1].split("=")[1])
    ours, far = CanBus.acquire(settings), can.Bus(interface="virtual", channel=settings.channel)
    yield ours, far
    ours.release()
    far.shutdown()


def test_an_id_at_which_one_device_is_commanded_is_nobody_elses_reply(bus: tuple[CanBus, can.BusABC]) -> None:
    ours, _ = bus
    ours.subscribe({0x11: lambda data: None}, [0x01, 0x7FF])
    with pytest.raises(ConfigError):
        ours.subscribe({0x21: lambda data: None}, [0x11, 0x7FF])  # its commands look like the other's replies
    with pytest.raises(ConfigError):
        ours.subscribe({0x01: lambda data: None}, [0x02, 0x7FF])  # its replies would be commands for the other
    ours.subscribe({0x12: lambda data: None}, [0x02, 0x7FF])
    ours.unsubscribe([0x11], [0x01, 0x7FF])
    ours.subscribe({0x01: lambda data: None}, [0x7FF])


def test_frames_with_long_ids_and_requests_are_no_replies(bus: tuple[CanBus, can.BusABC]) -> None:
    ours, far = bus
    seen: list[bytes] = []
    ours.subscribe({0x11: lambda data: seen.append(bytes(data))}, [])
    far.send(can.Message(arbitration_id=0x11, data=bytes(8), is_extended_id=True))
    far.send(can.Message(arbitration_id=0x11, is_remote_frame=True, dlc=8, is_extended_id=False))
    far.send(can.Message(arbitration_id=0x11, data=b"12345678", is_extended_id=False))
    assert ours.poll()
    assert seen == [b"12345678"]
    assert ours.unexpected == 2
