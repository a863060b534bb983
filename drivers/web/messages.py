"""What a page may say, and nothing else: JSON from outside becomes records here, or is malformed."""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping
from typing import Any, NamedTuple

from hal.views import ACTIONS, FRAMES, SETTINGS

from .padmessage import Malformed, PadMessage, number, pad_message

__all__ = [
    "LONGEST",
    "Act",
    "Away",
    "Demo",
    "Drawn",
    "Malformed",
    "Message",
    "Recover",
    "Setting",
    "Stop",
    "Take",
    "Watch",
    "encode",
    "parse",
]

SLOWEST = 0.01
"""Smallest share of the mapping's speeds that a page may set."""
LONGEST = 4096
"""Bytes that a page's message may have."""
CLOSED = "the page in control was closed"
HANDS = "a release of the controls may have been missed"
_AWAY = {
    "hidden": "the page was hidden",
    "blur": "the page lost the keyboard focus",
    "closing": CLOSED,
    "hands": HANDS,
}


class Away(NamedTuple):
    """The person turned to something else."""

    why: str
    """In words of this program; nothing that a page wrote is ever passed on."""


class Take(NamedTuple):
    """The page wants to drive (True), or to let go."""

    take: bool


class Stop(NamedTuple):
    """``rig.stop()``"""


class Recover(NamedTuple):
    """Clear a robot's fault."""

    robot: str


class Demo(NamedTuple):
    """Play the recorded tour, or end it."""

    play: bool


class Act(NamedTuple):
    """Steer a recording: one of ``hal.views.ACTIONS``."""

    action: str


class Setting(NamedTuple):
    """Change one of ``hal.views.SETTINGS``."""

    name: str
    value: str | float


class Watch(NamedTuple):
    """The cameras that the page shows from now on."""

    cameras: tuple[str, ...]


class Drawn(NamedTuple):
    """This camera's picture is drawn; the next one may come."""

    camera: str


Message = PadMessage | Away | Take | Stop | Recover | Demo | Act | Setting | Watch | Drawn

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

encode = json.JSONEncoder(separators=(",", ":"), allow_nan=False).encode
"""A message as JSON text. ValueError for a number that is not finite."""


def _no_constant(name: str) -> float:
    raise Malformed(f"{name} is no number")


_decode = json.JSONDecoder(parse_constant=_no_constant).decode


def parse(text: str, robots: Collection[str] = (), cameras: Collection[str] = ()) -> Message:
    """The message in ``text``; it may name these robots and cameras. Raises Malformed, and nothing else."""
    try:
        data = _decode(text)
    except Malformed:
        raise
    except (ValueError, RecursionError) as error:
        raise Malformed(f"no JSON: {type(error).__name__}") from None
    if not isinstance(data, dict):
        raise Malformed("no object")
    kind = data.get("type")
    keys = _KEYS.get(kind) if isinstance(kind, str) else None
    if keys is None or data.keys() != keys:
        raise Malformed("an unknown type, or not its keys")
    return _record(str(kind), data, robots, cameras)


def _record(kind: str, data: Mapping[str, Any], robots: Collection[str], cameras: Collection[str]) -> Message:
    if kind == "pad":
        return pad_message(data)
    if kind == "drawn":
        return Drawn(_one_of(data["camera"], cameras))
    if kind == "stop":
        return Stop()
    if kind == "away":
        return Away(_AWAY[_one_of(data["why"], _AWAY)])
    if kind == "lease":
        return Take(_flag(data["take"]))
    if kind == "recover":
        return Recover(_one_of(data["robot"], robots))
    if kind == "demo":
        return Demo(_flag(data["play"]))
    if kind == "action":
        return Act(_one_of(data["action"], ACTIONS))
    if kind == "setting":
        return _setting(_one_of(data["name"], SETTINGS), data["value"], robots)
    names = data["cameras"]
    if not isinstance(names, list):
        raise Malformed("no list of cameras")
    return Watch(tuple(dict.fromkeys(_one_of(name, cameras) for name in names)))


def _setting(name: str, value: object, robots: Collection[str]) -> Setting:
    if name == "speed":
        return Setting(name, number(value, SLOWEST, 1.0))
    return Setting(name, _one_of(value, {"robot": robots, "frame": FRAMES, "scene": ("reset",)}[name]))


def _flag(value: object) -> bool:
    if not isinstance(value, bool):
        raise Malformed("neither true nor false")
    return value


def _one_of(value: object, known: Collection[str]) -> str:
    if not isinstance(value, str) or value not in known:
        raise Malformed("an unknown name")
    return value
