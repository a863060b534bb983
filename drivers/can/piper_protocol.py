"""Frames of an AgileX PiPER arm and its gripper: pure functions and records, no bus.

The arm has a controller on board, which takes position targets and reports its state without being asked. Frames are
classic CAN with 11-bit ids and at most 8 bytes; numbers are big-endian integers. The layouts are those of the vendor's
``piper_sdk`` (protocol V2, firmware V1.5-2 and later), and are tested against it.

Records hold SI units and radians. ``frame()`` encodes a command, and :func:`decode_feedback` reads a report; the arm's
own side is in the emulator. A number that is not finite, or that its field cannot hold, raises ValueError: nothing is
clamped here.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Sequence
from math import pi
from typing import NamedTuple

JOINTS = 6
ALL_JOINTS = 7
"""Motor number that stands for all six joints in :class:`EnableRequest` and :class:`JointRequest`."""

STANDBY = 0
CAN_CONTROL = 1
"""Control modes of :class:`ModeRequest` and :class:`PiperStatus`: waiting, and driven over CAN."""
MOVE_J = 1
"""Move mode: joint targets."""

ARM_STATUS = {
    0x0: "normal",
    0x1: "emergency_stop",
    0x2: "no_solution",
    0x3: "singularity",
    0x4: "target_beyond_limit",
    0x5: "joint_communication",
    0x6: "brake_closed",
    0x7: "collision",
    0x8: "overspeed_in_teaching",
    0x9: "joint_status",
    0xA: "other",
    0xB: "teaching_record",
    0xC: "teaching_execution",
    0xD: "teaching_pause",
    0xE: "controller_hot",
    0xF: "brake_resistor_hot",
}
"""Names of :attr:`PiperStatus.status`."""

LOW_VOLTAGE, MOTOR_HOT, OVER_CURRENT, DRIVER_HOT = 0x01, 0x02, 0x04, 0x08
COLLISION, ERROR, ENABLED, STALLED = 0x10, 0x20, 0x40, 0x80
"""Bits of :attr:`JointStatus.flags`. A gripper has the same, with two exceptions: 0x10 is an error of its sensor, and
0x80 is HOMED."""
HOMED = 0x80
"""Bit of :attr:`GripperStatus.flags`: the gripper's zero is set."""

TORQUE_PER_AMPERE = (1.18125, 1.18125, 1.18125, 0.95844, 0.95844, 0.95844)
"""Joint torque over motor current, Nm/A, by piper_sdk; the manual of pyAgxArm has 4 times that for joints 1 to 3."""

STOP_ID, MODE_ID, TARGETS_ID, GRIPPER_ID = 0x150, 0x151, 0x155, 0x159
ENABLE_ID, LIMIT_QUERY_ID, LIMITS_ID, JOINT_ID = 0x471, 0x472, 0x473, 0x475
PARAMETER_QUERY_ID, STROKE_ID = 0x477, 0x47E
STATUS_ID, POSE_ID, ANGLES_ID, GRIPPER_STATUS_ID, MOTION_ID, MOTOR_STATUS_ID = 0x2A1, 0x2A2, 0x2A5, 0x2A8, 0x251, 0x261
ACKNOWLEDGEMENT = 0x476
"""Id of the answer to a command with an id of 0x470 and above."""
FIRMWARE = 0x4AF
"""Id of both the question for the firmware's version and its answer."""
COMMAND_IDS = (
    MODE_ID,
    *range(TARGETS_ID, TARGETS_ID + JOINTS // 2),
    GRIPPER_ID,
    ENABLE_ID,
    LIMIT_QUERY_ID,
    JOINT_ID,
    PARAMETER_QUERY_ID,
    FIRMWARE,
)
"""Ids of the commands that this package sends."""
FEEDBACK_IDS = (
    *range(MOTION_ID, MOTION_ID + JOINTS),
    *range(MOTOR_STATUS_ID, MOTOR_STATUS_ID + JOINTS),
    *range(STATUS_ID, GRIPPER_STATUS_ID + 1),
)
"""Ids of the frames that the arm and its gripper send without being asked."""
GRIPPER_IDS = (GRIPPER_STATUS_ID,)
"""Those of them that are the gripper's."""

PARAMETER_IDS = (LIMITS_ID, STROKE_ID, ACKNOWLEDGEMENT, FIRMWARE)
"""Ids of the answers to questions and settings."""

MILLIDEGREES = 180_000.0 / pi
"""Millidegrees per radian."""
SET = 0xAE
"""Value that makes a setting effective."""
_PAIR = struct.Struct(">ii")

CanFrame = tuple[int, bytes]
"""(11-bit id, data of at most 8 bytes)."""


# Commands: what a program sends to the arm


class ModeRequest(NamedTuple):
    """Control mode, move mode and speed (0x151)."""

    control: int = CAN_CONTROL
    """0 standby, 1 CAN, 3 Ethernet, 4 Wi-Fi, 7 offline trajectory."""
    move: int = MOVE_J
    """0 P, 1 J, 2 L, 3 C, 4 M (MIT), 5 CPV."""
    speed_percent: int = 100
    """Speed of the arm's own motion to a target, percent of each joint's largest."""
    mit: int = 0
    """0x00 position and speed, 0xAD MIT."""
    dwell_s: int = 0
    mounting: int = 0
    """0 unchanged, 1 upright, 2 on its left side, 3 on its right side; seen with the cables behind."""

    def frame(self) -> CanFrame:
        return MODE_ID, bytes((*self, 0, 0))


class JointTargets(NamedTuple):
    """Targets of two neighbouring joints (0x155 to 0x157)."""

    first: int
    """Index of the first of the two joints: 0, 2 or 4."""
    q: tuple[float, float]
    """rad, exact to 0.001 degrees."""

    def frame(self) -> CanFrame:
        return TARGETS_ID + self.first // 2, pack_pair(self.q, MILLIDEGREES)


class GripperRequest(NamedTuple):
    """Target of the gripper (0x159)."""

    width: float
    """Distance between the fingers, m; exact to a micrometre."""
    torque: float
    """Largest torque of the gripper's motor, Nm: 0 to 5."""
    enabled: bool = True
    clear_error: bool = False
    set_zero: bool = False
    """Whether the present position becomes the zero."""

    def frame(self) -> CanFrame:
        code = int(self.enabled) | int(self.clear_error) << 1
        return GRIPPER_ID, pack(">iHBB", self.width * 1e6, self.torque * 1e3, code, SET if self.set_zero else 0)


class EnableRequest(NamedTuple):
    """Switch the power of motors on or off (0x471). An arm that is switched off falls."""

    motor: int = ALL_JOINTS
    """1 to 6, 7 for all six joints, 255 for these and the gripper."""
    enabled: bool = True

    def frame(self) -> CanFrame:
        return ENABLE_ID, bytes((self.motor, 2 if self.enabled else 1, 0, 0, 0, 0, 0, 0))


class LimitQuery(NamedTuple):
    """Question for a joint's range and speed (0x472), answered by :class:`JointLimits`."""

    motor: int
    """1 to 6."""

    def frame(self) -> CanFrame:
        return LIMIT_QUERY_ID, bytes((self.motor, 1, 0, 0, 0, 0, 0, 0))


class JointRequest(NamedTuple):
    """Settings of a joint (0x475); here only to clear its error."""

    motor: int = ALL_JOINTS
    """1 to 6, 7 for all."""
    clear_error: bool = True
    set_zero: bool = False

    def frame(self) -> CanFrame:
        """Return the frame of this record. The joint's acceleration stays as it is (0x7FFF)."""
        zero, clear = (SET if flag else 0 for flag in (self.set_zero, self.clear_error))
        return JOINT_ID, bytes((self.motor, zero, 0, 0x7F, 0xFF, clear, 0, 0))


class ParameterQuery(NamedTuple):
    """Question for parameters (0x477); 4, the gripper's stroke, is answered by :class:`GripperStroke`."""

    content: int = 4

    def frame(self) -> CanFrame:
        """Return the frame of this record. Nothing is set: 3 stands for an unchanged load."""
        return PARAMETER_QUERY_ID, bytes((self.content, 0, 0, 0, 3, 0, 0, 0))


class FirmwareQuery(NamedTuple):
    """Question for the firmware's version (0x4AF), answered by :class:`FirmwarePiece` frames."""

    def frame(self) -> CanFrame:
        return FIRMWARE, bytes((1, 0, 0, 0, 0, 0, 0, 0))


PiperCommand = (
    ModeRequest
    | JointTargets
    | GripperRequest
    | EnableRequest
    | LimitQuery
    | JointRequest
    | ParameterQuery
    | FirmwareQuery
)


def encode_joint_targets(q: Sequence[float]) -> list[CanFrame]:
    """Return the three frames of the targets (6,) of all joints, rad."""
    return [(TARGETS_ID + k // 2, pack_pair(q[k : k + 2], MILLIDEGREES)) for k in (0, 2, 4)]


# Feedback: what the arm sends


class PiperStatus(NamedTuple):
    """State of the whole arm (0x2A1), 200 times a second."""

    control: int = STANDBY
    """As in :class:`ModeRequest`; also 2 teaching, 5 remote control, 6 leader of a pair of arms."""
    status: int = 0
    """See ``ARM_STATUS``."""
    move: int = MOVE_J
    teaching: int = 0
    moving: int = 0
    """0 at the target, 1 not yet."""
    point: int = 0
    beyond_limit: int = 0
    """Bit k: joint k + 1 is beyond its range."""
    no_communication: int = 0
    """Bit k: the motor of joint k + 1 does not answer the arm's controller."""


class JointAngles(NamedTuple):
    """Measured positions of two neighbouring joints (0x2A5 to 0x2A7), 200 times a second."""

    first: int
    """0, 2 or 4."""
    q: tuple[float, float]
    """rad, exact to 0.001 degrees."""


class GripperStatus(NamedTuple):
    """State of the gripper (0x2A8), 200 times a second."""

    width: float
    """m."""
    torque: float
    """Torque of its motor, Nm."""
    flags: int = 0
    """ENABLED, HOMED, ERROR and so on."""


class JointMotion(NamedTuple):
    """Speed and current of a joint (0x251 to 0x256), 200 times a second."""

    joint: int
    """Index of the joint, from 0."""
    dq: float
    """rad/s, exact to 0.001."""
    current: float
    """A, exact to 0.001. See ``TORQUE_PER_AMPERE``."""
    position: float = 0.0
    """rad, exact to 0.001. Real arms are reported to fill this field in different units: use :class:`JointAngles`."""


class JointStatus(NamedTuple):
    """Voltage, temperatures and flags of a joint (0x261 to 0x266), 40 times a second."""

    joint: int
    """Index of the joint, from 0."""
    voltage: float
    """V, exact to 0.1."""
    driver_temperature: int
    """Degrees Celsius."""
    motor_temperature: int
    """Degrees Celsius."""
    flags: int
    """ENABLED, ERROR and so on."""
    current: float = 0.0
    """Supply current, A; small motors always report 0."""


class JointLimits(NamedTuple):
    """Range and speed of a joint as set in the arm (0x473)."""

    motor: int
    """1 to 6."""
    upper: float
    """rad, exact to 0.1 degrees."""
    lower: float
    """rad, exact to 0.1 degrees."""
    velocity: float
    """rad/s, exact to 0.001."""


class GripperStroke(NamedTuple):
    """Parameters of the gripper (0x47E)."""

    stroke_mm: int
    """Largest width: 70 or 100 mm; 0 if it is not set."""
    teaching_percent: int = 100
    teaching_friction: int = 1


class FirmwarePiece(NamedTuple):
    """Piece of the answer to :class:`FirmwareQuery` (0x4AF); :func:`find_firmware` reads all pieces together."""

    text: bytes


PiperFeedback = (
    PiperStatus | JointAngles | GripperStatus | JointMotion | JointStatus | JointLimits | GripperStroke | FirmwarePiece
)


def find_firmware(pieces: Iterable[bytes]) -> str | None:
    """Return the firmware's version, for example ``S-V1.8-5``; None if it is not (yet) complete."""
    text = b"".join(pieces)
    start = text.find(b"S-V")
    version = text[start : start + 8] if start >= 0 else b""
    return version.decode("ascii", "replace").rstrip("\0") if len(version) == 8 else None


def decode_feedback(frame_id: int, data: bytes) -> PiperFeedback | None:
    """Return what the arm reports in a frame; None for any other frame, of this arm or not."""
    decoder = _FEEDBACK.get(frame_id)
    return None if decoder is None or len(data) != 8 else decoder(frame_id, data)


def _motion(frame_id: int, data: bytes) -> JointMotion:
    dq, current, position = struct.unpack(">hhi", data)
    return JointMotion(frame_id - MOTION_ID, dq * 1e-3, current * 1e-3, position * 1e-3)


def _motor_status(frame_id: int, data: bytes) -> JointStatus:
    voltage, driver, motor, flags, current = struct.unpack(">HhbBH", data)
    return JointStatus(frame_id - MOTOR_STATUS_ID, voltage * 0.1, driver, motor, flags, current * 1e-3)


def _gripper_status(_: int, data: bytes) -> GripperStatus:
    width, torque, flags = struct.unpack(">ihBx", data)
    return GripperStatus(width * 1e-6, torque * 1e-3, flags)


def _limits(_: int, data: bytes) -> JointLimits:
    motor, upper, lower, velocity = struct.unpack(">BhhHx", data)
    return JointLimits(motor, upper * 100 / MILLIDEGREES, lower * 100 / MILLIDEGREES, velocity * 1e-3)


_FEEDBACK: dict[int, Callable[[int, bytes], PiperFeedback | None]] = {
    STATUS_ID: lambda _, data: PiperStatus(*data),
    GRIPPER_STATUS_ID: _gripper_status,
    LIMITS_ID: _limits,
    STROKE_ID: lambda _, data: GripperStroke(data[1], data[0], data[2]),
    FIRMWARE: lambda _, data: None if (FIRMWARE, data) == FirmwareQuery().frame() else FirmwarePiece(data),
    **dict.fromkeys(
        range(ANGLES_ID, ANGLES_ID + 3),
        lambda frame_id, data: JointAngles(2 * (frame_id - ANGLES_ID), unpack_angles(data)),
    ),
    **dict.fromkeys(range(MOTION_ID, MOTION_ID + JOINTS), _motion),
    **dict.fromkeys(range(MOTOR_STATUS_ID, MOTOR_STATUS_ID + JOINTS), _motor_status),
}


# Numbers


def pack_pair(values: Sequence[float], scale: float, second: float | None = None) -> bytes:
    """Return two numbers as integers of 32 bits, after multiplication by ``scale`` (and ``second``)."""
    a, b = values
    return pack(">ii", a * scale, b * (scale if second is None else second))


def unpack_angles(data: bytes) -> tuple[float, float]:
    a, b = _PAIR.unpack(data)
    return a / MILLIDEGREES, b / MILLIDEGREES


def pack(layout: str, *numbers: float) -> bytes:
    """Return the rounded numbers in a frame's layout. Raises ValueError for one that is not finite or does not fit."""
    try:
        return struct.pack(layout, *map(round, numbers))
    except (struct.error, OverflowError, ValueError) as error:
        raise ValueError(f"{numbers} does not fit into a frame: {error}") from None
