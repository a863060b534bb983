"""What is printed before anything moves: nobody may take a robot for its stand-in, or the other way round."""

from __future__ import annotations

from typing import Any

import pytest
import yaml
from engines_kit import AUTO
from specs import data

import hal
from hal.apps._display import banner, list_devices
from hal.config import load
from hal.config.data_files import find_data, list_data
from hal.config.schema import is_own_host


def robot_line(config: Any, **arguments: Any) -> str:
    (line,) = (line for line in list_devices(load(config, **arguments).resolve()) if line.startswith("robot"))
    return line


@pytest.mark.parametrize(
    ("config", "sim", "words"),
    [
        ("franka", True, f"fr3, simulated ({AUTO}), 240 Hz, gripper 0..0.08 m"),
        ("franka_emulator", None, "fr3, EMULATED (franka at 127.0.0.2), 1000 Hz, gripper 0..0.08 m"),
        ("franka_emulator", True, f"fr3, simulated ({AUTO}), 240 Hz"),
    ],
)
def test_an_arm_is_called_what_it_is(config: str, sim: bool | None, words: str) -> None:
    assert words in robot_line(config, sim=sim)


@pytest.mark.parametrize("rig", list_data("config"))
def test_a_built_in_rig_names_no_robot_that_is_not_the_users(rig: str) -> None:
    written = yaml.safe_load(find_data("config", f"{rig}.yaml").read_text())
    for arm in written["robots"].values():
        assert is_own_host({"host": arm.get("real", {}).get("host", "127.0.0.1")})
    if rig in ("franka", "panda_table"):
        with pytest.raises(hal.ConfigError, match="real.host: is missing.* --set"):
            load(rig, sim=False)


def test_a_real_arm_is_called_real() -> None:
    line = robot_line("franka", sim=False, overrides=["robots.arm.real.host=172.16.0.2"])
    assert "fr3, REAL (franka at 172.16.0.2), 1000 Hz, gripper 0..0.08 m" in line


def test_a_real_hand_on_a_simulated_arm_is_called_real() -> None:
    hand = {"sim": False, "real": {"host": "172.16.0.2"}}
    line = robot_line({"robots": {"arm": {"model": "fr3", "gripper": hand}}})
    assert f"simulated ({AUTO}), 240 Hz, gripper 0..0.08 m, REAL (franka at 172.16.0.2)" in line


def test_what_the_simulation_changed_in_a_file_is_a_note() -> None:
    duck = {"name": "duck", "urdf": data("duck_vhacd.urdf"), "position": [0, 0.5, 0]}
    config = {"sim": True, "robots": {"arm": {"model": "panda"}}, "objects": [duck]}
    with hal.open(config, clock="lock_step", pad="none", engine="pybullet") as rig:
        (note,) = rig.notes
        assert note.startswith("duck: inertia computed from the collision shapes")
        assert f"note     {note}" in banner(rig)


def test_pads_of_fixed_models_are_named_with_the_arms_that_they_drive() -> None:
    arms = {name: {"model": "panda", "base": {"position": [0, y, 0]}} for name, y in (("left", 0.5), ("right", -0.5))}
    pads = {"one": {"model": "dualshock4", "drives": "right"}, "two": {"model": "xbox_one"}, "any": {}}
    lines = list_devices(load({"robots": arms, "gamepads": pads}).resolve())
    assert [line.split(maxsplit=2)[1:] for line in lines if line.startswith("gamepad")] == [
        ["one", "DualShock 4, auto, drives right"],
        ["two", "Xbox One pad, auto"],
        ["any", "auto"],
    ]
