"""Which devices share a process."""

from __future__ import annotations

from pathlib import Path

import pytest

from hal.config import load
from hal.host.hosts import GRIPPER_HZ, make_groups
from hal.specs import GroupSpec, from_json, to_json


@pytest.fixture
def apart(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Overrides that give the Panda a gripper whose driver needs a process of its own."""
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "lab_apart.py").write_text(
        "from hal.registry import DriverSpec\n"
        "MOCK = 'hal.drivers.mock.robot:MockGripper'\n"
        "HAND = DriverSpec('hand', gripper=MOCK, own_process=frozenset({'gripper'}))\n"
    )
    return ["robots.panda.gripper.drivers={sim: 'lab_apart:HAND'}"]


def groups(overrides: list[str], clock: str, driver: str | None = None) -> list[GroupSpec]:
    return make_groups(load("panda_table", sim=True, driver=driver, clock=clock, overrides=overrides).resolve())


@pytest.mark.parametrize("clock", ["real_time", "lock_step"])
def test_a_gripper_is_in_the_group_of_its_arm(clock: str) -> None:
    (group,) = groups([], clock)
    assert group.grippers == (group.robots[0].gripper,)


def test_an_arm_alone_has_its_gripper_with_it() -> None:
    (group,) = groups([], "real_time", driver="mock")
    assert (group.name, group.grippers[0].name) == ("panda", "panda.gripper")


@pytest.mark.parametrize("clock", ["real_time", "lock_step"])
def test_a_gripper_that_needs_a_process_of_its_own(clock: str, apart: list[str]) -> None:
    arm, hand = groups(apart, clock)
    assert (len(arm.robots), arm.grippers) == (1, ())
    assert (hand.name, hand.robots, hand.rate_hz, hand.world) == ("panda.gripper", (), GRIPPER_HZ, None)
    assert hand.grippers == (arm.robots[0].gripper,)
    assert from_json(GroupSpec, to_json(hand)) == hand


def test_a_gripper_that_is_switched_off_has_no_process(apart: list[str]) -> None:
    (group,) = groups([*apart, "robots.panda.gripper.enabled=false"], "real_time")
    assert group.grippers == ()
