"""The contracts of arms and grippers, for every built-in model whose package is installed, on each engine."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import pytest
from benchmark_kit import load_benchmark
from engines_kit import Engine

import hal
from hal import registry
from hal.config import load
from hal.config.data_files import list_data
from hal.errors import ConfigError
from hal.skills import grasp, grasp_pose, locate_by_truth
from hal.testing import RobotBench, RobotContract

from .benches import _robot_bench

robots = load_benchmark("robots")
pytestmark = pytest.mark.slow
ENTRIES = [entry for model in list_data("robots") for entry in robots.entries(model)]
WITHOUT_TORQUES = ("so101", "xarm7")
SLOW = ("jaco",)
"""Their joints are slower than the motion of a check."""


def bench_of(*models: str, others: bool = False) -> Any:
    """Return the fixture with the benches of these models, or of all others."""
    entries = [entry for entry in ENTRIES if (entry["model"] in models) != others]

    @pytest.fixture(params=entries, ids=["-".join(entry.values()) for entry in entries])
    def bench(self: object, request: pytest.FixtureRequest, engine: Engine) -> Iterator[RobotBench]:
        yield from _bench(request.param, engine)

    return bench


def _bench(entry: dict[str, Any], engine: Engine) -> Iterator[RobotBench]:
    arms: dict[str, dict[str, Any]] = {"arm": entry}
    if first := [one for one in ENTRIES if "arm" in entry and one["model"] == entry["model"] and one != entry][:1]:
        arms = {"other": first[0], "arm": entry | {"same": "other"}}  # the arm without the body of their robot
    try:
        plan = load({"sim": True, "robots": arms}, engine=engine.name).resolve()
    except ConfigError as error:
        if all(problem.code == "missing_package" for problem in error.problems):
            pytest.skip(error.problems[0].message)
        raise
    world: Any = registry.load(engine.name, "world")(plan.world)
    driver: Any = engine.robot(world, "arm")
    yield _robot_bench(driver, advance=world.step, joint=0)  # 1 Nm throws the light wrist of a small arm
    driver.close()
    world.close()


class TestModels(RobotContract):
    bench = bench_of(*WITHOUT_TORQUES, *SLOW, others=True)


class TestModelsWithoutTorques(
    RobotContract,
    left_out={"torque": "1 Nm throws an SO-101, and the damping in the URDF of the xArm7 takes most of it"},
):
    bench = bench_of(*WITHOUT_TORQUES)


class TestSlowModels(RobotContract):
    bench = bench_of(*SLOW)
    test_set_points_are_followed = None  # type: ignore[assignment]  # its motion is too fast


def test_fingers_that_come_forward_grasp_a_low_object_with_more_clearance() -> None:
    box = {"name": "box", "shape": "box", "half_extents": [0.015, 0.015, 0.02], "mass": 0.1, "position": [0.5, 0, 0.0]}
    config = {"sim": True, "robots": {"arm": {"model": "ur5e"}}, "objects": ["floor", box]}
    try:
        rig = hal.open(config, clock="lock_step")
    except ConfigError as error:
        if all(problem.code == "missing_package" for problem in error.problems):
            pytest.skip(error.problems[0].message)
        raise
    with rig:
        arm = rig.robots["arm"]
        assert arm.gripper is not None
        found = locate_by_truth(rig, arm, "box")
        result = grasp(arm, grasp_pose(found, arm.gripper, clearance=0.03), width=found.width, speed=0.5)
        assert result, result.message
