"""Arms on a bench."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

from hal.drivers.mock.robot import MockRobot
from hal.specs import WorldSpec
from hal.testing import RobotBench, robot_spec

from ..kits.specs import panda

__all__ = ["mock_robot", "pybullet_robot", "three_joints"]


def _bench(driver: MockRobot) -> RobotBench:
    return RobotBench(
        driver=driver,
        lose=lambda: driver.inject(disconnect=True),
        restore=lambda: driver.inject(disconnect=False),
        freeze=lambda: driver.inject(freeze=True),
        fail=lambda: driver.inject(fault="too hot") or "too hot",
    )


@contextmanager
def mock_robot() -> Iterator[RobotBench]:
    driver = MockRobot(panda(driver="mock"))
    yield _bench(driver)
    driver.close()


@contextmanager
def three_joints() -> Iterator[RobotBench]:
    """The arm of :func:`hal.testing.robot_spec`, of which there is no URDF."""
    driver = MockRobot(robot_spec())
    yield _bench(driver)
    driver.close()


@contextmanager
def pybullet_robot() -> Iterator[RobotBench]:
    from hal.drivers.pybullet.robot import PyBulletRobot
    from hal.drivers.pybullet.world import PyBulletWorld

    spec = panda(driver="pybullet")
    world = PyBulletWorld(WorldSpec("pybullet", 240.0, (0.0, 0.0, -9.81), (), (spec,)))
    driver = PyBulletRobot(spec, world)
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
