"""``KEY=VALUE``: any key of a rig, set from outside its file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import yaml

from .files import Problems, nearest, parse_yaml, plain_copy, yaml_problem

__all__ = ["apply_overrides"]

SET = "--set"
DEVICES = {"robots": "robot", "cameras": "camera", "gamepads": "gamepad"}


def apply_overrides(
    data: dict[str, Any], overrides: Sequence[str] | Mapping[str, Any], problems: Problems
) -> dict[str, Any]:
    """A copy of the rig's data with the overrides in it; what is wrong with their form is noted."""
    result = plain_copy(data)
    for key, value in _pairs(overrides, problems):
        _put(result, key, value, problems)
    return dict(result)


def _pairs(overrides: Sequence[str] | Mapping[str, Any], problems: Problems) -> list[tuple[str, Any]]:
    if isinstance(overrides, Mapping):
        return [(str(key), value) for key, value in overrides.items()]
    pairs = []
    for text in (overrides,) if isinstance(overrides, str) else overrides:
        key, equals, value = text.partition("=")
        if not equals or not key.strip():
            problems.add(SET, "", f"must be KEY=VALUE, for example cameras.wrist.output.width=320, not {text!r}")
            continue
        try:
            pairs.append((key.strip(), parse_yaml(value)))
        except yaml.YAMLError as error:
            problems.add(SET, key.strip(), f"the value {yaml_problem(error)}")
    return pairs


def _put(data: dict[str, Any], key: str, value: Any, problems: Problems) -> None:
    """Set one key, and note what the override is to blame for: the key, and what it made on the way there."""
    parts = key.split(".")
    if "" in parts:
        problems.add(SET, key, "has an empty part between its dots")
        return
    if len(parts) > 2 and parts[0] in DEVICES:
        known = data.get(parts[0]) or {}
        if isinstance(known, dict) and parts[1] not in known:
            problems.add(SET, key, f"this rig has no {DEVICES[parts[0]]} {parts[1]!r}{nearest(parts[1], known)}")
            return
    place: Any = data
    for k, part in enumerate(parts):
        last = k == len(parts) - 1
        if isinstance(place, list):
            if not part.isdecimal() or int(part) >= len(place):
                problems.add(SET, key, f"{'.'.join(parts[:k])} is a list of {len(place)}; {part!r} is no place in it")
                return
            index: Any = int(part)
        elif isinstance(place, dict):
            index = part
            if not last and place.get(part) is None:
                place[part] = {}
                problems.overridden.add(".".join(parts[: k + 1]))
        else:
            problems.add(SET, key, f"{'.'.join(parts[:k])} holds no keys")
            return
        if last:
            place[index] = value
        else:
            place = place[index]
    problems.overridden.add(key)
