"""Faults of an arm with Damiao motors, in motion: what the program gets, the arm's state, and how it recovers.

The arm is driven in lock-step: driver and emulator advance together, so the times in the table are exact. Print the
table with ``pytest -s tests/lock_step/test_can_faults.py``.
"""

from __future__ import annotations

import contextlib
import errno
import itertools
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from typing import Any
from unittest.mock import patch

import can
import numpy as np
import pytest
from stepped_can import SteppedArm, SteppedEmulator, stepped_arm

import hal
from hal.driver import GripperReading
from hal.drivers.can.bus import CanBus
from hal.drivers.can.damiao import DamiaoArm
from hal.drivers.can.damiao_gripper import DamiaoGripper
from hal.drivers.can.damiao_protocol import CLEAR_ERROR, MOTOR_RANGES, MotorStatus
from hal.errors import ConfigError, DeviceNotFound, HalError, MotionStopped, RobotFault
from hal.host.cycle import Cycle
from hal.host.records import AppRecord, GroupMemory
from hal.specs import GroupSpec
from hal.types import GripperOutcome
from hal_emulators.can.damiao_frames import MotorSide

DT = 0.004
"""Period of a YAM's cycle, s."""
DETECTION = 0.15
"""Longest time until a fault is reported, s."""
TURN = hal.JointVelocity([0.4, 0.0, 0.0, 0.0, 0.0, 0.0])
"""The motion in which the faults occur, rad/s: about the vertical axis."""
STILL = hal.JointVelocity([0.0] * 6)


@contextlib.contextmanager
def driven() -> Iterator[SteppedArm]:
    """Yield a YAM that moves."""
    with stepped_arm() as arm:
        assert arm.run(0.4, TURN) is None
        yield arm


# Faults: each begins, and ends.


@dataclass
class CanFault:
    """A fault that is injected in motion."""

    name: str
    begin: Callable[[SteppedArm], object]
    end: Callable[[SteppedArm], object]
    raised: tuple[type[HalError], str] | None
    """Error that the program gets, and its code; None where the arm has to go on."""
    cause: str = ""
    """Code of the fault in the arm's state."""
    recovers: bool = False
    """Whether the user has to call ``recover``."""


def line(text: str) -> Callable[[SteppedArm], object]:
    """Return a function that executes a command of the emulator's console."""
    return lambda arm: arm.far.execute(text)


def nothing(arm: SteppedArm) -> None:
    """Do nothing."""


def starve(arm: SteppedArm) -> None:
    """Let the motors hear nothing for longer than TIMEOUT, while this program stands still."""
    arm.far.advance(0.45)


def take_interface_down(arm: SteppedArm) -> None:
    def fail(*_: Any) -> None:
        raise can.CanOperationError("Failed to receive", errno.ENETDOWN)

    bus = arm.driver.chain.bus
    assert bus is not None
    broken = contextlib.ExitStack()
    broken.enter_context(patch.object(bus._bus, "recv", fail))
    broken.enter_context(patch.object(can, "Bus", fail))
    arm.broken = broken  # type: ignore[attr-defined]


def bring_interface_up(arm: SteppedArm) -> None:
    arm.broken.close()  # type: ignore[attr-defined]
    deadline = time.monotonic() + 5.0
    while arm.driver.chain.lost is not None and time.monotonic() < deadline:
        arm.run(0.02)
        time.sleep(0.01)  # a thread opens the bus, at most every 0.2 s


def _meanwhile(arm: SteppedArm, period: float, act: Callable[[], object]) -> None:
    """Call a function once per ``period`` of the emulator's time, s, until :func:`stop_repeating`."""
    advance, passed = arm.far.advance, [0.0]

    def advance_both(seconds: float) -> None:
        advance(seconds)
        passed[0] += seconds
        while passed[0] >= period:
            passed[0] -= period
            act()

    arm.far.advance = advance_both  # type: ignore[method-assign]


def stop_repeating(arm: SteppedArm) -> None:
    arm.far.execute("reset")
    del arm.far.advance


def repeat_some(arm: SteppedArm) -> None:
    """Repeat one answer of each motor in 0.16 s."""
    motors = list(arm.driver.chain.motors)

    def act() -> None:
        for motor in motors:
            motor.receive(bytearray(motor.bits.to_bytes(8, "big")))

    _meanwhile(arm, 0.16, act)


def command_as_another_program(arm: SteppedArm) -> None:
    """Send motor 3 the commands that hold it, from another node of the bus."""
    motor, channel = arm.driver.chain.motors[2], arm.driver.settings.channel
    bus = can.Bus(interface="virtual", channel=channel)
    data = motor.command(motor.q, 0.0, motor.kp, motor.kd, 0.0)
    _meanwhile(arm, 0.01, lambda: bus.send(can.Message(arbitration_id=motor.id, data=data, is_extended_id=False)))


RESET = line("reset")
STATUS = {
    0x8: "over_voltage",
    0x9: "under_voltage",
    0xA: "over_current",
    0xB: "mosfet_too_hot",
    0xC: "rotor_too_hot",
    0xD: "lost_communication",
    0xE: "overload",
}
LOST = (MotionStopped, "device_lost")
FAULT = (RobotFault, "robot_fault")
FAULTS = [
    CanFault("1 reply in 20 lost", line("lose 0.05"), RESET, None),
    CanFault("replies 6 ms late", line("late 0.006"), RESET, None),
    CanFault("1 reply in 40 doubled", repeat_some, stop_repeating, None),
    CanFault("replies doubled", line("double on"), RESET, FAULT, "other_program", recovers=True),
    CanFault(
        "another program commands motor 3, 100 times a second",
        command_as_another_program,
        stop_repeating,
        FAULT,
        "other_program",
        recovers=True,
    ),
    CanFault("200 frames of another device", line("frame 0x2ff 0011223344556677 200"), nothing, None),
    CanFault("20 frames with another motor's number", line("frame 0x11 1500007ff7ff1e1e 20"), nothing, None),
    CanFault("bus cut for 60 ms", line("cut 0.06"), RESET, None),
    *(
        CanFault(f"status {code:X}: {name}", line(f"status 1 {code:x}"), nothing, FAULT, name, recovers=True)
        for code, name in STATUS.items()
    ),
    CanFault(
        "rotor at 96 deg C", line("temperature 1 40 96"), line("temperature 1 40 60"), FAULT, "motor_hot", recovers=True
    ),
    CanFault("motors without power for a moment", line("power"), nothing, FAULT, "switched_off", recovers=True),
    CanFault("TIMEOUT expired", starve, nothing, FAULT, "lost_communication", recovers=True),
    CanFault("motor 1 silent", line("silent 1 on"), RESET, LOST, "motor_silent"),
    CanFault("all motors silent", line("silent all on"), RESET, LOST, "motor_silent"),
    CanFault("interface down", take_interface_down, bring_interface_up, LOST, "interface_down"),
]


TABLE: list[str] = []


@pytest.fixture(scope="module", autouse=True)
def _table() -> Iterator[None]:
    """Print the table of this file's tests at their end."""
    yield
    print(
        "\n\n"
        + "\n".join(["| fault | the program gets | after | the arm | recovery |", "|---|---|---|---|---|", *TABLE])
    )


def on(arm: SteppedArm) -> int:
    """Return how many motors are on."""
    return sum(motor.on for motor in arm.driver.chain.motors)


def fault_parameter(fault: CanFault) -> Any:
    """Return the parameter of a fault. Of the errors that a motor reports, which differ in a number, one is fast."""
    slow = fault.name.startswith("status ") and not fault.name.startswith("status 8")
    return pytest.param(fault, id=fault.name.replace(" ", "_"), marks=[pytest.mark.slow] if slow else [])


@pytest.mark.parametrize("fault", [fault_parameter(fault) for fault in FAULTS])
def test_a_fault_in_motion(fault: CanFault) -> None:
    with driven() as arm:
        began = arm.clock.now()
        fault.begin(arm)
        error = arm.run(0.6, TURN)
        took = arm.clock.now() - began
        if fault.raised is None:
            assert error is None, "the arm has to continue"
            assert arm.driver.engaged
            TABLE.append(f"| {fault.name} | nothing | | continues | |")
            return
        state = arm.robot._mail.get_state()
        assert isinstance(error, fault.raised[0])
        assert error.code == fault.raised[1]
        assert state is not None
        assert state.fault is not None
        assert state.fault.code == fault.cause
        assert took <= DETECTION
        at = arm.q
        arm.run(0.3)
        drift = np.abs(arm.q - at)
        assert drift[0] < 0.1, "the joint that moved has stopped"
        power = "holds" if arm.driver.engaged else f"{on(arm)} of 6 motors hold"
        lost = fault.raised == LOST
        arm_text = f"{power}, moves by {drift.max():.2f} rad in 0.3 s"

        fault.end(arm)
        arm.run(0.1)
        if lost:
            assert arm.driver.chain.lost is None, "the arm is found again by reading"
        if fault.recovers:
            with pytest.raises(RobotFault):
                arm.control.send(STILL)
            arm.robot.recover()
            arm.run(0.02)
            assert arm.robot.state(max_age=1.0).fault is None
        held, engaged, at = on(arm), arm.driver.engaged, arm.q[0]
        arm.run(0.3)
        assert on(arm) == held, "nothing is switched on before a new press"
        assert arm.driver.engaged is engaged
        assert arm.q[0] == pytest.approx(at, abs=0.01)

        arm.control.rearm()
        assert arm.run(0.6, TURN) is None
        assert arm.driver.engaged, "a press switches the drives on again"
        assert arm.q[0] > at + 0.05
        recovery = "recover(), then a press" if fault.recovers else "a press"
        TABLE.append(
            f"| {fault.name} | {type(error).__name__}: {fault.cause} | {1e3 * took:.0f} ms | {arm_text} | {recovery} |"
        )


def test_an_arm_with_a_motor_that_gets_hot_is_braked_within_its_limits() -> None:
    with stepped_arm() as arm:
        fast = hal.JointVelocity([1.5, 0.0, 0.0, 0.0, 0.0, 0.0])
        assert arm.run(0.8, fast) is None
        arm.far.execute("temperature 1 40 96")
        motor = arm.far.arm.motors[1]
        speeds = [motor.drive.dq]
        assert speeds[0] > 0.5
        for _ in range(150):
            arm.clock.sleep(DT)
            speeds.append(motor.drive.dq)
        steps = [abs(after - before) for before, after in itertools.pairwise(speeds)]
        rounding = 2.0 * MOTOR_RANGES["DM4340"].velocity / 4095
        assert max(steps) <= arm.robot.spec.limits.acceleration[0] * DT + 2.0 * rounding
        assert abs(speeds[-1]) <= rounding
        assert arm.robot.state(max_age=1.0).fault is not None
        arm.far.execute("status 2 a")
        arm.clock.sleep(3 * DT)
        fault = arm.robot.state(max_age=1.0).fault
        assert fault is not None
        assert fault.code == "over_current", "the graver fault is reported"


# Faults that are there before the arm is opened.


@pytest.mark.parametrize(
    ("command", "error", "code"),
    [
        ("register 2 VMAX 8", ConfigError, "wrong_range"),
        ("register 4 PMAX 3.1416", ConfigError, "wrong_range"),
        ("register 6 TMAX 7", ConfigError, "wrong_range"),
        ("register 3 TIMEOUT 0", ConfigError, "no_timeout"),
        ("register 5 CTRL_MODE 2", ConfigError, "wrong_mode"),
        ("place 0 1.5 1.35 -1.42 0 6.4", RobotFault, "full_turn"),
        ("silent 3 on", DeviceNotFound, "motor_missing"),
        ("silent all on", DeviceNotFound, "motor_missing"),
    ],
)
def test_a_fault_before_the_start_is_refused_by_motor(command: str, error: type[HalError], code: str) -> None:
    with SteppedEmulator("yam") as far:
        far.execute(command)
        driver = DamiaoArm(far.spec)
        with pytest.raises(error) as raised:
            driver.open()
        found = raised.value.problems[0].code if isinstance(raised.value, ConfigError) else raised.value.code
        assert found == code
        number = {"all": "motor 1", "0": "motor 6"}.get(command.split()[1], f"motor {command.split()[1]}")
        assert number in str(raised.value), "the message names the motor"
        assert all(state["status"] == "0" for state in far.execute("state")["motors"].values()), "nothing is energised"
        TABLE.append(f"| {command}, before the start | {error.__name__}: {code}, names {number} | at once | off | |")


def test_frames_from_before_the_connect_are_discarded() -> None:
    with SteppedEmulator("yam") as far:
        driver = DamiaoArm(far.spec)
        bus = CanBus.acquire(driver.settings.shared)  # another device of this process has opened it before
        stale = MotorSide(MOTOR_RANGES["DM4340"]).encode_feedback(1, 1, 2.0, 5.0, 9.0)
        far.execute(f"frame 0x11 {stale.hex()} 50")
        driver.open()
        reading = driver.read(0.0)
        assert reading.q == pytest.approx(far.spec.initial, abs=1e-3)
        assert driver.chain.motors[0].status == 0
        driver.close()
        bus.release()
        TABLE.append("| 50 frames from before the connect | nothing | | discarded | |")


# The gripper.


@pytest.fixture
def gripper() -> Iterator[tuple[SteppedEmulator, DamiaoGripper, Callable[[float], GripperReading]]]:
    """The emulator, the gripper's driver, and a function that lets seconds pass and returns the last reading."""
    with SteppedEmulator("yam") as far:
        assert far.spec.gripper is not None
        driver = DamiaoGripper(far.spec.gripper)
        driver.open()

        def run(seconds: float) -> GripperReading:
            for _ in range(round(seconds / DT)):
                far.advance(DT)
                reading = driver.read(far.passed)
            return reading

        yield far, driver, run
        driver.close()


@pytest.mark.parametrize(
    ("status", "code"), [("a", "over_current"), ("d", "lost_communication"), ("0", "switched_off")]
)
def test_a_gripper_with_a_fault_waits_for_the_next_command(gripper: Any, status: str, code: str) -> None:
    far, driver, run = gripper
    driver.move(0.0, 0.05, 30.0)
    run(0.3)
    far.execute(f"status 7 {status}")
    reading = run(0.1)
    assert reading.fault is not None
    assert reading.fault.code == code
    assert reading.outcome is GripperOutcome.FAILED
    width = reading.width
    assert not reading.moving
    assert run(0.5).width == pytest.approx(width, abs=2e-3), "nothing moves before a new command"
    assert width > 0.01
    driver.move(0.0, 0.05, 30.0)
    reading = run(1.5)
    assert reading.fault is None
    assert reading.width == pytest.approx(0.0, abs=1e-3)


@pytest.mark.parametrize("force", [10.0, 30.0])
def test_a_grip_is_no_stronger_than_commanded(gripper: Any, force: float) -> None:
    far, driver, run = gripper
    plant = far.arm.gripper
    plant.q = plant.upper  # wide open
    far.execute("object 0.03")
    driver.move(0.0, 0.1, force)
    slope = 0.095 / 6.5
    strongest = 0.0
    for ms in range(1600):
        far.advance(1e-3)
        if plant.q <= plant.lower:  # in contact: also before the driver notices
            strongest = max(strongest, abs(plant.tau))
        if ms % 4 == 3:
            driver.read(far.passed)
    assert strongest <= 1.2 * force * slope
    reading = run(1.0)
    assert reading.grasped
    assert not reading.moving
    assert reading.force == pytest.approx(force, rel=0.15)
    assert abs(plant.tau) == pytest.approx(force * slope, rel=0.1)
    driver.stop()
    assert run(0.5).force == pytest.approx(force, rel=0.15)


def test_fingers_that_were_opened_by_hand_are_not_pulled_back(gripper: Any) -> None:
    far, driver, run = gripper
    run(0.1)
    far.advance(10.0)  # this program stands still
    far.arm.gripper.q = far.arm.gripper.upper
    driver.move(0.095, 0.05, 30.0)
    narrowest = min((run(DT), far.arm.gripper.q)[1] for _ in range(100))
    assert narrowest > far.arm.gripper.upper - 1e-3


@pytest.mark.parametrize("before", [None, 0.05])
def test_fingers_that_their_friction_holds_have_not_grasped(gripper: Any, before: float | None) -> None:
    far, driver, run = gripper
    far.arm.gripper.q = far.arm.gripper.upper
    if before is not None:  # they closed before, on nothing
        driver.move(before, 0.1, 30.0)
        assert run(2.0).width == pytest.approx(before, abs=1e-3)
    driver.move(0.0, 0.05, 2.0)
    reading = run(1.0)
    assert reading.width > 0.04
    assert not reading.moving
    assert not reading.grasped


def test_an_object_is_still_grasped_while_the_force_changes(gripper: Any) -> None:
    far, driver, run = gripper
    far.execute("object 0.03")
    for force in (10.0, 30.0, 15.0):
        driver.move(0.0, 0.1, force)
        assert run(1.0).grasped, "the fingers do not move any more"
    driver.move(0.06, 0.1, 15.0)
    assert run(1.5).grasped is False
    far.execute("object none")
    driver.move(0.02, 0.1, 15.0)
    reading = run(2.0)
    assert reading.width == pytest.approx(0.02, abs=1e-3)
    assert reading.grasped is False


def test_fingers_move_at_the_commanded_speed(gripper: Any) -> None:
    far, driver, run = gripper
    far.arm.gripper.q = far.arm.gripper.upper
    driver.move(0.01, 0.05, 30.0)
    run(0.2)
    widths = [run(0.02).width for _ in range(100)]
    assert max(a - b for a, b in itertools.pairwise(widths)) / 0.02 == pytest.approx(0.05, rel=0.2)
    assert widths[-1] == pytest.approx(0.01, abs=1e-3)
    assert min(widths) > 0.0095, "they do not run beyond"


# Closing.


def test_close_lowers_a_raised_arm_slowly_and_never_drops_it() -> None:
    with SteppedEmulator("yam") as far:
        arm = SteppedArm(far)
        with arm.control:
            arm.run(0.2, TURN)
        far.execute("stats reset")
        began = far.passed
        arm.host.close()
        took = far.passed - began
        lowered = max(far.execute("stats")["peak_speed"])
        far.advance(1.0)
        motors = far.execute("state")["motors"]
        states = {motors[k]["status"] for k in range(1, 7)}
        assert states in ({"0"}, {"D"}), "off if it rests, else left to the damping of its motors"
        assert lowered < 0.5
        assert took < 6.5
        text = f"sinks at {lowered:.2f} rad/s at most, for {took:.1f} s; then {'off' if '0' in states else 'damped'}"
        TABLE.append(f"| the program ends, arm raised | | | {text} | |")


def test_an_arm_that_was_never_engaged_is_not_switched_off() -> None:
    with SteppedEmulator("yam") as far:
        driver = DamiaoArm(far.spec)
        driver.open()
        far.execute("status 2 1")  # another program left it on
        for k in range(10):
            far.advance(DT)
            driver.read(k * DT)
        assert not driver.engaged
        driver.close()
        assert far.execute("state")["motors"][2]["status"] == "1"


def test_a_gripper_holds_while_its_arm_sinks() -> None:
    with SteppedEmulator("yam") as far:
        spec = replace(far.spec, workspace=None)
        assert spec.gripper is not None
        group = GroupSpec("arm", "lock_step", spec.rate_hz, (spec,), grippers=(spec.gripper,))
        cycle = Cycle(group, GroupMemory.of(memoryview(bytearray(GroupMemory.size_of(group))), group))
        arm, hand = cycle.arms[spec.name].driver, cycle.grippers[spec.gripper.name].driver

        def run(seconds: float) -> None:
            for _ in range(round(seconds / DT)):
                far.advance(DT)
                cycle.step(far.passed, AppRecord(far.passed, 0))
                cycle.publish(far.passed)
                if not arm.engaged:
                    arm.engage()

        cycle.open(0.0)
        far.execute("object 0.03")
        hand.move(0.0, 0.1, 20.0)
        run(1.5)
        held = abs(far.arm.gripper.tau)
        weakest, down = [], far.arm.motors[2]
        advance = far.advance

        def watch(seconds: float) -> None:
            advance(seconds)
            if down.status == MotorStatus.ENABLED:
                weakest.append(abs(far.arm.gripper.tau))

        with patch.object(far, "advance", watch):
            far.clock.sleep = watch
            cycle.close()
        assert len(weakest) * DT > 1.0, "it sinks for longer than TIMEOUT"
        assert held > 0.2
        assert min(weakest) == pytest.approx(held, rel=0.1)


# Blocked, pushed, and let go: at most 0.5 rad/s, by the plant.


def fastest(arm: SteppedArm, seconds: float, joints: Sequence[int] = range(6)) -> float:
    """Let time pass; return the greatest speed of these joints meanwhile, rad/s."""
    arm.far.execute("stats reset")
    arm.run(seconds)
    return max(arm.far.arm.peak[k] for k in joints)


@pytest.mark.parametrize(("joint", "below", "beyond", "stiffness"), [(0, 12.0, 16.0, 80.0), (5, 3.0, 4.2, 10.0)])
def test_an_arm_that_is_pushed_away_gives_way_slowly_and_does_not_snap_back(
    joint: int, below: float, beyond: float, stiffness: float
) -> None:
    """Beyond half of what its joint may apply, Nm."""
    with driven() as arm:
        arm.far.execute(f"push {joint + 1} {-below}")
        assert arm.run(0.5, TURN) is None
        arm.far.execute(f"push {joint + 1} {-beyond}")
        fault = arm.run(0.5, TURN)
        assert isinstance(fault, RobotFault)
        assert arm.robot.state().fault.code == "not_following"
        assert arm.driver.engaged, "it holds"
        at = arm.q[joint]
        assert fastest(arm, 2.0) <= 0.5
        assert arm.q[joint] < at - 0.4, "it gives way for as long as it is pushed"
        at = arm.q[joint]
        arm.far.execute(f"push {joint + 1} 0")
        arm.run(1.0)
        assert abs(arm.q[joint] - at) < beyond / stiffness, "the way of its spring, not back to where it was sent"


@pytest.mark.parametrize("line", ["status 6 a", "silent 6 on"])
def test_no_joint_pushes_on_after_the_fault_of_another_one(line: str) -> None:
    with driven() as arm:
        arm.far.arm.plant.upper[0] = arm.q[0]  # an obstacle
        assert arm.run(0.3, TURN) is None
        shoulder = arm.far.arm.motors[1]
        assert shoulder.drive.q - arm.q[0] > 0.1
        arm.far.execute(line)
        assert arm.run(0.3, TURN) is not None
        arm.run(0.5)
        assert abs(shoulder.drive.q - arm.q[0]) < 0.01
        arm.far.arm.plant.upper[0] = 3.0
        assert fastest(arm, 0.5, range(5)) <= 0.1


def test_a_motor_that_was_switched_on_is_not_cleared_because_its_answers_are_late() -> None:
    with driven() as arm:
        starve(arm)
        arm.run(0.1)
        shoulder, cleared = arm.far.arm.motors[1], []
        command = shoulder.command

        def note(data: bytes) -> None:
            if data == CLEAR_ERROR:
                cleared.append(shoulder.status)
            command(data)

        shoulder.command = note
        arm.robot.recover()
        arm.run(0.02)
        assert cleared == []
        arm.far.execute("late 0.04")
        arm.control.rearm()
        assert arm.run(0.6, STILL) is None
        assert arm.driver.engaged
        assert cleared == [MotorStatus.LOST_COMMUNICATION]


@pytest.mark.parametrize("line", ["", "status 0 7", "status 4 10", "cut 0.3"])
def test_a_blocked_piper_stops_pushing_and_does_not_leap_once_it_is_free(line: str) -> None:
    """Whatever ended the motion: the arm's controller would go to its last target, at its own full speed."""
    with stepped_arm("piper") as arm:
        assert arm.run(0.4, TURN) is None
        arm.far.arm.plant.held = True  # in front of an obstacle
        assert arm.run(0.15, TURN) is None
        if line:
            arm.far.execute(line)
        assert arm.run(1.0, TURN) is not None
        arm.far.execute("reset")
        arm.run(0.1)
        if arm.robot.state().fault is not None:
            arm.robot.recover()
        arm.far.arm.plant.held = False
        assert fastest(arm, 1.0) <= 0.5
        assert np.abs(np.array(arm.far.arm.target) - arm.q).max() < 0.02
