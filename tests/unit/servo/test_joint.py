"""Motions in joint space: move_to, and action chunks (joint targets with times)."""

from __future__ import annotations

import math
import random
from dataclasses import replace

import numpy as np
import pytest
from servo_kit import Bench, N, tightened
from specs import PANDA_HOME, panda

import hal
from hal.commands import CHUNK_AHEAD, CHUNK_POINTS, Kind
from hal.errors import CommandError, MotionStopped
from hal.servo.joint import slope
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
def test_a_goal_is_reached_at_a_low_speed_of_the_tcp(tcp_speed, start, way):
    bench = Bench(speed=0.3, tcp_speed=tcp_speed, move_to=np.add(start, way).tolist(), begin=False)
    bench.q = start
    bench.servo.anchor(start)
    bench.begin()
    finish(bench)
    tcp = np.array([bench.servo.kinematics.fk(q)[:3] for q in bench.history])
    fastest = np.linalg.norm(np.diff(tcp, axis=0), axis=1).max() / bench.dt
    assert 0.9 * tcp_speed < fastest <= tcp_speed


def test_a_moving_target_stands_still_after_its_deadline() -> None:
    """The servo refuses the later commands, which are in time: they do not take the place of one that it follows."""
    bench = Bench()
    bench.target(PANDA_HOME, [0.2] + [0.0] * 6)
    for _ in range(round(1.0 / bench.dt)):
        bench.tick()
        bench.send(Kind.JOINT_TARGET, [math.nan] * 2 * N)
    assert bench.trip is Trip.COMMAND_LATE
    assert 0.01 < bench.q[0] - PANDA_HOME[0] < 0.05  # 0.2 rad if it continued


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
    bench.rearm()
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


def swing(t: float) -> list[float]:
    """A smooth motion of two joints from home, which starts at rest."""
    away = 0.3 * (1.0 - math.cos(2.0 * t))
    return [x + away * (k == 0) - 0.5 * away * (k == 3) for k, x in enumerate(PANDA_HOME)]


def send(bench: Bench, times: list[float], points: list[list[float]]) -> int:
    """``times`` on the bench's clock."""
    values = [t - bench.now for t in times] + [x for q in points for x in q]
    return bench.send(Kind.JOINT_CHUNK, values, deadline=times[-1] - bench.now)


def follow(bench: Bench, seconds: float, *, period: float = 0.05, length: int = 16, every: int = 8) -> list[float]:
    """Chunks of ``length`` targets, a new one after ``every`` of them; how far the arm was from the curve, rad."""
    start, errors, sent = bench.now, [], -1
    for _ in range(round(seconds / bench.dt)):
        turn = int((bench.now - start + 1e-9) / period) // every
        if turn > sent:
            sent = turn
            times = [start + (turn * every + k) * period for k in range(length)]
            send(bench, times, [swing(t - start) for t in times])
        bench.tick()
        errors.append(max(abs(a - b) for a, b in zip(bench.q, swing(bench.now - start), strict=True)))
    return errors


@pytest.mark.parametrize(("period", "length", "every"), [(0.05, 16, 8), (0.1, 16, 8), (0.02, 100, 90), (0.02, 50, 7)])
def test_the_arm_is_where_the_targets_say_when_they_say(period: float, length: int, every: int) -> None:
    bench = Bench(rate_hz=1000.0)
    errors = follow(bench, 3.0, period=period, length=length, every=every)
    assert max(errors) < 0.01, "of a swing of 0.6 rad"
    assert bench.trip is Trip.NONE
    assert max(q[0] for q in bench.history) > PANDA_HOME[0] + 0.5
    bench.assert_within_limits()


def test_between_targets_it_goes_evenly() -> None:
    """At 10 Hz targets the arm neither stops at each nor passes one by."""
    bench = Bench()
    start = bench.now
    times = [start + 0.1 * k for k in range(20)]
    points = [[x + 0.04 * k * (i == 0) for i, x in enumerate(PANDA_HOME)] for k in range(20)]
    send(bench, times, points)
    speeds = []
    for _ in range(round(1.8 / bench.dt)):
        bench.tick()
        if 0.5 < bench.now - start < 1.7:
            speeds.append(bench.servo.report.dq_set[0])
    assert min(speeds) > 0.3, "of 0.4 rad/s"
    assert max(speeds) < 0.5


def test_a_new_chunk_replaces_the_rest_from_its_first_time_on() -> None:
    bench = Bench()
    start = bench.now
    up = [[x + 0.2 * k / 10 * (i == 0) for i, x in enumerate(PANDA_HOME)] for k in range(21)]
    send(bench, [start + 0.1 * k for k in range(21)], up)
    bench.run(0.5)
    # From 0.8 s on something else: back to where it is then. Until then the first one counts.
    there = [x + 0.16 * (i == 0) for i, x in enumerate(PANDA_HOME)]
    seq = send(bench, [start + 0.8, start + 1.5], [there, there])
    bench.run(0.25)
    assert bench.servo.report.target_seq == seq
    assert bench.q[0] == pytest.approx(PANDA_HOME[0] + 0.15, abs=0.01), "still on the first chunk's way"
    bench.run(0.7)
    assert bench.q == pytest.approx(there, abs=2e-3)
    bench.assert_within_limits()


def test_plans_on_one_grid_may_differ_by_rounding() -> None:
    """A step in the joint would be a wait and then a leap."""
    bench = Bench()
    start = bench.now
    ramp = [[x + 0.1 * 0.1 * k * (i == 0) for i, x in enumerate(PANDA_HOME)] for k in range(20)]
    send(bench, [start + 0.1 * k for k in range(20)], ramp)
    bench.run(0.3)
    later = [start + 0.6 + 0.1 * k + 1e-10 for k in range(10)]
    send(bench, later, ramp[6:16])
    speeds = []
    for _ in range(round(0.6 / bench.dt)):
        bench.tick()
        speeds.append(bench.servo.report.dq_set[0])
    assert min(speeds) > 0.08, "of 0.1 rad/s"
    assert max(speeds) < 0.12


def test_running_out_is_the_deadline() -> None:
    bench = Bench()
    times = [bench.now + 0.1 * k for k in range(6)]
    send(bench, times, [swing(t - times[0]) for t in times])
    bench.run(0.48)
    assert bench.trip is Trip.NONE
    bench.run(0.05)
    assert bench.trip is Trip.COMMAND_LATE
    bench.until_rest()
    bench.assert_within_limits()


def test_a_chunk_that_begins_later_is_gone_to_from_here() -> None:
    bench = Bench()
    goal = [x + 0.08 * (k == 2) for k, x in enumerate(PANDA_HOME)]
    send(bench, [bench.now + 0.5, bench.now + 1.0], [goal, goal])
    bench.run(0.25)
    assert 0.01 < bench.q[2] - PANDA_HOME[2] < 0.07
    bench.run(0.7)
    assert bench.q == pytest.approx(goal, abs=2e-3)
    bench.assert_within_limits()


def test_a_released_dead_man_forgets_the_rest_of_a_chunk() -> None:
    bench = Bench(deadman=True)
    bench.tick()
    bench.press()
    bench.tick()
    start = bench.now
    times = [start + 0.1 * k for k in range(20)]
    send(bench, times, [swing(t - start) for t in times])
    bench.run(0.8)
    assert bench.moving
    bench.release()
    bench.until_rest()
    there = list(bench.q)
    bench.press()
    bench.run(0.5)
    assert bench.q == pytest.approx(there), "nothing is resumed after a new press"
    assert bench.trip is Trip.NONE


@pytest.mark.parametrize("where", ["far", "short", "backwards", "nan"])
def test_what_cannot_be_followed_is_refused_and_moves_nothing(where: str) -> None:
    bench = Bench()
    home, far = list(PANDA_HOME), [x + 0.2 * (k == 1) for k, x in enumerate(PANDA_HOME)]
    values = {
        "far": [0.0, 0.5, *far, *far],
        "short": [0.0, 0.5, *home, *home[:-1]],
        "backwards": [0.5, 0.1, *home, *home],
        "nan": [0.0, 0.5, *home, math.nan, *home[1:]],
    }[where]
    seq = bench.send(Kind.JOINT_CHUNK, values, deadline=0.5)
    bench.run(0.2)
    assert bench.servo.report.refused == seq
    assert bench.q == pytest.approx(PANDA_HOME)


@pytest.mark.parametrize("seed", range(20))
def test_wild_chunks_never_break_a_limit(seed: int) -> None:
    rng = random.Random(seed)
    bench = Bench(rate_hz=rng.choice([240.0, 1000.0]), speed=rng.uniform(0.1, 1.0))
    lower, upper = bench.spec.limits.lower, bench.spec.limits.upper
    for _ in range(8):
        count = rng.randint(1, 20)
        times = [bench.now + rng.uniform(-0.2, 0.3)]
        for _ in range(count - 1):
            times.append(times[-1] + rng.uniform(0.005, 0.2))
        if times[-1] <= bench.now:
            times.append(bench.now + 0.1)
        points = [[rng.uniform(low - 0.2, high + 0.2) for low, high in zip(lower, upper, strict=True)] for _ in times]
        if bench.servo.report.target_seq == 0:
            points = [list(PANDA_HOME), *points[1:]]
            times = [bench.now - 0.01, *sorted(t + 0.4 for t in times[1:])]
        send(bench, times, points)
        bench.run(rng.uniform(0.05, 0.6))
        bench.rearm()
    bench.until_rest(10.0)
    assert max(abs(q[0] - PANDA_HOME[0]) for q in bench.history) > 0.01
    bench.assert_within_limits()


def test_slopes_are_those_of_a_monotone_curve() -> None:
    assert slope(2.0, 2.0, 0.1, 0.3) == pytest.approx(2.0)
    assert slope(1.0, -1.0, 0.1, 0.1) == 0.0
    assert slope(0.0, 5.0, 0.1, 0.1) == 0.0
    assert 0.0 < slope(1.0, 4.0, 0.1, 0.1) < 3.0, "never above three times the flatter secant"


# Through the public session.


def test_a_policy_that_predicts_chunks() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        arm = rig.robots["panda"]
        home = arm.state().q
        with arm.control(rate_hz=2.5, speed=0.3) as control:
            for tick in rig.clock.rate(2.5):
                now = rig.clock.now()
                times = now + 0.1 * np.arange(8)
                away = np.minimum(0.1 * (times - times[0] + tick.elapsed), 0.2)
                control.send(hal.JointChunk(times, home + away[:, None] * np.eye(arm.n)[0]))
                if tick.elapsed > 3.0:
                    break
            assert arm.state().q[0] - home[0] == pytest.approx(0.2, abs=2e-3)
            rig.clock.sleep(1.0)
            with pytest.raises(MotionStopped, match="stopped coming"):
                control.send(hal.JointChunk([rig.clock.now(), rig.clock.now() + 0.5], [arm.state().q] * 2))


def test_what_a_chunk_must_be() -> None:
    q = np.zeros((3, N))
    for t, points, why in (
        ([0.0, 0.1], q, "shape"),
        ([0.0, 0.2, 0.1], q, "increase"),
        ([0.0, 0.1, math.inf], q, "finite"),
        ([0.0, 0.1, 0.2], q * math.nan, "finite"),
        ([], np.zeros((0, N)), "1 to 256"),
        (np.arange(CHUNK_POINTS + 1.0), np.zeros((CHUNK_POINTS + 1, N)), "1 to 256"),
    ):
        with pytest.raises(CommandError, match=why):
            hal.JointChunk(t, points)


def test_what_this_arm_cannot_follow_is_said_before_it_is_sent() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        arm = rig.robots["panda"]
        home, now = arm.state().q, rig.clock.now()
        with arm.control(rate_hz=10) as control:
            for t, points, why in (
                ([now + 0.1], [home[:-1]], "7 joints"),
                ([now - 1.0, now - 0.5], [home, home], "rig.clock"),
                ([now, now + CHUNK_AHEAD + 0.1], [home, home], "into the future"),
                ([now, now + 0.1], [home + 0.2, home], "move_to first"),
            ):
                with pytest.raises(CommandError, match=why):
                    control.send(hal.JointChunk(t, points))
                rig.clock.sleep(0.01)
                with pytest.raises(CommandError):
                    control.send(hal.JointChunk(t, points))
            high = np.vstack([home, np.where(np.arange(arm.n) == 1, 9.0, home)])
            sent = control.send(hal.JointChunk([rig.clock.now(), rig.clock.now() + 1.0], high))
            assert "position limit of panda_joint2" in sent.reasons[0]
            assert isinstance(sent.command, hal.JointChunk)
            assert sent.command.q[1, 1] == arm.limits.upper[1]


def test_a_full_chunk_travels_whole_to_the_servos_process() -> None:
    """The largest one, in real time: it passes through the memory that both processes share."""
    with hal.open("panda_table", driver="mock", clock="real_time", pad="none") as rig:
        arm = rig.robots["panda"]
        home = arm.state().q
        with arm.control(rate_hz=10) as control:
            times = rig.clock.now() + np.linspace(0.0, 1.0, CHUNK_POINTS)
            points = home + (0.1 * (times - times[0]))[:, None] * np.eye(arm.n)[0]
            control.send(hal.JointChunk(times, points))
            rig.clock.sleep_until(times[-1] - 0.1)
            state = arm.state()
            due = np.interp(state.stamp.t, times, points[:, 0])
            assert state.q[0] == pytest.approx(due, abs=5e-3)
            assert state.q[0] > home[0] + 0.05


def test_a_stream_brakes_with_the_jerk_that_is_allowed_at_present() -> None:
    soft = Bench(replace(panda(), limits=tightened(panda().limits, 1.0, 0.01)))
    lowered = Bench()
    for bench in (soft, lowered):
        for k in range(60):
            if k == 10:
                bench.servo.smoother.limit_jerk(soft.servo.smoother.jerk)
            ahead = 0.0 if k < 10 else min(1.5, 0.08 * (k - 10))
            bench.send(Kind.JOINT_TARGET, [PANDA_HOME[0] + ahead + 1e-12 * k, *PANDA_HOME[1:], *[0.0] * N])
            bench.run(0.05)
    assert lowered.q[0] > PANDA_HOME[0] + 1.4
    assert np.array(lowered.history) == pytest.approx(np.array(soft.history), abs=1e-6)
