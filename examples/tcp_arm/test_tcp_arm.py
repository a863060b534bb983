"""The contract of a driver, and what a rig makes of this one.

pytest examples/tcp_arm
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fake_arm import HOME, WATCHDOG, FakeArm
from tcp_arm import TcpArm

import hal
from hal.driver import Setpoint
from hal.testing import RobotBench, RobotContract, bench_of, robot_spec


@contextmanager
def tcp_arm() -> Iterator[RobotBench]:
    arm = FakeArm()
    options = {"host": "127.0.0.1", "port": arm.port}
    driver = TcpArm(robot_spec(joints=6, rate_hz=250, initial=HOME, options=options))
    yield RobotBench(
        driver=driver,
        advance=arm.step,
        patience=2.0,
        lose=arm.unplug,
        restore=arm.plug,
        freeze=lambda: setattr(arm, "silent", True),
        fail=lambda: setattr(arm, "fault", 7) or "too hot",
    )
    driver.close()
    arm.unplug()


class TestTcpArm(RobotContract, left_out={"torque": "it takes positions"}):
    bench = bench_of(tcp_arm)


def test_the_arm_stops_by_itself_when_the_program_is_killed() -> None:
    with tcp_arm() as bench:
        bench.driver.open()
        bench.driver.read(bench.pass_time())
        bench.driver.write(Setpoint(HOME, (0.5,) * 6, (0.0,) * 6))
        assert max(bench.driver.read(bench.pass_time()).dq) == 0.5
        for _ in range(WATCHDOG):
            bench.pass_time()  # no write, no read, no close
        assert max(bench.driver.read(bench.pass_time()).dq) == 0.0


def test_a_pulled_cable_counts_as_lost() -> None:
    with tcp_arm() as bench:
        bench.driver.open()
        bench.freeze()  # no end of the connection is seen
        with pytest.raises(hal.ConnectionLost, match="silent"):
            for _ in bench.turns(1.0):
                bench.driver.read(bench.pass_time())


@pytest.fixture
def arm() -> Iterator[FakeArm]:
    arm = FakeArm()
    threading.Thread(target=arm.run, daemon=True).start()
    yield arm
    arm.unplug()


def test_nan_from_the_arm_stops_it_and_no_set_point_becomes_nan(arm: FakeArm) -> None:
    rig_file = Path(__file__).with_name("rig.yaml")
    with hal.open(rig_file, sim=False, overrides=[f"robots.arm.real.port={arm.port}"]) as rig:
        robot = rig.robots["arm"]
        with (
            pytest.raises(hal.MotionStopped, match="impossible"),
            robot.control(rate_hz=50, unattended=True) as control,
        ):
            for tick in rig.clock.rate(50):
                control.send(hal.JointVelocity([0.1] * 6))
                arm.nan = arm.nan or tick.elapsed > 0.3
                assert tick.elapsed < 10.0
        moved = len(arm.log)
        assert moved > 10
        assert all(map(math.isfinite, (x for setpoint in arm.log for x in setpoint)))
        arm.nan, since = False, rig.clock.now()
        while robot.state(max_age=math.inf).stamp.t <= since:
            rig.clock.sleep(0.01)
        goal = robot.home + 0.05
        assert abs(robot.move_to(goal, unattended=True).q - goal).max() < 1e-6
        assert len(arm.log) > moved
