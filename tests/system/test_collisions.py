"""Arms in processes of their own stop before each other, by the newest states that they publish."""

from __future__ import annotations

import numpy as np
import pytest

import hal

pytestmark = pytest.mark.pair


def test_two_arms_of_two_processes_stop_apart() -> None:
    facing = {"position": [1.0, 0, 0], "orientation": [0, 0, 1, 0]}
    robots = {"left": {"model": "panda"}, "right": {"model": "panda", "base": facing}}
    with hal.open({"robots": robots}, driver="mock", clock="real_time", pad="none") as rig:
        left, right = rig.robots["left"], rig.robots["right"]
        start, collisions = left.state().q_set, left.collisions
        least, seen = 1.0, hal.Limited.NONE
        with left.control(rate_hz=5) as one, right.control(rate_hz=5) as two:
            for tick in rig.clock.rate(30):
                one.send(hal.Twist([0.25, 0, 0]))
                two.send(hal.Twist([0.25, 0, 0]))
                found = [pair for pair in collisions.check(left.state().q_set, 0.1) if "right/" in pair.second]
                least = min([least, *(pair.distance for pair in found)])
                seen |= left.state().limited | right.state().limited
                if tick.elapsed > 2.0:
                    break
        assert np.abs(left.state().q_set - start).max() > 0.05
        assert 0.005 < least < 0.05
        assert hal.Limited.COLLISION in seen
