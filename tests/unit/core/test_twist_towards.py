"""twist_towards: reach a pose by twists."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hal.geometry import Pose, apply_rotation
from hal.teleop import twist_towards

numbers = st.floats(-1.0, 1.0)
poses = st.builds(
    Pose.from_rpy, st.tuples(numbers, numbers, numbers), st.tuples(st.floats(-3, 3), st.floats(-1.5, 1.5), numbers)
)


@given(poses, poses)
@settings(deadline=None, max_examples=50)
def test_it_arrives_within_its_speeds_and_without_overshoot(goal: Pose, start: Pose) -> None:
    tcp, dt = start, 0.02
    left = tcp.distance(goal)
    for _ in range(2000):
        twist = twist_towards(goal, tcp, 0.2, 0.8)
        assert np.linalg.norm(twist.linear) <= 0.2 + 1e-9
        assert np.linalg.norm(twist.angular) <= 0.8 + 1e-9
        turned = apply_rotation(tcp.orientation.tolist(), (dt * twist.angular).tolist())
        tcp = Pose(tcp.position + dt * twist.linear, turned)
        now = tcp.distance(goal)
        assert now[0] <= left[0] + 1e-9
        assert now[1] <= left[1] + 1e-6
        left = now
        if max(left) < 1e-4:
            break
    assert left[0] < 1e-3
    assert left[1] < 1e-3


def test_at_the_goal_the_twist_is_zero() -> None:
    here = Pose([0.3, 0.0, 0.5], [1.0, 0.0, 0.0, 0.0])
    twist = twist_towards(here, here, 0.2, 0.8)
    assert twist.linear == pytest.approx(np.zeros(3))
    assert twist.angular == pytest.approx(np.zeros(3))
