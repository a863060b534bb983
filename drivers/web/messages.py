"""The messages that a page may send, checked: text from outside becomes one of these records, or is refused.

:class:`Outbox` holds the messages that wait to be sent, in all directions.
"""

from __future__ import annotations

import json
import math
from collections import deque
from collections.abc import Callable, Collection, Mapping
from types import MappingProxyType
from typing import Any, Generic, NamedTuple, TypeVar

from hal.types import BUTTONS, ONE_SIDED, PAGE_AXES
from hal.views import ACTIONS, FRAMES, SETTINGS

HANDS = ("any", "left", "right")
"""Hands that may hold: ``any`` for the pad of the whole page, the others for a pad of their own."""
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
    "headset": "the headset shows something else",
}
_MIN_SPEED = 0.01
"""Smallest share of the mapping's speeds that a page may set."""
_RANGES = tuple((0.0 if axis in ONE_SIDED else -1.0, 1.0) for axis in PAGE_AXES)
_MASKS = 1 << len(BUTTONS)
_HAND = ((-100.0, 100.0),) * 3 + ((-1.01, 1.01),) * 4 + ((0.0, 1.0),)
"""Ranges of a hand's pose (m, and a unit quaternion) and grip."""
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
    """In the order of ``hal.types.PAGE_AXES``: sticks and joints -1..1, triggers 0..1."""
    buttons: int
    """Bit k: button k of ``hal.types.BUTTONS`` is pressed."""
    hands: Mapping[str, tuple[float, ...]] = MappingProxyType({})
    """Side of a hand that holds, of :data:`HANDS` -> its pose (that of ``hal.types.PadState``) and grip, (8,)."""


class PageLeft(NamedTuple):
    """The page can no longer be used: it is hidden, lost the focus, or may have missed a release."""

    why: str
    """One of this program's own sentences; text that a page wrote is never passed on."""


class ControlRequest(NamedTuple):
    """Take control (True), or release it."""

    take: bool


class StopRequest(NamedTuple):
    """Stop every arm: ``rig.stop()``."""


class DriverRequest(NamedTuple):
    """A request to the app that only the page in control may make."""

    what: str
    """The request, in words."""
    message: dict[str, Any]
    """What the app gets: ``recover``, a robot; ``demo``, whether to play the recorded tour; ``action``, one of
    ``hal.views.ACTIONS``; ``setting``, one of ``hal.views.SETTINGS``, and its ``value``."""


class WatchRequest(NamedTuple):
    """Send the pictures of these cameras from now on, and of no others."""

    widths: dict[str, float]
    """Width at which the page shows each camera, device pixels."""


class PictureDrawn(NamedTuple):
    """The last picture of this camera is drawn, so the next one may be sent."""

    camera: str


PageMessage = PadMessage | PageLeft | ControlRequest | StopRequest | DriverRequest | WatchRequest | PictureDrawn

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
    kind = data.pop("type", None)
    keys, make = _MESSAGES.get(kind, (None, None)) if isinstance(kind, str) else (None, None)
    if make is None or data.keys() != keys:
        raise MalformedMessage("an unknown type, or the wrong keys")
    return make(_Names(robots, cameras), **data)


class _Names(NamedTuple):
    """Names that a message may contain."""

    robots: Collection[str]
    cameras: Collection[str]


def _pad_message(_: _Names, seen: object, since: object, axes: object, buttons: object, hands: object) -> PadMessage:
    if type(buttons) is not int or not 0 <= buttons < _MASKS or not isinstance(hands, dict):
        raise MalformedMessage("not a mask of buttons, or no hands")
    return PadMessage(
        seen=_number(seen, 0.0, _MAX_TIME),
        since=_number(since, 0.0, _MAX_TIME) / 1000.0,
        axes=_numbers(axes, _RANGES),
        buttons=buttons,
        hands={_check_choice(side, HANDS): _hand(numbers) for side, numbers in hands.items()},
    )


def _hand(values: object) -> tuple[float, ...]:
    numbers = _numbers(values, _HAND)
    if not 0.99 < math.hypot(*numbers[3:7]) < 1.01:
        raise MalformedMessage("not a unit quaternion")
    return numbers


def _setting(known: _Names, name: object, value: object) -> DriverRequest:
    name = _check_choice(name, SETTINGS)
    if name == "speed":
        value = _number(value, _MIN_SPEED, 1.0)
    else:
        value = _check_choice(value, {"robot": known.robots, "frame": FRAMES, "scene": ("reset",)}[name])
    return DriverRequest("change settings", {"setting": name, "value": value})


def _request(what: str, key: str, value: object) -> DriverRequest:
    return DriverRequest(what, {key: value})


def _watch(known: _Names, cameras: object) -> WatchRequest:
    if not isinstance(cameras, dict):
        raise MalformedMessage("no widths of cameras")
    return WatchRequest({_check_choice(name, known.cameras): _number(w, 1.0, _MAX_TIME) for name, w in cameras.items()})


_MESSAGES: dict[str, tuple[set[str], Callable[..., PageMessage]]] = {
    "pad": ({"seen", "since", "axes", "buttons", "hands"}, _pad_message),
    "away": ({"why"}, lambda _, why: PageLeft(_LEFT[_check_choice(why, _LEFT)])),
    "lease": ({"take"}, lambda _, take: ControlRequest(_flag(take))),
    "stop": (set(), lambda _: StopRequest()),
    "recover": (
        {"robot"},
        lambda known, robot: _request("clear a fault", "recover", _check_choice(robot, known.robots)),
    ),
    "demo": ({"play"}, lambda _, play: _request("play the tour", "demo", _flag(play))),
    "action": ({"action"}, lambda _, action: _request("steer the recording", "action", _check_choice(action, ACTIONS))),
    "setting": ({"name", "value"}, _setting),
    "watch": ({"cameras"}, _watch),
    "drawn": ({"camera"}, lambda known, camera: PictureDrawn(_check_choice(camera, known.cameras))),
}
"""Type of a message -> exactly its other keys, and what makes its record of them."""


def _number(value: object, low: float, high: float) -> float:
    # Not isinstance: True is an int. NaN and integers too large for a float fail the comparison.
    if type(value) is not float and type(value) is not int:
        raise MalformedMessage("not a number")
    if not low <= value <= high:
        raise MalformedMessage("a number out of its range")
    return float(value)


def _numbers(values: object, ranges: tuple[tuple[float, float], ...]) -> tuple[float, ...]:
    if not isinstance(values, list) or len(values) != len(ranges):
        raise MalformedMessage(f"not {len(ranges)} numbers")
    return tuple(_number(value, *limits) for value, limits in zip(values, ranges, strict=True))


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise MalformedMessage("neither true nor false")
    return value


def _check_choice(value: object, known: Collection[str]) -> str:
    if not isinstance(value, str) or value not in known:
        raise MalformedMessage("an unknown name")
    return value


# What waits to be sent.

M = TypeVar("M")


class Outbox(Generic[M]):
    """Messages that wait to be sent, a bounded number: of some kinds the newest, and others in their order."""

    def __init__(self, *first: str, most: int) -> None:
        """Send the kinds ``first`` before those in order, of which ``most`` may wait, and other kinds after them."""
        self._first = first
        self._most = most
        self._in_order: deque[M] = deque()
        self._newest: dict[str, M] = {}

    def put(self, message: M) -> bool:
        """Add a message that is sent in its order; False if too many wait: then it is dropped."""
        if len(self._in_order) >= self._most:
            return False
        self._in_order.append(message)
        return True

    def put_newest(self, kind: str, message: M) -> None:
        """Replace the message of this kind."""
        self._newest[kind] = message

    def discard(self, kind: str) -> None:
        """Send no message of this kind."""
        self._newest.pop(kind, None)

    def pop(self) -> M | None:
        """Remove and return the message that is sent next; None if there is none."""
        for kind in self._first:
            if kind in self._newest:
                return self._newest.pop(kind)
        if self._in_order:
            return self._in_order.popleft()
        return self._newest.pop(next(iter(self._newest))) if self._newest else None
