"""Frames of Damiao motors: pure functions that encode commands and read registers. No bus, no time.

Feedback is decoded by :class:`.damiao_motor.ChainMotor`. The motor's own side is in the emulator.

A motor listens at its own id. Whatever it is sent, it answers with one feedback frame at its master id. Frames have
8 bytes. In commands and feedback, numbers are unsigned integers of 12 or 16 bits, big-endian, that map linearly onto
a range around zero; the ranges are the motor's registers PMAX, VMAX and TMAX. Registers are read and written at the
common id 0x7FF.

    command (to the motor's id)           feedback (from the master id)
    position   16 bits, -PMAX..PMAX       status      4 bits, see Status
    velocity   12 bits, -VMAX..VMAX       motor id    4 bits, the lowest
    kp         12 bits, 0..500 Nm/rad     position   16 bits
    kd         12 bits, 0..5 Nm s/rad     velocity   12 bits
    torque     12 bits, -TMAX..TMAX       torque     12 bits
                                          temperatures of MOSFETs and rotor, 8 bits each, deg C

A motor in MIT mode applies kp (q - q_measured) + kd (dq - dq_measured) + torque. Sources: openarm_can (Enactic),
i2rt (I2RT Robotics), LeRobot (Hugging Face), and Damiao's manuals.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from enum import IntEnum
from types import MappingProxyType
from typing import NamedTuple

KP_MAX, KD_MAX = 500.0, 5.0
"""Largest gains of a command, Nm/rad and Nm s/rad. The smallest are 0."""
MASTER_OFFSET = 0x10
"""Usual distance of a motor's master id from its own id."""
REGISTER_ID = 0x7FF
"""Id at which all motors take requests of their registers and of their state."""
ENABLE = b"\xff" * 7 + b"\xfc"
"""Data of the command that switches a motor on. It then holds nothing until it gets its first command."""
DISABLE = b"\xff" * 7 + b"\xfd"
"""Data of the command that switches a motor off: it applies no torque any more."""
CLEAR_ERROR = b"\xff" * 7 + b"\xfb"
"""Data of the command that clears an error; the motor is then off."""
TIMEOUT_UNIT = 50e-6
"""Unit of the register TIMEOUT, s."""
MIT_MODE = 1
"""Value of the register CTRL_MODE in which commands have position, velocity, gains and torque."""
READ_REGISTER, WRITE_REGISTER, STATE_REQUEST = 0x33, 0x55, 0xCC
"""Operations at REGISTER_ID: the third byte of a request."""


class MotorRange(NamedTuple):
    """Ranges onto which a motor maps the numbers of its frames: from minus to plus these values."""

    position: float
    """PMAX, rad."""
    velocity: float
    """VMAX, rad/s."""
    torque: float
    """TMAX, Nm."""


MOTOR_RANGES: Mapping[str, MotorRange] = MappingProxyType(
    {
        "DM3507": MotorRange(12.5, 50.0, 5.0),
        "DM4310": MotorRange(12.5, 30.0, 10.0),
        "DM4310_48V": MotorRange(12.5, 50.0, 10.0),
        "DM4340": MotorRange(12.5, 10.0, 28.0),
        "DM4340_48V": MotorRange(12.5, 10.0, 28.0),
        "DM6006": MotorRange(12.5, 45.0, 20.0),
        "DM8006": MotorRange(12.5, 45.0, 40.0),
        "DM8009": MotorRange(12.5, 45.0, 54.0),
        "DM10010L": MotorRange(12.5, 25.0, 200.0),
        "DM10010": MotorRange(12.5, 20.0, 200.0),
        "DMH3510": MotorRange(12.5, 280.0, 1.0),
        "DMH6215": MotorRange(12.5, 45.0, 10.0),
        "DMG6220": MotorRange(12.5, 45.0, 10.0),
    }
)
"""Type of a motor -> its ranges as it leaves the factory (openarm_can). They are registers, so a user can change them,
and other public tables differ: the driver compares them with the registers of every motor."""


class MotorStatus(IntEnum):
    """Status in a feedback frame. A motor with a status of 8 or more has a fault and applies no position control."""

    DISABLED = 0x0
    ENABLED = 0x1
    OVER_VOLTAGE = 0x8
    UNDER_VOLTAGE = 0x9
    OVER_CURRENT = 0xA
    MOSFET_TOO_HOT = 0xB
    ROTOR_TOO_HOT = 0xC
    LOST_COMMUNICATION = 0xD
    """It heard nothing for TIMEOUT, and damps."""
    OVERLOAD = 0xE


class MotorRegister(IntEnum):
    """Registers that the driver reads, by their number (RID)."""

    OT_VALUE = 2
    """Over-temperature protection, 80 to 200 deg C. Taken as the rotor's: by the manual only the rotor's can be set."""
    MST_ID = 7
    ESC_ID = 8
    """The motor's own id."""
    TIMEOUT = 9
    """Silence after which the motor damps, in units of TIMEOUT_UNIT; 0 is never."""
    CTRL_MODE = 10
    HW_VERSION = 13
    SW_VERSION = 14
    SERIAL = 15
    PMAX = 21
    VMAX = 22
    TMAX = 23
    CAN_BR = 35
    """Code of the bit rate: 0..9 for 125k, 200k, 250k, 500k, 1M, 2M, 2.5M, 3.2M, 4M, 5M."""


INTEGER_REGISTERS = frozenset({*range(7, 11), *range(13, 17), 35, 36})
"""Registers that hold a uint32; the others hold a float32."""


class MotorCodec:
    """Encoder of the commands to motors with one range.

    Values beyond the range are clamped. A number is truncated to the next lower step, so zero is half a step below
    zero (0x7FFF, 0x7FF), and a value comes back at most one step lower.
    """

    def __init__(self, limits: MotorRange) -> None:
        self.limits = limits
        p, v, t = limits
        if not (0.0 < p < 1e4 and 0.0 < v < 1e4 and 0.0 < t < 1e4):
            raise ValueError(f"the ranges of a motor must be positive, not {limits}")
        self._p, self._v, self._t = p, v, t
        self._p2, self._v2, self._t2 = 2.0 * p, 2.0 * v, 2.0 * t

    def encode_command(self, q: float, dq: float, kp: float, kd: float, tau: float) -> bytes:
        """Return the data of a command: rad, rad/s, Nm/rad, Nm s/rad, Nm. Raises ValueError for NaN."""
        p, v, t = self._p, self._v, self._t
        position = 65535 if q >= p else 0 if q <= -p else int((q + p) * 65535.0 / self._p2)
        velocity = 4095 if dq >= v else 0 if dq <= -v else int((dq + v) * 4095.0 / self._v2)
        torque = 4095 if tau >= t else 0 if tau <= -t else int((tau + t) * 4095.0 / self._t2)
        stiffness = 4095 if kp >= KP_MAX else 0 if kp <= 0.0 else int(kp * 4095.0 / KP_MAX)
        damping = 4095 if kd >= KD_MAX else 0 if kd <= 0.0 else int(kd * 4095.0 / KD_MAX)
        return (position << 48 | velocity << 36 | stiffness << 24 | damping << 12 | torque).to_bytes(8, "big")


# Registers. Requests and replies: id low, id high, operation, register, then its value in 4 bytes, little-endian.


class RegisterReply(NamedTuple):
    """Value of a register, from a motor."""

    register: int
    value: float
    """An int where the register holds one."""


def encode_state_request(motor: int) -> bytes:
    """Return the data of a request for feedback, to be sent to REGISTER_ID. It changes nothing at the motor."""
    return bytes((motor & 0xFF, motor >> 8, STATE_REQUEST, 0, 0, 0, 0, 0))


def encode_register_read(motor: int, register: int) -> bytes:
    """Return the data of a request for a register's value, to be sent to REGISTER_ID."""
    return bytes((motor & 0xFF, motor >> 8, READ_REGISTER, register, 0, 0, 0, 0))


def decode_register_reply(data: bytes | bytearray, motor: int) -> RegisterReply | None:
    """Return the content of a frame that ``motor`` sent to its master id; None unless it is a register's reply.

    Replies come at the same id as feedback. As feedback, this would be a motor that is off, one step away from -PMAX,
    where no joint can be.
    """
    if len(data) == 8 and data[2] in (READ_REGISTER, WRITE_REGISTER) and data[0] | data[1] << 8 == motor:
        return RegisterReply(data[3], unpack_register(data[3], bytes(data[4:8])))
    return None


def unpack_register(register: int, data: bytes) -> float:
    value: float = struct.unpack("<I" if register in INTEGER_REGISTERS else "<f", data)[0]
    return value
