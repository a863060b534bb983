"""What a rig may set of a PiPER, and the errors that the arm reports."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import pytest

from hal.config import load
from hal.drivers.can import piper_protocol as protocol
from hal.drivers.can.piper_link import arm_fault, control_fault, gripper_fault
from hal.drivers.can.piper_protocol import ENABLED, JOINTS, GripperStatus, PiperStatus
from hal.drivers.can.settings import BusSettings, PiperArmSettings, check_piper_arm, check_piper_gripper, group_key
from hal.errors import ConfigError
from hal.testing import gripper_spec, robot_spec

BUS = {"interface": "virtual", "channel": "piper"}
ON = [ENABLED] * JOINTS


def problems(rate_hz: float = 200.0, joints: int = JOINTS, **options: Any) -> dict[str, str]:
    """Return the problems of an arm with these options: key -> code."""
    spec = robot_spec(joints, driver="piper", rate_hz=rate_hz, options=BUS | options)
    return {key: code for key, _, code in check_piper_arm(spec)}


def test_a_rig_without_mistakes_has_no_problems() -> None:
    assert problems() == problems(speed_percent=30, mounting="left", bit_rate=1_000_000) == {}
    assert not list(check_piper_gripper(gripper_spec(driver="piper", options=BUS | {"force_per_torque": 30.0})))


@pytest.mark.parametrize(
    ("wrong", "key", "code"),
    [
        ({"fd": True}, "real.fd", "not_supported"),
        ({"bit_rate": 500_000}, "real.bit_rate", "out_of_range"),
        ({"speed_percent": 0}, "real.speed_percent", "out_of_range"),
        ({"speed_percent": 101}, "real.speed_percent", "out_of_range"),
        ({"mounting": "ceiling"}, "real.mounting", "invalid_choice"),
        ({"rate_hz": 500.0}, "rate_hz", "out_of_range"),
        ({"joints": 7}, "model", "wrong_count"),
        ({"speed": 50}, "real.speed", "unknown_key"),
    ],
)
def test_each_mistake_is_named(wrong: dict[str, Any], key: str, code: str) -> None:
    assert problems(**wrong) == {key: code}


def test_a_gripper_on_a_wrong_bus_is_named() -> None:
    spec = gripper_spec(driver="piper", options=BUS | {"fd": True})
    assert [(key, code) for key, _, code in check_piper_gripper(spec)] == [("real.fd", "not_supported")]
    assert [key for key, *_ in check_piper_gripper(replace(spec, options={"interface": "virtual"}))] == ["real.channel"]


def test_the_mounting_is_a_number_of_the_protocol() -> None:
    codes = {
        mounting: PiperArmSettings(**BUS, mounting=mounting).mounting_code
        for mounting in (None, "upright", "left", "right")
    }
    assert codes == {None: 0, "upright": 1, "left": 2, "right": 3}


@pytest.mark.parametrize("status", sorted(set(range(1, 0x10)) - {0xB, 0xC, 0xD}))
def test_every_error_of_the_arm_is_a_fault_with_a_remedy(status: int) -> None:
    fault = arm_fault(PiperStatus(1, status), ON)
    assert fault is not None
    assert fault.code == protocol.ARM_STATUS[status]
    assert fault.cause
    assert fault.remedy


@pytest.mark.parametrize("status", [0x0, 0xB, 0xC, 0xD])
def test_teaching_is_no_fault(status: int) -> None:
    assert arm_fault(PiperStatus(0, status), [0] * JOINTS) is None


@pytest.mark.parametrize(
    ("status", "joints"),
    [
        (PiperStatus(1, 0x4, beyond_limit=0b000100), "joint 3"),
        (PiperStatus(1, 0x5, no_communication=0b110001), "joints 1, 5, 6"),
    ],
)
def test_the_error_bits_name_the_joints(status: PiperStatus, joints: str) -> None:
    fault = arm_fault(status, ON)
    assert fault is not None
    assert joints in fault.cause


@pytest.mark.parametrize(
    ("flag", "code"),
    [
        (protocol.LOW_VOLTAGE, "low_voltage"),
        (protocol.MOTOR_HOT, "motor_hot"),
        (protocol.OVER_CURRENT, "over_current"),
        (protocol.DRIVER_HOT, "driver_hot"),
        (protocol.COLLISION, "collision"),
        (protocol.ERROR, "joint_error"),
        (protocol.STALLED, "stalled"),
    ],
)
def test_every_flag_of_a_motor_is_a_fault_that_names_the_joint(flag: int, code: str) -> None:
    fault = arm_fault(PiperStatus(1, 0x9), [ENABLED, ENABLED | flag, *ON[2:]])
    assert fault is not None
    assert fault.code == code
    assert "joint 2" in fault.cause
    assert fault.remedy


def test_an_engaged_arm_must_stay_on_and_under_can_control() -> None:
    assert control_fault(PiperStatus(1), ON) is None
    off = control_fault(PiperStatus(1), [*ON[:5], 0])
    teaching, moved = control_fault(PiperStatus(2), ON), control_fault(PiperStatus(1, move=0), ON)
    assert [fault and fault.code for fault in (off, teaching, moved)] == [
        "switched_off", "not_in_control", "not_in_control"
    ]  # fmt: skip
    assert off is not None
    assert "joint 6" in off.cause


def test_a_grippers_own_flags_are_no_faults_of_the_arm() -> None:
    """The bits of collision and stall mean something else there."""
    assert gripper_fault(GripperStatus(0.05, 0.0, ENABLED | protocol.HOMED | protocol.COLLISION)) is None
    fault = gripper_fault(GripperStatus(0.05, 0.0, ENABLED | protocol.OVER_CURRENT))
    assert fault is not None
    assert fault.code == "over_current"


def test_each_multicast_channel_has_a_port_of_its_own() -> None:
    """On a common port a socket hears the groups of all other programs of this computer."""
    ports = {
        channel: BusSettings(interface="udp_multicast", channel=channel).arguments()["port"]
        for channel in ("239.74.163.2", "239.74.163.3", "239.74.164.2")
    }
    assert ports["239.74.163.2"] == 43113  # python-can's own
    assert len(set(ports.values())) == 3
    assert BusSettings(interface="udp_multicast", channel="239.74.163.3", bus={"port": 5}).arguments()["port"] == 5
    assert "port" not in BusSettings(interface="socketcan", channel="can0").arguments()


@pytest.mark.parametrize("interface", ["virtual", "slcan", "gs_usb"])
def test_arms_on_an_adapter_of_one_process_belong_together(interface: str) -> None:
    left, right = ({"interface": interface, "channel": channel} for channel in ("a", "b"))
    assert group_key(left) == group_key({**left, "motors": []}) is not None
    assert group_key(left) != group_key(right)
    assert group_key({"interface": "socketcan", "channel": "a"}) is None


def test_a_gripper_takes_the_bus_from_its_arm_and_lock_step_is_refused() -> None:
    bus = ["robots.arm.real.interface=virtual", "robots.arm.real.channel=group", "cameras={}"]
    plan = load("piper", sim=False, overrides=bus).resolve()
    gripper = plan.robots[0].gripper
    assert gripper is not None
    assert gripper.options == {"interface": "virtual", "channel": "group"}
    with pytest.raises(ConfigError):
        load("piper", sim=False, clock="lock_step", overrides=bus).resolve()
