"""The engine of this folder as its author tests it: the contracts of worlds and arms.

``tests/contract/test_outside_engine.py`` runs this folder elsewhere, as a package that is installed beside robot-hal.
"""

from __future__ import annotations

from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory

import pytest
from kinematic_engine import KinematicRobot, KinematicWorld

import hal
from hal.testing import RobotBench, RobotContract, WorldBench, WorldContract, bench_of


class TestKinematicWorld(WorldContract, left_out={"physics": "nothing falls or collides"}):
    @pytest.fixture
    def bench(self) -> WorldBench:
        return WorldBench(name="kinematic", make=KinematicWorld)


@contextmanager
def kinematic_arm():
    with TemporaryDirectory() as folder:
        worlds = WorldBench(name="kinematic", make=KinematicWorld)
        spec = worlds.arm(Path(folder))
        world = worlds.world(spec)
        driver = KinematicRobot(spec, world)
        yield RobotBench(
            driver=driver,
            advance=world.step,
            lose=lambda: driver.inject(disconnect=True),
            restore=lambda: driver.inject(disconnect=False),
            freeze=lambda: driver.inject(freeze=True),
            fail=lambda: driver.inject(fault="too hot") or "too hot",
        )
        driver.close()
        world.close()


class TestKinematicRobot(RobotContract, left_out={"torque": "nothing has a mass"}):
    bench = bench_of(kinematic_arm)


def test_a_rig_is_opened_with_the_engine_by_its_name():
    robots = {"arm": {"model": "panda", "gripper": {"enabled": False}}}
    with hal.open({"robots": robots, "simulation": {"engine": "kinematic"}}, sim=True, clock="lock_step") as rig:
        arm = rig.robots["arm"]
        goal = arm.home + 0.1
        assert abs(arm.move_to(goal).q - goal).max() < 1e-6
