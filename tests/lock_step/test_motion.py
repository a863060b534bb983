"""Small counts of ``benchmarks/motion.py``: lines in both worlds, refusals, and speeds."""

import runpy
from pathlib import Path

import pytest

BENCHMARK = runpy.run_path(str(Path(__file__).parents[2] / "benchmarks" / "motion.py"))


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_the_simulated_arm_stays_on_its_line(engine: str) -> None:
    pytest.importorskip(engine)
    found = BENCHMARK["lines"](2, engine)
    assert found["off_set"] <= 5e-4
    assert found["off"] <= 2e-3
    assert found["tilt"] <= 5e-3
    assert found["ratio"] <= 1.3


def test_lines_that_are_begun_end_and_those_refused_are_impossible() -> None:
    found = BENCHMARK["checks"](6)
    assert found["began"]
    assert found["refused"]
    assert (found["stopped_underway"], found["off"], found["confirmed"]) == (0, 0, 1.0)
    assert found["peak_of_limits"] <= 1.0


def test_poses_out_of_reach_are_refused_before_anything_moves() -> None:
    assert BENCHMARK["refusals"](4)["moved"] == 0


def test_move_to_keeps_its_share_of_the_speed() -> None:
    found = BENCHMARK["speeds"]()
    assert found["ratio"] == pytest.approx(10.0, rel=0.01)
    assert 0.2 < found["tcp_at_1.0"] <= 0.25
