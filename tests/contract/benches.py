"""Benches of the mock, of the simulation and of the emulated RealSense, for the contracts."""

from __future__ import annotations

import contextlib
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

import hal
from hal import registry
from hal.clock import LockStepClock, RealClock
from hal.drivers.mock.camera import MockCamera
from hal.drivers.mock.robot import MockGripper, MockRobot
from hal.drivers.served.camera import ServedCamera
from hal.remote.client import fetch_devices
from hal.remote.server import Server
from hal.specs import BodySpec, CameraSpec, GroupSpec, ViewSpec, WorldSpec
from hal.testing import CameraBench, GripperBench, RobotBench, WorldBench, camera_spec, gripper_spec, robot_spec

from ..kits.drives import ArmWithDrives
from ..kits.engines_kit import Engine, need_engine
from ..kits.specs import data, panda

FROM_ABOVE = ViewSpec((0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0))
BALL = BodySpec("ball", (0.0, 0.0, 0.1), (0.0, 0.0, 0.0, 1.0), "sphere", radius=0.1, mass=1.0)
FLOOR = BodySpec("floor", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "plane")
WORLD = WorldSpec("pybullet", 240.0, (0.0, 0.0, -9.81), (FLOOR, BALL), ())


def links(driver: Any) -> dict[str, Callable[[], None]]:
    """Return the fields of a bench that break, restore and silence the link of a driver that takes these faults."""
    return {
        "lose": lambda: driver.inject(disconnect=True),
        "restore": lambda: driver.inject(disconnect=False),
        "freeze": lambda: driver.inject(freeze=True),
    }


# Arms.


def _robot_bench(driver: Any, **more: Any) -> RobotBench:
    return RobotBench(driver=driver, fail=lambda: driver.inject(fault="too hot") or "too hot", **links(driver), **more)


@contextmanager
def mock_robot() -> Iterator[RobotBench]:
    driver = MockRobot(panda(driver="mock"))
    yield _robot_bench(driver)
    driver.close()


@contextmanager
def mock_robot_with_drives() -> Iterator[RobotBench]:
    driver = ArmWithDrives(panda(driver="mock"))
    yield _robot_bench(driver)
    driver.close()


@contextmanager
def three_joints() -> Iterator[RobotBench]:
    """The arm of :func:`hal.testing.robot_spec`, which has no URDF."""
    driver = MockRobot(robot_spec())
    yield _robot_bench(driver)
    driver.close()


@contextmanager
def simulated_robot(engine: Engine) -> Iterator[RobotBench]:
    world = engine.world(panda())
    driver = engine.robot(world)
    yield _robot_bench(driver, advance=world.step)
    driver.close()
    world.close()


# Grippers.


@contextmanager
def mock_gripper() -> Iterator[GripperBench]:
    driver = MockGripper(gripper_spec())
    yield GripperBench(driver=driver, put_object=lambda width: driver.inject(object_width=width), **links(driver))
    driver.close()


@contextmanager
def simulated_gripper(engine: Engine) -> Iterator[GripperBench]:
    world = engine.world(panda())
    arm, driver = engine.robot(world), engine.gripper(world)
    arm.open()
    x, y, z = world.pose("panda", "panda_hand")["position"]

    def put_object(width: float) -> None:
        place = (x, y, z - 0.1034)  # its fingers point down
        world.add(BodySpec("object", place, (0.0, 0.0, 0.0, 1.0), "sphere", radius=width / 2, fixed=True))

    yield GripperBench(driver=driver, advance=world.step, put_object=put_object)
    driver.close()
    arm.close()
    world.close()


# Worlds.


@contextmanager
def simulated_world(name: str) -> Iterator[WorldBench]:
    need_engine(name)
    yield WorldBench(name=name, make=registry.load(name, "world"))


# Cameras.


@contextmanager
def mock_camera() -> Iterator[CameraBench]:
    clock = RealClock()
    driver = MockCamera(camera_spec(capture_width=128, capture_height=96, rate_hz=60.0), clock)
    yield CameraBench(driver=driver, clock=clock, patience=1.0, **links(driver))
    driver.close()


class CameraComputer:
    """A computer with a mock camera that it serves, in this process."""

    def __init__(self) -> None:
        model = {"model": "pinhole", "capture": {"width": 128, "height": 96, "rate_hz": 60.0}}
        rig = {"robots": {}, "cameras": {"scene": {**model, "streams": ["color", "depth"]}}}
        self.rig = hal.open(rig, driver="mock", clock="real_time", pad="none")
        self.port = 0
        self.start()

    def start(self) -> None:
        """Serve at the port of the last time."""
        self._server = Server(self.rig, "127.0.0.1", self.port, lambda line: None)
        self.port = self._server.port
        self._thread = threading.Thread(target=self._server.run)
        self._thread.start()

    def stop(self) -> None:
        """End the server and its connections."""
        self._server.close()
        self._thread.join()

    def close(self) -> None:
        self.stop()
        self.rig.close()


@contextmanager
def served_camera() -> Iterator[CameraBench]:
    computer = CameraComputer()
    spec = fetch_devices(f"127.0.0.1:{computer.port}")["scene"]
    driver = ServedCamera(spec)
    freeze = partial(computer.rig.driver("scene").inject, freeze=True)
    yield CameraBench(driver=driver, patience=2.0, lose=computer.stop, restore=computer.start, freeze=freeze)
    driver.close()
    computer.close()


@contextmanager
def mock_camera_in_lock_step() -> Iterator[CameraBench]:
    clock = LockStepClock(lambda: bench.now, lambda t: None)
    driver = MockCamera(camera_spec(), clock)
    bench = CameraBench(driver=driver, clock=clock, **links(driver))
    yield bench
    driver.close()


@contextmanager
def pybullet_camera_in_lock_step() -> Iterator[CameraBench]:
    """A camera that renders the present state of the world in the caller's thread."""
    data("plane.urdf")
    from hal.drivers.pybullet.world import PyBulletWorld
    from hal.drivers.scene.camera import DirectSource, SimulatedCamera, choose_renderer
    from hal.drivers.scene.mirror import LocalMirror

    spec = camera_spec(driver="pybullet", view=FROM_ABOVE)
    world = PyBulletWorld(WORLD)
    mirror = LocalMirror(world)
    renderer = choose_renderer(mirror.drawn, "tiny")
    driver = SimulatedCamera(spec, DirectSource(mirror, renderer, spec, lambda: bench.now))
    clock = LockStepClock(lambda: bench.now, lambda t: None)
    bench = CameraBench(driver=driver, clock=clock, dt=world.dt, advance=world.step)
    yield bench
    driver.close()
    world.close()


class RenderedWorld:
    """A simulated world in real time with its render process, which serve many cameras in turn."""

    def __init__(self) -> None:
        data("plane.urdf")
        from hal.drivers.scene.camera import SimulatedPictures
        from hal.host.hosts import RemoteHost

        self.spec = camera_spec(driver="pybullet", view=FROM_ABOVE)
        self.host = RemoteHost(GroupSpec("simulation", "real_time", 240.0, (), WORLD))
        self.pictures = SimulatedPictures(self.host, [self.spec], "tiny")
        self.pictures.wait_ready()
        self.host.wait_ready()
        self.broken = False

    @contextmanager
    def camera(self) -> Iterator[CameraBench]:
        """One camera of the world."""
        from hal.drivers.scene.camera import SimulatedCamera

        driver = SimulatedCamera(self.spec, self.pictures.source(self.spec.name))
        yield CameraBench(driver=driver, lose=self._break, patience=5.0)
        driver.close()

    def _break(self) -> None:
        """Kill the render process."""
        self.broken = True
        child = self.pictures._child
        child.process.kill()
        child.process.wait()

    def close(self) -> None:
        with contextlib.suppress(Exception):
            self.pictures.close()
        self.host.close()


# RealSense cameras.


def _realsense_spec(**options: Any) -> CameraSpec:
    pytest.importorskip("pyrealsense2", reason="needs pyrealsense2: pip install 'robot-hal[realsense]'")
    streams = ("color", "depth", "infrared")
    return camera_spec(driver="realsense", width=424, height=240, depth_max=10.0, streams=streams, options=options)


@contextmanager
def software_realsense() -> Iterator[CameraBench]:
    """An emulated camera, which streams by itself."""
    spec = _realsense_spec(emulated={}, warm_up_s=0.0, stall_s=0.5)
    from hal.drivers.realsense.camera import RealSenseCamera

    driver = RealSenseCamera(spec)
    yield CameraBench(driver=driver, patience=5.0, **links(driver))
    driver.close()


def recording(folder: Path) -> str:
    """Write a recording of two seconds, and return its path."""
    from realsense_kit import write_recording

    file = folder / "recorded.db3"
    write_recording(file, _realsense_spec(), 60)
    return str(file)


@contextmanager
def played_realsense(file: str, *, paced: bool) -> Iterator[CameraBench]:
    """A recording that repeats, at its own rate or as fast as it is read."""
    from hal.drivers.realsense.camera import RealSenseCamera

    driver = RealSenseCamera(_realsense_spec(play=file, paced=paced, warm_up_s=0.0))
    yield CameraBench(driver=driver)
    driver.close()
