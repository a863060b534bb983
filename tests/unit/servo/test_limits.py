"""The stopping formulas against Ruckig, which computes the same profiles numerically."""

from __future__ import annotations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from ruckig import ControlInterface, InputParameter, Ruckig, Trajectory

from hal.servo.smoothing import speed_for, stop_displacement, stop_distance, stop_peak, stop_phases, stop_step

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
