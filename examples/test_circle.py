"""Unit-test research code with the mock: no robot, no simulator, no display, the same numbers every time.

pytest examples/test_circle.py
"""

from __future__ import annotations

import numpy as np
import pytest

import hal


def draw_circle(rig: hal.Rig, radius: float = 0.05, seconds: float = 3.0, deadman: hal.Deadman | None = None) -> None:
    """Research code: move the tcp once around a circle, at constant height."""
    arm = rig.robots["panda"]
    rate = 2.0 * np.pi / seconds
    with arm.control(deadman=deadman, rate_hz=50) as control:
        for tick in rig.clock.rate(50):
            if tick.elapsed > seconds:
                break
            angle = rate * tick.elapsed
            control.send(hal.Twist(linear=[-radius * rate * np.sin(angle), radius * rate * np.cos(angle), 0.0]))


def test_the_circle_has_its_radius_and_keeps_its_height() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        arm = rig.robots["panda"]
        start = arm.state().tcp.position
        draw_circle(rig, radius=0.05)
        path = np.array([arm.fk(setpoint.q).position for setpoint in rig.driver("panda").log]) - start
        assert np.ptp(path[:, 1]) == pytest.approx(0.1, abs=0.01)
        assert np.ptp(path[:, 2]) < 0.003


def test_nothing_moves_while_the_dead_man_is_released() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        arm, pad = rig.robots["panda"], rig.gamepads["pad"]
        start = arm.state().q
        draw_circle(rig, deadman=pad.hold("l2"))
        assert np.array_equal(arm.state().q, start)
        rig.driver("pad").press("l2")
        draw_circle(rig, deadman=pad.hold("l2"), seconds=0.5)
        assert not np.array_equal(arm.state().q, start)


def test_a_lost_arm_ends_the_motion_and_says_why() -> None:
    with hal.open("panda_table", driver="mock") as rig:
        rig.driver("panda").inject(disconnect=True)
        with pytest.raises(hal.MotionStopped, match="does not answer"):
            draw_circle(rig)
