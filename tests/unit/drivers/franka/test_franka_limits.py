"""Franka's official limits as data, and the FR3's speed near its stops."""

from __future__ import annotations

from math import sqrt

import pytest

from hal.drivers.franka.limits import LIMITS, ArmLimits

HOME = (0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785)
FR3, FER = LIMITS["fr3"], LIMITS["fer"]


@pytest.mark.parametrize("limits", LIMITS.values(), ids=LIMITS)
def test_every_limit_is_seven_sensible_numbers(limits: ArmLimits) -> None:
    for name in ("lower", "upper", "velocity", "acceleration", "jerk", "torque", "torque_rate"):
        assert len(getattr(limits, name)) == 7, name
    assert all(a < b for a, b in zip(limits.lower, limits.upper, strict=True))
    for name in ("velocity", "acceleration", "jerk", "torque", "torque_rate"):
        assert min(getattr(limits, name)) > 0.0, name
    assert all(a < q < b for a, q, b in zip(limits.lower, HOME, limits.upper, strict=True))


def test_the_panda_has_the_same_speed_everywhere() -> None:
    near = [upper - 1e-3 for upper in FER.upper]
    lowest, highest = FER.velocity_range(near)
    assert tuple(highest) == FER.velocity
    assert tuple(-value for value in lowest) == FER.velocity


def test_the_fr3_at_home_may_lower_some_joints_slowly_only() -> None:
    lowest, highest = FR3.velocity_range(HOME)
    assert tuple(highest) == FR3.velocity
    assert [round(lowest[k], 2) for k in (1, 3, 5)] == [-2.08, -2.05, -3.04]
    assert lowest[0] == -2.62


def test_towards_a_stop_the_fr3_gets_slower_until_it_may_only_go_back() -> None:
    for k in range(7):
        q = list(HOME)
        last = FR3.velocity[k]
        for left in (1.0, 0.3, 0.1, 0.05):
            q[k] = FR3.upper[k] - left
            cap = FR3.velocity_range(q)[1][k]
            assert 0.0 < cap <= last
            last = cap
        q[k] = FR3.upper[k]
        lowest, highest = FR3.velocity_range(q)
        assert highest[k] == 0.0
        assert lowest[k] < 0.0
        q[k] = FR3.upper[k] + 0.1  # beyond it
        lowest, highest = FR3.velocity_range(q)
        assert highest[k] == 0.0
        assert lowest[k] < 0.0


def test_the_formula_for_the_speed() -> None:
    q = list(HOME)
    q[1] = FR3.lower[1] + 0.1
    expected = sqrt(2 * FR3.deceleration[1] * 0.1) - FR3.velocity_offset[1]
    assert FR3.velocity_range(q)[0][1] == pytest.approx(-expected)
    assert expected == pytest.approx(0.467, abs=1e-3)


def test_the_suggested_rectangle_has_corners_a_little_beyond_the_formula() -> None:
    box = FR3.rectangle
    lowest, highest = FR3.velocity_range(box.lower)[0], FR3.velocity_range(box.upper)[1]
    shares = [box.velocity[k] / min(highest[k], -lowest[k]) for k in range(7)]
    assert 1.0 < max(shares) < 1.045
