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

robots = load_benchmark("robots")
pytestmark = pytest.mark.slow
ENTRIES = [entry for model in list_data("robots") for entry in robots.entries(model)]
WITHOUT_TORQUES = ("so101", "wx250s", "xarm7")
SLOW = ("jaco",)
"""Their joints are slower than the motion of a check."""


def of_models(*models: str, others: bool = False) -> Any:
    """Return the mark that runs a class for these models, or for all others."""
    entries = [entry for entry in ENTRIES if (entry["model"] in models) != others]
    ids = ["-".join(entry.values()) for entry in entries]
    return pytest.mark.parametrize("world", entries, ids=ids, indirect=True, scope="class")


@pytest.fixture(scope="class")
def world(request: pytest.FixtureRequest, engine: Engine) -> Iterator[Any]:
    """A world of a model."""
    world = _make_world(request.param, engine)
    yield world
    world.close()


def _make_world(entry: dict[str, Any], engine: Engine) -> Any:
    arms: dict[str, dict[str, Any]] = {"arm": entry}
    if first := [one for one in ENTRIES if "arm" in entry and one["model"] == entry["model"] and one != entry][:1]:
        arms = {"other": first[0], "arm": entry | {"same": "other"}}  # the arm without the body of their robot
    try:
        plan = load({"sim": True, "robots": arms}, engine=engine.name).resolve()
    except ConfigError as error:
        if all(problem.code == "missing_package" for problem in error.problems):
            pytest.skip(error.problems[0].message)
        raise
    return registry.load(engine.name, "world")(plan.world)


OF_THE_DRIVER = "the same for every model: test_drivers.py has it for a Panda on each engine"


class Models(RobotContract, left_out=dict.fromkeys(("lose", "restore", "freeze", "fail"), OF_THE_DRIVER)):
    """What depends on the model. All checks of a model run in one world, which each begins as it was made."""

    @pytest.fixture
    def bench(self, world: Any, engine: Engine) -> Iterator[RobotBench]:
        """The arm as the world was made."""
        world.request("reset", {})
        driver: Any = engine.robot(world, "arm")
        yield RobotBench(driver=driver, advance=world.step, joint=0)  # 1 Nm throws the light wrist of a small arm
        driver.close()


for _name in (
    "test_modes_are_declared",
    "test_read_and_write_do_not_block",
    "test_close_may_be_repeated_or_come_before_open",
    "test_another_thread_may_close",
    "test_a_driver_that_is_not_open_raises",
    "test_an_unknown_fault_to_inject_is_refused",
):
    assert hasattr(RobotContract, _name)
    setattr(Models, _name, None)


@of_models(*WITHOUT_TORQUES, *SLOW, others=True)
class TestModels(Models):
    pass


@of_models(*WITHOUT_TORQUES)
class TestModelsWithoutTorques(
    Models,
    left_out={"torque": "1 Nm throws small arms, and the damping in the URDF of the xArm7 takes most of it"},
):
    pass


@of_models(*SLOW)
class TestSlowModels(Models):
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
