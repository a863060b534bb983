"""The messages that a page may send; everything else is malformed."""

from __future__ import annotations

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.drivers.web.messages import (
    MAX_BYTES,
    ControlRequest,
    DriverRequest,
    MalformedMessage,
    PadMessage,
    PageLeft,
    PictureDrawn,
    StopRequest,
    WatchRequest,
    encode,
    parse,
)
from hal.drivers.web.sockets import MAX_MALFORMED, MAX_MESSAGES, RateLimit
from hal.views import ACTIONS

AXES = [0.0, -1, 0.25, 1, 1, 0.0, -1.0, 1, 0, 0, -1, 0, 0, 0, 0, 1]
PAD = {"type": "pad", "seen": 12.5, "since": 20.0, "axes": AXES, "buttons": 64, "hands": {}}
HAND = [0.1, -2, 3, 0, 0.6, 0, 0.8, 1]


def take(text: str) -> object:
    return parse(text, robots=["panda"], cameras=["scene", "wrist"])


@pytest.mark.parametrize(
    ("message", "record"),
    [
        (PAD, PadMessage(12.5, 0.02, tuple(AXES), 64, {})),
        ({**PAD, "hands": {"left": HAND}}, PadMessage(12.5, 0.02, tuple(AXES), 64, {"left": tuple(HAND)})),
        ({"type": "away", "why": "hidden"}, PageLeft("the page was hidden")),
        *(({"type": "lease", "take": take}, ControlRequest(take)) for take in (True, False)),
        ({"type": "stop"}, StopRequest()),
        ({"type": "recover", "robot": "panda"}, DriverRequest("clear a fault", {"recover": "panda"})),
        ({"type": "demo", "play": True}, DriverRequest("play the tour", {"demo": True})),
        *(
            ({"type": "action", "action": action}, DriverRequest("steer the recording", {"action": action}))
            for action in ACTIONS
        ),
        *(
            (
                {"type": "setting", "name": name, "value": value},
                DriverRequest("change settings", {"setting": name, "value": value}),
            )
            for name, value in (("robot", "panda"), ("speed", 0.25), ("frame", "tcp"), ("scene", "reset"))
        ),
        ({"type": "watch", "cameras": {"wrist": 640, "scene": 1}}, WatchRequest({"wrist": 640, "scene": 1})),
        ({"type": "watch", "cameras": {}}, WatchRequest({})),
        ({"type": "drawn", "camera": "scene"}, PictureDrawn("scene")),
    ],
)
def test_valid_messages(message: dict[str, Any], record: object) -> None:
    assert take(json.dumps(message)) == record


WRONG_FIELDS: dict[str, list[Any]] = {
    "axes": [[0.0] * 8, [], {}, [0, 0, 0, 0, -0.5, *[0] * 11]],  # a trigger has no other side
    "buttons": [1 << 14, -1, 1.0, True, 10**400, ["l2"]],
    "seen": [-1.0, None, False, 10**400],
    "since": [-0.001, 1e10, "20"],
    "extra": [1],
}


WRONG_SETTINGS: dict[str, list[Any]] = {
    "robot": ["ur5"],
    "speed": [0, 1.1, float("nan"), "fast"],
    "frame": ["world", ["tcp"]],
    "scene": [True],
    "torque": [1],
}


def with_axis(value: str) -> str:
    return json.dumps(PAD).replace("0.25", value)


@pytest.mark.parametrize(
    "text",
    [
        *map(with_axis, ["NaN", "Infinity", "-Infinity", "1e999", "1.001", "-1.001", "true", "null", '"0"', "[0]"]),
        *map(with_axis, ["9" * 3000, "0.25, 0.25"]),
        *(json.dumps({**PAD, key: value}) for key, values in WRONG_FIELDS.items() for value in values),
        *(
            json.dumps({**PAD, "hands": {"left": wrong}})
            for wrong in ([], HAND[:7], [0] * 8, [0] * 6 + [2, 0], [200, *HAND[1:]], [*HAND[:7], 1.1], [1] * 9, "hand")
        ),
        *(json.dumps({**PAD, "hands": wrong}) for wrong in ([], [HAND], {"third": HAND}, None)),
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
        *(json.dumps({"type": "action", "action": wrong}) for wrong in ("erase", "Record", ["record"], None)),
        '{"type":"action","action":"record","episode":3}',
        *(
            json.dumps({"type": "setting", "name": name, "value": value})
            for name, values in WRONG_SETTINGS.items()
            for value in values
        ),
        '{"type":"setting","name":"speed","value":0.5,"robot":"panda"}',
        '{"type":"watch","cameras":["scene"]}',
        '{"type":"watch","cameras":{"scene":640,"attic":640}}',
        '{"type":"watch","cameras":{"scene":0}}',
        '{"type":"watch","cameras":{"scene":NaN}}',
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


@settings(deadline=None, max_examples=50)
@given(st.one_of(st.text(), JSON.map(json.dumps), st.fixed_dictionaries(dict.fromkeys(PAD, JSON)).map(json.dumps)))
def test_any_text_is_a_record_or_malformed(text: str) -> None:
    try:
        record = take(text)
    except MalformedMessage:
        return
    assert record is not None


@settings(deadline=None)
@given(JSON, st.sampled_from([*PAD]))
def test_a_pad_with_any_field_replaced_is_valid_or_malformed(value: object, key: str) -> None:
    try:
        record = take(json.dumps({**PAD, key: value}))
    except MalformedMessage:
        return
    if isinstance(record, PadMessage):
        assert len(record.axes) == 16
        assert all(-1.0 <= axis <= 1.0 for axis in record.axes)
        assert 0 <= record.buttons < 1 << 14


def test_nan_is_never_sent() -> None:
    with pytest.raises(ValueError, match="JSON"):
        encode({"t": float("nan")})


def test_the_rate_limit_counts_messages_per_second_and_malformed_ones_for_ever() -> None:
    allowance = RateLimit()
    assert all(allowance.allows_message(5.0 + k * 1e-3) for k in range(MAX_MESSAGES))
    assert not allowance.allows_message(5.5)
    assert allowance.allows_message(6.0)
    assert all(RateLimit().allows_message(7.0 + 0.02 * k) for k in range(10 * MAX_MESSAGES))
    allowance = RateLimit()
    assert all(allowance.allows_malformed() for _ in range(MAX_MALFORMED))
    assert not allowance.allows_malformed()
