"""Cameras on a bench."""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from contextlib import contextmanager

from hal.clock import LockStepClock, RealClock
from hal.drivers.mock.camera import MockCamera
from hal.specs import BodySpec, GroupSpec, ViewSpec, WorldSpec
from hal.testing import CameraBench, camera_spec

from ..kits.specs import data

__all__ = ["Studio", "mock_camera", "mock_camera_in_lock_step", "pybullet_camera_in_lock_step"]

STREAMS = ("color", "depth", "infrared", "segmentation")
FROM_ABOVE = ViewSpec((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
BALL = BodySpec("ball", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0), "sphere", radius=0.1, mass=1.0)
FLOOR = BodySpec("floor", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "plane")
WORLD = WorldSpec("pybullet", 240.0, (0.0, 0.0, -9.81), (FLOOR, BALL), ())


@contextmanager
def mock_camera() -> Iterator[CameraBench]:
    clock = RealClock()
    driver = MockCamera(camera_spec(capture_width=128, capture_height=96, rate_hz=60.0), clock)
    yield CameraBench(
        driver=driver,
        clock=clock,
        patience=1.0,
        lose=lambda: driver.inject(disconnect=True),
        restore=lambda: driver.inject(disconnect=False),
        freeze=lambda: driver.inject(freeze=True),
    )
    driver.close()


@contextmanager
def mock_camera_in_lock_step() -> Iterator[CameraBench]:
    clock = LockStepClock(lambda: bench.now, lambda t: None)
    driver = MockCamera(camera_spec(), clock)
    bench = CameraBench(
        driver=driver,
        clock=clock,
        lose=lambda: driver.inject(disconnect=True),
        restore=lambda: driver.inject(disconnect=False),
        freeze=lambda: driver.inject(freeze=True),
    )
    yield bench
    driver.close()


@contextmanager
def pybullet_camera_in_lock_step() -> Iterator[CameraBench]:
    """The caller's thread draws the present state of the world."""
    data("plane.urdf")
    from hal.drivers.pybullet.camera import DirectSource, PyBulletCamera, TinyRenderer
    from hal.drivers.pybullet.world import PyBulletWorld

    spec = camera_spec(driver="pybullet", view=FROM_ABOVE)
    world = PyBulletWorld(WORLD)
    driver = PyBulletCamera(spec, DirectSource(world, TinyRenderer(world), spec, lambda: bench.now))
    clock = LockStepClock(lambda: bench.now, lambda t: None)
    bench = CameraBench(driver=driver, clock=clock, dt=world.dt, advance=world.step)
    yield bench
    driver.close()
    world.close()


class Studio:
    """A simulated world in real time and the process that draws its pictures, which serve many cameras in turn."""

    def __init__(self) -> None:
        data("plane.urdf")
        from hal.drivers.pybullet.camera import PyBulletPictures
        from hal.host.hosts import RemoteHost

        self.spec = camera_spec(driver="pybullet", view=FROM_ABOVE)
        self.host = RemoteHost(GroupSpec("simulation", "real_time", 240.0, (), WORLD))
        self.pictures = PyBulletPictures(self.host, [self.spec], "tiny")
        self.pictures.wait_ready()
        self.host.wait_ready()
        self.broken = False

    @contextmanager
    def camera(self) -> Iterator[CameraBench]:
        """One camera."""
        from hal.drivers.pybullet.camera import PyBulletCamera

        driver = PyBulletCamera(self.spec, self.pictures.source(self.spec.name))
        yield CameraBench(driver=driver, lose=self._break, patience=5.0)
        driver.close()

    def _break(self) -> None:
        """The process that draws is killed."""
        self.broken = True
        child = self.pictures._child
        assert child is not None
        child.process.kill()
        child.process.wait()

    def close(self) -> None:
        with contextlib.suppress(Exception):
            self.pictures.close()
        self.host.close()
