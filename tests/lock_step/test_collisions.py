"""Two simulated arms that are driven at each other stop apart, and a rig names what is not checked."""

from __future__ import annotations

import runpy
from pathlib import Path

import numpy as np
import pytest

import hal

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "collisions.py"
BENCHMARK = runpy.run_path(str(SCRIPT))
POINTED = [0.0, 0.6, 0.0, -1.2, 0.0, 1.8, 0.8]


def test_two_arms_driven_at_each_other_stop_apart() -> None:
    found = BENCHMARK["arms"](1)
    assert found["5 mm apart or more"] == found["came within 20 mm"] == 1


def test_torques_towards_the_table_are_stopped_before_its_margin() -> None:
    found = BENCHMARK["torques"](3)
    assert found["nearest of all, mm"] >= 10.0
    assert found["stopped because of a collision"] == 2


def test_a_compliant_arm_that_is_pushed_beyond_the_margin_is_held() -> None:
    free, pushed = BENCHMARK["pushes"](forces=(0.0, 20.0), names=("tcp 1000 N/m",)).values()
    distance, end = free.split(" mm, ")
    assert 9.95 <= float(distance) <= 11.0
    assert end == "no trip"
    distance, end = pushed.split(" mm, ")
    assert float(distance) >= 5.0
    assert end == "torque_limit"


@pytest.mark.parametrize(("model", "count"), [("so101", 4), ("piper", 2)])
def test_an_arm_inside_a_margin_comes_home_or_is_refused_at_once(model: str, count: int) -> None:
    found = BENCHMARK["starts"](model, count)
    assert found["came home"] + found["refused at once"] == count
    assert found["came home"] >= count // 2


def test_a_motion_into_another_arm_is_refused_before_anything_moves() -> None:
    facing = {"position": [0.8, 0, 0], "orientation": [0, 0, 1, 0]}
    robots = {"left": {"model": "panda"}, "right": {"model": "panda", "base": facing}}
    with hal.open({"robots": robots}, driver="mock", clock="lock_step", pad="none") as rig:
        left = rig.robots["left"]
        before = left.state()
        with pytest.raises(hal.CollisionError) as caught:
            left.move_to(POINTED, timeout=10.0)
        assert caught.value.first.startswith("left/")
        assert caught.value.second.startswith("right/")
        assert 0.0 < caught.value.along < 1.0
        assert np.array_equal(left.state().q_set, before.q_set)


@pytest.mark.parametrize(("apart", "overlaps"), [(0.0, False), (0.05, True), (1.2, False)])
def test_arms_that_overlap_at_the_start_are_named(apart: float, overlaps: bool) -> None:
    robots = {"one": {"model": "panda"}, "two": {"model": "panda", "base": {"position": [apart, 0, 0]}}}
    with hal.open({"robots": robots}, driver="mock", clock="lock_step", pad="none") as rig:
        notes = [note for note in rig.notes if "one" in note and "two" in note]
        assert bool(notes) == (apart < 1.0)
        assert any("one/panda_link" in note for note in notes) == overlaps


@pytest.mark.parametrize("name", ["panda_table", "franka", "yam", "piper", "iiwa_table", "baxter_table"])
def test_a_motion_into_the_table_of_a_built_in_rig_is_refused(name: str) -> None:
    with hal.open(name, driver="mock", clock="lock_step", pad="none", sim=True, overrides={"cameras": {}}) as rig:
        for arm in rig.robots.values():
            tcp, top = arm.state().tcp_set, 0.7 if name == "baxter_table" else 0.6
            below = top - 0.065 - arm.spec.base_position[2]
            with pytest.raises(hal.CollisionError) as caught:
                arm.move_to(hal.Pose([*tcp.position[:2], below], tcp.orientation), timeout=30.0)
            assert caught.value.second == "table"
