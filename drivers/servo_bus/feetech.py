"""Feetech's protocol of its SMS and STS series, as in its library (feetech-servo-sdk 1.0.0), and the STS3215."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from typing import ClassVar

from .protocol import (
    ALL,
    WRITE,
    Answer,
    Block,
    Calibration,
    MotorState,
    Registers,
    ServoProtocol,
    Writes,
    signed,
    unsigned,
)

MODEL = 777
"""Number of an STS3215."""
STALL_TORQUES = {12.0: 2.94, 7.4: 1.91}
"""Stall torque by the nominal voltage, Nm: 30 and 19.5 kg cm, by Feetech's data sheets of the STS3215."""
STIFFNESS = 28.0 / 32.0
"""Torque for each rad off the goal, Nm/rad, for each unit of the gain P: about 25 counts under 1.5 kg at 0.1 m and 45
degrees with the gain as delivered, 32 (issue 134 of TheRobotStudio/SO-ARM100)."""
ACCELERATION, SPEED = 254, 4000
"""Of the motors' own profile, 100 counts/s2 and counts/s: more than a motor reaches, so that it makes no profile."""
_STATE = struct.Struct("<B x H 4x H 5x x HHH BB x B 5x")


class Feetech(ServoProtocol):
    """Frames and registers of Feetech's STS3215."""

    name = "Feetech"
    bauds: ClassVar[Mapping[int, int]] = {1_000_000: 0, 500_000: 1, 115_200: 4, 57_600: 6, 38_400: 7}
    full = 1000
    stored: ClassVar[Block] = (0, 40)
    state: ClassVar[Block] = (40, 31)
    status = watchdog = None
    homing = -1
    torque, limit, id_address, baud_address, delay_address, lock = 40, 48, 5, 6, 7, 55
    goal: ClassVar[Block] = (42, 2)
    free: ClassVar[tuple[int, int]] = (33, 0)
    restart = 0.1
    errors: ClassVar[Mapping[int, tuple[str, str, str]]] = {
        1: ("voltage", "has a supply of {0.voltage:.1f} V", "check the supply: 12 V, or 5 to 7.4 V for a 7.4 V motor"),
        2: ("sensor", "has a faulty angle sensor", "support the arm, switch the power off and on; replace the motor"),
        4: ("too_hot", "has {0.temperature} deg C", "let it cool down; lower its load or its speed"),
        8: ("overcurrent", "draws too much current", "check what the arm touches, and its load"),
        32: ("overload", "is overloaded, and has reduced its torque", "check what the arm touches, and its load"),
    }

    def encode(self, id: int, instruction: int, data: bytes = b"") -> bytes:
        body = bytes((id, len(data) + 2, instruction)) + data
        return b"\xff\xff" + body + bytes((~sum(body) & 0xFF,))

    def split(self, came: bytes) -> tuple[list[Answer], bytes, int]:
        found: list[Answer] = []
        spoilt = 0
        while (start := came.find(b"\xff\xff")) >= 0:
            came = came[start:]
            if len(came) < 4 or (came[2] < ALL + 1 and came[3] >= 2 and len(came) < came[3] + 4):
                return found, came, spoilt
            end = came[3] + 4
            if came[2] > ALL or came[3] < 2:
                came = came[1:]
            elif ~sum(came[2 : end - 1]) & 0xFF == came[end - 1]:
                found.append(Answer(came[2], came[4], came[5 : end - 1]))
                came = came[end:]
            else:
                spoilt += 1
                came = came[2:]
        return found, came[-1:], spoilt

    def place(self, address: int, *size: int) -> bytes:
        return bytes((address, *size))

    def decode_state(self, now: float, answer: Answer, status: bytes) -> MotorState:
        on, goal, limit, position, velocity, load, voltage, temperature, errors = _STATE.unpack(answer.data)
        goal, position, speed, load = signed(goal, 15), signed(position, 15), signed(velocity, 15), signed(load, 10)
        errors |= answer.error
        return MotorState(now, errors, bool(on), False, goal, limit, position, speed, load, voltage / 10, temperature)

    def decode_registers(self, data: bytes) -> Registers:
        number, low, high, voltage_max, limit, offset = struct.unpack("<3x H 4x HH x B x H 13x H 7x", data)
        nominal = 12.0 if voltage_max > 100 else 7.4  # its greatest voltage tells the two kinds apart
        wrong = "is not set to positions; calibrate it: hal calibrate arm" if data[33] != 0 else ""
        if data[18] & 0x10:  # no calibration changes that
            wrong = "is not set to positions within one turn; clear bit 4 of its phase (address 18) with Feetech's tool"
        model, stiffness = "STS3215" if number == MODEL else "", STIFFNESS * max(1, data[21])
        calibration, torque = Calibration(0, signed(offset, 11), low, high), STALL_TORQUES[nominal]
        return Registers(model, number, data[7], calibration, nominal, torque, 4.7, stiffness, limit, wrong, turns=0)

    def prepare(self, ids: Sequence[int], goals: Sequence[int], limits: Sequence[int], watch: bool) -> Writes:
        values = {
            id: struct.pack("<BHHHH", ACCELERATION, goal, 0, SPEED, limit)
            for id, goal, limit in zip(ids, goals, limits, strict=True)
        }
        return [(41, values)]

    def clear(self, states: Mapping[int, MotorState]) -> list[tuple[int, int, bytes]]:
        """An overload ends when the torque is written again, on or off; the goal is where the motor is."""
        found = []
        for id, state in states.items():
            if state.error & 0x28:
                found += [(id, WRITE, struct.pack("<BH", 42, max(0, state.position)))]
                found += [(id, WRITE, bytes((40, state.on)))]
        return found

    def store_calibration(self, calibration: Calibration) -> list[tuple[int, bytes]]:
        _, offset, low, high = calibration
        words = (31, unsigned(offset, 11)), (9, low), (11, high)
        return [(address, struct.pack("<H", word)) for address, word in words]
