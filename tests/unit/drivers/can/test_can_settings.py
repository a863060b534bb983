"""Settings of arms on a CAN bus, and what is refused before a bus is opened."""

from __future__ import annotations

import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from hal.config.data_files import find_data
from hal.drivers.can.settings import (
    DamiaoArmSettings,
    DamiaoGripperSettings,
    check_damiao_arm,
    check_damiao_gripper,
    is_emulated,
)
from hal.errors import ConfigError
from hal.specs import GripperSpec, RobotSpec
from hal.testing import gripper_spec, robot_spec

BUS = {"interface": "udp_multicast", "channel": "239.74.163.2"}


def motor(id: int, **changes: Any) -> dict[str, Any]:
    return {"id": id, "type": "DM4340", "kp": 80.0, "kd": 5.0, **changes}


def gripper(**options: Any) -> GripperSpec:
    widths = [[0.0, 0.0], [-1.0, 0.05], [-2.0, 0.08]]
    return gripper_spec(driver="damiao", options={**BUS, "motor": motor(7), "widths": widths, **options})


def arm(changes: dict[int, dict[str, Any]] | None = None, **options: Any) -> RobotSpec:
    """Return a valid arm of three motors, with changes of some, by their number from 0."""
    motors = [{**motor(k + 1), **(changes or {}).get(k, {})} for k in range(3)]
    joints, urdf = ("joint1", "joint2", "joint3"), str(find_data("robots", "yam.urdf"))
    spec = robot_spec(3, driver="damiao", urdf=urdf, options={**BUS, "motors": motors, **options})
    return replace(spec, joints=joints)


def test_a_valid_arm_and_gripper_have_no_problems() -> None:
    spec = replace(arm(), gripper=gripper())
    assert list(check_damiao_arm(spec)) == []
    assert list(check_damiao_gripper(gripper())) == []
    first = DamiaoArmSettings.of(spec).motors[0]
    assert (first.id, first.reply_id, first.direction, first.offset) == (1, 0x11, 1.0, 0.0)
    assert first.limits == (12.5, 10.0, 28.0)
    assert DamiaoGripperSettings.of(gripper()).widths[0] == (-2.0, 0.08)


@pytest.mark.parametrize(
    ("changes", "key", "code"),
    [
        ({1: {"id": 1}}, "real.motors.1.id", "id_collision"),
        ({1: {"master": 0x11}}, "real.motors.1.master", "id_collision"),
        ({1: {"master": 3}}, "real.motors.1.master", "id_collision"),
        ({1: {"master": 2}}, "real.motors.1.master", "id_collision"),
        ({0: {"id": 0}}, "real.motors.0.id", "out_of_range"),
        ({0: {"id": 0x200}}, "real.motors.0.id", "out_of_range"),
        ({0: {"id": True}}, "real.motors.0.id", "wrong_type"),
        ({0: {"type": "DM4341"}}, "real.motors.0.type", "invalid"),
        ({0: {"direction": 0}}, "real.motors.0.direction", "invalid_choice"),
        ({0: {"direction": -2}}, "real.motors.0.direction", "invalid_choice"),
        ({0: {"kp": 501.0}}, "real.motors.0.kp", "out_of_range"),
        ({0: {"kp": 0.0}}, "real.motors.0.kp", "out_of_range"),
        ({0: {"kd": 5.1}}, "real.motors.0.kd", "out_of_range"),
        ({0: {"kd": 0}}, "real.motors.0.kd", "out_of_range"),
        ({0: {"ranges": [12.5, 45.0, 54.0]}}, "real.motors.0", "invalid"),
        ({0: {"ranges": [12.5, 8.0]}}, "real.motors.0.ranges", "wrong_count"),
        ({0: {"offset": 11.0}}, "real.motors.0.offset", "out_of_range"),
        ({0: {"torque": 1}}, "real.motors.0.torque", "unknown_key"),
    ],
)
def test_wrong_motors_are_refused(changes: dict[int, dict[str, Any]], key: str, code: str) -> None:
    assert [(found[0], found[2]) for found in check_damiao_arm(arm(changes))][:1] == [(key, code)]


def test_ranges_near_those_of_the_type_are_accepted() -> None:
    spec = arm({0: {"ranges": [12.5, 8.0, 28.0]}})
    assert list(check_damiao_arm(spec)) == []
    assert DamiaoArmSettings.of(spec).motors[0].limits.velocity == 8.0


def test_the_number_of_motors_is_that_of_the_joints() -> None:
    found = list(check_damiao_arm(arm(motors=[motor(1), motor(2)])))
    assert [(key, code) for key, _, code in found] == [("real.motors", "wrong_count")]


def test_a_speed_limit_beyond_the_motors_range_is_refused() -> None:
    spec = arm()
    fast = replace(spec, limits=replace(spec.limits, velocity=(11.0, 2.0, 2.0)))
    assert [found[0] for found in check_damiao_arm(fast)] == ["limits.velocity"]


def test_a_urdf_without_masses_is_refused_by_link(tmp_path: Path) -> None:
    text = Path(arm().urdf).read_text()
    bare = tmp_path / "bare.urdf"
    bare.write_text(re.sub(r"<mass value=.*?/>", '<mass value="0"/>', text))
    found = list(check_damiao_arm(replace(arm(), urdf=str(bare))))
    assert {(key, code) for key, _, code in found} == {("model", "wrong_inertials")}
    assert len(found) >= 3


def test_ids_of_arm_and_gripper_on_one_bus_may_not_collide() -> None:
    spec = replace(arm(), gripper=gripper(motor=motor(3)))
    assert {found[2] for found in check_damiao_arm(spec)} == {"id_collision"}
    elsewhere = replace(arm(), gripper=gripper(motor=motor(3), channel="239.74.163.3"))
    assert list(check_damiao_arm(elsewhere)) == []


@pytest.mark.parametrize(
    "widths",
    [
        [[0.0, 0.0]],
        [[0.0, 0.0], [0.0, 0.08]],
        [[0.0, 0.0], [1.0, 0.08], [2.0, 0.04]],
        [[0.0, 0.0], [1.0, 0.05]],
        [[0.0, -0.01], [1.0, 0.08]],
        [[0.0, 0.0], [13.0, 0.08]],
        [0.0, 0.08],
        "wide",
    ],
)
def test_wrong_tables_of_widths_are_refused(widths: Any) -> None:
    keys = {".".join(found[0].split(".")[:2]) for found in check_damiao_gripper(gripper(widths=widths))}
    assert keys == {"real.widths"}


@pytest.mark.parametrize("option", ["interface", "channel", "motors"])
def test_missing_options_are_named(option: str) -> None:
    options = {name: value for name, value in arm().options.items() if name != option}
    found = list(check_damiao_arm(replace(arm(), options=options)))
    assert [(key, code) for key, _, code in found] == [(f"real.{option}", "missing_key")]
    with pytest.raises(ConfigError):
        DamiaoArmSettings.of(replace(arm(), options=options))


@pytest.mark.parametrize("channel", ["/dev/ttyACM0", "239.74.163.2/24", "an_interface_with_a_long_name"])
def test_a_channel_that_is_no_network_interface_is_refused(channel: str) -> None:
    spec = arm(interface="socketcan", channel=channel)
    assert [(key, code) for key, _, code in check_damiao_arm(spec)] == [("real", "invalid")]


@pytest.mark.parametrize(
    ("interface", "emulated"), [("virtual", True), ("udp_multicast", True), ("socketcan", False), ("slcan", False)]
)
def test_interfaces_without_hardware_count_as_emulated(interface: str, emulated: bool) -> None:
    assert is_emulated({"interface": interface}) is emulated


def test_the_checks_do_not_import_python_can() -> None:
    code = "import sys, hal.drivers.can.settings; print('can' in sys.modules)"
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True, timeout=60)
    assert result.stdout.strip() == "False"
