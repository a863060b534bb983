"""The fixtures for users' tests; the pages of ``docs/unit-tests.md`` run in a session of pytest of their own."""

from __future__ import annotations

import subprocess
import sys

import pytest

import hal

pytest_plugins = ["hal.pytest_plugin"]

rigs: list[hal.Rig] = []


@pytest.mark.parametrize("turn", [1, 2])
def test_each_test_has_a_rig_of_mocks_of_its_own(mock_rig: hal.Rig, turn: int) -> None:
    rigs.append(mock_rig)
    assert mock_rig.lock_step
    assert {robot.driver for robot in mock_rig.plan.robots} == {"mock"}
    arm = mock_rig.robots["panda"]
    assert arm.state().q == pytest.approx(arm.home), "as if there had been no test before"
    arm.move_to(arm.home + 0.1)
    for before in rigs[: turn - 1]:
        with pytest.raises(hal.HalError):
            before.robots["panda"].move_to(arm.home)


@pytest.mark.parametrize("mock_rig_config", [{"robots": {"arm": {"model": "fr3"}}}])
def test_a_test_names_another_rig(mock_rig: hal.Rig) -> None:
    assert list(mock_rig.robots) == ["arm"]


def test_tests_without_a_rig_do_not_wait_for_it() -> None:
    code = "import hal.pytest_plugin, sys; print({'numpy', 'yaml', 'pydantic', 'hal.rig'} & {*sys.modules})"
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, timeout=60, check=True)
    assert done.stdout.strip() == "set()"
