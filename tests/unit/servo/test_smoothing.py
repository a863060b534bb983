"""The smoother and its stopping formulas: every limit is kept, judged by the positions that it hands out."""

from __future__ import annotations

import math
from collections.abc import Sequence

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from ruckig import ControlInterface, InputParameter, Ruckig, RuckigError, Trajectory
from servo_kit import tightened

from hal.servo.audit import SetpointAudit
from hal.servo.smoothing import (
    JointSmoother,
    speed_for,
    stop_displacement,
    stop_distance,
    stop_peak,
    stop_phases,
    stop_step,
)
from hal.specs import LimitsSpec

LIMITS = LimitsSpec((-1.0, -2.0), (1.0, 0.5), (2.0, 1.0), (10.0, 5.0), (1000.0, 100.0))
SHARES = st.tuples(st.floats(0.1, 1.0), st.floats(0.02, 1.0))
# One thing to ask for, and for how many ticks: velocities, a position, or a stop.
REQUEST = st.tuples(
    st.sampled_from(("follow", "reach", "settle", "stop")),
    st.tuples(st.floats(-4.0, 4.0), st.floats(-4.0, 4.0)),
    st.integers(1, 80),
)
QUICK = settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])


def clamp(q: Sequence[float], smoother: JointSmoother) -> list[float]:
    return [max(low, min(high, x)) for x, low, high in zip(q, smoother.lower, smoother.upper, strict=True)]


def play(smoother: JointSmoother, requests: Sequence[tuple[str, tuple[float, float], int]]) -> list[list[float]]:
    path = []
    for what, values, ticks in requests:
        for _ in range(ticks):
            if what == "follow":
                smoother.follow(values)
            elif what == "settle":
                smoother.settle()
            elif what == "stop" or not smoother.reach(clamp(values, smoother), smoother.velocity):
                smoother.stop()
            path.append(list(smoother.q))
    return path


@QUICK
@given(SHARES, st.sampled_from((240.0, 1000.0)), st.lists(REQUEST, min_size=1, max_size=12))
def test_every_limit_is_kept(shares: tuple[float, float], rate: float, requests: list) -> None:
    limits = tightened(LIMITS, *shares)
    smoother = JointSmoother(limits, 1.0 / rate)
    audit = SetpointAudit(limits, 1.0 / rate)
    for q in play(smoother, requests):
        audit.add(q)
    assert all(peak <= 1.0 for peak in audit.peaks().values()), audit.peaks()


@QUICK
@given(
    SHARES,
    st.tuples(st.floats(-1.2, 1.2), st.floats(-2.2, 0.7)),
    st.tuples(st.floats(-2.0, 2.0), st.floats(-1.0, 1.0)),
    st.lists(REQUEST, min_size=1, max_size=8),
)
def test_from_outside_and_in_motion_no_farther_than_a_stop(shares, q, dq, requests):
    smoother = JointSmoother(tightened(LIMITS, *shares), 1 / 240)
    smoother.anchor(q, dq)
    stop = JointSmoother(tightened(LIMITS, *shares), 1 / 240)
    stop.anchor(q, dq)
    ends = stop.stop_end()
    highest = [max(high, x, end) for high, x, end in zip(LIMITS.upper, q, ends, strict=True)]
    lowest = [min(low, x, end) for low, x, end in zip(LIMITS.lower, q, ends, strict=True)]
    for at in play(smoother, requests):
        assert all(low - 1e-9 <= x <= high + 1e-9 for x, low, high in zip(at, lowest, highest, strict=True))


def test_an_arm_outside_comes_back_in_and_stays() -> None:
    smoother = JointSmoother(LIMITS, 1 / 240)
    smoother.anchor((1.1, 0.0))
    for _ in range(50):
        smoother.follow((1.0, 0.0))
    assert smoother.q[0] == pytest.approx(1.1)
    for _ in range(100):
        smoother.follow((-0.5, 0.0))
    assert smoother.q[0] < 1.0
    for _ in range(400):
        smoother.follow((1.0, 0.0))
    assert 0.99 < smoother.q[0] <= 1.0


def test_a_lower_jerk_counts_at_once() -> None:
    smoother = JointSmoother(LIMITS, 1.0 / 240.0)
    smoother.anchor((0.5, -0.7))
    play(smoother, [("follow", (0.0, 0.0), 1)])
    smoother.limit_jerk((10.0, 10.0))
    path = play(smoother, [("follow", (0.9, 0.0), 600)])
    assert 0.95 < max(q for q, _ in path) <= 1.0


def test_velocity_is_reached_and_the_stop_ends_where_it_was_foretold() -> None:
    smoother = JointSmoother(LIMITS, 1 / 240)
    for _ in range(60):
        smoother.follow((0.7, -0.3))
    assert smoother.dq == pytest.approx([0.7, -0.3])
    foretold = smoother.stop_end()
    while not smoother.at_rest():
        smoother.stop()
    assert smoother.q == pytest.approx(foretold, abs=1e-9)
    assert foretold[0] > 0.1


def test_settling_keeps_the_proportions_and_takes_no_longer_than_the_slowest_joint() -> None:
    settling, stopping = JointSmoother(LIMITS, 1 / 240), JointSmoother(LIMITS, 1 / 240)
    for smoother in (settling, stopping):
        smoother.anchor([0.0, 0.0], [0.8, -0.4])
    ratios = []
    ticks = {"settle": 0, "stop": 0}
    for smoother, way in ((settling, "settle"), (stopping, "stop")):
        while not smoother.at_rest():
            getattr(smoother, way)()
            ticks[way] += 1
            assert ticks[way] < 1000
            if way == "settle" and abs(smoother.dq[0]) > 0.01:
                ratios.append(smoother.dq[1] / smoother.dq[0])
    assert ratios == pytest.approx([-0.5] * len(ratios), rel=1e-3)
    assert len(ratios) > 5
    assert ticks["settle"] <= ticks["stop"] + 2
    assert settling.q[1] / settling.q[0] == pytest.approx(-0.5, rel=1e-3)


def test_reach_arrives_exactly_and_keeps_its_speed() -> None:
    smoother = JointSmoother(LIMITS, 1 / 240)
    fastest = 0.0
    for _ in range(1000):
        assert smoother.reach((0.8, -1.0), (0.5, 0.5))
        fastest = max(fastest, *map(abs, smoother.dq))
    assert smoother.q == pytest.approx([0.8, -1.0], abs=1e-12)
    assert fastest == pytest.approx(0.5)
    assert smoother.at_rest()


def test_a_guard_turns_the_step_into_a_stop() -> None:
    smoother = JointSmoother(LIMITS, 1 / 240)
    for _ in range(60):
        smoother.follow((0.7, 0.0))
    end = smoother.stop_end()[0]
    for _ in range(200):
        smoother.follow((0.7, 0.0), guard=lambda s: s.stop_end_next()[0] <= end + 1e-9)
    assert smoother.q[0] == pytest.approx(end)
    assert smoother.guarded


@pytest.mark.parametrize("bad", [math.nan, math.inf, -math.inf])
def test_a_goal_that_is_no_number_stops_the_arm(bad: float) -> None:
    smoother = JointSmoother(LIMITS, 1 / 240)
    for _ in range(60):
        smoother.follow((0.7, -0.3))
    for _ in range(120):
        smoother.follow((bad, -0.3))
    assert smoother.at_rest()


class BrokenRuckig:
    """Refuses everything, as Ruckig does with input that it cannot plan."""

    def update(self, *_: object) -> None:
        raise RuckigError("refused")

    def reset(self) -> None:
        pass


def test_without_ruckig_the_arm_still_stops_inside_the_limits() -> None:
    dt = 1 / 240
    smoother = JointSmoother(LIMITS, dt)
    audit = SetpointAudit(LIMITS, dt)
    for _ in range(40):
        smoother.follow((2.0, -1.0))
        audit.add(smoother.q)
    assert smoother.dq[0] > 1.0
    foretold = smoother.stop_end()
    smoother._ruckig = BrokenRuckig()
    assert not smoother.reach((0.9, -0.9), (1.0, 1.0))
    for _ in range(200):
        smoother.follow((2.0, -1.0))
        audit.add(smoother.q)
    assert smoother.at_rest()
    assert smoother.q == pytest.approx(foretold, abs=1e-6)
    assert all(peak <= 1.0 for peak in audit.peaks().values()), audit.peaks()


ACCELERATION = st.floats(0.1, 30.0)
JERK = st.floats(5.0, 10_000.0)
SPEED = st.floats(-3.0, 3.0)
SHARE = st.floats(-1.0, 1.0)


def ruckig_stop(v: float, a: float, A: float, J: float) -> Trajectory:
    inputs = InputParameter(1)
    inputs.control_interface = ControlInterface.Velocity
    inputs.current_position, inputs.current_velocity, inputs.current_acceleration = [0.0], [v], [a]
    inputs.target_velocity = [0.0]
    inputs.max_velocity, inputs.max_acceleration, inputs.max_jerk = [10.0], [A], [J]
    trajectory = Trajectory(1)
    Ruckig(1, 0.001).calculate(inputs, trajectory)
    return trajectory


@settings(max_examples=500)
@given(SPEED, SHARE, ACCELERATION, JERK)
def test_peaks_and_ends_of_stops(v: float, share: float, A: float, J: float) -> None:
    a = share * A
    trajectory = ruckig_stop(v, a, A, J)
    extrema = trajectory.position_extrema[0]
    assert stop_peak(v, a, A, J) == pytest.approx(extrema.max, abs=1e-9, rel=1e-9)
    assert stop_peak(-v, -a, A, J) == pytest.approx(-extrema.min, abs=1e-9, rel=1e-9)
    end = trajectory.at_time(trajectory.duration)[0][0]
    assert stop_displacement(v, a, A, J) == pytest.approx(end, abs=1e-9, rel=1e-9)


@settings(max_examples=500)
@given(SPEED, SHARE, ACCELERATION, JERK, st.floats(0.0, 1.5))
def test_a_stop_by_hand_is_the_time_optimal_one(v: float, share: float, A: float, J: float, when: float) -> None:
    trajectory = ruckig_stop(v, share * A, A, J)
    t = when * trajectory.duration
    expected = [values[0] for values in trajectory.at_time(t)]
    assert stop_step(0.0, v, share * A, A, J, t) == pytest.approx(expected, abs=1e-6)
    jerk, first, second, third = stop_phases(v, share * A, A, J)
    assert abs(jerk) == J
    assert 0.0 <= first <= second <= third
    assert third == pytest.approx(trajectory.duration, abs=1e-6)


@given(ACCELERATION, JERK, st.floats(0.0, 3.0))
def test_speed_for_inverts_stop_distance(A: float, J: float, d: float) -> None:
    assert stop_distance(speed_for(d, A, J), A, J) == pytest.approx(d, abs=1e-9)
    assert speed_for(-d, A, J) == 0.0


def test_stop_distance_where_the_profile_changes_its_shape() -> None:
    A, J = 2.0, 10.0
    edge = A * A / J
    assert stop_distance(edge, A, J) == pytest.approx(stop_distance(edge * (1 + 1e-9), A, J))
    assert stop_distance(2.0, A, J) > 2.0 * 2.0 / (2 * A)  # more than without a jerk limit
