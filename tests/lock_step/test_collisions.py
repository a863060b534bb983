"""Two simulated arms that are driven at each other stop apart, and a rig names what is not checked."""

from __future__ import annotations

import contextlib
import os
from collections.abc import Callable, Iterator

import numpy as np
import pytest
from benchmark_kit import load_benchmark

import hal

collisions = load_benchmark("collisions")
POINTED = [0.0, 0.6, 0.0, -1.2, 0.0, 1.8, 0.8]


def test_two_arms_driven_at_each_other_stop_apart() -> None:
    found = collisions.arms(1)
    assert found["5 mm apart or more"] == found["came within 20 mm"] == 1


OVER_THE_TABLE = [0.0, 0.45, 0.0, -2.1, 0.0, 2.55, 0.785]
"""The hand points down, some 15 cm above the table."""


@contextlib.contextmanager
def over_the_table() -> Iterator[tuple[hal.Rig, Callable[[], tuple[float, bool]]]]:
    """Open a rig whose arm must not touch the table; also yield a function that makes a step.

    It returns the distance of the nearest pair, m, and whether something held the arm back to avoid a collision.
    """
    overrides = {"robots.panda.initial": OVER_THE_TABLE, "robots.panda.workspace": {}, "cameras": {}}
    overrides |= {"collisions.boxes": ["table"]}
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=overrides) as rig:
        panda = rig.robots["panda"]
        model = panda.collisions.model

        def step() -> tuple[float, bool]:
            rig.clock.sleep(1 / 240)
            state = panda.state()
            model.place(state.q)
            return float(model.distances().min()), hal.Limited.COLLISION in state.limited

        rig.clock.sleep(0.2)
        yield rig, step


def test_torques_towards_the_table_are_stopped_before_its_margin() -> None:
    """Constant torques: random ones, and those of forces down on the table."""
    rng = np.random.default_rng(3)
    stopped = []
    for kind in ("force", "torques", "force"):
        with over_the_table() as (rig, step):
            panda, seen = rig.robots["panda"], []
            force = ([0.0, 0.0, -1.0] + 0.5 * rng.normal(size=3)) * rng.uniform(2.0, 12.0)
            tau = panda.kinematics.jacobian(OVER_THE_TABLE)[:3].T @ force
            if kind == "torques":
                tau = rng.normal(size=7) * [8.0, 8.0, 8.0, 8.0, 1.5, 1.5, 1.5]
            with panda.control(rate_hz=100) as control, contextlib.suppress(hal.MotionStopped):
                for _ in range(120):
                    control.send(hal.JointTorque(tau))
                    seen += [step(), step()]
            seen += [step() for _ in range(60)]
        assert min(distance for distance, _ in seen) >= 0.01
        stopped.append(any(limited for _, limited in seen))
    assert stopped.count(True) == 2


@pytest.mark.parametrize(("newtons", "least", "end"), [(0.0, 9.95e-3, ""), (20.0, 5e-3, "torque_limit")])
def test_a_compliant_arm_that_is_pushed_beyond_the_margin_is_held(newtons: float, least: float, end: str) -> None:
    with over_the_table() as (rig, step):
        seen, trip = [], ""
        with rig.robots["panda"].control(rate_hz=50, controller=hal.OperationalSpace()) as control:
            for k in range(120):
                if k == 80 and newtons:
                    rig.world.apply_force("panda", [0.0, 0.0, -newtons], link="panda_hand", duration=0.5)
                try:
                    control.send(hal.Twist([0.0, 0.0, -0.25 if k < 80 else 0.0]))
                except hal.MotionStopped as stop:
                    trip = stop.code
                seen += [step()[0] for _ in range(4)]
    assert least <= min(seen) <= 11e-3
    assert trip == end


SOAK = os.environ.get("HAL_SOAK") == "1"
STARTS = (
    [(arm, 100, seed) for arm in collisions.ARMS for seed in (11, 12)]
    if SOAK
    else [("so101", 1, 27), ("yam", 4, 5), ("openarm_right", 4, 5)]
)
"""From the start of the SO-101 stops of the joints one by one lead nearer, while the way home leads away."""


@pytest.mark.parametrize(("arm", "count", "seed"), STARTS)
def test_an_arm_inside_a_margin_comes_home_or_is_refused_at_once(arm: str, count: int, seed: int) -> None:
    found = collisions.starts(arm, count, seed)
    assert found["came home"] + found["refused at once"] == count
    assert found["came home"] >= count / 3


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
