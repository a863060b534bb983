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
    MotorStatus,
    encode_state_request,
)
from hal.drivers.can.piper_protocol import (
    FEEDBACK_IDS,
    POSE_ID,
    JointAngles,
    JointStatus,
    PiperStatus,
    decode_feedback,
)
from hal_emulators.can.console import execute
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

    def status(self, motor: int) -> int:
        (data,) = self.ask(REGISTER_ID, encode_state_request(motor))
        return data[0] >> 4

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


def test_an_arm_is_held_until_all_its_motors_are_on_and_have_a_command(yam: Wire) -> None:
    start = yam.arm.plant.q.copy()
    yam.ask(1, ENABLE)
    yam.let_pass(0.2)
    assert yam.status(1) == MotorStatus.ENABLED
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
    assert yam.status(2) == MotorStatus.ENABLED
    yam.let_pass(0.02)
    assert yam.status(2) == MotorStatus.LOST_COMMUNICATION  # a request for the state feeds no watchdog
    yam.let_pass(1.0)
    assert 0.1 < max(yam.arm.peak) < 0.6  # it sinks, damped
    yam.ask(2, ENABLE)
    assert yam.status(2) == MotorStatus.LOST_COMMUNICATION
    yam.ask(2, CLEAR_ERROR)
    assert yam.status(2) == MotorStatus.DISABLED
    yam.ask(2, ENABLE)
    assert yam.status(2) == MotorStatus.ENABLED


def test_a_piper_reports_at_its_rates_without_being_asked(piper: Wire) -> None:
    sent = piper.let_pass(0.5)
    decoded = [decode_feedback(id, data) for id, data, _ in sent]
    assert sum(isinstance(record, PiperStatus) for record in decoded) == pytest.approx(100, abs=1)
    assert sum(isinstance(record, JointAngles) for record in decoded) == pytest.approx(300, abs=3)
    assert sum(isinstance(record, JointStatus) for record in decoded) == pytest.approx(120, abs=6)
    assert {id for id, *_ in sent} == set(FEEDBACK_IDS)
    unread = {id for (id, *_), record in zip(sent, decoded, strict=True) if record is None}
    assert unread == {POSE_ID, POSE_ID + 1, POSE_ID + 2}, "the driver does without the flange's pose"


@pytest.fixture
def emulator() -> CanEmulator:
    """An emulator of two arms that is not started."""
    return CanEmulator("openarm", can_overrides("virtual", ("left", "right")))


@pytest.mark.parametrize("line", ["double on", "friction 0", "help", "masses 1.2", "stall 0.1", "stats reset"])
def test_a_command_without_another_test_is_accepted(emulator: CanEmulator, line: str) -> None:
    execute(emulator, ["right", *line.split()])


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
        "lose 2",
        "silent three on",
        "push 0 2",
        "place a b c d e f g",
        "late -1",
        "cut now",
        "frame 0x11 0g",
        "status 3 Z",
        "status 3 7",
        "register 3 NONE 1",
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
