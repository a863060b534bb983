"""A gripper whose driver needs a process of its own: what becomes of it is no business of the arm."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import pytest
from waiting import wait_until

import hal
from hal import ConnectionLost, GripperOutcome, JointTarget, JointVelocity, MotionStopped
from hal.host.hosts import RemoteHost

pytestmark = pytest.mark.slow

DRIVER = """
import time

from hal.drivers.mock.robot import MockGripper
from hal.errors import ConnectionLost
from hal.registry import DriverSpec

HAND = DriverSpec("hand", gripper="lab_hand:Hand", own_process=frozenset({"gripper"}))
NO_HAND = DriverSpec("no_hand", gripper="lab_hand:NoHand", own_process=frozenset({"gripper"}))


class Hand(MockGripper):
    def home(self):
        time.sleep(0.7)  # a vendor's call that blocks
        super().home()


class NoHand(MockGripper):
    def open(self):
        raise ConnectionLost("nobody listens at 192.0.2.1")
"""


@pytest.fixture
def lab(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "lab_hand.py").write_text(DRIVER)
    monkeypatch.syspath_prepend(tmp_path)


def open_rig(driver: str, clock: str = "real_time", *more: str) -> hal.Rig:
    overrides = ["cameras={}", f"robots.panda.gripper.drivers={{sim: 'lab_hand:{driver}'}}", *more]
    return hal.open("panda_table", sim=True, clock=clock, pad="none", overrides=overrides)


@pytest.fixture
def rig(lab: None) -> Iterator[hal.Rig]:
    with open_rig("HAND") as opened:
        yield opened


def hand_of(rig: hal.Rig) -> hal.gripper.Gripper:
    gripper = rig.robots["panda"].gripper
    assert gripper is not None
    return gripper


def host_of(rig: hal.Rig, name: str) -> RemoteHost:
    (host,) = (host for host in rig._hosts if host.spec.name == name)
    assert isinstance(host, RemoteHost)
    return host


def test_the_gripper_works_as_any_other(rig: hal.Rig) -> None:
    assert {host.spec.name for host in rig._hosts} == {"simulation", "panda.gripper"}
    arm, hand = rig.robots["panda"], hand_of(rig)
    assert hand.move(0.04).width == pytest.approx(0.04, abs=1e-3)
    hand.inject(object_width=0.03)
    assert hand.grasp(0.03)
    assert not hand.grasp(0.01)
    assert hand.open().width == pytest.approx(hand.width_max, abs=1e-3)
    with arm.control(rate_hz=5) as control:
        for tick in rig.clock.rate(50):
            control.send(JointTarget(arm.home), grip=0.25)
            if hand.state(max_age=1.0).width_target == pytest.approx(0.75 * hand.width_max):
                break
            assert tick.elapsed < 10.0
    statistics = rig.statistics()["panda.gripper"]
    assert statistics["robots"] == {}
    assert statistics["ticks"] > 0


def test_a_stop_of_the_rig_reaches_it(rig: hal.Rig) -> None:
    hand = hand_of(rig)
    motion = hand.start(0.0, speed=0.02)
    wait_until(lambda: hand.state().width < 0.07)
    rig.stop()
    result = motion.wait()
    assert result.outcome is GripperOutcome.STOPPED
    assert 0.01 < result.state.width < 0.07
    with pytest.raises(MotionStopped, match="rearm"):
        hand.start(0.0)
    rig.rearm()
    assert hand.home().width == pytest.approx(hand.width_max, abs=1e-3)


@pytest.mark.parametrize("clock", ["real_time", "lock_step"])
def test_it_stops_with_the_session_of_its_arm(lab: None, clock: str) -> None:
    with open_rig("HAND", clock, "robots.panda.gripper.speed=0.02") as rig:
        arm, hand, deadman = rig.robots["panda"], hand_of(rig), hal.Deadman("the test's")

        def drive(control: hal.Control, held: bool, until: Callable[[], bool]) -> None:
            for tick in rig.clock.rate(50):
                deadman.update(held, True, rig.clock.now())
                control.send(JointVelocity([0.01, 0, 0, 0, 0, 0, 0]), grip=1.0)
                if until():
                    return
                assert tick.elapsed < 10.0

        deadman.update(False, True, rig.clock.now())
        with arm.control(deadman=deadman, rate_hz=5) as control:
            drive(control, True, lambda: hand.state().width < 0.075)
            drive(control, False, lambda: hand.state().outcome is GripperOutcome.STOPPED)
            stopped = hand.state().width
            assert stopped > 0.02
            drive(control, True, lambda: hand.state().width < stopped - 0.005)
        wait_until(lambda: hand.state().outcome is GripperOutcome.STOPPED or rig.clock.sleep(0.01))


def test_an_arm_does_not_wait_for_a_gripper_that_is_slow_or_dead(rig: hal.Rig) -> None:
    arm, hand = rig.robots["panda"], hand_of(rig)
    child = host_of(rig, "panda.gripper").child.process
    slowest, sent = 0.0, 0
    with arm.control(rate_hz=5) as control:
        start = np.array(arm.state().q_set)
        for turn, tick in enumerate(rig.clock.rate(50)):
            if turn == 10:
                hand.start_home()  # blocks its process for a while
            if turn == 30:
                os.kill(child.pid, signal.SIGSTOP)
            if turn == 50:
                os.kill(child.pid, signal.SIGKILL)
            before = time.monotonic()
            control.send(JointVelocity([0.1, 0, 0, 0, 0, 0, 0]), grip=(turn // 5) % 2)
            slowest, sent = max(slowest, time.monotonic() - before), sent + 1
            if tick.elapsed > 2.0:
                break
        assert sent > 20
        assert slowest < 0.5, "as long as its process blocks, and much less than for ever"
        assert arm.state().q_set[0] - start[0] > 0.1, "it went on"
    child.wait(5.0)
    with pytest.raises(ConnectionLost, match=r"the panda\.gripper process ended"):
        hand.state()
    with pytest.raises(ConnectionLost):
        hand.start(0.0)
    with pytest.raises(ConnectionLost):
        hand.stop()
    assert "process ended" in hand.trouble
    arm.move_to(arm.home, speed=0.5)
    rig.close()


def test_a_motion_that_loses_its_process_says_so(rig: hal.Rig) -> None:
    hand = hand_of(rig)
    motion = hand.start(0.0, speed=0.01)
    wait_until(lambda: hand.state().moving)
    host_of(rig, "panda.gripper").child.process.kill()
    with pytest.raises(ConnectionLost):
        motion.wait()
    with pytest.raises(ConnectionLost):
        _ = motion.done


def test_its_process_ends_with_the_arms(lab: None) -> None:
    with open_rig("HAND") as rig:
        children = [host_of(rig, name).child.process for name in ("simulation", "panda.gripper")]
    assert [child.returncode for child in children] == [0, 0]


def test_a_hand_that_is_not_there_is_told_when_the_rig_is_opened(lab: None) -> None:
    with pytest.raises(ConnectionLost, match=r"panda\.gripper cannot be opened: nobody listens.*enabled: false"):
        open_rig("NO_HAND")
