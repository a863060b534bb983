"""The messages that a page may send, checked: text from outside becomes one of these records, or is refused."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

from hal.types import BUTTONS, ONE_SIDED, STICK_AXES
from hal.views import ACTIONS, FRAMES, SETTINGS

__all__ = [
    "ALARMS",
    "CLOCK_AHEAD",
    "MAX_BYTES",
    "MESSAGES_LATE",
    "PAGE_CLOSED",
    "PAGE_GONE",
    "PAGE_SILENT",
    "RELEASE_MISSED",
    "ControlRequest",
    "MalformedMessage",
    "PadMessage",
    "PageLeft",
    "PageMessage",
    "PictureDrawn",
    "RecordingRequest",
    "RecoverRequest",
    "SettingRequest",
    "StopRequest",
    "TourRequest",
    "WatchRequest",
    "encode",
    "parse",
]

MAX_BYTES = 4096
"""Longest message of a page."""
PAGE_CLOSED = "the page in control was closed"
PAGE_GONE = "the page in control is no longer connected"
RELEASE_MISSED = "a release of the controls may have been missed"
CLOCK_AHEAD = "The page's clock runs ahead"
MESSAGES_LATE = "The page's messages came late"
PAGE_SILENT = "The page gave no sign of life"
ALARMS = frozenset((RELEASE_MISSED, CLOCK_AHEAD, MESSAGES_LATE, PAGE_SILENT))
"""Reasons for losing the pad that are not intended."""
_LEFT = {
    "hidden": "the page was hidden",
    "blur": "the page lost the keyboard focus",
    "closing": PAGE_CLOSED,
    "hands": RELEASE_MISSED,
}
_MIN_SPEED = 0.01
"""Smallest share of the mapping's speeds that a page may set."""
_RANGES = tuple((0.0 if axis in ONE_SIDED else -1.0, 1.0) for axis in STICK_AXES)
_MASKS = 1 << len(BUTTONS)
_MAX_TIME = 1e9
"""ms, and s: more than any clock here shows."""


class MalformedMessage(ValueError):
    """A page sent a message that no page may send."""


class PadMessage(NamedTuple):
    """The state of the whole pad."""

    seen: float
    """Newest time stamp of the server that the page had received, in s."""
    since: float
    """Time since the page received it, in s."""
    axes: tuple[float, ...]
    """In the order of ``hal.types.STICK_AXES``: sticks -1..1, triggers 0..1."""
    buttons: int
    """Bit k: button k of ``hal.types.BUTTONS`` is pressed."""


class PageLeft(NamedTuple):
    """The page can no longer be used: it is hidden, lost the focus, or may have missed a release."""

    why: str
    """One of this program's own sentences; text that a page wrote is never passed on."""


class ControlRequest(NamedTuple):
    """Take control (True), or release it."""

    take: bool


class StopRequest(NamedTuple):
    """Stop every arm: ``rig.stop()``."""


class RecoverRequest(NamedTuple):
    """Clear the fault of a robot."""

    robot: str


class TourRequest(NamedTuple):
    """Play the recorded tour (True), or end it."""

    play: bool


class RecordingRequest(NamedTuple):
    """Press one of the buttons of a recording."""

    action: str
    """One of ``hal.views.ACTIONS``."""


class SettingRequest(NamedTuple):
    """Change one of ``hal.views.SETTINGS``."""

    name: str
    value: str | float


class WatchRequest(NamedTuple):
    """Send the pictures of these cameras from now on, and of no others."""

    cameras: tuple[str, ...]


class PictureDrawn(NamedTuple):
    """The last picture of this camera is drawn, so the next one may be sent."""

    camera: str


PageMessage = (
    PadMessage
    | PageLeft
    | ControlRequest
    | StopRequest
    | RecoverRequest
    | TourRequest
    | RecordingRequest
    | SettingRequest
    | WatchRequest
    | PictureDrawn
)

_KEYS = {
    "pad": {"type", "seen", "since", "axes", "buttons"},
    "away": {"type", "why"},
    "lease": {"type", "take"},
    "stop": {"type"},
    "recover": {"type", "robot"},
    "demo": {"type", "play"},
    "action": {"type", "action"},
    "setting": {"type", "name", "value"},
    "watch": {"type", "cameras"},
    "drawn": {"type", "camera"},
}
"""Type of a message -> exactly its keys."""

encode = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode
"""Return a message as JSON text; ValueError for a number that is not finite."""


def _refuse_constant(name: str) -> float:
    raise MalformedMessage(f"{name} is not a number")


_decode = json.JSONDecoder(parse_constant=_refuse_constant).decode


def parse(text: str, robots: Collection[str] = (), cameras: Collection[str] = ()) -> PageMessage:
    """Parse and check a message of a page.

    Args:
        text: What the page sent.
        robots: Names of robots that the message may contain.
        cameras: Names of cameras that the message may contain.

    Raises:
        MalformedMessage: For everything that is not exactly one of the messages above. No other error is raised.
    """
    try:
        data = _decode(text)
    except MalformedMessage:
        raise
    except (ValueError, RecursionError) as error:
        raise MalformedMessage(f"not JSON: {type(error).__name__}") from None
    if not isinstance(data, dict):
        raise MalformedMessage("not an object")
    kind = data.get("type")
    keys = _KEYS.get(kind) if isinstance(kind, str) else None
    if keys is None or data.keys() != keys:
        raise MalformedMessage("an unknown type, or the wrong keys")
    return _record(str(kind), data, robots, cameras)


def _record(kind: str, data: Mapping[str, Any], robots: Collection[str], cameras: Collection[str]) -> PageMessage:
    if kind == "pad":
        return _pad_message(data)
    if kind == "drawn":
        return PictureDrawn(_one_of(data["camera"], cameras))
    if kind == "stop":
        return StopRequest()
    if kind == "away":
        return PageLeft(_LEFT[_one_of(data["why"], _LEFT)])
    if kind == "lease":
        return ControlRequest(_flag(data["take"]))
    if kind == "recover":
        return RecoverRequest(_one_of(data["robot"], robots))
    if kind == "demo":
        return TourRequest(_flag(data["play"]))
    if kind == "action":
        return RecordingRequest(_one_of(data["action"], ACTIONS))
    if kind == "setting":
        return _setting(_one_of(data["name"], SETTINGS), data["value"], robots)
    names = data["cameras"]
    if not isinstance(names, list):
        raise MalformedMessage("not a list of cameras")
    return WatchRequest(tuple(dict.fromkeys(_one_of(name, cameras) for name in names)))


def _pad_message(data: Mapping[str, Any]) -> PadMessage:
    axes, buttons = data["axes"], data["buttons"]
    if not isinstance(axes, list) or len(axes) != len(_RANGES):
        raise MalformedMessage(f"not {len(_RANGES)} axes")
    if type(buttons) is not int or not 0 <= buttons < _MASKS:
        raise MalformedMessage("not a mask of buttons")
    return PadMessage(
        seen=_number(data["seen"], 0.0, _MAX_TIME),
        since=_number(data["since"], 0.0, _MAX_TIME) / 1000.0,
        axes=tuple(_number(value, *limits) for value, limits in zip(axes, _RANGES, strict=True)),
        buttons=buttons,
    )


def _setting(name: str, value: object, robots: Collection[str]) -> SettingRequest:
    if name == "speed":
        return SettingRequest(name, _number(value, _MIN_SPEED, 1.0))
    return SettingRequest(name, _one_of(value, {"robot": robots, "frame": FRAMES, "scene": ("reset",)}[name]))


def _number(value: object, low: float, high: float) -> float:
    # Not isinstance: True is an int. NaN and integers too large for a float fail the comparison.
    if type(value) is not float and type(value) is not int:
        raise MalformedMessage("not a number")
    if not low <= value <= high:
        raise MalformedMessage("a number out of its range")
    return float(value)


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise MalformedMessage("neither true nor false")
    return value


def _one_of(value: object, known: Collection[str]) -> str:
    if not isinstance(value, str) or value not in known:
        raise MalformedMessage("an unknown name")
    return value
