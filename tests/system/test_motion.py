"""Motions in the background, with the servo in a process of its own."""

from __future__ import annotations

import os
import signal
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest
from waiting import wait_until

import hal
from hal.deadman import Deadman

DOWN = np.array([0.1, 0.15, -0.1])


def open_rig() -> hal.Rig:
    return hal.open("panda_table", driver="mock", clock="real_time", pad="none", overrides=["cameras={}"])


@pytest.fixture
def rig() -> Iterator[hal.Rig]:
    with open_rig() as opened:
        yield opened


class Switch:
    """A dead-man switch whose device is alive, in a thread of its own."""

    def __init__(self, rig: hal.Rig) -> None:
        self.deadman = Deadman("switch of the test")
        self.pressed = False
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, args=(rig.clock,))
        self._thread.start()

    def _run(self, clock: hal.Clock) -> None:
        while not self._over.wait(0.01):
            self.deadman.update(pressed=self.pressed, connected=True, t_alive=clock.now())

    def close(self) -> None:
        self._over.set()
        self._thread.join()


def off_line(arm: hal.Robot, start: hal.Pose, goal: hal.Pose) -> float:
    """Return the distance of the tcp's set-point from the line between two poses, m."""
    way = goal.position - start.position
    here = arm.fk(arm.state().q_set).position - start.position
    return float(np.linalg.norm(here - way * (here @ way) / (way @ way)))


def test_a_line_is_paused_by_its_deadman_and_continued_to_its_end(rig: hal.Rig) -> None:
    arm, switch = rig.robots["panda"], Switch(rig)
    start = arm.fk(arm.state().q_set)
    goal = hal.Pose(start.position + DOWN, start.orientation)
    try:
        motion = arm.start_move_to(goal, straight=True, speed=0.3, deadman=switch.deadman)
        time.sleep(0.2)
        assert motion.progress == 0.0
        switch.pressed = True
        wait_until(lambda: motion.progress > 0.2)
        switch.pressed = False
        wait_until(lambda: not arm.state().dq_set.any())
        paused = motion.progress
        assert 0.2 < paused < 1.0
        assert off_line(arm, start, goal) < 5e-4
        with pytest.raises(TimeoutError):
            motion.wait(0.2)
        assert motion.progress == paused
        assert not motion.done
        switch.pressed = True
        result = motion.wait(10.0)
        assert result
        assert result.progress == motion.progress == 1.0
        assert arm.fk(arm.state().q_set).distance(goal)[0] < 1e-4
    finally:
        switch.close()


def test_a_cancelled_motion_ends_on_its_way_and_the_next_one_can_begin(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    start = arm.fk(arm.state().q_set)
    goal = hal.Pose(start.position + DOWN, start.orientation)
    corner = hal.Pose(goal.position + [0.0, 0.1, 0.0], goal.orientation)
    motion = arm.start_move_along([goal, corner], speed=0.1)
    with pytest.raises(hal.ControlTaken):
        arm.start_move_to(arm.home)
    wait_until(lambda: motion.progress > 0.1)
    motion.cancel()
    result = motion.wait(10.0)
    assert result.outcome is hal.MotionOutcome.CANCELLED
    assert 0.1 < result.progress < 0.7
    assert off_line(arm, start, goal) < 5e-4
    assert arm.start_move_to(arm.home, speed=0.5).wait(10.0)


def test_a_host_that_is_killed_ends_a_motion() -> None:
    rig = open_rig()
    motion = rig.robots["panda"].start_move_to(rig.robots["panda"].home + 0.2)
    wait_until(lambda: motion.progress > 0.05)
    os.kill(rig._hosts[0].child.process.pid, signal.SIGKILL)
    with pytest.raises(hal.ConnectionLost):
        motion.wait(10.0)
    with pytest.raises(hal.ConnectionLost):
        assert motion.done
    with pytest.raises(hal.ConnectionLost):  # the motion was not over
        rig.close()
