"""The emulated Franka Hand without sockets: its messages, byte for byte, and what its fingers do."""

from __future__ import annotations

import struct

import pytest

from hal_emulators.franka.hand_fingers import FULL_WIDTH, FingerMotion, FingerMotionKind, Fingers
from hal_emulators.franka.hand_network import (
    HandCode,
    HandRequest,
    HandRequestParser,
    HandStatePacket,
    HandStatus,
    hand_response,
)

GRASP = struct.pack("<HII5d", 2, 7, 50, 0.03, 0.004, 0.006, 0.1, 40.0)
MOVE = struct.pack("<HII2d", 3, 8, 26, 0.08, 0.05)


def run(fingers: Fingers, seconds: float, dt: float = 0.01) -> HandStatus | None:
    """Let time pass; the status of the motion that ended."""
    for _ in range(round(seconds / dt)):
        status = fingers.advance(dt)
        if status is not None:
            return status
    return None


def test_requests_are_cut_from_a_stream_however_it_arrives():
    requests = HandRequestParser()
    stream = struct.pack("<HIIHH", 0, 0, 14, 3, 40000) + struct.pack("<HII", 1, 1, 10) + GRASP + MOVE
    found = [request for byte in stream for request in requests.feed(bytes([byte]))]
    assert found == [
        HandRequest(HandCode.CONNECT, 0, (3, 40000)),
        HandRequest(HandCode.HOMING, 1, ()),
        HandRequest(HandCode.GRASP, 7, (0.03, 0.004, 0.006, 0.1, 40.0)),
        HandRequest(HandCode.MOVE, 8, (0.08, 0.05)),
    ]


@pytest.mark.parametrize(
    "stream", [struct.pack("<HII", 9, 0, 10), struct.pack("<HII", 3, 0, 10), b"GET / HTTP/1.1\r\n"]
)
def test_unknown_requests_are_refused(stream):
    with pytest.raises(ValueError, match=r"valid HandCode|bytes"):
        list(HandRequestParser().feed(stream))


def test_responses_and_states_have_the_sizes_that_the_client_expects():
    assert hand_response(HandRequest(HandCode.MOVE, 8, ()), HandStatus.UNSUCCESSFUL) == struct.pack(
        "<HIIH", 3, 8, 12, 2
    )
    assert hand_response(HandRequest(HandCode.CONNECT, 0, ()), HandStatus.SUCCESS, 3) == struct.pack(
        "<HIIHH", 0, 0, 14, 0, 3
    )
    packed = HandStatePacket(5, 0.03, 0.08, True, 31).pack()
    assert len(packed) == 23
    assert struct.unpack("<IddBH", packed) == (5, 0.03, 0.08, 1, 31)


def test_fingers_move_at_the_commanded_speed_up_to_their_limit():
    fingers = Fingers()
    fingers.width = 0.0
    assert fingers.start(FingerMotion(FingerMotionKind.MOVE, 0.05, 0.02)) is None
    assert run(fingers, 1.0) is None
    assert fingers.width == pytest.approx(0.02)
    assert run(fingers, 2.0) is HandStatus.SUCCESS
    assert fingers.width == 0.05
    fingers.start(FingerMotion(FingerMotionKind.MOVE, 0.0, 9.0))
    assert run(fingers, 0.4) is None


def test_a_second_grasp_lets_go_and_a_second_motion_is_refused():
    fingers = Fingers(object_width=0.03)
    fingers.start(FingerMotion(FingerMotionKind.GRASP, 0.03, 0.1, 40.0, 0.01, 0.01))
    assert fingers.start(FingerMotion(FingerMotionKind.MOVE, 0.08, 0.1)) is HandStatus.FAIL
    assert run(fingers, 1.0) is HandStatus.SUCCESS
    assert fingers.start(FingerMotion(FingerMotionKind.GRASP, 0.03, 0.1, 60.0, 0.01, 0.01)) is HandStatus.UNSUCCESSFUL
    assert not fingers.is_grasped


def test_a_thing_that_is_pulled_out_is_lost_and_the_fingers_close():
    fingers = Fingers(object_width=0.03)
    fingers.start(FingerMotion(FingerMotionKind.GRASP, 0.03, 0.1, 40.0, 0.01, 0.01))
    run(fingers, 1.0)
    fingers.put(None)
    run(fingers, 1.0)
    assert fingers.width == 0.0
    assert not fingers.is_grasped


def test_a_move_that_meets_something_hangs_for_minutes():
    fingers = Fingers(object_width=0.03)
    fingers.start(FingerMotion(FingerMotionKind.MOVE, 0.0, 0.1))
    assert run(fingers, 90.0, dt=0.1) is None
    assert run(fingers, 20.0, dt=0.1) is HandStatus.UNSUCCESSFUL


def test_homing_finds_the_width_unless_something_is_in_the_way():
    fingers = Fingers(homed=False)
    assert fingers.max_width == 0.0
    fingers.start(FingerMotion(FingerMotionKind.HOMING))
    assert run(fingers, 3.0) is HandStatus.SUCCESS
    assert fingers.width == fingers.max_width == FULL_WIDTH
    fingers.put(0.03)
    fingers.start(FingerMotion(FingerMotionKind.HOMING))
    assert run(fingers, 3.0) is HandStatus.FAIL


@pytest.mark.parametrize("values", [(float("nan"), 0.1), (0.04, 0.0), (0.09, 0.1), (-0.01, 0.1)])
def test_numbers_that_cannot_be_fail(values):
    assert Fingers().start(FingerMotion(FingerMotionKind.MOVE, *values)) is HandStatus.FAIL
