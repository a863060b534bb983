"""Frames of a PiPER on the arm's own side: commands are decoded, and reports encoded.

Records and numbers are those of :mod:`hal.drivers.can.piper_protocol`, with what its driver neither sends nor reads.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator, Sequence
from typing import NamedTuple

from hal.drivers.can import piper_protocol as protocol
from hal.drivers.can.piper_protocol import (
    FIRMWARE,
    MILLIDEGREES,
    SET,
    TARGETS_ID,
    CanFrame,
    EnableRequest,
    FirmwareQuery,
    GripperRequest,
    GripperStatus,
    GripperStroke,
    JointAngles,
    JointLimits,
    JointMotion,
    JointRequest,
    JointStatus,
    JointTargets,
    LimitQuery,
    ModeRequest,
    ParameterQuery,
    PiperCommand,
    PiperFeedback,
    PiperStatus,
    pack,
    pack_pair,
    unpack_angles,
)


class EmergencyRequest(NamedTuple):
    """Emergency stop, trajectory and teaching requests (0x150), which the driver never sends.

    ``resume`` cuts the power of the motors: a raised arm falls.
    """

    emergency: int
    """0 nothing, 1 stop, 2 resume."""
    trajectory: int
    teaching: int


class PoseNumbers(NamedTuple):
    """Two of the six numbers of the flange's pose (0x2A2 to 0x2A4): x, y; z, roll; pitch, yaw."""

    first: int
    """0, 2 or 4."""
    values: tuple[float, float]
    """m, exact to a micrometre, and rad, exact to 0.001 degrees."""


class Acknowledgement(NamedTuple):
    """Answer to a command with an id of 0x470 and above (0x476)."""

    command: int
    """Last byte of the command's id."""
    zero_set: bool = False


def decode_command(frame_id: int, data: bytes) -> PiperCommand | EmergencyRequest | None:
    """Return the command in a frame; None for any other frame, of this arm or not."""
    decoder = _COMMANDS.get(frame_id)
    return None if decoder is None or len(data) != 8 else decoder(frame_id, data)


_COMMANDS: dict[int, Callable[[int, bytes], PiperCommand | EmergencyRequest | None]] = {
    protocol.STOP_ID: lambda _, data: EmergencyRequest(*data[:3]),
    protocol.MODE_ID: lambda _, data: ModeRequest(*data[:6]),
    protocol.GRIPPER_ID: lambda _, data: _gripper_request(*struct.unpack(">iHBB", data)),
    protocol.ENABLE_ID: lambda _, data: EnableRequest(data[0], data[1] == 2) if data[1] in (1, 2) else None,
    protocol.LIMIT_QUERY_ID: lambda _, data: LimitQuery(data[0]) if data[1] == 1 else None,
    protocol.JOINT_ID: lambda _, data: JointRequest(data[0], data[5] == SET, data[1] == SET),
    protocol.PARAMETER_QUERY_ID: lambda _, data: ParameterQuery(data[0]),
    FIRMWARE: lambda _, data: FirmwareQuery() if (FIRMWARE, data) == FirmwareQuery().frame() else None,
    **dict.fromkeys(
        range(TARGETS_ID, TARGETS_ID + 3), lambda id, data: JointTargets(2 * (id - TARGETS_ID), unpack_angles(data))
    ),
}


def _gripper_request(width: int, torque: int, code: int, zero: int) -> GripperRequest:
    return GripperRequest(width * 1e-6, torque * 1e-3, bool(code & 1), bool(code & 2), zero == SET)


def encode_report(record: PiperFeedback | PoseNumbers | Acknowledgement) -> CanFrame:
    """Return the frame of what the arm reports."""
    match record:
        case PiperStatus():
            return protocol.STATUS_ID, bytes(record)
        case PoseNumbers(first, values):
            return protocol.POSE_ID + first // 2, pack_pair(values, *_POSE_SCALES[first])
        case JointAngles(first, q):
            return protocol.ANGLES_ID + first // 2, pack_pair(q, MILLIDEGREES)
        case GripperStatus(width, torque, flags):
            return protocol.GRIPPER_STATUS_ID, pack(">ihBx", width * 1e6, torque * 1e3, flags)
        case JointMotion():
            return protocol.MOTION_ID + record.joint, pack(">hhi", *(value * 1e3 for value in record[1:]))
        case JointStatus(joint, voltage, driver, motor, flags, current):
            data = pack(">HhbBH", voltage * 10, driver, motor, flags, current * 1e3)
            return protocol.MOTOR_STATUS_ID + joint, data
        case JointLimits(motor, upper, lower, velocity):
            tenths = MILLIDEGREES * 1e-2
            return protocol.LIMITS_ID, pack(">BhhHx", motor, upper * tenths, lower * tenths, velocity * 1e3)
        case Acknowledgement(command, zero_set):
            return protocol.ACKNOWLEDGEMENT, bytes((command, int(zero_set), 0, 0, 0, 0, 0, 0))
        case GripperStroke(stroke, percent, friction):
            return protocol.STROKE_ID, bytes((percent, stroke, friction, 0, 0, 0, 0, 0))
        case _:
            return FIRMWARE, record.text.ljust(8, b"\0")


_POSE_SCALES = {0: (1e6, 1e6), 2: (1e6, MILLIDEGREES), 4: (MILLIDEGREES, MILLIDEGREES)}


def encode_joint_angles(q: Sequence[float]) -> list[CanFrame]:
    """Return the three frames of the measured positions (6,) of all joints, rad."""
    return [encode_report(JointAngles(k, (q[k], q[k + 1]))) for k in (0, 2, 4)]


def encode_pose(position: Sequence[float], roll_pitch_yaw: Sequence[float]) -> list[CanFrame]:
    """Return the three frames of the flange's pose: position (3,), m, and roll, pitch, yaw, rad."""
    values = (*position, *roll_pitch_yaw)
    return [encode_report(PoseNumbers(k, (values[k], values[k + 1]))) for k in (0, 2, 4)]


def firmware_pieces(version: str) -> Iterator[CanFrame]:
    """Yield the frames of an arm's answer to a FirmwareQuery, 8 characters each."""
    text = version.encode("ascii")
    return (encode_report(protocol.FirmwarePiece(text[k : k + 8])) for k in range(0, len(text), 8))
