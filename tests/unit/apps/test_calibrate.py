"""``apps/calibrate.py``: the controls that it uses."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

import hal
from hal import calibration
from hal.apps import calibrate


@pytest.mark.parametrize(
    ("own", "arguments", "deadman"),
    [(None, [], "l2"), ("spacemouse", [], "l1"), ("spacemouse", ["--mapping", "default"], "l2")],
)
def test_the_dead_man_is_that_of_the_pads_own_mapping(
    own: str | None, arguments: list[str], deadman: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    used: dict[str, Any] = {}
    monkeypatch.setattr(calibration, "collect_views", lambda *_, **options: used.update(options))
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig:
        rig.driver("pad").meant_for = own
        collector: Any = SimpleNamespace(robot=rig.robots["panda"])
        calibrate._collect(calibrate.parser().parse_args(["--auto", *arguments]), rig, collector, hal.Pose())
        rig.driver("pad").press(deadman)
        rig.clock.sleep(0.1)
        assert used["deadman"].held
