"""The messages that a page may send; everything else is malformed."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.drivers.web.messages import (
    MAX_BYTES,
    ControlRequest,
    MalformedMessage,
    PadMessage,
    PageLeft,
    PictureDrawn,
    RecordingRequest,
    RecoverRequest,
    SettingRequest,
    StopRequest,
    TourRequest,
    WatchRequest,
    encode,
    parse,
)
from hal.drivers.web.sockets import MAX_MALFORMED, MAX_MESSAGES, RateLimit

PAD = {"type": "pad", "seen": 12.5, "since": 20.0, "axes": [0.0, -1, 0.25, 1, 1, 0.0, -1.0, 1], "buttons": 64}


def take(text: str) -> object:
    return parse(text, robots=["panda"], cameras=["scene", "wrist"])


@pytest.mark.parametrize(
    ("message", "record"),
    [
        (PAD, PadMessage(12.5, 0.02, (0.0, -1.0, 0.25, 1.0, 1.0, 0.0, -1.0, 1.0), 64)),
        ({"type": "away", "why": "hidden"}, PageLeft("the page was hidden")),
        ({"type": "lease", "take": True}, ControlRequest(True)),
        ({"type": "lease", "take": False}, ControlRequest(False)),
        ({"type": "stop"}, StopRequest()),
        ({"type": "recover", "robot": "panda"}, RecoverRequest("panda")),
        ({"type": "demo", "play": True}, TourRequest(True)),
        ({"type": "action", "action": "record"}, RecordingRequest("record")),
        ({"type": "action", "action": "finish"}, RecordingRequest("finish")),
        ({"type": "action", "action": "fail"}, RecordingRequest("fail")),
        ({"type": "action", "action": "discard"}, RecordingRequest("discard")),
        ({"type": "setting", "name": "robot", "value": "panda"}, SettingRequest("robot", "panda")),
        ({"type": "setting", "name": "speed", "value": 0.25}, SettingRequest("speed", 0.25)),
        ({"type": "setting", "name": "frame", "value": "tcp"}, SettingRequest("frame", "tcp")),
        ({"type": "setting", "name": "scene", "value": "reset"}, SettingRequest("scene", "reset")),
        ({"type": "watch", "cameras": ["wrist", "wrist", "scene"]}, WatchRequest(("wrist", "scene"))),
        ({"type": "watch", "cameras": []}, WatchRequest(())),
        ({"type": "drawn", "camera": "scene"}, PictureDrawn("scene")),
    ],
)
def test_valid_messages(message: dict[str, Any], record: object) -> None:
    assert take(json.dumps(message)) == record


def with_axis(value: str) -> str:
    return json.dumps(PAD).replace("0.25", value)


@pytest.mark.parametrize(
    "text",
    [
        with_axis("NaN"),
        with_axis("Infinity"),
        with_axis("-Infinity"),
        with_axis("1e999"),
        with_axis("1.001"),
        with_axis("-1.001"),
        with_axis("true"),
        with_axis("null"),
        with_axis('"0"'),
        with_axis("[0]"),
        with_axis("9" * 3000),
        with_axis("0.25, 0.25"),
        *(
            json.dumps({**PAD, **wrong})
            for wrong in (
                {"axes": PAD["axes"][:7]},
                {"axes": []},
                {"axes": {}},
                {"axes": [0, 0, 0, 0, -0.5, 0, 0, 0]},  # a trigger has no other side
                {"buttons": 1 << 14},
                {"buttons": -1},
                {"buttons": 1.0},
                {"buttons": True},
                {"buttons": 10**400},
                {"buttons": ["l2"]},
                {"seen": -1.0},
                {"seen": None},
                {"seen": False},
                {"seen": 10**400},
                {"since": -0.001},
                {"since": 1e10},
                {"since": "20"},
                {"extra": 1},
            )
        ),
        '{"type":"pad"}',
        '{"type":"stop","now":true}',
        '{"type":"stopp"}',
        '{"type":["stop"]}',
        '{"type":null}',
        '{"stop":true}',
        '["stop"]',
        '"stop"',
        "stop",
        "1",
        "",
        '{"type":"stop"',
        '{"type":"lease","take":1}',
        '{"type":"lease","take":"true"}',
        '{"type":"away","why":"asleep"}',
        '{"type":"away","why":["hidden"]}',
        '{"type":"recover","robot":"\\ud800"}',
        '{"type":"recover","robot":"ur5"}',
        '{"type":"recover","robot":{}}',
        '{"type":"action"}',
        '{"type":"action","action":"erase"}',
        '{"type":"action","action":"Record"}',
        '{"type":"action","action":["record"]}',
        '{"type":"action","action":null}',
        '{"type":"action","action":"record","episode":3}',
        '{"type":"setting","name":"robot","value":"ur5"}',
        '{"type":"setting","name":"speed","value":0}',
        '{"type":"setting","name":"speed","value":1.1}',
        '{"type":"setting","name":"speed","value":NaN}',
        '{"type":"setting","name":"speed","value":"fast"}',
        '{"type":"setting","name":"frame","value":"world"}',
        '{"type":"setting","name":"frame","value":["tcp"]}',
        '{"type":"setting","name":"scene","value":true}',
        '{"type":"setting","name":"torque","value":1}',
        '{"type":"setting","name":"speed","value":0.5,"robot":"panda"}',
        '{"type":"watch","cameras":"scene"}',
        '{"type":"watch","cameras":["scene","attic"]}',
        '{"type":"watch","cameras":[["scene"]]}',
        '{"type":"drawn","camera":0}',
        "[" * MAX_BYTES,
        '{"a":' * (MAX_BYTES // 5),
    ],
)
def test_malformed_messages(text: str) -> None:
    with pytest.raises(MalformedMessage):
        take(text)


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(),
    lambda inner: st.lists(inner, max_size=9) | st.dictionaries(st.sampled_from([*PAD, "take", "why"]), inner),
    max_leaves=20,
)


@given(st.one_of(st.text(), JSON.map(json.dumps), st.fixed_dictionaries(dict.fromkeys(PAD, JSON)).map(json.dumps)))
def test_any_text_is_a_record_or_malformed(text: str) -> None:
    try:
        record = take(text)
    except MalformedMessage:
        return
    assert record is not None


@given(JSON, st.sampled_from([*PAD]))
def test_a_pad_with_any_field_replaced_is_valid_or_malformed(value: object, key: str) -> None:
    try:
        record = take(json.dumps({**PAD, key: value}))
    except MalformedMessage:
        return
    if isinstance(record, PadMessage):
        assert len(record.axes) == 8
        assert all(-1.0 <= axis <= 1.0 for axis in record.axes)
        assert 0 <= record.buttons < 1 << 14


def test_nan_is_never_sent() -> None:
    with pytest.raises(ValueError, match="JSON"):
        encode({"t": float("nan")})


def test_the_rate_limit_counts_per_second() -> None:
    allowance = RateLimit()
    assert all(allowance.allows_message(5.0 + k * 1e-3) for k in range(MAX_MESSAGES))
    assert not allowance.allows_message(5.5)
    assert allowance.allows_message(6.0)
    assert all(RateLimit().allows_message(7.0 + 0.02 * k) for k in range(10 * MAX_MESSAGES))


def test_malformed_messages_count_for_the_whole_connection() -> None:
    allowance = RateLimit()
    assert all(allowance.allows_malformed() for _ in range(MAX_MALFORMED))
    assert not allowance.allows_malformed()
