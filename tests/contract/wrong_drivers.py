"""Drivers that break one rule each. ``test_contract.py`` runs this file on its own, and reads pytest's output."""

from __future__ import annotations

import time
from collections.abc import Iterator

import numpy as np
import pytest

from hal import registry
from hal.clock import RealClock
from hal.drivers.mock.camera import MockCamera
from hal.drivers.mock.gamepad import MockPad
from hal.drivers.mock.robot import MockGripper, MockRobot
from hal.testing import (
    CameraBench,
    CameraContract,
    GamepadContract,
    GripperBench,
    GripperContract,
    PadBench,
    RobotBench,
    RobotContract,
    WorldBench,
    WorldContract,
    camera_spec,
    gripper_spec,
    pad_spec,
    robot_spec,
)

# Cameras.


class WrongCamera(CameraContract):
    driver = MockCamera

    @pytest.fixture
    def bench(self) -> Iterator[CameraBench]:
        driver = self.driver(camera_spec(rate_hz=100.0), RealClock())
        yield CameraBench(
            driver=driver,
            lose=lambda: driver.inject(disconnect=True),
            restore=lambda: driver.inject(disconnect=False),
            freeze=lambda: driver.inject(freeze=True),
            patience=0.5,
        )
        MockCamera.close(driver)


class TestShortPictures(WrongCamera):
    class driver(MockCamera):  # noqa: N801
        def open(self):
            super().open()
            self.inject(garbage="shape")


class TestMillimetres(WrongCamera):
    class driver(MockCamera):  # noqa: N801
        def grab(self, timeout):
            frame = super().grab(timeout)
            return frame and frame._replace(depth=frame.depth * 1000)


class TestOneBuffer(WrongCamera):
    class driver(MockCamera):  # noqa: N801
        buffer = None

        def grab(self, timeout):
            frame = super().grab(timeout)
            if frame is None:
                return None
            self.buffer = frame.color if self.buffer is None else self.buffer
            self.buffer.flags.writeable = True
            self.buffer[:] = frame.color
            return frame._replace(color=self.buffer)


class TestOldFrames(WrongCamera):
    class driver(MockCamera):  # noqa: N801
        kept = None

        def grab(self, timeout):
            self.kept = super().grab(timeout) or self.kept
            return self.kept


class TestOwnErrors(WrongCamera):
    class driver(MockCamera):  # noqa: N801
        def grab(self, timeout):
            try:
                return super().grab(timeout)
            except ConnectionError:
                raise RuntimeError("device gone") from None


class TestWallClock(WrongCamera):
    class driver(MockCamera):  # noqa: N801
        def grab(self, timeout):
            frame = super().grab(timeout)
            return frame and frame._replace(t=time.time())


class TestWideLens(WrongCamera):
    class driver(MockCamera):  # noqa: N801
        @property
        def info(self):
            from dataclasses import replace

            return replace(super().info, K=np.diag([60.0, 60.0, 1.0]))


# Arms.


class WrongRobot(RobotContract):
    driver = MockRobot

    @pytest.fixture
    def bench(self) -> Iterator[RobotBench]:
        driver = self.driver(robot_spec())
        yield RobotBench(
            driver=driver,
            lose=lambda: driver.inject(disconnect=True),
            restore=lambda: driver.inject(disconnect=False),
            freeze=lambda: driver.inject(freeze=True),
            fail=lambda: driver.inject(fault="too hot") or "too hot",
        )
        MockRobot.close(driver)


class TestDegrees(WrongRobot):
    class driver(MockRobot):  # noqa: N801
        def read(self, now):
            reading = super().read(now)
            return reading._replace(q=tuple(np.rad2deg(reading.q).tolist()))


class TestNewStamps(WrongRobot):
    class driver(MockRobot):  # noqa: N801
        def read(self, now):
            return super().read(now)._replace(t=now)


class TestSlowRead(WrongRobot):
    class driver(MockRobot):  # noqa: N801
        def read(self, now):
            time.sleep(0.008)
            return super().read(now)


class TestLimp(WrongRobot):
    """An arm that drops at ``halt``."""

    class driver(MockRobot):  # noqa: N801
        def halt(self):
            super().halt()
            q = [position + 0.3 for position in self._follows.q]
            self._follows = self._commanded = self._follows._replace(q=q)


class TestSinks(WrongRobot):
    """An arm that sinks when its host is gone."""

    class driver(MockRobot):  # noqa: N801
        def read(self, now):
            if now - self._now > 0.5:
                q = [position - 0.1 for position in self._follows.q]
                self._follows = self._commanded = self._follows._replace(q=q)
            return super().read(now)


class TestJumpsWhenEngaged(WrongRobot):
    """An arm that goes to zero when its drives are switched on."""

    class driver(MockRobot):  # noqa: N801
        engaged = False

        def engage(self):
            self.engaged = True
            self._follows = self._commanded = self._follows._replace(q=(0.0,) * len(self.spec.joints))


class TestFaultWithoutRemedy(WrongRobot):
    class driver(MockRobot):  # noqa: N801
        def read(self, now):
            from hal.errors import Fault

            reading = super().read(now)
            return reading._replace(fault=reading.fault and Fault("7", reading.fault.cause, ""))


# Grippers.


class WrongGripper(GripperContract):
    driver = MockGripper

    @pytest.fixture
    def bench(self) -> Iterator[GripperBench]:
        driver = self.driver(gripper_spec())
        yield GripperBench(
            driver=driver,
            put_object=lambda width: driver.inject(object_width=width),
            lose=lambda: driver.inject(disconnect=True),
            restore=lambda: driver.inject(disconnect=False),
            freeze=lambda: driver.inject(freeze=True),
        )
        MockGripper.close(driver)


class TestOpensAtStop(WrongGripper):
    class driver(MockGripper):  # noqa: N801
        def stop(self):
            super().stop()
            self.move(self.spec.width_max, self.spec.speed, self.spec.force)


class TestFullSpeed(WrongGripper):
    class driver(MockGripper):  # noqa: N801
        def move(self, width, speed, force):
            super().move(width, self.spec.speed, force)


class TestOpensAtClose(WrongGripper):
    class driver(MockGripper):  # noqa: N801
        def close(self):
            super().close()
            self._width = self.spec.width_max


# Pads.


class WrongPad(GamepadContract):
    driver = MockPad

    @pytest.fixture
    def bench(self) -> Iterator[PadBench]:
        driver = self.driver(pad_spec())
        yield PadBench(
            driver=driver,
            press=lambda: driver.press("south"),
            release=lambda: driver.release("south"),
            lose=lambda: driver.inject(disconnect=True),
            restore=lambda: driver.inject(disconnect=False),
            freeze=lambda: driver.inject(freeze=True),
        )
        MockPad.close(driver)


class TestAlwaysAlive(WrongPad):
    class driver(MockPad):  # noqa: N801
        def poll(self, now, timeout):
            return super().poll(now, timeout)._replace(t_alive=now)


class TestStuckButtons(WrongPad):
    class driver(MockPad):  # noqa: N801
        def poll(self, now, timeout):
            return super().poll(now, timeout)._replace(buttons=self._buttons)


class TestCounts(WrongPad):
    """Raw values of the device."""

    class driver(MockPad):  # noqa: N801
        def poll(self, now, timeout):
            return super().poll(now, timeout)._replace(axes={"left_x": 128.0})


class TestWaits(WrongPad):
    class driver(MockPad):  # noqa: N801
        def poll(self, now, timeout):
            time.sleep(0.01)
            return super().poll(now, timeout)


# Worlds.


class WrongWorld(WorldContract):
    engine = registry.choose_engine("auto")

    @pytest.fixture
    def bench(self) -> WorldBench:
        return WorldBench(name=self.engine, make=self.driver)


class TestStalePoses(WrongWorld):
    class driver(registry.load(WrongWorld.engine, "world")):  # noqa: N801
        def pose(self, name, link=None):
            self.kept = getattr(self, "kept", None) or super().pose(name, link)
            return self.kept


class TestMoreThanPoses(WrongWorld):
    class driver(registry.load(WrongWorld.engine, "world")):  # noqa: N801
        def set_pose(self, name, pose):
            super().set_pose(name, pose)
            self.revision += 1


# Benches.


class TestNoBench(CameraContract):
    pass


class TestForgotten(CameraContract):
    @pytest.fixture
    def bench(self) -> CameraBench:
        return CameraBench(driver=MockCamera(camera_spec(), RealClock()))


class TestBoth(WrongPad, left_out={"lose": "and the bench has one"}):
    pass
