"""The servo's side of ``move_to``."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from servo_kit import Bench
from specs import PANDA_HOME, panda

from hal.errors import CommandError
from hal.specs import WorkspaceSpec
from hal.types import Limited, RobotStatus, Trip

STEP = (0.8, 0.5, -0.4, 0.6, 0.3, -0.5, 1.2)
GOAL = tuple(x + d for x, d in zip(PANDA_HOME, STEP, strict=True))


def finish(bench: Bench, most: float = 20.0) -> None:
    begun = bench.now
    while not bench.servo.report.arrived:
        bench.tick()
        assert bench.now - begun < most


def off_line(bench: Bench) -> float:
    """Greatest distance of a set-point from the straight line in joint space, rad."""
    path = np.array(bench.history) - PANDA_HOME
    line = np.array(STEP) / np.linalg.norm(STEP)
    return float(np.abs(path - np.outer(path @ line, line)).max())


@pytest.mark.parametrize("speed", [1.0, 0.1])
def test_a_straight_line_at_the_speed_of_the_slowest_joint(speed: float) -> None:
    bench = Bench(speed=speed, move_to=GOAL)
    finish(bench)
    assert bench.q == pytest.approx(GOAL, abs=1e-12)
    assert off_line(bench) < 1e-9
    assert 0.9 * speed < bench.audit.peaks()["velocity"] <= speed
    bench.assert_within_limits()
    bench.run(0.2)
    assert (bench.status, bench.moving) == (RobotStatus.FOLLOWING, False)


def test_the_tcp_keeps_its_speed() -> None:
    bench = Bench(speed=1.0, tcp_speed=0.25, move_to=GOAL)
    finish(bench)
    tcp = np.array([bench.servo.kinematics.fk(q)[:3] for q in bench.history])
    fastest = np.linalg.norm(np.diff(tcp, axis=0), axis=1).max() / bench.dt
    assert 0.2 < fastest <= 0.25


@pytest.mark.parametrize("rate_hz", [240.0, 1000.0])
@pytest.mark.parametrize("speed", [0.02, 0.1, 0.3])
def test_the_arm_rests_only_at_the_end_of_a_long_way(rate_hz: float, speed: float) -> None:
    """All joints move, so that together they are faster than the slowest of them may be by itself."""
    goal = np.add(PANDA_HOME, [0.8, 0.5, -0.7, 0.6, 0.9, -0.6, 1.0])
    bench = Bench(rate_hz=rate_hz, speed=speed, tcp_speed=0.25, move_to=goal.tolist())
    finish(bench, 60.0)
    fastest = np.abs(np.diff(bench.history, axis=0)).max(axis=1) / bench.dt
    begun, end = np.flatnonzero(fastest > 1e-4)[[0, -1]]
    assert fastest[begun:end].min() > 1e-4
    assert not bench.limited & Limited.TCP_SPEED


@pytest.mark.parametrize(
    ("tcp_speed", "start", "way"),
    [
        (0.01, [0.147, -1.018, 0.349, -1.75, 0.296, 2.124, 0.313], [0.0, -0.015, 0.0, -0.005, 0.002, 0.007, 0.0]),
        (0.02, [-2.465, 1.486, -2.516, -1.198, 0.359, 1.597, 1.701], [0.0, 0.009, 0.0, -0.03, -0.039, 0.0, 0.007]),
    ],
)
def test_a_goal_is_reached_although_the_first_step_is_refused(tcp_speed, start, way):
    bench = Bench(speed=0.3, tcp_speed=tcp_speed, move_to=np.add(start, way).tolist(), begin=False)
    bench.q = start
    bench.servo.anchor(start)
    bench.begin()
    finish(bench)
    assert bench.limited & Limited.TCP_SPEED


def test_already_there() -> None:
    bench = Bench(move_to=PANDA_HOME)
    bench.tick()
    bench.tick()
    assert bench.servo.report.arrived


def test_a_deadman_that_is_held_already_counts_and_a_release_pauses() -> None:
    bench = Bench(deadman=True, move_to=GOAL, begin=False)
    bench.press()
    bench.begin()
    bench.run(0.3)
    assert bench.moving
    bench.release()
    bench.until_rest(0.5)
    assert (bench.status, bench.servo.report.arrived) == (RobotStatus.HOLDING, False)
    bench.run(0.5)
    assert not bench.moving
    bench.press()
    finish(bench)
    assert bench.q == pytest.approx(GOAL, abs=1e-12)
    bench.assert_within_limits()


def test_a_trip_latches_and_a_rearm_goes_on() -> None:
    bench = Bench(move_to=GOAL)
    bench.run(0.3)
    bench.stops += 1
    bench.until_rest(0.5)
    assert bench.trip is Trip.STOP
    bench.rearms += 1
    finish(bench)
    assert bench.q == pytest.approx(GOAL, abs=1e-12)
    bench.assert_within_limits()


def test_an_anchor_on_the_way_makes_a_new_plan() -> None:
    bench = Bench(move_to=GOAL)
    bench.run(0.3)
    bench.q = [x + 0.2 for x in PANDA_HOME]
    bench.servo.anchor(bench.q)
    bench.audit.reset()
    finish(bench)
    assert bench.q == pytest.approx(GOAL, abs=1e-12)
    bench.assert_within_limits()


def test_from_outside_a_limit_back_in() -> None:
    bench = Bench(begin=False, move_to=PANDA_HOME)
    bench.q = [bench.spec.limits.upper[0] + 0.05, *PANDA_HOME[1:]]
    bench.servo.anchor(bench.q)
    bench.begin()
    finish(bench)
    assert bench.q == pytest.approx(PANDA_HOME)


def test_goals_that_may_not_be_reached_are_refused() -> None:
    with pytest.raises(CommandError, match="joint 3"):
        Bench(move_to=[*PANDA_HOME[:3], 0.0, *PANDA_HOME[4:]])
    with pytest.raises(CommandError, match="7 joint positions"):
        Bench(move_to=PANDA_HOME[:6])
    with pytest.raises(CommandError):
        Bench(move_to=[float("nan")] * 7)
    box = WorkspaceSpec((-1.0, -0.2, 0.0), (1.0, 0.2, 1.0))
    with pytest.raises(CommandError, match="workspace"):
        Bench(replace(panda(), workspace=box), move_to=[1.5, *PANDA_HOME[1:]])
    bench = Bench(replace(panda(), workspace=box), move_to=[0.5, *PANDA_HOME[1:]])
    finish(bench)
