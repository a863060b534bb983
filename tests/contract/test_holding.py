"""Grippers hold what they grasp, and the check notices one that does not.

Three models, with an object and an engine each. ``HAL_SOAK=1 pytest tests/contract/test_holding.py`` takes every model
with every object on every engine, held for 10 seconds: 10 minutes on one core.
"""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any, get_args

import pytest
from benchmark_kit import load_benchmark
from engines_kit import need_engine

from hal.config.data_files import find_data, list_data
from hal.errors import ConfigError, NotSupported
from hal.testing.holding import Thing, hold_object

SOAK = os.environ.get("HAL_SOAK") == "1"
CASES: list[tuple[dict[str, Any], str, Thing]] = [
    ({"model": "panda"}, "mujoco", "cube"),
    ({"model": "vx300s"}, "mujoco", "plate"),
    ({"model": "ur5e"}, "pybullet", "cylinder"),  # six joints in loops, the hardest for PyBullet
]
if SOAK:
    entries = load_benchmark("robots").entries
    ARMS = [entry for model in list_data("robots") for entry in entries(model)]
    CASES = [(arm, engine, thing) for arm in ARMS for engine in ("pybullet", "mujoco") for thing in get_args(Thing)]


@pytest.mark.parametrize(
    ("robot", "engine", "thing"),
    [
        pytest.param(*case, id="-".join([*case[0].values(), *case[1:]]), marks=[pytest.mark.slow] * SOAK)
        for case in CASES
    ],
)
def test_a_gripper_holds_what_it_grasps(robot: dict[str, Any], engine: str, thing: Thing) -> None:
    need_engine(engine)
    try:
        held = hold_object(robot, thing, engine=engine, seconds=10.0 if SOAK else 0.1)
    except NotSupported as error:
        if SOAK and error.code == "no_gripper":
            pytest.skip(str(error))
        raise
    except ConfigError as error:
        if all(problem.code == "missing_package" for problem in error.problems):
            pytest.skip(error.problems[0].message)
        raise
    assert held.good, held


def test_a_wrong_table_of_widths_is_noticed(tmp_path: Path) -> None:
    """By it the fingers are 6 mm apart where they touch."""
    model, joints = find_data("robots", "panda.yaml"), "joints: [panda_finger_joint1, panda_finger_joint2]"
    ends = ", ".join(f"{{name: panda_finger_joint{k}, open: 0.04, closed: 0}}" for k in (1, 2))
    text = model.read_text(encoding="utf-8").replace("urdf: ", f"urdf: {model.parent}/")
    assert joints in text
    table = f"joints: [{ends}]\n  widths: [[0, 0.006], [0.04, 0.086]]"
    (tmp_path / "wrong.yaml").write_text(text.replace(joints, table), encoding="utf-8")
    held = hold_object(str(tmp_path / "wrong.yaml"), engine=need_engine("mujoco").name, seconds=0.1)
    assert held.error == pytest.approx(0.006, abs=5e-4)
    assert held.wrong
    assert not held.good
