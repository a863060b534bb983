"""The skills in the simulated worlds of both engines; ``benchmarks/skills.py`` counts hundreds of tries of the same."""

from __future__ import annotations

import importlib.util
from pathlib import Path
from types import ModuleType

import pytest
from engines_kit import AUTO, Engine


@pytest.fixture(scope="module")
def tries() -> ModuleType:
    """Return the benchmark, whose functions make the tries."""
    path = Path(__file__).parents[2] / "benchmarks" / "skills.py"
    spec = importlib.util.spec_from_file_location("benchmark_of_skills", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.mark.parametrize("thing", ["cube", "mug"])
def test_grasps_by_ground_truth(tries: ModuleType, engine: Engine, thing: str) -> None:
    assert tries.grasps(engine.name, thing, tries.TRUTH, 1) == [""]


def test_a_grasp_by_noisy_depth(tries: ModuleType) -> None:
    assert tries.grasps(AUTO, "duck", tries.NOISY, 1) == [""]


def test_a_gentle_grasp_moves_the_object_by_less_than_2_mm(tries: ModuleType, engine: Engine) -> None:
    assert tries.gentle_grasps(engine.name, "cube", 1) == [""]


@pytest.mark.parametrize("thing", ["cube", "cylinder"])
def test_pushes_to_a_goal(tries: ModuleType, engine: Engine, thing: str) -> None:
    assert tries.pushes(engine.name, thing, 1) == [""]


@pytest.mark.slow
def test_pushes_on_a_slippery_table(tries: ModuleType, engine: Engine) -> None:
    """On friction 0.1 the cube slid 14 mm to and fro over the goal, as short pushes were planned as if it turned."""
    assert tries.pushes(engine.name, "cube", 12, seed=2, friction=0.1) == [""] * 12
