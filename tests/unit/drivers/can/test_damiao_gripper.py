"""The table from the angle of a gripper's motor to the width between the fingers."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from hal.drivers.can.damiao_gripper import FingerTable

RISING = FingerTable(((0.0, 0.0), (1.0, 0.02), (3.0, 0.1)))
FALLING = FingerTable(((-1.0472, 0.088), (0.0, 0.0)))


@given(st.floats(0.0, 0.1))
def test_angle_and_width_are_inverse(width: float) -> None:
    assert RISING.width(RISING.angle(width)) == pytest.approx(width, abs=1e-12)
    narrow = min(width, 0.088)
    assert FALLING.width(FALLING.angle(narrow)) == pytest.approx(narrow, abs=1e-12)


def test_widths_beyond_the_table_are_clamped() -> None:
    assert RISING.angle(0.5) == 3.0
    assert FALLING.angle(0.5) == -1.0472
    assert FALLING.angle(-0.1) == 0.0


def test_the_slope_turns_force_into_torque_in_each_part() -> None:
    assert RISING.slope(0.5) == pytest.approx(0.02)
    assert RISING.slope(2.0) == RISING.slope(9.0) == pytest.approx(0.04)
    assert FALLING.slope(-0.5) == pytest.approx(0.088 / 1.0472)
    assert (RISING.opening, FALLING.opening) == (1.0, -1.0)
