"""Robotis's protocol 2.0, and the Dynamixel X series, by its manual (emanual.robotis.com/docs/en/dxl/x)."""

from __future__ import annotations

import struct
from collections.abc import Mapping, Sequence
from math import pi
from typing import ClassVar, NamedTuple

from .protocol import COUNT, TURN, Answer, Block, Calibration, MotorState, Registers, ServoProtocol, Writes

REBOOT, STATUS = 0x08, 0x55
WATCHDOG = 8
"""Time without a frame after which a motor stops, 20 ms: longer than the servo's own patience with its host."""
SINGLE, MULTI, CURRENT = 3, 4, 5
"""Operating modes in which a motor takes positions; in the last two it counts its turns."""
_HEAD = b"\xff\xff\xfd\x00"
_STATE = struct.Struct("<i 4x h 2x ii 8x HB")
_STATUS = struct.Struct("<B 5x B 27x B x H")


class ServoModel(NamedTuple):
    """A servo of the X series."""

    name: str
    nominal: float
    """V"""
    stall_torque: float
    """There, Nm."""
    rpm: float
    """There, without a load."""


MODELS = {
    1020: ServoModel("XM430-W350", 12.0, 4.1, 46),
    1030: ServoModel("XM430-W210", 12.0, 3.0, 77),
    1060: ServoModel("XL430-W250", 12.0, 1.5, 61),
    1070: ServoModel("XC430-W150", 12.0, 1.6, 106),
    1120: ServoModel("XM540-W270", 12.0, 10.6, 30),
    1190: ServoModel("XL330-M077", 5.0, 0.215, 383),
    1200: ServoModel("XL330-M288", 5.0, 0.52, 103),
}
"""By their numbers; stall torques and speeds are those of ROBOTIS (e-manual)."""


def _make_table() -> list[int]:
    table = []
    for value in range(256):
        crc = value << 8
        for _ in range(8):
            crc = (crc << 1) ^ (0x8005 if crc & 0x8000 else 0)
        table.append(crc & 0xFFFF)
    return table


_TABLE = _make_table()


def checksum(data: bytes) -> int:
    """Return the CRC-16 of a frame."""
    crc, table = 0, _TABLE
    for byte in data:
        crc = (crc << 8 & 0xFFFF) ^ table[crc >> 8 ^ byte]
    return crc


class Dynamixel(ServoProtocol):
    """Frames of the protocol 2.0, and registers of the X series."""

    name = "Dynamixel"
    bauds: ClassVar[Mapping[int, int]] = {1_000_000: 3, 57_600: 1, 115_200: 2, 2_000_000: 4, 3_000_000: 5, 4_000_000: 6}
    full = 885
    stored: ClassVar[Block] = (0, 86)
    state: ClassVar[Block] = (116, 31)
    status: ClassVar[Block] = (64, 38)
    torque, watchdog, limit, id_address, baud_address, delay_address, lock = 64, 98, 100, 7, 8, 9, None
    goal: ClassVar[Block] = (116, 4)
    homing = 1
    free: ClassVar[tuple[int, int]] = (11, MULTI)  # in the mode of one turn it takes an offset of a quarter of it only
    restart = 1.5
    errors: ClassVar[Mapping[int, tuple[str, str, str]]] = {
        1: ("voltage", "has a supply of {0.voltage:.1f} V", "check the supply: 12 V, 5 V for an XL330"),
        4: ("too_hot", "has {0.temperature} deg C", "let it cool down; lower its load or its speed"),
        8: ("sensor", "has a faulty encoder", "replace the motor"),
        16: ("overcurrent", "had an electrical shock, or too little power", "check the supply and the cables"),
        32: ("overload", "is overloaded, and has switched its torque off", "check what the arm touches, and its load"),
    }

    def encode(self, id: int, instruction: int, data: bytes = b"") -> bytes:
        body = (bytes((instruction,)) + data).replace(b"\xff\xff\xfd", b"\xff\xff\xfd\xfd")
        frame = _HEAD + struct.pack("<BH", id, len(body) + 2) + body
        return frame + struct.pack("<H", checksum(frame))

    def encode_answer(self, id: int, error: int, data: bytes = b"") -> bytes:
        return self.encode(id, STATUS, bytes((error,)) + data)

    def split(self, came: bytes) -> tuple[list[Answer], bytes, int]:
        found: list[Answer] = []
        spoilt = 0
        while (start := came.find(_HEAD)) >= 0:
            came = came[start:]
            size = int.from_bytes(came[5:7], "little")
            if len(came) >= 7 and not 3 <= size <= 1024:
                came = came[4:]
                continue
            if len(came) < size + 7 or len(came) < 7:
                return found, came, spoilt
            frame, crc = came[: size + 5], int.from_bytes(came[size + 5 : size + 7], "little")
            if checksum(frame) != crc:
                spoilt += 1
                came = came[4:]
                continue
            body = frame[7:].replace(b"\xff\xff\xfd\xfd", b"\xff\xff\xfd")
            answers = body[0] == STATUS and len(body) > 1
            found.append(Answer(frame[4], body[answers], body[1 + answers :]))
            came = came[size + 7 :]
        return found, came[-3:], spoilt

    def place(self, address: int, *size: int) -> bytes:
        return struct.pack(f"<{1 + len(size)}H", address, *size)

    def decode_state(self, now: float, answer: Answer, status: bytes) -> MotorState:
        goal, load, velocity, position, voltage, temperature = _STATE.unpack(answer.data)
        on, errors, watchdog, limit = _STATUS.unpack(status)
        speed = velocity * 0.229 / 60 * TURN  # rpm
        return MotorState(
            now, errors, on == 1, watchdog == 255, goal, limit, position, speed, load, voltage / 10, temperature
        )

    def decode_registers(self, data: bytes) -> Registers:
        number, delay, drive, mode, follows, offset = struct.unpack_from("<H 7x BBBB 7x i", data)
        limit, high, low, gain = struct.unpack_from("<H 10x ii 28x H", data, 36)
        name, nominal, torque, rpm = MODELS.get(number, ServoModel("", 12.0, 1.0, 60))
        wrong = ""
        if mode not in (SINGLE, MULTI, CURRENT):
            wrong = f"is in the operating mode {mode}, not in one for positions ({SINGLE}, {MULTI} or {CURRENT}); "
            wrong += "calibrate it: hal calibrate arm"
        elif drive & 0x0A:
            wrong = f"has the drive mode {drive}: it is driven by another motor's cable, or switched on by a goal; "
            wrong += f"set it to {drive & ~0x0A} (address 10) with Dynamixel Wizard"
        # The error in counts times the gain over 128 is the duty cycle, of which `full` gives the stall torque.
        stiffness = torque / self.full * max(1, gain) / 128 / COUNT
        calibration = Calibration(drive & 1, offset, low, high)
        turns, speed = 1 if mode == SINGLE else 2, rpm * 2.0 * pi / 60.0
        motor = Registers(name, number, delay, calibration, nominal, torque, speed, stiffness, limit, wrong)
        return motor._replace(turns=turns, follows=follows)

    def prepare(self, ids: Sequence[int], goals: Sequence[int], limits: Sequence[int], watch: bool) -> Writes:
        """The watchdog ends its own stop when it is written: only then the motor takes goals."""
        return [
            (98, dict.fromkeys(ids, b"\x00")),
            (100, {id: struct.pack("<H", limit) for id, limit in zip(ids, limits, strict=True)}),
            (108, {id: struct.pack("<IIi", 0, 0, goal) for id, goal in zip(ids, goals, strict=True)}),
            *([(98, dict.fromkeys(ids, bytes((WATCHDOG,))))] if watch else []),
        ]

    def clear(self, states: Mapping[int, MotorState]) -> list[tuple[int, int, bytes]]:
        """A motor with an error has switched its torque off; only a restart ends it."""
        return [(id, REBOOT, b"") for id, state in states.items() if state.error]

    def store_calibration(self, calibration: Calibration) -> list[tuple[int, bytes]]:
        _, offset, low, high = calibration
        return [(20, struct.pack("<i", offset)), (48, struct.pack("<ii", high, low))]
