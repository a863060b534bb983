"""The pre-flight check of a Franka against an emulated FR3."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from hal.config import load
from hal.drivers.franka import preflight
from hal.drivers.franka.network import NotMeasured
from hal.drivers.franka.preflight import check
from hal.preflight import CheckResult
from hal.specs import RobotSpec

from .franka_kit import Client, Emulator, free_host

pytest.importorskip("pylibfranka", reason="needs pylibfranka: pip install 'robot-hal[franka]'")
pytest.importorskip("panda_py", reason="needs panda-python: pip install 'robot-hal[panda]'")


@pytest.fixture(scope="module")
def robot() -> Iterator[Emulator]:
    with Emulator(hand=True) as emulator:
        yield emulator


def rig(robot: Emulator, *overrides: str) -> RobotSpec:
    options = [f"robots.arm.real.host={robot.host}", *overrides]
    return load("franka_emulator", overrides=options).resolve().robots[0]


def checked(spec: RobotSpec) -> dict[str, CheckResult]:
    return {result.name: result for result in check(spec, 0.05)}


def test_an_emulated_fr3_passes_every_check(robot: Emulator) -> None:
    found = checked(rig(robot))
    assert list(found) == ["route", "robot", "state", "set-points", "hand", "network"]
    assert {result.level for name, result in found.items() if name != "network"} == {"ok"}
    assert robot.control.send("state")["mode"] == "idle", "the robot is left unchanged"


def test_noise_of_the_reported_set_points_is_a_failure(robot: Emulator) -> None:
    robot.control.send("report-noise 0.01")
    try:
        found = checked(rig(robot))
    finally:
        robot.control.send("report-noise 0")
    assert found["set-points"].level == "fail"
    assert found["state"].level == "ok"


@pytest.mark.parametrize(
    ("on", "off", "word"),
    [
        ("reflex joint_reflex", "restart", "collision"),
        ("user-stop on", "user-stop off", "user stop"),
        ("guiding on", "guiding off", "guided"),
    ],
)
def test_a_robot_that_may_not_move_is_a_warning(robot: Emulator, on: str, off: str, word: str) -> None:
    robot.control.send(on)
    try:
        found = checked(rig(robot))
    finally:
        robot.control.send(off)
    assert found["robot"].level == "ok"
    assert found["state"].level == "warn"
    assert word in found["state"].found
    assert found["state"].remedy


def test_another_arm_than_the_rigs_is_a_failure(robot: Emulator) -> None:
    found = checked(rig(robot, "robots.arm.model=panda", "robots.arm.gripper.enabled=false"))
    assert found["robot"].level == "fail"
    assert "model: fr3" in found["robot"].remedy
    assert "state" not in found
    assert "hand" not in found, "the rig has none"


def test_a_missing_hand_is_a_failure(robot: Emulator) -> None:
    found = checked(rig(robot, f"robots.arm.gripper.real.host={free_host()}"))
    assert found["hand"].level == "fail"
    assert "gripper: {enabled: false}" in found["hand"].remedy


def test_a_client_of_another_computer_holds_the_robot(robot: Emulator) -> None:
    with Client(robot.host) as other:
        assert other.reply()[0] == 0
        found = checked(rig(robot))
    assert found["robot"].level == "fail"


def test_a_network_that_cannot_be_measured_is_unknown(robot: Emulator, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(address: str, duration: float) -> None:
        raise NotMeasured("not allowed")

    monkeypatch.setattr(preflight, "measure_round_trips", refuse)
    found = checked(rig(robot))["network"]
    assert found.level == "unknown"
    assert "ping_group_range" in found.remedy
