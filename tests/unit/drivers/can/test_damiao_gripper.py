"""The table from the angle of a gripper's motor to the width between the fingers, and where it begins."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from stepped_can import SteppedArm, SteppedEmulator, take_for_off

from hal.drivers.can import damiao_gripper
from hal.drivers.can.damiao_gripper import FingerTable
from hal.errors import RobotFault
from hal.types import GripperOutcome

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


# Homing, on an emulated motor whose zero is not where the fingers are closed.


@pytest.fixture
def yam() -> Iterator[SteppedArm]:
    with SteppedEmulator("yam") as far:
        fingers = far.arm.gripper
        fingers.lower, fingers.upper, fingers.q = SHIFT, fingers.upper + SHIFT, SHIFT + 0.5
        arm = SteppedArm(far, grips=True)
        yield arm
        take_for_off(arm.driver)
        arm.host.close()


SHIFT = 0.7
"""Angle of the closed fingers, rad."""


@pytest.mark.parametrize("step", [None, 0.12])
def test_homing_finds_the_closed_position_also_in_steps_with_stops_in_between(
    yam: SteppedArm, step: float | None
) -> None:
    gripper = yam.robot.gripper
    for _ in range(1 if step is None else 100):
        motion = gripper.start_home()
        if step is None:
            assert motion.wait(20.0)
            break
        yam.host.advance_to(yam.host.now() + step)
        if motion.done:
            break
        gripper.stop()
        yam.host.advance_to(yam.host.now() + step)
    assert motion.wait().outcome is GripperOutcome.DONE
    assert gripper.state().width == pytest.approx(0.0, abs=1e-3)
    found = yam.host.request("statistics")["grippers"][gripper.name]["offset"]
    assert found == pytest.approx(-SHIFT, abs=0.01)
    gripper.move(0.05)
    assert gripper.state().width == pytest.approx(0.05, abs=1e-3)
    assert yam.far.arm.gripper.q == pytest.approx(SHIFT + 0.05 / 0.095 * 6.5, abs=0.05)


def test_fingers_that_nothing_stops_are_a_fault(yam: SteppedArm, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(damiao_gripper, "_HOMING_WAY", 0.2)
    yam.far.arm.gripper.lower = -20.0
    with pytest.raises(RobotFault, match="nothing stopped them"):
        yam.robot.gripper.home()
