"""Grippers on a bench."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from hal.drivers.mock.robot import MockGripper
from hal.specs import BodySpec, WorldSpec
from hal.testing import GripperBench, gripper_spec

from ..kits.specs import panda

__all__ = ["mock_gripper", "pybullet_gripper"]


@contextmanager
def mock_gripper() -> Iterator[GripperBench]:
    driver = MockGripper(gripper_spec())
    yield GripperBench(
        driver=driver,
        put_object=lambda width: driver.inject(object_width=width),
        lose=lambda: driver.inject(disconnect=True),
        restore=lambda: driver.inject(disconnect=False),
        freeze=lambda: driver.inject(freeze=True),
    )
    driver.close()


@contextmanager
def pybullet_gripper() -> Iterator[GripperBench]:
    from hal.drivers.pybullet.gripper import PyBulletGripper
    from hal.drivers.pybullet.robot import PyBulletRobot
    from hal.drivers.pybullet.world import PyBulletWorld

    spec = panda(driver="pybullet")
    assert spec.gripper is not None
    world = PyBulletWorld(WorldSpec("pybullet", 240.0, (0.0, 0.0, -9.81), (), (spec,)))
    arm = PyBulletRobot(spec, world)
    arm.open()
    driver = PyBulletGripper(spec.gripper, world)
    x, y, z = world.pose("panda", "panda_hand")["position"]

    def put_object(width: float) -> None:
        place = (x, y, z - 0.1034)  # its fingers point down
        world.add(BodySpec("thing", place, (0.0, 0.0, 0.0, 1.0), "sphere", radius=width / 2, fixed=True))

    yield GripperBench(driver=driver, advance=world.step, put_object=put_object)
    driver.close()
    arm.close()
    world.close()
