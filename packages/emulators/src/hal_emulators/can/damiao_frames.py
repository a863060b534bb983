"""Frames of Damiao motors on the motor's own side: commands are decoded, and feedback encoded.

The layouts are in :mod:`hal.drivers.can.damiao_protocol`.
"""

from __future__ import annotations

import struct
from typing import NamedTuple

from hal.drivers.can.damiao_protocol import (
    INTEGER_REGISTERS,
    KD_MAX,
    KP_MAX,
    READ_REGISTER,
    MotorCodec,
    unpack_register,
)

SET_ZERO = b"\xff" * 7 + b"\xfe"
"""Data of the command that makes the present position the zero."""
SAVE_REGISTERS = 0xAA
"""Operation of a request to keep all registers without power."""


class MotorCommand(NamedTuple):
    """Content of a command in MIT mode, on the motor's side: without direction and offset of a joint."""

    q: float
    dq: float
    kp: float
    kd: float
    tau: float


class RegisterRequest(NamedTuple):
    """A request at REGISTER_ID."""

    motor: int
    """Id of the motor that it is for."""
    operation: int
    """READ_REGISTER, WRITE_REGISTER, SAVE_REGISTERS or STATE_REQUEST; others are not documented."""
    register: int
    value: float
    """New value, when writing; an int where the register holds one."""


class MotorSide(MotorCodec):
    """The driver's encoder of commands, and what a motor does: decode them, and encode its feedback."""

    def decode_command(self, data: bytes | bytearray) -> MotorCommand:
        """Return the content of a command, which is none of the special forms (ENABLE, ...). Raises ValueError."""
        if len(data) != 8:
            raise ValueError(f"a command has 8 bytes, not {len(data)}")
        bits, (p, v, t) = int.from_bytes(data, "big"), self.limits
        return MotorCommand(
            (bits >> 48) * (2.0 * p / 65535.0) - p,
            (bits >> 36 & 0xFFF) * (2.0 * v / 4095.0) - v,
            (bits >> 24 & 0xFFF) * (KP_MAX / 4095.0),
            (bits >> 12 & 0xFFF) * (KD_MAX / 4095.0),
            (bits & 0xFFF) * (2.0 * t / 4095.0) - t,
        )

    def encode_feedback(
        self, motor: int, status: int, q: float, dq: float, tau: float, mosfet: int = 30, rotor: int = 30
    ) -> bytes:
        """Return the data of a feedback frame: rad, rad/s, Nm, and temperatures in deg C. Raises ValueError for NaN."""
        p, v, t = self.limits
        position = 65535 if q >= p else 0 if q <= -p else int((q + p) * 65535.0 / (2.0 * p))
        velocity = 4095 if dq >= v else 0 if dq <= -v else int((dq + v) * 4095.0 / (2.0 * v))
        torque = 4095 if tau >= t else 0 if tau <= -t else int((tau + t) * 4095.0 / (2.0 * t))
        head = (status & 15) << 60 | (motor & 15) << 56
        heat = min(max(int(mosfet), 0), 255) << 8 | min(max(int(rotor), 0), 255)
        return (head | position << 40 | velocity << 28 | torque << 16 | heat).to_bytes(8, "big")


def encode_register_reply(motor: int, register: int, value: float, operation: int = READ_REGISTER) -> bytes:
    """Return the data of the reply, at the master id, to a request with this ``operation``."""
    packed = struct.pack("<I", int(value)) if register in INTEGER_REGISTERS else struct.pack("<f", value)
    return bytes((motor & 0xFF, motor >> 8, operation, register)) + packed


def decode_register_request(data: bytes | bytearray) -> RegisterRequest | None:
    """Return the content of a request at REGISTER_ID; None for a frame with less than 3 bytes."""
    if len(data) < 3:
        return None
    padded = bytes(data).ljust(8, b"\0")
    register = padded[3]
    return RegisterRequest(padded[0] | padded[1] << 8, padded[2], register, unpack_register(register, padded[4:8]))
