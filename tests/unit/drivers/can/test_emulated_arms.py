"""The emulated Damiao motors and the emulated PiPER, stepped by hand: no bus, no time."""

from __future__ import annotations

import pytest
from can_kit import can_overrides

from hal.config.loader import load
from hal.drivers.can.damiao_protocol import (
    CLEAR_ERROR,
    DISABLE,
    ENABLE,
    REGISTER_ID,
    MotorFeedback,
    MotorRegister,
    MotorStatus,
    decode_register_reply,
    encode_register_read,
    encode_state_request,
)
from hal.drivers.can.piper_protocol import (
    ENABLED,
    FEEDBACK_IDS,
    POSE_ID,
    EnableRequest,
    FirmwareQuery,
    GripperRequest,
    GripperStatus,
    JointAngles,
    JointStatus,
    ModeRequest,
    PiperStatus,
    decode_feedback,
    encode_joint_targets,
    find_firmware,
)
from hal_emulators.can import piper as emulated_piper
from hal_emulators.can.console import COMMANDS, execute
from hal_emulators.can.damiao import EmulatedDamiaoArm
from hal_emulators.can.piper import EmulatedPiperArm
from hal_emulators.can.server import CanEmulator

DT = 1e-3


class Wire:
    """An arm with its bus replaced by lists."""

    def __init__(self, rig: str) -> None:
        overrides = can_overrides("virtual")
        spec = load(rig, sim=False, overrides=overrides).resolve().robots[0]
        self.arm = EmulatedDamiaoArm(spec) if spec.driver == "damiao" else EmulatedPiperArm(spec)
        self.sent: list[tuple[int, bytes, int]] = []

    def ask(self, id: int, data: bytes) -> list[bytes]:
        """Give the arm a frame, and return the data of its answers."""
        self.sent.clear()
        self.arm.take(id, data, self._send)
        return [data for _, data, _ in self.sent]

    def let_pass(self, seconds: float) -> list[tuple[int, bytes, int]]:
        """Let time pass, and return what the arm sent."""
        self.sent.clear()
        for _ in range(round(seconds / DT)):
            self.arm.step(DT, self._send)
        return list(self.sent)

    def feedback(self, motor: int) -> MotorFeedback:
        (data,) = self.ask(REGISTER_ID, encode_state_request(motor))
        return self.arm.motors[motor].codec.decode_feedback(data)

    def hold(self) -> None:
        """Switch every motor on where it is."""
        weight = self.arm.plant.gravity()
        for k, motor in enumerate(self.arm._arm):
            self.ask(motor.id, ENABLE)
            q = motor.settings.direction * (float(self.arm.plant.q[k]) - motor.settings.offset)
            self.ask(motor.id, motor.codec.encode_command(q, 0.0, 80.0, 5.0, motor.settings.direction * weight[k]))

    def _send(self, id: int, data: bytes, motor: int) -> None:
        self.sent.append((id, data, motor))


@pytest.fixture
def yam() -> Wire:
    return Wire("yam")


@pytest.fixture
def piper() -> Wire:
    return Wire("piper")


def test_motors_answer_at_their_master_ids_and_show_their_registers(yam: Wire) -> None:
    for motor in range(1, 8):
        (answer,) = yam.ask(REGISTER_ID, encode_register_read(motor, MotorRegister.VMAX))
        assert yam.sent[0][0] == motor + 0x10
        assert decode_register_reply(answer, motor).value == (10.0 if motor <= 3 else 30.0)
    (answer,) = yam.ask(REGISTER_ID, bytes((2, 0, 0x55, MotorRegister.TIMEOUT, 0, 0, 0, 0)))
    assert decode_register_reply(answer, 2).value == 0
    assert yam.ask(REGISTER_ID, encode_register_read(9, MotorRegister.VMAX)) == []
    assert yam.ask(0x99, b"\0" * 8) == []


def test_an_arm_is_held_until_all_its_motors_are_on_and_have_a_command(yam: Wire) -> None:
    start = yam.arm.plant.q.copy()
    yam.ask(1, ENABLE)
    yam.let_pass(0.2)
    assert yam.feedback(1).status == MotorStatus.ENABLED
    assert yam.arm.plant.held
    yam.hold()
    assert not yam.arm.plant.held
    yam.let_pass(0.2)
    assert yam.arm.plant.q == pytest.approx(start, abs=2e-3)
    for motor in range(1, 8):
        yam.ask(motor, DISABLE)
    yam.let_pass(0.2)
    assert abs(yam.arm.plant.q - start).max() > 0.1  # it falls


def test_silence_longer_than_timeout_ends_in_damping_until_the_error_is_cleared(yam: Wire) -> None:
    yam.hold()
    yam.let_pass(0.39)
    assert yam.feedback(2).status == MotorStatus.ENABLED
    yam.let_pass(0.02)
    assert yam.feedback(2).status == MotorStatus.LOST_COMMUNICATION  # a request for the state feeds no watchdog
    yam.let_pass(1.0)
    assert 0.1 < max(yam.arm.peak) < 0.6  # it sinks, damped
    yam.ask(2, ENABLE)
    assert yam.feedback(2).status == MotorStatus.LOST_COMMUNICATION
    yam.ask(2, CLEAR_ERROR)
    assert yam.feedback(2).status == MotorStatus.DISABLED
    yam.ask(2, ENABLE)
    assert yam.feedback(2).status == MotorStatus.ENABLED


def test_a_timeout_of_zero_never_expires(yam: Wire) -> None:
    for motor in range(1, 7):
        yam.arm.set_register(motor, "timeout", 0)
    yam.hold()
    yam.let_pass(1.0)
    assert yam.feedback(2).status == MotorStatus.ENABLED


def test_a_motor_with_a_fault_or_without_power_follows_no_command(yam: Wire) -> None:
    yam.hold()
    yam.arm.set_status(3, 0xA)
    codec = yam.arm.motors[3].codec
    (answer,) = yam.ask(3, codec.encode_command(0.5, 0.0, 80.0, 5.0, 0.0))
    assert codec.decode_feedback(answer).status == MotorStatus.OVER_CURRENT
    assert yam.arm.motors[3].step(DT).kp == 0.0
    yam.arm.restart()
    assert yam.feedback(3).status == MotorStatus.DISABLED


def test_directions_offsets_and_changed_ranges_show_in_the_feedback(yam: Wire) -> None:
    motor = yam.arm.motors[2]
    motor.settings = motor.settings.model_copy(update={"direction": -1.0, "offset": 0.5})
    assert yam.feedback(2).q == pytest.approx(-(1.5 - 0.5), abs=1e-3)
    yam.arm.set_register(1, "PMAX", 6.25)
    (data,) = yam.ask(REGISTER_ID, encode_state_request(2))
    yam.arm.set_register(2, "PMAX", 6.25)
    (other,) = yam.ask(REGISTER_ID, encode_state_request(2))
    assert data != other


def test_temperatures_are_reported(yam: Wire) -> None:
    yam.arm.set_temperature(4, 71, 96)
    assert (yam.feedback(4).mosfet, yam.feedback(4).rotor) == (71, 96)


def test_a_piper_reports_at_its_rates_without_being_asked(piper: Wire) -> None:
    sent = piper.let_pass(0.5)
    decoded = [decode_feedback(id, data) for id, data, _ in sent]
    assert sum(isinstance(record, PiperStatus) for record in decoded) == pytest.approx(100, abs=1)
    assert sum(isinstance(record, JointAngles) for record in decoded) == pytest.approx(300, abs=3)
    assert sum(isinstance(record, JointStatus) for record in decoded) == pytest.approx(120, abs=6)
    assert {id for id, *_ in sent} == set(FEEDBACK_IDS)
    unread = {id for (id, *_), record in zip(sent, decoded, strict=True) if record is None}
    assert unread == {POSE_ID, POSE_ID + 1, POSE_ID + 2}, "the driver does without the flange's pose"


def switch_on(piper: Wire, speed_percent: int = 100) -> None:
    piper.ask(*EnableRequest().frame())
    piper.ask(*ModeRequest(speed_percent=speed_percent).frame())


def test_a_piper_follows_targets_only_when_it_is_on_and_driven_over_can(piper: Wire) -> None:
    start = piper.arm.plant.q.tolist()
    goal = [q + 0.1 for q in start[:4]] + start[4:]
    for frame in encode_joint_targets(goal):
        piper.ask(*frame)
    piper.let_pass(0.5)
    assert piper.arm.plant.q.tolist() == pytest.approx(start)
    switch_on(piper)
    for frame in encode_joint_targets(goal):
        piper.ask(*frame)
    piper.let_pass(1.0)
    assert piper.arm.plant.q.tolist() == pytest.approx(goal, abs=2e-3)
    piper.let_pass(5.0)  # silence: it holds
    assert piper.arm.plant.q.tolist() == pytest.approx(goal, abs=2e-3)
    flags = [decode_feedback(id, data) for id, data, _ in piper.let_pass(0.05)]
    assert {record.flags for record in flags if isinstance(record, JointStatus)} == {ENABLED}


def test_a_pipers_speed_setting_bounds_its_motion(piper: Wire) -> None:
    switch_on(piper, speed_percent=10)
    piper.let_pass(0.1)
    for frame in encode_joint_targets([0.5, *piper.arm.target[1:]]):
        piper.ask(*frame)
    piper.let_pass(1.0)
    assert piper.arm.peak[0] == pytest.approx(0.1 * emulated_piper._SPEED, rel=0.05)


def test_a_piper_refuses_targets_beyond_its_limits(piper: Wire) -> None:
    switch_on(piper)
    piper.ask(*encode_joint_targets([3.0, *piper.arm.target[1:]])[0])
    assert piper.arm.target[0] == pytest.approx(0.0)
    assert piper.arm.report()["status"] == "target_beyond_limit"


def test_a_piper_without_power_falls(piper: Wire) -> None:
    switch_on(piper)
    piper.let_pass(0.2)
    before = piper.arm.plant.q.copy()
    piper.ask(*EnableRequest(enabled=False).frame())
    piper.let_pass(0.3)
    assert abs(piper.arm.plant.q - before).max() > 0.05


def test_a_piper_tells_its_firmware_and_closes_its_gripper_on_an_object(piper: Wire) -> None:
    assert find_firmware(piper.ask(*FirmwareQuery().frame())) == "S-V1.8-5"
    piper.arm.set_object(0.03)
    piper.ask(*GripperRequest(0.0, 1.0).frame())
    reports = [decode_feedback(id, data) for id, data, _ in piper.let_pass(1.0)]
    last = [record for record in reports if isinstance(record, GripperStatus)][-1]
    assert (last.width, last.torque) == (pytest.approx(0.03), pytest.approx(-1.0))


@pytest.fixture
def emulator() -> CanEmulator:
    """An emulator of two arms that is not started."""
    return CanEmulator("openarm", can_overrides("virtual", ("left", "right")))


@pytest.mark.parametrize(
    "line",
    [
        "lose 0.5",
        "lose next 3 2",
        "late 0.02",
        "double on",
        "silent 3 0.2",
        "silent all on",
        "cut on",
        "frame 0x11 00ff 2",
        "stall 0.1",
        "status 3 A",
        "register 2 VMAX 8",
        "temperature 4 80 90",
        "power",
        "masses 1.2",
        "friction 0",
        "payload 0.5 0 0 0.1",
        "place",
        "push 1 2.0",
        "object 0.03",
        "object none",
        "state",
        "stats",
        "stats reset",
        "reset",
        "help",
    ],
)
def test_every_command_of_the_console_is_accepted_for_the_arm_that_it_names(emulator: CanEmulator, line: str) -> None:
    execute(emulator, ["right", *line.split()])
    assert line.split()[0] in COMMANDS


def test_a_command_reaches_the_arm_that_it_names(emulator: CanEmulator) -> None:
    execute(emulator, ["right", "status", "3", "A"])
    left, right = (emulator.arms[name].report()["motors"][3]["status"] for name in ("left", "right"))
    assert (left, right) == ("0", "A")
    assert len(emulator.buses) == 2


@pytest.mark.parametrize(
    "line",
    [
        "",
        "frobnicate",
        "lose",
        "lose 2",
        "lose next 1 99",
        "status 99 A",
        "register 1 NONE 3",
        "silent",
        "silent 99 on",
        "silent three on",
        "push 0 2",
        "push one 2",
        "place 1 2",
        "place a b c d e f g",
        "double x",
        "late -1",
        "masses nan",
        "cut now",
        "frame 0x900 00",
        "frame 0x11 0g",
        "status 3 Z",
        "status 3 7",
        "register 3 VMAX fast",
        "register 3 NONE 1",
        "temperature 3 hot hot",
        "payload",
        "payload 1 2",
        "object wide",
    ],
)
def test_a_wrong_command_is_refused_and_changes_nothing(emulator: CanEmulator, line: str) -> None:
    before = {name: arm.report() for name, arm in emulator.arms.items()}
    with pytest.raises(ValueError) as refused:  # noqa: PT011  # the wording is what the user gets
        execute(emulator, line.split())
    assert not any(raw in str(refused.value) for raw in ("literal", "convert", "unpack", "non-hex"))
    assert {name: arm.report() for name, arm in emulator.arms.items()} == before


@pytest.mark.parametrize(
    ("line", "offered"),
    [
        ("status 3 Z", "0 to FF"),
        ("status 3 7", "A over_current"),
        ("silent foo on", "or all"),
        ("register 3 NONE 1", "VMAX"),
    ],
)
def test_a_wrong_value_is_answered_with_those_that_there_are(emulator: CanEmulator, line: str, offered: str) -> None:
    with pytest.raises(ValueError, match=offered):
        execute(emulator, line.split())


@pytest.mark.parametrize("line", ["status 5 100", "status seven 1", "register 1 VMAX 8"])
def test_a_piper_refuses_what_it_cannot_report(line: str) -> None:
    emulator = CanEmulator("piper", can_overrides("virtual"))
    with pytest.raises(ValueError):  # noqa: PT011
        execute(emulator, line.split())
