"""Frames of Damiao motors: golden bytes, and properties of encoding and decoding."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.drivers.can import damiao_protocol as protocol
from hal.drivers.can.damiao_motor import ChainMotor
from hal.drivers.can.damiao_protocol import MOTOR_RANGES, MotorCodec, MotorRange
from hal.drivers.can.settings import DamiaoMotorSettings
from hal_emulators.can import damiao_frames as motor_side
from hal_emulators.can.damiao_frames import MotorSide

DM4340 = MotorCodec(MOTOR_RANGES["DM4340"])
DM4310 = MotorSide(MOTOR_RANGES["DM4310"])


def read_feedback(data: bytes, limits: MotorRange = MOTOR_RANGES["DM4310"]) -> ChainMotor:
    """The driver's side of motor 3, mounted straight, with the content of a feedback frame."""
    settings = DamiaoMotorSettings.model_construct(id=3, type="DM4310", kp=1.0, kd=1.0, ranges=limits)
    motor = ChainMotor(settings, "motor 3")
    motor.receive(bytearray(data))
    motor.decode()
    return motor


GOLDEN_COMMANDS = [
    ((0.0, 0.0, 0.0, 0.0, 0.0), "7fff 7ff0 0000 07ff"),
    ((12.5, 10.0, 500.0, 5.0, 28.0), "ffff ffff ffff ffff"),
    ((-12.5, -10.0, 0.0, 0.0, -28.0), "0000 0000 0000 0000"),
    ((99.0, 99.0, 999.0, 99.0, 99.0), "ffff ffff ffff ffff"),
    ((-99.0, -99.0, -1.0, -1.0, -99.0), "0000 0000 0000 0000"),
    ((0.5, 0.0, 20.0, 1.0, 0.0), "851e 7ff0 a333 37ff"),
    ((1.0, -1.0, 80.0, 5.0, 5.6), "8a3c 7322 8fff f999"),
]
"""q, dq, kp, kd and tau for a DM4340, and the frame."""


@pytest.mark.parametrize(("command", "data"), GOLDEN_COMMANDS)
def test_commands_have_their_golden_bytes(command: tuple[float, ...], data: str) -> None:
    assert DM4340.encode_command(*command) == bytes.fromhex(data)


def test_zero_encodes_to_half_a_step_below_zero() -> None:
    command = DM4310.decode_command(DM4310.encode_command(0.0, 0.0, 0.0, 0.0, 0.0))
    assert command.q == pytest.approx(-12.5 / 65535)
    assert command.dq == pytest.approx(-30.0 / 4095)
    assert command.tau == pytest.approx(-10.0 / 4095)
    assert (command.kp, command.kd) == (0.0, 0.0)


def test_special_commands_have_their_golden_bytes() -> None:
    commands = (protocol.ENABLE, protocol.DISABLE, motor_side.SET_ZERO, protocol.CLEAR_ERROR)
    assert [data[-1] for data in commands] == [0xFC, 0xFD, 0xFE, 0xFB]
    assert all(data[:7] == b"\xff" * 7 for data in commands)


def test_feedback_has_its_golden_bytes() -> None:
    data = bytes.fromhex("13 851e 7ff 999 1e 28".replace(" ", ""))
    feedback = read_feedback(data)
    assert (feedback.replies, feedback.status, feedback.mosfet, feedback.rotor) == (1, 1, 30, 40)
    assert feedback.q == pytest.approx((0x851E + 0.5) * 25.0 / 65535 - 12.5)
    assert feedback.dq == pytest.approx(0.0, abs=1e-12)
    assert feedback.tau == pytest.approx((0x999 + 0.5) * 20.0 / 4095 - 10.0)
    assert DM4310.encode_feedback(3, 1, 0.5, 0.0, 2.0, 30, 40) == data
    assert DM4310.encode_feedback(0x13, 0xD, -99.0, 99.0, 0.0, -5, 400).hex() == "d30000fff7ff00ff"


@pytest.mark.parametrize(
    ("data", "expected"),
    [
        (protocol.encode_state_request(3), "0300cc0000000000"),
        (protocol.encode_register_read(1, protocol.MotorRegister.PMAX), "0100331500000000"),
        (motor_side.encode_register_reply(2, protocol.MotorRegister.TIMEOUT, 8000, 0x55), "02005509401f0000"),
        (motor_side.encode_register_reply(2, protocol.MotorRegister.VMAX, 10.0, 0x55), "0200551600002041"),
        (motor_side.encode_register_reply(1, protocol.MotorRegister.PMAX, 12.5), "0100331500004841"),
        (motor_side.encode_register_reply(7, protocol.MotorRegister.CTRL_MODE, 1), "0700330a01000000"),
    ],
)
def test_register_frames_have_their_golden_bytes(data: bytes, expected: str) -> None:
    assert data.hex() == expected


limits = st.builds(
    MotorRange,
    st.floats(1.0, 50.0),
    st.floats(1.0, 300.0),
    st.floats(0.5, 300.0),
)
anything = st.floats(allow_nan=False, allow_infinity=True)


def step_down(value: float, decoded: float, lowest: float, highest: float, steps: int) -> None:
    """Check that a number came back clamped, and at most one step lower."""
    clamped = min(max(value, lowest), highest)
    step = (highest - lowest) / steps
    assert clamped - step - 1e-9 * highest <= decoded <= clamped + 1e-9 * highest


@given(limits, anything, anything, anything, anything, anything)
def test_commands_round_trip(limits: MotorRange, q: float, dq: float, kp: float, kd: float, tau: float) -> None:
    codec = MotorSide(limits)
    found = codec.decode_command(codec.encode_command(q, dq, kp, kd, tau))
    step_down(q, found.q, -limits.position, limits.position, 65535)
    step_down(dq, found.dq, -limits.velocity, limits.velocity, 4095)
    step_down(kp, found.kp, 0.0, protocol.KP_MAX, 4095)
    step_down(kd, found.kd, 0.0, protocol.KD_MAX, 4095)
    step_down(tau, found.tau, -limits.torque, limits.torque, 4095)


@given(limits, st.integers(0, 15), anything, anything, anything, st.integers(0, 255))
def test_feedback_comes_back_to_half_a_step(
    limits: MotorRange, status: int, q: float, dq: float, tau: float, heat: int
) -> None:
    data = MotorSide(limits).encode_feedback(3, status, q, dq, tau, heat, 255 - heat)
    found = read_feedback(data, limits)
    assert (found.replies, found.status, found.mosfet, found.rotor) == (1, status, heat, 255 - heat)
    for value, came, most, steps in (
        (q, found.q, limits.position, 65535),
        (dq, found.dq, limits.velocity, 4095),
        (tau, found.tau, limits.torque, 4095),
    ):
        assert came == pytest.approx(min(max(value, -most), most), abs=most / steps + 1e-9 * most)


@given(st.binary(min_size=8, max_size=8))
def test_every_command_decodes_to_gains_in_range(data: bytes) -> None:
    command = DM4310.decode_command(bytearray(data))
    assert 0.0 <= command.kp <= 500.0 + 1e-9
    assert 0.0 <= command.kd <= 5.0 + 1e-9


@given(st.binary(max_size=12).filter(lambda data: len(data) != 8))
def test_frames_of_another_length_are_refused(data: bytes) -> None:
    motor = read_feedback(data)
    assert (motor.replies, motor.foreign) == (0, 1)
    with pytest.raises(ValueError, match="8 bytes"):
        DM4310.decode_command(data)
    assert protocol.decode_register_reply(data, 1) is None


@pytest.mark.parametrize("place", range(5))
def test_nan_is_never_encoded(place: int) -> None:
    numbers = [0.0] * 5
    numbers[place] = math.nan
    with pytest.raises(ValueError, match="NaN"):
        DM4310.encode_command(*numbers)


INTEGERS = st.sampled_from([7, 8, 9, 10, 13, 14, 15, 16, 35, 36])
FLOATS = st.sampled_from([0, 2, 4, 11, 17, 21, 22, 23, 29])


@given(
    st.integers(1, 0x7FE),
    st.one_of(st.tuples(INTEGERS, st.integers(0, 2**32 - 1)), st.tuples(FLOATS, st.floats(width=32, allow_nan=False))),
)
def test_register_values_round_trip(motor: int, content: tuple[int, float]) -> None:
    register, value = content
    reply = motor_side.encode_register_reply(motor, register, value)
    assert protocol.decode_register_reply(reply, motor) == (register, value)
    assert protocol.decode_register_reply(reply, motor % 0x7FE + 1) is None
    written = motor_side.encode_register_reply(motor, register, value, protocol.WRITE_REGISTER)
    request = motor_side.decode_register_request(written)
    assert request == (motor, protocol.WRITE_REGISTER, register, value)
    read = motor_side.decode_register_request(protocol.encode_register_read(motor, register))
    assert read is not None
    assert read[:3] == (motor, protocol.READ_REGISTER, register)


@given(st.integers(1, 15), st.sampled_from([1, *range(8, 15)]), st.floats(-12.4, 12.4))
def test_feedback_of_a_motor_is_no_register_reply(motor: int, status: int, q: float) -> None:
    assert protocol.decode_register_reply(DM4310.encode_feedback(motor, status, q, 0.0, 0.0), motor) is None


def test_a_state_request_names_its_motor() -> None:
    request = motor_side.decode_register_request(protocol.encode_state_request(5))
    assert request is not None
    assert request[:2] == (5, protocol.STATE_REQUEST)
    assert motor_side.decode_register_request(b"\x05\x00") is None


@pytest.mark.parametrize("limits", [(0.0, 1.0, 1.0), (12.5, -1.0, 1.0), (12.5, 1.0, math.nan)])
def test_impossible_ranges_are_refused(limits: tuple[float, float, float]) -> None:
    with pytest.raises(ValueError, match="positive"):
        MotorCodec(MotorRange(*limits))
