"""Arms on a servo bus: what is refused, what is a fault, and that nothing leaps. The emulator is stepped."""

from __future__ import annotations

import json
import os
import re
import termios
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from dataclasses import replace
from math import pi
from pathlib import Path
from time import monotonic, sleep
from unittest.mock import patch

import pytest
from servo_bus_kit import SteppedServos
from waiting import wait_until

from hal import registry
from hal.driver import Reading, Setpoint
from hal.drivers.servo_bus import bus
from hal.drivers.servo_bus.arm import ServoArm
from hal.drivers.servo_bus.bus import ServoBus
from hal.drivers.servo_bus.dynamixel import Dynamixel
from hal.drivers.servo_bus.feetech import Feetech
from hal.drivers.servo_bus.preflight import check
from hal.drivers.servo_bus.protocol import signed
from hal.errors import ConfigError, ConnectionLost, DeviceNotFound, HalError, RobotFault
from hal.testing import GripperBench
from hal.testing.hosting import HostedGripper
from hal.types import GripperOutcome


class Arm:
    """A driver, and the emulator behind it."""

    def __init__(self, far: SteppedServos, driver: ServoArm) -> None:
        self.far, self.driver, self.now = far, driver, 1000.0
        self.sent: list[float] = []

    def run(self, seconds: float = 0.01) -> Reading:
        """Read 100 times a second, and return the last reading."""
        for _ in range(round(seconds / 0.01)):
            self.far.advance(0.01)
            self.now += 0.01
            reading = self.driver.read(self.now)
        return reading

    def engage(self) -> Reading:
        """Open it and switch it on."""
        self.driver.open()
        reading = self.run()
        for _ in range(100):
            if self.driver.engaged:
                return reading
            self.driver.engage()
            reading = self.run()
        raise AssertionError("not engaged")

    def write(self, q: list[float]) -> Reading:
        still, before = (0.0,) * len(q), self.sent or q
        self.driver.write(Setpoint(tuple(q), tuple((b - a) / 0.01 for a, b in zip(before, q, strict=True)), still))
        self.sent = list(q)
        return self.run()


def make(far: SteppedServos, **changes: object) -> ServoArm:
    """Return a driver of an emulated arm."""
    driver: ServoArm = registry.load(far.spec.driver, "robot")(replace(far.spec, **changes))  # type: ignore[arg-type]
    return driver


@contextmanager
def made(rig: str) -> Iterator[Arm]:
    with SteppedServos(rig) as far, closing(make(far)) as driver:
        yield Arm(far, driver)


@pytest.fixture(params=["so101", "viperx"])
def arm(request: pytest.FixtureRequest) -> Iterator[Arm]:
    with made(request.param) as arm:
        yield arm


@pytest.fixture
def so101() -> Iterator[Arm]:
    with made("so101") as arm:
        yield arm


@pytest.fixture
def viperx() -> Iterator[Arm]:
    with made("viperx") as arm:
        yield arm


def test_frames_are_those_of_the_protocols() -> None:
    """Of the manuals: a ping of motor 1 and its answer; of Robotis's, also a write with a byte that is stuffed."""
    feetech, dynamixel = Feetech(), Dynamixel()
    assert feetech.encode(1, 1).hex() == "ffff010201fb"
    answers, rest, spoilt = feetech.split(bytes.fromhex("00ff ffff010200fc ffff010200fd ffff01"))
    assert [answer.id for answer in answers] == [1]
    assert (rest, spoilt) == (b"\xff\xff\x01", 1)
    assert (signed(0x0801, 11), signed(0x0401, 11)) == (-1, 0x401)
    assert dynamixel.encode(1, 1).hex() == "fffffd000103000" + "1194e"
    ping = bytes.fromhex("fffffd000107005500060426655d")
    answers, rest, spoilt = dynamixel.split(b"\xff" + ping + ping[:-1] + b"\x5e" + ping[:5])
    assert [tuple(answer) for answer in answers] == [(1, 0, b"\x06\x04\x26")]
    assert (rest, spoilt) == (ping[:5], 1)
    data = b"\x74\x00\xff\xff\xfd\xfd\xff\xff\xfd"
    frame = dynamixel.encode(2, 3, data)
    assert frame.count(b"\xff\xff\xfd\x00") == 1
    assert [tuple(answer) for answer in dynamixel.split(frame)[0]] == [(2, 3, data)]


def test_the_middle_of_the_calibrated_range_is_zero_and_a_turn_has_4096_counts(so101: Arm) -> None:
    so101.far.arm.plant.place([0.0, 0.5, 0.0, 0.0, 0.0])
    so101.far.advance(0.002)
    so101.driver.open()
    c = so101.driver.chain.registers[1].calibration
    so101.run()
    state = so101.far.arm.servos[1]
    assert round(state.angle) == round(0.5 * (c.range_min + c.range_max) + 0.5 * 4096 / (2 * pi))
    assert so101.run().q == pytest.approx([0.0, 0.5, 0.0, 0.0, 0.0], abs=2e-3)


def test_goals_are_the_present_positions_before_the_torque_is_on_and_nothing_leaps(arm: Arm) -> None:
    address = arm.driver.protocol.goal[0]
    for id in range(1, len(arm.far.arm.servos)):
        arm.far.execute(f"register {id} {address} 3000")  # of an earlier program
    arm.driver.open()
    before = arm.run().q
    assert not any(arm.far.execute("state")["on"])
    reading = arm.engage()
    state = arm.far.execute("state")
    assert all(state["on"][:-1])
    # 2.9 of 2.94 Nm; all that the motors have
    assert set(state["limits"][:-1]) == ({986} if arm.far.spec.model == "so101" else {885})
    arm.run(0.5)
    assert reading.q_commanded == pytest.approx(before, abs=2e-3)
    assert arm.run().q == pytest.approx(before, abs=2e-3), "its weight is carried"
    assert max(arm.far.arm.peak) < 0.3, "rad/s: its load bends the motors' springs, until the goals lead"


@pytest.mark.parametrize("arm", ["so101", "viperx", "widowx"], indirect=True)
def test_a_load_does_not_pull_it_off_its_set_point(arm: Arm) -> None:
    goal = list(arm.engage().q)
    for _ in range(100):
        goal[1] = goal[1] + 0.003
        arm.write(goal)
    assert arm.run().q[1] == pytest.approx(goal[1], abs=0.02), "it hardly lags"
    for _ in range(100):
        reading = arm.write(goal)
    assert reading.q == pytest.approx(goal, abs=2e-3), "friction does not, either"
    assert abs(arm.far.arm.plant.tau[1]) > 0.2  # Nm: without a lead it would be 7 mrad off, a ViperX 40


REFUSED = {
    "silent 3 on": (DeviceNotFound, "(motor 3)"),
    "twin 2 on": (DeviceNotFound, "two motors have the id 2"),
    "baud 115200": (DeviceNotFound, "but at 115200"),
    "register 4 {model} 2825": (ConfigError, "model 2825"),
    "register 4 {mode} 1": (ConfigError, "mode|not set to positions"),
    "register 1 {low} 2000": (ConfigError, "calibrate it"),
}
PLACES = {
    "Feetech": {"model": 3, "mode": 33, "low": 9, "sensor": 2, "current": 8},
    "Dynamixel": {"model": 0, "mode": 11, "low": 52, "sensor": 8, "current": 16},
}
"""Registers, and bits of errors."""


@pytest.mark.parametrize("command", REFUSED)
def test_a_wrong_motor_is_refused_by_name(arm: Arm, command: str) -> None:
    error, words = REFUSED[command]
    arm.far.execute(command.format(**PLACES[arm.driver.protocol.name]))
    with pytest.raises(error, match=words if "|" in words else re.escape(words)):
        arm.driver.open()
    assert [result.level for result in check(arm.far.spec, 0.1)] == ["fail"]


def test_a_motor_that_follows_another_one_is_refused(viperx: Arm) -> None:
    viperx.far.execute("register 6 12 1")
    with pytest.raises(ConfigError, match=r"forearm_roll \(motor 6\).*follows the motor 1"):
        viperx.driver.open()


FAULTS = {"error 3 32": "overload", "voltage all 17": "voltage", "voltage 2 3.5": "voltage"}
FAULTS |= {"temperature 5 85": "too_hot", "power 0": "switched_off"}
FAULTS |= {"error 1 {sensor}": "sensor", "error 1 {current}": "overcurrent"}


@pytest.mark.parametrize("command", FAULTS)
def test_a_fault_is_named_stops_the_arm_and_is_over_after_recover(arm: Arm, command: str) -> None:
    arm.engage()
    arm.far.execute(command.format(**PLACES[arm.driver.protocol.name]))
    reading = arm.run(0.06)
    assert reading.fault is not None
    assert reading.fault.code == FAULTS[command]
    assert reading.fault.remedy
    assert not arm.driver.engaged
    with pytest.raises(RobotFault):
        arm.driver.engage()
    arm.far.execute("reset")
    arm.far.execute("place")
    arm.driver.recover()
    assert arm.run().fault is None
    arm.run(0.05)
    arm.engage()


@pytest.mark.parametrize("command", ["temperature 2 85", "voltage 2 3.5"])
def test_a_joint_that_fell_does_not_leap_when_its_motor_has_its_torque_again(so101: Arm, command: str) -> None:
    held = so101.engage().q[1]
    so101.far.execute(command)
    fallen = so101.run(0.6).q[1]
    assert abs(fallen - held) > 0.2
    so101.far.execute("reset")
    assert abs(so101.run(1.0).q[1] - held) > 0.9 * abs(fallen - held)


def test_two_motors_of_a_joint_that_disagree_are_named(viperx: Arm) -> None:
    viperx.engage()
    viperx.far.execute("register 3 20 -300")
    viperx.far.arm.servos[2].put(20, -100)
    fault = viperx.run(0.02).fault
    assert fault is not None
    assert (fault.code, "motors 2, 3" in fault.cause) == ("twisted", True)


@pytest.mark.parametrize("turns", [-3, 1])
def test_turns_that_a_motor_counts_are_no_angle(viperx: Arm, turns: int) -> None:
    """In the modes that count turns, a motor loses them with its power; in that of one turn, once it is on."""
    for servo in viperx.far.arm.servos:
        servo.put(11, 4 if servo.id % 2 else 3)
        viperx.far.execute(f"turn {servo.id} {turns}")
    before = viperx.far.spec.initial
    viperx.engage()
    assert viperx.run(0.3).q == pytest.approx(before, abs=3e-3)
    assert max(viperx.far.arm.peak) < 0.3


def test_a_joint_at_both_ends_of_a_whole_turn_is_not_driven(viperx: Arm) -> None:
    viperx.far.execute("register 1 11 4")
    viperx.far.execute("place 3.12 -0.18 -0.36 0 -1.38 0")
    viperx.driver.open()
    viperx.run(0.05)
    with pytest.raises(RobotFault, match=r"waist \(motor 1\) may be at either end"):
        viperx.driver.engage()


def test_a_motor_stops_when_it_hears_nothing_and_is_switched_on_anew(viperx: Arm) -> None:
    goal = list(viperx.engage().q)
    for _ in range(20):
        goal[0] += 0.01
        viperx.write(goal)
    viperx.far.advance(0.15)
    assert viperx.far.arm.servos[0].registers[98] == 8
    viperx.far.advance(0.02)
    assert viperx.far.arm.servos[0].registers[98] == 255
    viperx.far.advance(0.2)
    there = viperx.far.arm.plant.q.tolist()
    reading = viperx.run(0.06)
    assert reading.fault is None
    assert not viperx.driver.engaged
    for _ in range(60):
        viperx.driver.engage()
        viperx.run()
    assert viperx.driver.engaged
    assert viperx.run().q == pytest.approx(there, abs=3e-3)
    viperx.driver.close()
    viperx.far.advance(0.25)
    assert viperx.far.arm.servos[0].registers[98] == 0, "other programs can use the motors, which hold"


def test_a_joint_outside_of_its_range_is_not_driven(so101: Arm) -> None:
    so101.far.execute("place 0 -0.6 0.87 -1.7 0")
    so101.far.execute("register 4 9 1120")
    so101.driver.open()
    so101.run()
    with pytest.raises(RobotFault, match=r"wrist_flex \(motor 4\) is 0\.\d\d rad outside"):
        so101.driver.engage()


@pytest.mark.parametrize("command", ["lose next 2", "lose next 2 3", "spoil 2", "double on", "late 0.002"])
def test_single_bad_answers_are_counted_and_stop_nothing(
    arm: Arm, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    goal = list(arm.engage().q)
    arm.driver.reset_statistics()
    monkeypatch.setattr(bus, "_ANSWER", 0.05)
    arm.far.execute(command)
    for _ in range(20):
        goal[0] += 0.005
        assert arm.write(goal).fault is None
    figures = arm.driver.statistics()["bus"]
    counted = {"lose": "lost", "spoil": "spoilt", "double": "surplus"}.get(command.split()[0])
    assert counted is None or figures[counted] >= 2
    arm.write(goal)
    assert arm.run(0.2).q == pytest.approx(goal, abs=0.01)


def test_an_arm_answers_in_time_after_cycles_in_which_no_motor_did(viperx: Arm) -> None:
    """On the wire of a real one; the status of all motors at once would take longer than a cycle waits."""
    viperx.engage()
    viperx.far.execute(f"lose next {8 * 4}")
    with patch.object(bus, "_ANSWER", 0.05):
        viperx.run(0.08)  # late answers pass in each second cycle
    assert viperx.run().t == viperx.now, "all joints are new again"
    assert viperx.driver.chain.bus is not None
    viperx.driver.chain.bus._status.clear()  # as after a longer silence
    protocol, took = viperx.driver.protocol, []
    with patch.object(ServoBus, "read_all", autospec=True, side_effect=ServoBus.read_all) as asked:
        for _ in range(4):
            asked.reset_mock()
            reading = viperx.run()
            sizes = [len(protocol.encode_answer(1, 0, bytes(c.args[1][1]))) * len(c.args[2]) for c in asked.mock_calls]
            took.append(10.0 * sum(sizes) / viperx.driver.settings.baud)
    assert reading.t == viperx.now
    assert 0.003 < max(took) < 0.007


def test_late_answers_are_of_the_time_of_their_question_and_keep_the_arm_going(
    arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    goal, line = list(arm.engage().q), arm.far.lines["arm"]
    monkeypatch.setattr(bus, "_ANSWER", 0.002)
    arm.far.execute("late 0.01")
    ages, faults = [], []
    for k in range(32):
        goal[0] += 0.003 * (k < 20)
        reading = arm.write(goal)
        ages.append(round(100 * (arm.now - reading.t)))
        faults.append(reading.fault)
        if k == 20:
            arm.far.execute("error 3 32")
        arm.far.advance(0.0)  # it has heard the question
        wait_until(lambda: not line._waiting, "the answers have come")
    assert {*ages[1:]} == ({1} if arm.far.spec.model == "so101" else {1, 2}), "a ViperX is also asked for its status"
    assert not any(faults[:20])
    assert [fault.code for fault in faults if fault is not None][:1] == ["overload"]


def test_a_silent_motor_is_lost_after_a_tenth_of_a_second_and_comes_back(
    arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm.engage()
    monkeypatch.setattr(bus, "_ANSWER", 0.02)
    arm.far.execute("silent 3 on")
    began = arm.now
    with pytest.raises(ConnectionLost, match=r"\(motor 3\)"):
        arm.run(1.0)
    assert 0.09 < arm.now - began < 0.13
    arm.far.execute("silent 3 off")
    for _ in range(3):  # late answers pass first
        with suppress(ConnectionLost):
            arm.run()
    arm.run()
    for _ in range(60):
        arm.driver.engage()
        arm.run()
    assert arm.driver.engaged


def test_the_link_that_a_killed_emulator_left_leads_to_no_other_terminal(tmp_path: Path) -> None:
    port, ends = tmp_path / "arm.emulated", os.openpty()
    port.symlink_to(os.ttyname(ends[1]))
    os.utime(port, (0.0, 0.0), follow_symlinks=False)  # older than the terminal
    before = termios.tcgetattr(ends[1])
    with pytest.raises(ConnectionLost, match="hal emulate"):
        ServoBus.acquire(str(port), Feetech())
    assert termios.tcgetattr(ends[1]) == before
    for end in ends:
        os.close(end)


def test_an_arm_that_was_plugged_in_instead_is_not_driven(arm: Arm) -> None:
    arm.engage()
    arm.far.execute("unplug on")
    with pytest.raises(ConnectionLost, match="cable|plug in"):
        arm.run()
    arm.far.execute("register 2 {low} 950".format(**PLACES[arm.driver.protocol.name]))
    arm.far.execute("unplug off")
    deadline = monotonic() + 5.0
    while "other motors" not in (text := lose(arm)):
        assert monotonic() < deadline, text
        sleep(0.02)
    with pytest.raises(ConnectionLost):
        arm.driver.engage()


def lose(arm: Arm) -> str:
    """Return why the arm counts as lost."""
    with pytest.raises(ConnectionLost) as caught:
        arm.run()
    return str(caught.value)


def test_tighter_limits_of_a_rig_are_no_wrong_calibration(so101: Arm) -> None:
    limits = replace(so101.far.spec.limits, lower=(-0.3,) * 5, upper=(0.9,) * 5)
    with closing(make(so101.far, limits=limits)) as driver:
        driver.open()


def test_lerobots_calibration_file_must_be_what_the_motors_hold(arm: Arm, tmp_path: Path) -> None:
    arm.driver.open()
    names = arm.far.spec.joints
    stored = [registers.calibration._asdict() for registers in arm.driver.chain.registers]
    ids = [joint.ids[0] for joint in arm.driver.chain.joints]
    content = {name: {"id": ids[k], **c} for k, (name, c) in enumerate(zip(names, stored, strict=True))}
    arm.driver.close()
    file = tmp_path / "arm.json"
    file.write_text(json.dumps(content), encoding="utf-8")
    options = {**arm.far.spec.options, "calibration": str(file)}
    with closing(make(arm.far, options=options)) as driver:
        driver.open()
    content[names[2]]["homing_offset"] += 1
    file.write_text(json.dumps(content), encoding="utf-8")
    with closing(make(arm.far, options=options)) as driver, pytest.raises(ConfigError, match="elbow.*homing_offset"):
        driver.open()


def test_the_check_counts_motors_and_names_an_adapter_that_collects_answers(
    viperx: Arm, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(bus, "_ADAPTERS", tmp_path)
    timer = tmp_path / Path(viperx.far.arm.port).resolve().name / "latency_timer"
    timer.parent.mkdir()
    timer.write_text("16\n")
    viperx.far.execute("register 5 9 250")  # the second motor of the elbow
    motors, delay, _, adapter, *_ = check(viperx.far.spec, 0.1)  # the third one is of the gripper
    assert sum(map(int, re.findall(r"(\d+) XM", motors.found))) == 8, motors.found
    assert delay.found.startswith("elbow (motor 5) ")
    assert (adapter.level, adapter.found, adapter.remedy) == (
        "warn",
        "it collects answers for 16 ms",
        f"echo 1 | sudo tee {timer}",
    )


@contextmanager
def hosted_jaw(rig: str) -> Iterator[tuple[SteppedServos, HostedGripper]]:
    """The gripper of an arm, open, as an app sees it."""
    with SteppedServos(rig) as far, closing(registry.load(far.spec.driver, "gripper")(far.spec.gripper)) as driver:
        assert far.arm.jaw is not None
        far.arm.jaw.q = far.arm.jaw.upper
        far.arm.place(far.spec.initial)
        with HostedGripper(GripperBench(driver=driver, dt=0.02, advance=lambda: far.advance(0.02))) as hosted:
            yield far, hosted


@pytest.mark.parametrize("command", ["error {id} 32", "temperature {id} 85", "voltage {id} 3.5", "power 0"])
@pytest.mark.parametrize("rig", ["so101", "viperx"])
def test_a_fault_of_the_jaw_fails_its_command_and_the_next_command_moves_it(rig: str, command: str) -> None:
    with hosted_jaw(rig) as (far, hosted):
        motion = hosted.gripper.start(0.0, speed=0.02)
        hosted.run_for(0.3)
        far.execute(command.format(id=far.arm.servos[-1].id))
        result = motion.wait(1.0)
        assert result.outcome is GripperOutcome.FAILED
        assert result.fault is not None
        assert result.fault.remedy
        far.execute("reset")
        at = hosted.run_for(0.1).width
        assert hosted.run_for(0.5).width == pytest.approx(at, abs=1e-3), "nothing goes on by itself"
        assert hosted.gripper.move(0.02).width == pytest.approx(0.02, abs=2e-3)


@pytest.mark.parametrize("cycles", [1, 2, 3])
@pytest.mark.parametrize("rig", ["so101", "viperx"])
def test_a_stop_before_the_motor_of_the_jaw_is_on_ends_the_command(rig: str, cycles: int) -> None:
    with hosted_jaw(rig) as (_, hosted):
        hosted.gripper.start(0.0)
        at = hosted.run_for(0.02 * cycles).width
        hosted.host.latch.stop()
        assert hosted.run_for(1.0).width == pytest.approx(at, abs=3e-3)
        hosted.host.latch.acknowledge(hosted.host.latch.stops)
        assert hosted.gripper.move(0.02).width == pytest.approx(0.02, abs=2e-3)


@pytest.mark.parametrize("rig", ["so101", "viperx"])
def test_what_the_jaw_holds_stays_held_when_the_port_comes_back(rig: str) -> None:
    with hosted_jaw(rig) as (far, hosted):
        far.execute("object 0.03")
        assert hosted.gripper.grasp(0.03)
        assert far.arm.jaw is not None
        pressed, least = abs(far.arm.jaw.tau), 1e9
        far.execute("unplug on")
        with pytest.raises(ConnectionLost):
            hosted.run_for(1.0)
        far.execute("unplug off")
        deadline = monotonic() + 5.0
        while hosted.gripper.peek().fault is not None:  # type: ignore[union-attr]
            with suppress(HalError):
                hosted.run_for(0.02)
            least = min(least, abs(far.arm.jaw.tau))
            assert monotonic() < deadline
        for _ in range(20):
            state = hosted.run_for(0.02)
            least = min(least, abs(far.arm.jaw.tau))
        assert least > 0.8 * pressed > 0.0
        assert state.grasped
