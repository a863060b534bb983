"""What a pad's controls do, as a file says it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from hal.config.data_files import list_data
from hal.config.mapping import TeleopMapping, load_mapping
from hal.errors import ConfigError
from hal.types import PadState, Stamp

STAMP = Stamp(0.0, 0.0, 1)


def pad(*buttons: str, **axes: float) -> PadState:
    return PadState(STAMP, axes, frozenset(buttons), True)


@pytest.mark.parametrize(
    ("state", "twist"),
    [
        (pad(), (0, 0, 0, 0, 0, 0)),
        (pad(dpad_y=1.0), (0.2, 0, 0, 0, 0, 0)),  # up: forwards
        (pad(dpad_x=-1.0), (0, 0.2, 0, 0, 0, 0)),  # left: to the left
        (pad("l1"), (0, 0, 0.2, 0, 0, 0)),
        (pad("r1"), (0, 0, -0.2, 0, 0, 0)),
        (pad("l1", "r1"), (0, 0, 0, 0, 0, 0)),
        (pad(right_y=0.5), (0, 0, 0, 0.4, 0, 0)),
        (pad(right_x=1.0), (0, 0, 0, 0, -0.8, 0)),
        (pad(left_x=-0.5), (0, 0, 0, 0, 0, 0.4)),
        (pad(left_y=1.0), (0, 0, 0, 0, 0, 0)),
    ],
)
def test_the_default_is_the_tutorials_mapping(state: PadState, twist: tuple[float, ...]) -> None:
    assert load_mapping().twist(state) == pytest.approx(twist)


def test_the_defaults_other_controls() -> None:
    mapping = load_mapping("default")
    assert (mapping.frame, mapping.deadman, mapping.go_home) == ("base", "l2", "north")
    assert mapping.gripper is not None
    assert mapping.gripper.axis == "r2"
    assert mapping.actions == {"record": "south", "finish": "home", "fail": "west", "discard": "east"}
    assert load_mapping(mapping) is mapping


def test_every_built_in_mapping_is_sound_and_says_what_it_is_for() -> None:
    for name in list_data("config", "teleop"):
        mapping = load_mapping(name)
        assert mapping.description
        assert min(mapping.speeds()) > 0.0
    assert {"default", "spacemouse"} <= set(list_data("config", "teleop"))


def test_a_mapping_of_ones_own(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(
        "{deadman: l1, frame: tcp, linear: {z: {axis: left_y, scale: 0.1}}, gripper: {open: east, close: south}}"
    )
    mapping = load_mapping(tmp_path / "mine.yaml")
    assert mapping.twist(pad(left_y=-1.0)) == pytest.approx((0, 0, -0.1, 0, 0, 0))
    assert mapping.frame == "tcp"
    assert isinstance(load_mapping({"deadman": "l1"}), TeleopMapping)


@pytest.mark.parametrize(
    ("changes", "key", "words"),
    [
        ({"linear": {"x": {"axis": "dpad", "scale": 1.0}}}, "linear.x", ["no axis 'dpad'", "dpad_x"]),
        ({"linear": {"x": {"buttons": ["l1", "cross"], "scale": 1.0}}}, "linear.x", ["no button 'cross'", "south"]),
        ({"linear": {"x": {"scale": 1.0}}}, "linear.x", ["needs an axis"]),
        ({"linear": {"x": {"axis": "dpad_x"}}}, "linear.x.scale", ["is missing"]),
        ({"linear": {"x": {"axis": "dpad_x", "scale": 0.0}}}, "linear.x.scale", ["above 0"]),
        ({"linear": {"roll": {}}}, "linear.roll", ["no key here", "x, y, z"]),
        ({"frame": "tool"}, "frame", ["'tool'", "base, tcp"]),
        ({"deadman": "l4"}, "deadman", ["no button 'l4'"]),
        ({"gripper": {"open": "east"}}, "gripper", ["open and close"]),
        ({"gripper": {"toggle": "r9"}}, "gripper", ["no button 'r9'"]),
        ({"gripper": {"toggle": "r1", "axis": "r2"}}, "gripper", ["needs an axis, or", "toggle"]),
        ({"gripper": {"toggle": "l2"}}, "", ["'l2' has two meanings"]),
        ({"linear": {"x": {"axis": "l2", "scale": 1.0}}}, "", ["'l2' has two meanings"]),
        ({"go_home": "north", "actions": {"record": "north"}}, "", ["'north' has two meanings"]),
    ],
)
def test_mistakes_in_a_mapping(changes: dict[str, Any], key: str, words: list[str]) -> None:
    with pytest.raises(ConfigError) as caught:
        load_mapping({"deadman": "l2", **changes})
    (problem,) = caught.value.problems
    assert problem.key == key
    for word in words:
        assert word in problem.message


def test_missing_mappings(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="did you mean 'default'"):
        load_mapping("defualt")
    with pytest.raises(ConfigError, match="there is no such file"):
        load_mapping(tmp_path / "mine.yaml")
