"""The contract of a driver, and what a rig makes of this one.

pytest examples/tcp_arm
"""

from __future__ import annotations

import math
import os
import signal
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from fake_arm import HOME, FakeArm
from tcp_arm import STATE, TcpArm

import hal
from hal.testing import RobotBench, RobotContract, bench_of, robot_spec

RIG = Path(__file__).with_name("rig.yaml")


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


def test_a_pulled_cable_counts_as_lost() -> None:
    with tcp_arm() as bench:
        bench.driver.open()
        bench.freeze()  # no end of the connection is seen
        with pytest.raises(hal.ConnectionLost, match="silent"):
            for _ in bench.turns(1.0):
                bench.driver.read(bench.pass_time())


def test_half_of_the_first_state_is_no_lost_link() -> None:
    clients: list[socket.socket] = []
    state = STATE.pack(1, 4, 0, *HOME, *[0.0] * 6, *HOME)
    with socket.create_server(("127.0.0.1", 0)) as server:
        options = {"host": "localhost", "port": server.getsockname()[1]}
        driver = TcpArm(robot_spec(joints=6, rate_hz=250, initial=HOME, options=options))
        begin = threading.Thread(target=lambda: clients.append(server.accept()[0]) or clients[0].send(state[:50]))
        begin.start()
        driver.open()
        begin.join()
    with clients[0] as client:
        with pytest.raises(hal.ConnectionLost, match="connecting"):
            driver.read(1000.0)
        client.send(state[50:])
        assert driver.read(1000.004).seq == 1
        driver.close()


@pytest.fixture
def arm() -> Iterator[FakeArm]:
    arm = FakeArm()
    threading.Thread(target=arm.run, daemon=True).start()
    yield arm
    arm.unplug()


def find_children() -> set[int]:
    return set(map(int, Path(f"/proc/self/task/{os.getpid()}/children").read_text().split()))


def test_the_arm_stops_by_itself_when_its_host_process_is_killed(arm: FakeArm) -> None:
    before = find_children()
    with hal.open(RIG, sim=False, overrides=[f"robots.arm.real.port={arm.port}"]) as rig:
        (host,) = find_children() - before
        with (
            pytest.raises(hal.ConnectionLost),
            rig.robots["arm"].control(rate_hz=50, unattended=True) as control,
        ):
            for tick in rig.clock.rate(50):
                if max(arm.dq) > 0.05 and host:
                    os.kill(host, signal.SIGKILL)
                    host = 0
                control.send(hal.JointVelocity([0.1] * 6))
                assert tick.elapsed < 10.0
    assert host == 0
    end = time.monotonic() + 5.0
    while max(arm.dq) > 0.0:
        assert time.monotonic() < end
        time.sleep(0.01)


def test_nan_from_the_arm_stops_it_and_no_set_point_becomes_nan(arm: FakeArm) -> None:
    with hal.open(RIG, sim=False, overrides=[f"robots.arm.real.port={arm.port}"]) as rig:
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
