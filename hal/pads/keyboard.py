"""The keys of a keyboard as controls of a gamepad: the table ``sensors/keyboard.yaml``, for terminals and browsers."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache
from typing import Any, NamedTuple

from ..config.data_files import find_data

_ASCII = {"↑": "Up", "↓": "Down", "←": "Left", "→": "Right"}
"""Label of an arrow key -> its name for messages."""


class KeyboardTable(NamedTuple):
    """The keys of one kind of keyboard, by what they do. ``_asdict()`` of it is JSON."""

    hold: tuple[str, ...]
    """Keys that are the dead-man, l2."""
    sticks: Mapping[str, tuple[str, float]]
    """Key -> the axis that it pushes, and its direction, 1 or -1."""
    grip: Mapping[str, float]
    """Key -> direction in which r2 moves while it is held: 1 closes, -1 opens."""
    buttons: Mapping[str, str]
    """Key -> the button that it is, all but l2."""
    slow: tuple[str, ...]
    """Keys that make the sticks go only :attr:`slow_share` of their way."""
    stop: tuple[str, ...]
    """Keys that stop every arm."""
    go_home: tuple[str, ...]
    """Keys that drive the arm home while they are held."""
    slow_share: float
    """Share of its travel to which a stick is pushed while a slow key is held."""
    grip_speed: float
    """Speed of r2 while one of its keys is held, full travels per second."""
    names: Mapping[str, str]
    """Control -> the label of its first key, or of both keys of an axis, in ASCII."""
    legend: tuple[tuple[str, str], ...]
    """(labels of the keys, their control) for people, in the order of the table, without l2, ``slow`` and ``stop``."""


@cache
def keyboard_table(column: str) -> KeyboardTable:
    """Return the keys that ``column`` of the table names."""
    from ..config.files import parse_yaml  # slow to import

    data: dict[str, Any] = parse_yaml(find_data("sensors", "keyboard.yaml").read_text(encoding="utf-8"))
    rows = [(row[column], row["control"], row["label"]) for row in data["keys"] if column in row]
    pushes = {key: (control[1:], 1.0 if control[0] == "+" else -1.0) for key, control, _ in rows if control[0] in "+-"}
    labels: dict[str, list[str]] = {}
    for _, control, label in rows:
        labels.setdefault(control.lstrip("+-"), []).append(label)

    def keys(wanted: str) -> tuple[str, ...]:
        return tuple(key for key, control, _ in rows if control == wanted)

    apart = ("l2", "slow", "stop", "go_home")
    axes = {axis for axis, _ in pushes.values()}
    return KeyboardTable(
        hold=keys("l2"),
        sticks={key: push for key, push in pushes.items() if push[0] != "r2"},
        grip={key: direction for key, (axis, direction) in pushes.items() if axis == "r2"},
        buttons={key: control for key, control, _ in rows if key not in pushes and control not in apart},
        slow=keys("slow"),
        stop=keys("stop"),
        go_home=keys("go_home"),
        slow_share=float(data["slow_share"]),
        grip_speed=float(data["grip_speed"]),
        names={
            control: "/".join(_ASCII.get(label, label) for label in found[: 2 if control in axes else 1])
            for control, found in labels.items()
            if control not in ("slow", "stop", "go_home")
        },
        legend=tuple(
            ((" " if control in axes else " / ").join(found), control)
            for control, found in labels.items()
            if control not in apart
        ),
    )
