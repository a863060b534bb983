"""Mappings of a pad's controls, read from files."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from hal.config.data_files import list_data
from hal.config.mapping import TeleopMapping, load_mapping
from hal.errors import ConfigError
from hal.learning.policy_config import load_policy_config
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


def test_every_built_in_mapping_is_valid_and_has_a_description() -> None:
    for name in list_data("config", "teleop"):
        mapping = load_mapping(name)
        assert mapping.description
        assert min(mapping.speeds()) > 0.0 or name == "leader"
    assert {"default", "spacemouse"} <= set(list_data("config", "teleop"))


def test_a_mapping_of_the_user(tmp_path: Path) -> None:
    (tmp_path / "mine.yaml").write_text(
        "{deadman: l1, frame: tcp, linear: {z: {axis: left_y, scale: 0.1}}, gripper: {open: east, close: south}}"
    )
    mapping = load_mapping(tmp_path / "mine.yaml")
    assert mapping.twist(pad(left_y=-1.0)) == pytest.approx((0, 0, -0.1, 0, 0, 0))
    assert mapping.frame == "tcp"
    assert isinstance(load_mapping({"deadman": "l1"}), TeleopMapping)


@pytest.mark.parametrize(
    ("changes", "key", "code"),
    [
        ({"linear": {"x": {"axis": "dpad", "scale": 1.0}}}, "linear.x.axis", "unknown_control"),
        ({"linear": {"x": {"buttons": ["l1", "cross"], "scale": 1.0}}}, "linear.x.buttons.1", "unknown_control"),
        ({"linear": {"x": {"scale": 1.0}}}, "linear.x", "missing_key"),
        ({"linear": {"x": {"axis": "dpad_x"}}}, "linear.x.scale", "missing_key"),
        ({"linear": {"x": {"axis": "dpad_x", "scale": 0.0}}}, "linear.x.scale", "out_of_range"),
        ({"linear": {"roll": {}}}, "linear.roll", "unknown_key"),
        ({"frame": "tool"}, "frame", "invalid_choice"),
        ({"deadman": "l4"}, "deadman", "unknown_control"),
        ({"gripper": {"open": "east"}}, "gripper", "missing_key"),
        ({"gripper": {"toggle": "r9"}}, "gripper.toggle", "unknown_control"),
        ({"gripper": {"toggle": "r1", "axis": "r2"}}, "gripper", "conflict"),
        ({"gripper": {"toggle": "l2"}}, "", "duplicate_name"),
        ({"linear": {"x": {"axis": "l2", "scale": 1.0}}}, "", "duplicate_name"),
        ({"go_home": "north", "actions": {"record": "north"}}, "", "duplicate_name"),
    ],
)
def test_mistakes_in_a_mapping(changes: dict[str, Any], key: str, code: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_mapping({"deadman": "l2", **changes})
    (problem,) = caught.value.problems
    assert (problem.key, problem.code) == (key, code)


@pytest.mark.parametrize(("load", "kind"), [(load_mapping, "mapping"), (load_policy_config, "policy_config")])
def test_a_name_or_a_file_that_does_not_exist(load: Callable[[Any], Any], kind: str, tmp_path: Path) -> None:
    for given, code in (("defualt", f"unknown_{kind}"), (tmp_path / "mine.yaml", "missing_file")):
        with pytest.raises(ConfigError) as caught:
            load(given)
        assert [problem.code for problem in caught.value.problems] == [code]
