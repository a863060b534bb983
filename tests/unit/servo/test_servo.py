"""The servo from outside: what it follows, what it refuses, and what a driver is given."""

from __future__ import annotations

import math
import random

import pytest
from benchmark_kit import load_benchmark
from servo_kit import STILL, Bench, N
from specs import PANDA_HOME

from hal.commands import Kind, Session
from hal.errors import CommandError, ControlTaken
from hal.types import Limited, RobotStatus, Trip

streams = load_benchmark("servo_streams")


@pytest.mark.slow
def test_random_target_streams() -> None:
    """What the benchmark does 10,000 times."""
    results = [streams.run_stream(seed) for seed in range(120)]
    for result in results:
        assert all(peak <= 1.0 for peak in result.peaks.values()), (result.description, result.peaks)
        assert result.ratio <= 1.2, (result.description, result.ratio)
        assert result.overshoot <= 1e-3, (result.description, result.overshoot)
    assert min(result.travel for result in results) > 0.02
    assert sum(result.trips for result in results) > 10
    assert max(result.peaks["velocity"] for result in results) > 0.99


def test_a_leap_of_the_target_is_not_a_leap_of_the_arm() -> None:
    bench = Bench()
    bench.target(PANDA_HOME)
    bench.tick()
    goal = [x + 1.5 * (k == 0) for k, x in enumerate(PANDA_HOME)]
    bench.stream(2.0, Kind.JOINT_TARGET, [*goal, *STILL])
    assert bench.q == pytest.approx(goal, abs=1e-9)
    assert bench.audit.peaks()["velocity"] > 0.9
    bench.assert_within_limits()


@pytest.mark.parametrize(("hz", "worst"), [(1000, 1e-3), (250, 1e-3), (50, 2e-3)])
def test_a_moving_target_is_tracked(hz: int, worst: float) -> None:
    bench = Bench(rate_hz=1000.0)
    errors = []
    for k in range(3000):
        t = k / 1000
        x, v = 0.25 * (1 - math.cos(2.5 * t)), 0.625 * math.sin(2.5 * t)
        if k % (1000 // hz) == 0:
            q, dq = list(PANDA_HOME), [0.0] * N
            q[0], dq[0] = q[0] + x, v
            bench.target(q, dq)
        bench.tick()
        if t > 0.5:
            errors.append(bench.q[0] - PANDA_HOME[0] - x)
    assert math.sqrt(sum(e * e for e in errors) / len(errors)) < worst
    assert max(q[0] for q in bench.history) > 0.4
    bench.assert_within_limits()


def test_a_stream_without_speeds_is_smooth() -> None:
    """At 10 Hz the arm must not stop at every target."""
    bench = Bench()
    slowest = 9.0
    for k in range(720):
        if k % 24 == 0:
            q = [x + 0.04 * (k // 24) * (i == 0) for i, x in enumerate(PANDA_HOME)]
            bench.send(Kind.JOINT_TARGET, [*q, *STILL], deadline=0.25)
        bench.tick()
        if k > 240:
            slowest = min(slowest, bench.servo.report.dq_set[0])
    assert slowest > 0.15  # of 0.4 rad/s


def test_the_first_target_must_be_near() -> None:
    bench = Bench()
    bench.target([x + 0.101 * (k == 3) for k, x in enumerate(PANDA_HOME)])
    bench.run(0.3)
    assert bench.servo.report.refused == 1
    assert (bench.status, bench.servo.report.target_seq) == (RobotStatus.HOLDING, 0)
    assert bench.q == pytest.approx(PANDA_HOME)
    near = [x + 0.099 * (k == 3) for k, x in enumerate(PANDA_HOME)]
    bench.stream(0.5, Kind.JOINT_TARGET, [*near, *STILL])
    assert bench.q == pytest.approx(near)
    bench.stops += 1
    bench.run(0.1)
    bench.rearm()
    bench.run(0.1)
    refused = bench.target([x - 0.2 * (k == 3) for k, x in enumerate(PANDA_HOME)])
    bench.run(0.3)
    assert bench.servo.report.refused == refused
    assert not bench.moving


@pytest.mark.parametrize(
    ("kind", "values"),
    [
        (Kind.JOINT_TARGET, [math.nan] * 14),
        (Kind.JOINT_TARGET, [0.0] * 13),
        (Kind.JOINT_VELOCITY, [math.inf] + [0.0] * 6),
        (Kind.JOINT_VELOCITY, []),
        (Kind.JOINT_TORQUE, [1.0] * 7),
        (Kind.NONE, []),
        (Kind.CARTESIAN_TARGET, [0.3, 0.0, 0.5, 0.0, 0.0, 0.0, 0.0]),
        (Kind.TWIST, [0.1] * 6),
    ],
)
def test_a_command_that_makes_no_sense_is_refused(kind: Kind, values: list[float]) -> None:
    bench = Bench()
    bench.drive(0.2)
    followed = bench.servo.report.target_seq
    refused = bench.send(kind, values)
    bench.tick()
    assert bench.servo.report.refused == refused
    assert bench.servo.report.target_seq == followed
    bench.run(0.2)
    assert bench.trip is Trip.COMMAND_LATE  # it does not count as a sign of life either


def test_hostile_numbers_never_leave_the_limits() -> None:
    rng = random.Random(3)
    for speed in (1.0, 0.3):
        bench = Bench(speed=speed, tcp_speed=0.5)
        bench.drive(0.1)
        for _ in range(600):
            kind = rng.choice((Kind.JOINT_TARGET, Kind.JOINT_VELOCITY, Kind.CARTESIAN_TARGET, Kind.TWIST))
            size = {Kind.JOINT_TARGET: 14}.get(kind, 7)
            bench.send(kind, [rng.choice((0.0, 1.0, -1e300, 1e300, 1e-320, math.nan, 3.0)) for _ in range(size)])
            bench.command = bench.command._replace(
                t=rng.choice((bench.now, math.nan, -1e300, bench.now + 9.0)),
                deadline=rng.choice((bench.now + 0.1, math.inf, math.nan, -1.0)),
            )
            bench.tick()
            if bench.trip:
                bench.rearm()
        assert bench.servo.report.target_seq > 5
        bench.assert_within_limits()


def test_position_limits_hold_and_are_reported() -> None:
    bench = Bench()
    bench.stream(3.0, Kind.JOINT_VELOCITY, [2.0] * N)
    assert bench.limited & Limited.POSITION
    assert bench.q == pytest.approx(bench.spec.limits.upper, abs=1e-2)
    bench.assert_within_limits()


def test_the_session_share_of_speed_is_kept_and_reported() -> None:
    bench = Bench(speed=0.3)
    bench.stream(1.0, Kind.JOINT_VELOCITY, [2.0] + [0.0] * 6)
    assert bench.limited == Limited.SPEED
    assert bench.servo.report.dq_set[0] == pytest.approx(0.3 * 2.175, rel=1e-3)


def test_one_session_at_a_time_and_sensible_terms() -> None:
    bench = Bench()
    with pytest.raises(ControlTaken):
        bench.servo.open_session(Session(2, 1.0, 1.0, False), bench.inbox())
    with pytest.raises(CommandError):
        Bench(speed=math.nan)
    with pytest.raises(CommandError):
        Bench(tcp_speed=0.0)
    with pytest.raises(CommandError):
        bench.servo.anchor([math.nan] * N)


def test_end_brakes_and_then_there_is_nothing_to_write() -> None:
    bench = Bench()
    bench.drive()
    bench.servo.close_session()
    assert bench.tick() is not None
    assert bench.status is RobotStatus.STOPPING
    assert bench.servo.report.t_stop == bench.now
    for _ in range(200):
        last = bench.tick()
    assert last is None
    assert (bench.status, bench.servo.active) == (RobotStatus.IDLE, False)
    bench.assert_within_limits()
    bench.servo.anchor(bench.q)
    bench.servo.open_session(Session(2, 1.0, 1.0, False), bench.inbox())
    bench.drive(0.2)  # commands of session 1
    assert not bench.moving


def test_a_session_that_ends_while_the_device_is_lost_is_over_as_well() -> None:
    bench = Bench()
    bench.drive()
    bench.servo.close_session()
    for _ in range(200):
        last = bench.lose()
    assert last is None
    assert (bench.status, bench.servo.active) == (RobotStatus.LOST, False)


def test_an_anchor_in_an_open_session_forgets_the_goal() -> None:
    bench = Bench()
    bench.drive()
    elsewhere = [x + 0.5 for x in PANDA_HOME]
    bench.servo.anchor(elsewhere)
    bench.audit.reset()
    bench.q = elsewhere
    bench.run(0.5)
    assert bench.q == pytest.approx(elsewhere)
    bench.drive(0.2)
    assert bench.moving
    bench.assert_within_limits()


def test_a_start_outside_the_limits_only_comes_back_in() -> None:
    bench = Bench(begin=False)
    start = list(PANDA_HOME)
    start[0] = bench.spec.limits.upper[0] + 0.05
    bench.q = start
    bench.servo.anchor(start)
    bench.begin()
    bench.drive(0.3, speed=1.0)
    assert max(q[0] for q in bench.history) <= start[0] + 1e-9
    inside = [x - 0.09 * (k == 0) for k, x in enumerate(start)]
    bench.stream(0.5, Kind.JOINT_TARGET, [*inside, *STILL])
    assert bench.q == pytest.approx(inside)
