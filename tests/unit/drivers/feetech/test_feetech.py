"""An SO-101 on a servo bus: what is refused, what is a fault, and that nothing leaps. The emulator is stepped."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import closing, suppress
from dataclasses import replace
from math import pi
from pathlib import Path
from time import monotonic, sleep

import pytest
from feetech_kit import SteppedFeetech

from hal.driver import Reading, Setpoint
from hal.drivers.feetech import bus
from hal.drivers.feetech.arm import FeetechArm
from hal.drivers.feetech.bus import encode, signed, split
from hal.drivers.feetech.preflight import check
from hal.errors import ConfigError, ConnectionLost, DeviceNotFound, RobotFault

STILL = (0.0,) * 5


class Arm:
    """A driver, and the emulator behind it."""

    def __init__(self, far: SteppedFeetech, driver: FeetechArm) -> None:
        self.far, self.driver, self.now = far, driver, 1000.0

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
        self.driver.write(Setpoint(tuple(q), STILL, STILL))
        return self.run()


@pytest.fixture
def arm() -> Iterator[Arm]:
    with SteppedFeetech() as far, closing(FeetechArm(far.spec)) as driver:
        yield Arm(far, driver)


def test_frames_are_those_of_the_protocol() -> None:
    """Of the manual of Feetech's protocol: a ping of motor 1, and its answer."""
    assert encode(1, 1).hex() == "ffff010201fb"
    answers, rest, spoilt = split(bytes.fromhex("00ff ffff010200fc ffff010200fd ffff01"))
    assert [answer.id for answer in answers] == [1]
    assert (rest, spoilt) == (b"\xff\xff\x01", 1)
    assert (signed(0x0801, 11), signed(0x0401, 11)) == (-1, 0x401)


def test_the_middle_of_the_calibrated_range_is_zero_and_a_turn_has_4096_counts(arm: Arm) -> None:
    arm.far.arm.plant.place([0.0, 0.5, 0.0, 0.0, 0.0])
    arm.far.advance(0.002)
    arm.driver.open()
    c = arm.driver.chain.registers[1].calibration
    arm.run()
    state = arm.far.arm.servos[2]
    assert round(state.angle) == round(0.5 * (c.range_min + c.range_max) + 0.5 * 4096 / (2 * pi))
    assert arm.run().q == pytest.approx([0.0, 0.5, 0.0, 0.0, 0.0], abs=2e-3)


def test_goals_are_the_present_positions_before_the_torque_is_on_and_nothing_leaps(arm: Arm) -> None:
    for id in range(1, 6):
        arm.far.execute(f"register {id} 42 3000")  # of an earlier program
    arm.driver.open()
    before = arm.run().q
    assert not any(arm.far.execute("state")["on"])
    reading = arm.engage()
    state = arm.far.execute("state")
    assert all(state["on"][:5])
    assert state["limits"][:5] == [986] * 5  # 2.9 of 2.94 Nm
    arm.run(0.5)
    assert reading.q_commanded == pytest.approx(before, abs=2e-3)
    assert arm.run().q == pytest.approx(before, abs=2e-3), "its weight is carried"
    assert max(arm.far.arm.peak) < 0.3, "rad/s: its load bends the motors' springs, until the goals lead"


def test_a_load_does_not_pull_it_off_its_set_point(arm: Arm) -> None:
    goal = list(arm.engage().q)
    for _ in range(100):
        goal[1] = goal[1] + 0.006
        arm.write(goal)
    arm.run(0.3)
    assert arm.run().q == pytest.approx(goal, abs=5e-3)
    assert abs(arm.far.arm.plant.tau[1]) > 0.2  # Nm: without a lead it would be 7 mrad off


REFUSED = {
    "silent 3 on": (DeviceNotFound, "elbow_flex (motor 3)"),
    "twin 2 on": (DeviceNotFound, "two motors have the id 2"),
    "baud 115200": (DeviceNotFound, "but at 115200"),
    "register 4 3 2825": (ConfigError, "model 2825"),
    "register 4 33 1": (ConfigError, "not set to positions"),
    "register 1 9 0": (ConfigError, "calibrate it"),
}


@pytest.mark.parametrize("command", REFUSED)
def test_a_wrong_motor_is_refused_by_name(arm: Arm, command: str) -> None:
    error, words = REFUSED[command]
    if "9 0" in command:
        arm.far.execute("register 1 11 4095")
    arm.far.execute(command)
    with pytest.raises(error) as caught:
        arm.driver.open()
    assert words in str(caught.value)
    assert [result.level for result in check(arm.far.spec, 0.1)] == ["fail"]


FAULTS = {"error 3 32": "overload", "voltage all 15": "voltage", "voltage 2 3.5": "voltage"}
FAULTS |= {"temperature 5 80": "too_hot", "error 1 2": "sensor", "error 1 8": "overcurrent", "power 0": "switched_off"}


@pytest.mark.parametrize("command", FAULTS)
def test_a_fault_is_named_stops_the_arm_and_is_over_after_recover(arm: Arm, command: str) -> None:
    arm.engage()
    arm.far.execute(command)
    reading = arm.run(0.02)
    assert reading.fault is not None
    assert reading.fault.code == FAULTS[command]
    assert reading.fault.remedy
    assert not arm.driver.engaged
    with pytest.raises(RobotFault):
        arm.driver.engage()
    arm.far.execute("reset")
    arm.driver.recover()
    assert arm.run().fault is None
    arm.engage()


def test_a_joint_outside_of_its_range_is_not_driven(arm: Arm) -> None:
    arm.far.execute("place 0 -0.6 0.87 -1.7 0")
    arm.far.execute("register 4 9 1120")
    arm.driver.open()
    arm.run()
    with pytest.raises(RobotFault, match=r"wrist_flex \(motor 4\) is 0\.\d\d rad outside"):
        arm.driver.engage()


@pytest.mark.parametrize("command", ["lose next 2", "lose next 2 3", "spoil 2", "double on", "late 0.002"])
def test_single_bad_answers_are_counted_and_stop_nothing(
    arm: Arm, command: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    goal = list(arm.engage().q)
    arm.driver.reset_statistics()
    monkeypatch.setattr(bus, "_ANSWER", 0.05)
    arm.far.execute(command)
    for _ in range(20):
        goal[0] += 0.01
        assert arm.write(goal).fault is None
    figures = arm.driver.statistics()["bus"]
    counted = {"lose": "lost", "spoil": "spoilt", "double": "surplus"}.get(command.split()[0])
    assert counted is None or figures[counted] >= 2
    assert arm.run(0.2).q == pytest.approx(goal, abs=0.01)


def test_a_silent_motor_is_lost_after_a_tenth_of_a_second_and_comes_back(
    arm: Arm, monkeypatch: pytest.MonkeyPatch
) -> None:
    arm.engage()
    monkeypatch.setattr(bus, "_ANSWER", 0.02)
    arm.far.execute("silent 3 on")
    began = arm.now
    with pytest.raises(ConnectionLost, match="elbow_flex"):
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


def test_an_arm_that_was_plugged_in_instead_is_not_driven(arm: Arm) -> None:
    arm.engage()
    arm.far.execute("unplug on")
    with pytest.raises(ConnectionLost, match="cable|plug in"):
        arm.run()
    arm.far.execute("register 2 9 950")
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


def test_tighter_limits_of_a_rig_are_no_wrong_calibration(arm: Arm) -> None:
    limits = replace(arm.far.spec.limits, lower=(-0.3,) * 5, upper=(0.9,) * 5)
    with closing(FeetechArm(replace(arm.far.spec, limits=limits))) as driver:
        driver.open()


def test_lerobots_calibration_file_must_be_what_the_motors_hold(arm: Arm, tmp_path: Path) -> None:
    arm.driver.open()
    names = arm.far.spec.joints
    stored = [registers.calibration._asdict() for registers in arm.driver.chain.registers]
    content = {name: {"id": k + 1, "drive_mode": 0, **c} for k, (name, c) in enumerate(zip(names, stored, strict=True))}
    arm.driver.close()
    file = tmp_path / "so101.json"
    file.write_text(json.dumps(content), encoding="utf-8")
    spec = replace(arm.far.spec, options={**arm.far.spec.options, "calibration": str(file)})
    with closing(FeetechArm(spec)) as driver:
        driver.open()
    content["elbow_flex"]["homing_offset"] += 1
    file.write_text(json.dumps(content), encoding="utf-8")
    with closing(FeetechArm(spec)) as driver, pytest.raises(ConfigError, match=r"elbow_flex.*homing_offset"):
        driver.open()
