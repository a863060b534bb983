"""How fast an episode is: stamps that jitter make nothing faster, and what is really faster is refused."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from replay_kit import FPS, Recorded, course_of, opened

import hal


def driven(speed: float, late: float = 0.0, seconds: float = 3.0) -> Recorded:
    """A joint at ``speed``, there and back; single rows are measured up to ``late`` s late, as on a busy machine."""
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        start, joints, n = arm.state().q, arm.joints, arm.n
    t = np.arange(0.0, seconds, 1.0 / FPS)
    q = np.tile(np.append(start, 0.04), (len(t), 1))
    q[:, n - 1] += speed * (np.minimum(t, seconds / 2) - np.maximum(t - seconds / 2, 0.0))
    tcp = np.tile([0.5, 0.0, 0.5, 1.0, 0.0, 0.0, 0.0], (len(t), 1))
    stamps = t + np.random.default_rng(1).uniform(0.0, late, len(t))
    columns = {"observation.setpoint": q, "observation.state": q, "observation.tcp": tcp}
    return Recorded(
        {key: rows.astype(np.float32) for key, rows in columns.items()}, {"robot.panda": stamps}, {}, joints
    )


def test_rows_whose_stamps_jitter_are_no_faster_than_they_were() -> None:
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        most = arm.spec.speed * arm.limits.velocity[-1]
        course = course_of(driven(most, late=0.008), arm)
        rows = np.abs(np.diff(course.q_set[:, -1])) / np.diff(course.t)
        assert rows.max() > 1.1 * most, "from row to row it seems to be"
        course.check(arm, 1.0)


@pytest.mark.parametrize("times", [1.06, 1.5, 5.0])
@pytest.mark.parametrize("late", [0.0, 0.008])
def test_what_is_really_faster_is_refused(times: float, late: float) -> None:
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        most = arm.spec.speed * arm.limits.velocity[-1]
        course = course_of(driven(times * most, late, seconds=2.4 / times), arm)
        with pytest.raises(hal.CommandError, match=r"panda_joint7 moves at .* at speed [0-9.]+ it could") as refused:
            course.check(arm, 1.0)
        possible = float(str(refused.value).rpartition("at speed ")[2].split()[0])
        assert possible == pytest.approx(1.0 / times, rel=0.15)
        course.check(arm, possible)


@pytest.mark.parametrize("row", [1, 40, -1])
def test_a_leap_is_refused_wherever_it_is(row: int) -> None:
    with opened("mock") as rig:
        arm = rig.robots["panda"]
        course = course_of(driven(0.1), arm)
        q = course.q_set.copy()
        q[row:, -1] += 0.2
        with pytest.raises(hal.CommandError, match="panda_joint7 moves at"):
            replace(course, q_set=q).check(arm, 1.0)
