"""hal check of arms on a CAN bus, against the emulator in this process: what it reports, and the remedy."""

from __future__ import annotations

import itertools
from collections.abc import Callable

import can
import pytest
from can_kit import can_overrides, emulated_arm

from hal.config import load
from hal.drivers.can.preflight import check_damiao, check_piper
from hal.preflight import CheckResult
from hal.specs import RobotSpec

CHECKS = {"damiao": check_damiao, "piper": check_piper}


def absent(rig: str) -> RobotSpec:
    """Return the record of an arm whose bus has no other user."""
    return load(rig, sim=False, overrides=can_overrides("virtual")).resolve().robots[0]


def results(spec: RobotSpec, duration: float = 0.2) -> list[CheckResult]:
    """Return the results of an arm's check."""
    return list(CHECKS[spec.driver](spec, duration))


def wrong(found: list[CheckResult]) -> list[CheckResult]:
    """Return the results that fail, each of which must have a remedy."""
    failed = [result for result in found if result.level == "fail"]
    assert all(result.remedy for result in failed)
    return failed


@pytest.mark.parametrize("rig", ["yam", "piper"])
def test_an_arm_in_order_passes_every_check(rig: str) -> None:
    with emulated_arm(rig) as far:
        found = results(far.spec)
        names = [result.name for result in found]
        assert names[:2] == ["interface", "motors"]
        assert {"firmware", "state", "bus"} <= set(names)
        assert {result.level for result in found} <= {"ok", "warn"}, found  # a busy computer may answer late
        assert "%" in next(result.found for result in found if result.name == "bus")
        assert results(far.spec)[1].level == "ok"  # nothing stays open
        assert far.arm.plant.held  # no motor was ever switched on


def test_a_motor_a_full_turn_away_fails_by_joint_and_motor() -> None:
    with emulated_arm("yam") as far:
        far.execute("place 0 -4.78 1.35 -1.42 0 0")
        failed = next(result for result in wrong(results(far.spec)) if result.name == "position")
        assert "joint2 (motor 2)" in failed.found


@pytest.mark.parametrize("rig", ["yam", "piper"])
def test_a_bus_without_a_motor_fails(rig: str) -> None:
    failed = wrong(results(absent(rig)))
    assert [result.name for result in failed][:1] == ["motors"]
    assert failed[0].found.startswith(("no motor answers", "no PiPER reports"))
    assert "emulator" in failed[0].remedy


@pytest.mark.parametrize(("rig", "motor"), [("yam", "motor 4"), ("piper", "joint 3")])
def test_a_missing_motor_is_named(rig: str, motor: str) -> None:
    with emulated_arm(rig) as far:
        far.execute("silent 4 on" if rig == "yam" else "silent 3 on")
        failed = wrong(results(far.spec))
    assert len(failed) == 1
    assert motor in failed[0].found
    if rig == "yam":
        assert "1, 2, 3, 5, 6 do" in failed[0].found


def test_a_wrong_range_is_named_with_its_motor_and_register() -> None:
    with emulated_arm("yam") as far:
        far.execute("register 2 VMAX 8")
        failed = wrong(results(far.spec))
    assert [(result.name, "motor 2" in result.found, "VMAX" in result.found) for result in failed] == [
        ("registers", True, True)
    ]


def test_a_bus_at_another_bit_rate_shows_error_frames(monkeypatch: pytest.MonkeyPatch) -> None:
    """The interface is up, but the motors are not: their frames are errors."""
    receive: Callable[..., can.Message | None] = can.interfaces.virtual.VirtualBus.recv  # type: ignore[attr-defined]
    count = itertools.count()

    def garbled(self: can.BusABC, timeout: float | None = None) -> can.Message | None:
        message = receive(self, timeout)
        return message or (can.Message(is_error_frame=True, arbitration_id=0x8) if next(count) % 2 else None)

    monkeypatch.setattr(can.interfaces.virtual.VirtualBus, "recv", garbled)  # type: ignore[attr-defined]
    failed = wrong(results(absent("yam")))
    assert "another bit rate" in failed[0].found
    assert "bit rate" in failed[0].remedy


def test_limits_that_were_lost_in_the_arm_fail() -> None:
    """An arm whose own limits are damaged reports a range of nothing: it would not move."""
    with emulated_arm("piper") as far:
        plant = far.arm.plant
        plant.lower[1] = plant.upper[1] = -0.002
        failed = wrong(results(far.spec))
    assert [result.name for result in failed] == ["ranges"]
    assert "joint 2" in failed[0].found
