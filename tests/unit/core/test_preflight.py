"""The check of a rig: which arms are looked at, and what becomes of drivers that cannot, or fail to."""

from __future__ import annotations

import sys
from collections.abc import Iterator
from dataclasses import replace
from types import ModuleType

import pytest

from hal.config import load
from hal.errors import DriverMissing
from hal.preflight import CheckResult, preflight, real_arms
from hal.registry import DriverSpec
from hal.specs import CameraSpec, Plan, RobotSpec


def check(spec: RobotSpec, duration: float) -> Iterator[CheckResult]:
    yield CheckResult("link", "ok", f"{spec.name} for {duration:g} s")
    if spec.options.get("broken"):
        raise DriverMissing("no library; pip install it")


@pytest.fixture
def plan(monkeypatch: pytest.MonkeyPatch) -> Plan:
    """A rig with one arm that takes itself for real."""
    module = ModuleType("checked_driver")
    vars(module).update(check=check, DRIVER=DriverSpec("checked_driver", preflight="checked_driver:check"))
    monkeypatch.setitem(sys.modules, "checked_driver", module)
    plan = load("panda_table", sim=True).resolve()
    return replace(plan, robots=tuple(replace(r, driver="checked_driver:DRIVER", attended=True) for r in plan.robots))


def of_arms(plan: Plan) -> list[CheckResult]:
    return [v for v in preflight(plan, 0.25) if ":" in v.name]


def test_a_simulated_rig_has_only_the_machine_to_check() -> None:
    plan = load("panda_table", sim=True).resolve()
    assert real_arms(plan) == ()
    assert [v.name for v in preflight(plan)] == ["kernel", "processor", "scheduling", "memory"]


def test_an_arm_is_checked_by_its_driver_under_its_own_name(plan: Plan) -> None:
    assert of_arms(plan) == [CheckResult("panda: link", "ok", "panda for 0.25 s")]


def test_an_emulated_arm_is_checked_too(plan: Plan) -> None:
    emulated = replace(plan, robots=(replace(plan.robots[0], attended=False, emulated=True),))
    assert of_arms(emulated) == of_arms(plan)


def test_a_check_that_breaks_is_a_failure_after_what_it_found(plan: Plan) -> None:
    broken = replace(plan, robots=(replace(plan.robots[0], options={"broken": True}),))
    first, last = of_arms(broken)
    assert first.level == "ok"
    assert last.level == "fail"
    assert "pip install it" in last.found


def test_a_driver_without_a_check_is_unknown(plan: Plan) -> None:
    (found,) = of_arms(replace(plan, robots=(replace(plan.robots[0], driver="mock"),)))
    assert found.level == "unknown"
    assert "'mock'" in found.found


def test_a_driver_that_is_not_there_is_a_failure(plan: Plan) -> None:
    (found,) = of_arms(replace(plan, robots=(replace(plan.robots[0], driver="nothing:DRIVER"),)))
    assert found.level == "fail"


def test_a_camera_is_checked_by_its_driver_unless_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    def look(spec: CameraSpec, duration: float) -> Iterator[CheckResult]:
        yield CheckResult("rate", "ok", f"{spec.rate_hz:g} Hz over {duration:g} s")

    module = ModuleType("checked_camera")
    vars(module).update(look=look, DRIVER=DriverSpec("checked_camera", camera_preflight="checked_camera:look"))
    monkeypatch.setitem(sys.modules, "checked_camera", module)
    plan = load("panda_table", sim=True).resolve()
    first, *others = plan.cameras
    plan = replace(plan, cameras=(replace(first, driver="checked_camera:DRIVER"), *others))
    assert of_arms(plan) == [CheckResult(f"{first.name}: rate", "ok", "30 Hz over 0.25 s")]
    assert [v for v in preflight(plan, 0.25, cameras=False) if ":" in v.name] == []
