"""The table of keys: every control of it exists, and both kinds of keyboard reach what is needed to drive."""

from __future__ import annotations

import json

import pytest

from hal.pads.keyboard import keyboard_table
from hal.types import AXES, BUTTONS


@pytest.mark.parametrize("column", ["terminal", "browser"])
def test_keys_stand_for_controls_of_a_gamepad(column: str) -> None:
    table = keyboard_table(column)
    assert {axis for axis, _ in table.sticks.values()} == {*AXES[:4], "dpad_x", "dpad_y"}
    assert len(set(table.sticks.values())) == len(table.sticks) == 12, "each direction has one key"
    assert sorted(table.grip.values()) == [-1.0, 1.0]
    assert {"south", "east", "west", "north", "l1", "r1", "start", "home"} <= {*table.buttons.values()} <= {*BUTTONS}
    assert table.stop
    assert bool(table.hold) == bool(table.slow) == (column == "browser"), "in a terminal no key can be held"
    used = [*table.hold, *table.sticks, *table.grip, *table.buttons, *table.slow, *table.stop, *table.go_home]
    assert len(set(used)) == len(used), "no key has two meanings"
    assert {control for _, control in table.legend} >= {*table.buttons.values(), "r2", "dpad_x"}
    json.dumps(table._asdict())


def test_keys_name_the_controls() -> None:
    browser, terminal = keyboard_table("browser").names, keyboard_table("terminal").names
    assert (browser["l2"], browser["left_y"], browser["dpad_x"], browser["home"]) == ("Space", "W/S", "Left/Right", "0")
    assert (terminal["l1"], terminal["left_y"], terminal["home"]) == ("Q", "W/S", "Home")
    assert set(browser) <= {*AXES, *BUTTONS}
    assert all(name.isascii() for name in (*browser.values(), *terminal.values()))
