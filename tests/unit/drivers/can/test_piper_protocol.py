"""Frames of a PiPER: against bytes written down, against the vendor's SDK, and there and back."""

from __future__ import annotations

from math import inf, nan, pi, radians
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.drivers.can import piper_protocol as piper
from hal.drivers.can.piper_protocol import (
    ACKNOWLEDGEMENT,
    FIRMWARE,
    EnableRequest,
    FirmwarePiece,
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
    PiperStatus,
    decode_feedback,
)
from hal_emulators.can.piper_frames import (
    Acknowledgement,
    EmergencyRequest,
    PoseNumbers,
    decode_command,
    encode_joint_angles,
    encode_pose,
    encode_report,
    firmware_pieces,
)

FULL = piper.ENABLED | piper.STALLED
COMMANDS = [
    (EmergencyRequest(1, 0, 0), 0x150, "0100000000000000"),
    (EmergencyRequest(2, 3, 6), 0x150, "0203060000000000"),
    (ModeRequest(), 0x151, "0101640000000000"),
    (ModeRequest(0, 4, 30, 0xAD, 7, 3), 0x151, "00041ead07030000"),
    (JointTargets(0, (radians(150), radians(-0.001))), 0x155, "000249f0ffffffff"),
    (JointTargets(2, (radians(-170), radians(90))), 0x156, "fffd67f000015f90"),
    (JointTargets(4, (0.0, radians(120))), 0x157, "000000000001d4c0"),
    (GripperRequest(0.07, 1.0), 0x159, "0001117003e80100"),
    (GripperRequest(0.0, 5.0, enabled=False, clear_error=True, set_zero=True), 0x159, "00000000138802ae"),
    (GripperRequest(-0.001, 0.0, clear_error=True), 0x159, "fffffc1800000300"),
    (EnableRequest(), 0x471, "0702000000000000"),
    (EnableRequest(255, False), 0x471, "ff01000000000000"),
    (LimitQuery(3), 0x472, "0301000000000000"),
    (JointRequest(), 0x475, "0700007fffae0000"),
    (JointRequest(2, clear_error=False, set_zero=True), 0x475, "02ae007fff000000"),
    (ParameterQuery(), 0x477, "0400000003000000"),
    (FirmwareQuery(), 0x4AF, "0100000000000000"),
]
FEEDBACK = [
    (PiperStatus(), 0x2A1, "0000010000000000"),
    (PiperStatus(1, 9, 1, 0, 1, 255, 0b100000, 0b000011), 0x2A1, "0109010001ff2003"),
    (PoseNumbers(0, (0.3, -0.000001)), 0x2A2, "000493e0ffffffff"),
    (PoseNumbers(2, (0.2, pi)), 0x2A3, "00030d400002bf20"),
    (PoseNumbers(4, (-pi / 2, 0.0)), 0x2A4, "fffea07000000000"),
    (JointAngles(0, (radians(-150), radians(180))), 0x2A5, "fffdb6100002bf20"),
    (JointAngles(2, (radians(-0.001), radians(0.001))), 0x2A6, "ffffffff00000001"),
    (JointAngles(4, (radians(-70), 0.0)), 0x2A7, "fffeee9000000000"),
    (GripperStatus(0.05, -0.5, FULL), 0x2A8, "0000c350fe0cc000"),
    (JointMotion(0, -0.5, 1.25, 0.7), 0x251, "fe0c04e2000002bc"),
    (JointMotion(5, 32.767, -0.001, -1.0), 0x256, "7fffffff" + "fffffc18"),
    (JointStatus(0, 24.1, 31, -5, piper.ENABLED, 0.5), 0x261, "00f1001ffb4001f4"),
    (JointStatus(5, 0.0, -10, 127, 0xFF, 65.535), 0x266, "0000fff67fffffff"),
    (JointLimits(2, pi, 0.0, 3.0), 0x473, "02070800000bb800"),
    (JointLimits(3, 0.0, radians(-170), 3.0), 0x473, "030000f95c0bb800"),
    (Acknowledgement(0x71), 0x476, "7100000000000000"),
    (Acknowledgement(0x75, True), 0x476, "7501000000000000"),
    (GripperStroke(70, 100, 1), 0x47E, "6446010000000000"),
    (FirmwarePiece(b"S-V1.8-5"), 0x4AF, "532d56312e382d35"),
]


def same(one: Any, other: Any) -> bool:
    """Return whether two records are equal, but for the last bits of their floats."""
    return type(one) is type(other) and all(
        a == pytest.approx(b, abs=1e-12) if isinstance(b, (int, float, tuple)) else a == b
        for a, b in zip(one, other, strict=True)
    )


UNREAD = (PoseNumbers, Acknowledgement)
"""What the driver does not read."""


@pytest.mark.parametrize(("record", "frame_id", "data"), COMMANDS + FEEDBACK, ids=str)
def test_golden_bytes(record: Any, frame_id: int, data: str) -> None:
    command = (record, frame_id, data) in COMMANDS
    frame = (frame_id, bytes.fromhex(data))
    if not isinstance(record, EmergencyRequest):
        assert (record.frame() if command else encode_report(record)) == frame
    found = decode_command(*frame) if command else decode_feedback(*frame)
    assert found is None if isinstance(record, UNREAD) else same(found, record)


def test_several_frames_at_once() -> None:
    q = [0.1, 0.2, -0.3, 0.4, -0.5, 0.6]
    pairs = [(k, (q[k], q[k + 1])) for k in (0, 2, 4)]
    assert piper.encode_joint_targets(q) == [JointTargets(*pair).frame() for pair in pairs]
    assert encode_joint_angles(q) == [encode_report(JointAngles(*pair)) for pair in pairs]
    assert encode_pose(q[:3], q[3:]) == [encode_report(PoseNumbers(*pair)) for pair in pairs]
    pieces = [decode_feedback(*frame) for frame in firmware_pieces("H-V1.2-1 S-V1.8-5 and more")]
    texts = [piece.text for piece in pieces if isinstance(piece, FirmwarePiece)]
    assert len(texts) == 4
    assert piper.find_firmware(texts) == "S-V1.8-5"
    assert piper.find_firmware(texts[:2]) is None


@pytest.mark.parametrize("value", [nan, inf, -inf, 1e9])
def test_a_number_that_does_not_fit_is_refused(value: float) -> None:
    for record in (JointTargets(0, (0.0, value)), GripperRequest(value, 1.0), GripperRequest(0.0, value)):
        with pytest.raises(ValueError, match="frame"):
            record.frame()
    with pytest.raises(ValueError, match="frame"):
        piper.encode_joint_targets([0.0, 0.0, 0.0, value, 0.0, 0.0])


@given(st.lists(st.integers(-(2**31), 2**31 - 1), min_size=6, max_size=6))
def test_targets_are_exact_to_a_millidegree(millidegrees: list[int]) -> None:
    """The number that a program sends is the number that an arm which stands at the target reports."""
    targets = piper.encode_joint_targets([radians(value / 1000) for value in millidegrees])
    received = [decode_command(*frame) for frame in targets]
    q = [angle for record in received if isinstance(record, JointTargets) for angle in record.q]
    assert [data for _, data in encode_joint_angles(q)] == [data for _, data in targets]


@given(st.sampled_from([*range(0x140, 0x160), *range(0x250, 0x2B0), *range(0x470, 0x4B0)]), st.binary(max_size=8))
def test_any_frame_is_decoded_or_passed_over(frame_id: int, data: bytes) -> None:
    command, report = decode_command(frame_id, data), decode_feedback(frame_id, data)
    if command is not None and not isinstance(command, EmergencyRequest):
        assert decode_command(*command.frame()) == command
    if report is not None:
        assert decode_feedback(*encode_report(report)) == report


def test_commands_and_feedback_do_not_overlap() -> None:
    """Own frames come back on some buses; the two kinds share an id only for the firmware's version."""
    commands = {frame_id for _, frame_id, _ in COMMANDS}
    assert commands == {*piper.COMMAND_IDS, piper.STOP_ID}
    assert not commands.intersection(piper.FEEDBACK_IDS)
    assert commands & {frame_id for _, frame_id, _ in FEEDBACK} == {FIRMWARE}
    assert decode_feedback(*FirmwareQuery().frame()) is None
    assert ACKNOWLEDGEMENT not in commands


# The vendor's SDK.


def sdk_message(record: Any, messages: Any) -> tuple[str, Any]:
    """Return the vendor's record for a command: name of its kind, and the record."""
    transmit = messages
    if isinstance(record, EmergencyRequest):
        return "PiperMsgMotionCtrl_1", ("arm_motion_ctrl_1", transmit.ArmMsgMotionCtrl_1(*record))
    if isinstance(record, ModeRequest):
        return "PiperMsgMotionCtrl_2", ("arm_motion_ctrl_2", transmit.ArmMsgMotionCtrl_2(*record))
    if isinstance(record, JointTargets):
        names = [f"joint_{record.first + 1}", f"joint_{record.first + 2}"]
        values = dict(zip(names, (round(angle * 180000 / pi) for angle in record.q), strict=True))
        kind = f"PiperMsgJointCtrl_{record.first + 1}{record.first + 2}"
        return kind, ("arm_joint_ctrl", transmit.ArmMsgJointCtrl(**values))
    if isinstance(record, GripperRequest):
        code = int(record.enabled) | int(record.clear_error) << 1
        numbers = (round(record.width * 1e6), round(record.torque * 1e3), code, 0xAE if record.set_zero else 0)
        return "PiperMsgGripperCtrl", ("arm_gripper_ctrl", transmit.ArmMsgGripperCtrl(*numbers))
    if isinstance(record, EnableRequest):
        flag = 2 if record.enabled else 1
        command = transmit.ArmMsgMotorEnableDisableConfig(record.motor, flag)
        return "PiperMsgMotorEnableDisableConfig", ("arm_motor_enable", command)
    if isinstance(record, LimitQuery):
        command = transmit.ArmMsgSearchMotorMaxAngleSpdAccLimit(record.motor, 1)
        return "PiperMsgSearchMotorMaxAngleSpdAccLimit", ("arm_search_motor_max_angle_spd_acc_limit", command)
    if isinstance(record, JointRequest):
        zero, clear = (0xAE if flag else 0 for flag in (record.set_zero, record.clear_error))
        return "PiperMsgJointConfig", (
            "arm_joint_config",
            transmit.ArmMsgJointConfig(record.motor, zero, 0, 0x7FFF, clear),
        )
    assert isinstance(record, ParameterQuery)
    command = transmit.ArmMsgParamEnquiryAndConfig(record.content)
    return "PiperMsgParamEnquiryAndConfig", ("arm_param_enquiry_and_config", command)


@pytest.mark.parametrize(("record", "frame_id", "data"), COMMANDS[:-1], ids=str)
def test_the_vendors_sdk_encodes_the_same_commands(record: Any, frame_id: int, data: str) -> None:
    pytest.importorskip("piper_sdk", reason="needs piper_sdk: pip install 'robot-hal[test]'")
    import can
    from piper_sdk.piper_msgs import msg_v2
    from piper_sdk.protocol.protocol_v2.piper_protocol_v2 import C_PiperParserV2

    kind, (attribute, command) = sdk_message(record, msg_v2)
    message, frame = msg_v2.PiperMessage(), can.Message()
    message.type_ = getattr(msg_v2.ArmMsgType, kind)
    setattr(message, attribute, command)
    assert C_PiperParserV2().EncodeMessage(message, frame)
    assert (frame.arbitration_id, bytes(frame.data)) == (frame_id, bytes.fromhex(data))


def numbers_of(record: Any, message: Any) -> tuple[list[float], list[float]]:
    """Return the numbers of a feedback record in the vendor's units, and those that the SDK decoded."""
    if isinstance(record, PiperStatus):
        status = message.arm_status_msgs
        flags = record.beyond_limit << 8 | record.no_communication
        found = [status.ctrl_mode, status.arm_status, status.mode_feed, status.teach_status, status.motion_status]
        return [*record[:6], flags], [*map(int, found), status.trajectory_num, status.err_code]
    if isinstance(record, PoseNumbers):
        names = ("X_axis", "Y_axis", "Z_axis", "RX_axis", "RY_axis", "RZ_axis")[record.first : record.first + 2]
        scales = [1e6 if name in ("X_axis", "Y_axis", "Z_axis") else 180000 / pi for name in names]
        ours = [value * scale for value, scale in zip(record.values, scales, strict=True)]
        return ours, [getattr(message.arm_end_pose, name) for name in names]
    if isinstance(record, JointAngles):
        joints = message.arm_joint_feedback
        found = [getattr(joints, f"joint_{record.first + k}") for k in (1, 2)]
        return [angle * 180000 / pi for angle in record.q], found
    if isinstance(record, GripperStatus):
        gripper = message.gripper_feedback
        ours = [record.width * 1e6, record.torque * 1e3, record.flags]
        return ours, [gripper.grippers_angle, gripper.grippers_effort, gripper.status_code]
    if isinstance(record, JointMotion):
        motor = getattr(message, f"arm_high_spd_feedback_{record.joint + 1}")
        return [value * 1e3 for value in record[1:]], [motor.motor_speed, motor.current, motor.pos]
    if isinstance(record, JointStatus):
        motor = getattr(message, f"arm_low_spd_feedback_{record.joint + 1}")
        found = [motor.vol, motor.foc_temp, motor.motor_temp, motor.foc_status_code, motor.bus_current]
        return [record.voltage * 10, *record[2:5], record.current * 1e3], found
    if isinstance(record, JointLimits):
        motor = message.arm_feedback_current_motor_angle_limit_max_spd
        ours = [record.motor, *(angle * 1800 / pi for angle in record[1:3]), record.velocity * 1e3]
        return ours, [motor.motor_num, motor.max_angle_limit, motor.min_angle_limit, motor.max_joint_spd]
    if isinstance(record, Acknowledgement):
        answer = message.arm_feedback_resp_set_instruction
        return [*map(int, record)], [answer.instruction_index, answer.is_set_zero_successfully]
    if isinstance(record, GripperStroke):
        stroke = message.arm_gripper_teaching_param_feedback
        found = [stroke.max_range_config, stroke.teaching_range_per, stroke.teaching_friction]
        return [*record], found
    return [*record.text], [*message.firmware_data]


@pytest.mark.parametrize(("record", "frame_id", "data"), FEEDBACK, ids=str)
def test_the_vendors_sdk_reads_the_same_feedback(record: Any, frame_id: int, data: str) -> None:
    pytest.importorskip("piper_sdk", reason="needs piper_sdk: pip install 'robot-hal[test]'")
    import can
    from piper_sdk.piper_msgs.msg_v2 import PiperMessage
    from piper_sdk.protocol.protocol_v2.piper_protocol_v2 import C_PiperParserV2

    message = PiperMessage()
    frame = can.Message(arbitration_id=frame_id, data=bytes.fromhex(data), is_extended_id=False)
    assert C_PiperParserV2().DecodeMessage(frame, message)
    ours, theirs = numbers_of(record, message)
    assert theirs == pytest.approx(ours, abs=1e-6)
