"""The skills in the simulated worlds of both engines; ``python -m benchmarks skills`` counts hundreds of tries."""

from __future__ import annotations

import pytest
from benchmark_kit import load_benchmark
from engines_kit import AUTO, Engine

tries = load_benchmark("skills")


@pytest.mark.parametrize("thing", ["cube", "mug"])
def test_grasps_by_ground_truth(engine: Engine, thing: str) -> None:
    assert tries.grasps(engine.name, thing, tries.TRUTH, 1) == [""]


def test_a_grasp_by_noisy_depth() -> None:
    assert tries.grasps(AUTO, "duck", tries.NOISY, 1) == [""]


def test_a_gentle_grasp_moves_the_object_by_less_than_2_mm(engine: Engine) -> None:
    assert tries.gentle_grasps(engine.name, "cube", 1) == [""]


@pytest.mark.parametrize("thing", ["cube", "cylinder"])
def test_pushes_to_a_goal(engine: Engine, thing: str) -> None:
    assert tries.pushes(engine.name, thing, 1) == [""]


@pytest.mark.slow
def test_pushes_on_a_slippery_table(engine: Engine) -> None:
    """On friction 0.1 the cube slid 14 mm to and fro over the goal, as short pushes were planned as if it turned."""
    assert tries.pushes(engine.name, "cube", 5, seed=2, friction=0.1) == [""] * 5
