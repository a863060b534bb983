"""Franka's official limits, and which command breaks which of them in the emulator."""

from __future__ import annotations

from itertools import pairwise
from math import cos, pi, sqrt

import pytest

from hal.drivers.franka.flags import FLAGS
from hal.drivers.franka.limits import LIMITS, ArmLimits
from hal_emulators.franka.motion import (
    DT,
    LimitChecker,
    MotionSample,
    Tolerances,
    Violation,
    at_rest,
    braked,
    extrapolate,
    step_position,
    step_velocity,
)

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
    assert (tuple(highest), tuple(-value for value in lowest)) == (FER.velocity, FER.velocity)


def test_the_fr3_at_home_may_lower_some_joints_slowly_only() -> None:
    lowest, highest = FR3.velocity_range(HOME)
    assert tuple(highest) == FR3.velocity
    assert ([round(lowest[k], 2) for k in (1, 3, 5)], lowest[0]) == ([-2.08, -2.05, -3.04], -2.62)


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


def moving(dq: float = 0.0, ddq: float = 0.0, joint: int = 0, q: tuple[float, ...] = HOME) -> MotionSample:
    """One joint moves, the others stand."""
    return MotionSample(
        q, [dq if k == joint else 0.0 for k in range(7)], [ddq if k == joint else 0.0 for k in range(7)]
    )


def after(before: MotionSample, acceleration: float, joint: int = 0) -> MotionSample:
    """The next sample, with that acceleration in one joint."""
    dq = list(before.dq)
    dq[joint] += acceleration * DT
    return step_velocity(before, dq)


def name(violation: Violation | None) -> str:
    return "" if violation is None else FLAGS[violation.flag]


@pytest.mark.parametrize("limits", [FR3, FER], ids=["fr3", "fer"])
@pytest.mark.parametrize("joint", range(7))
def test_each_limit_of_each_joint_just_inside_and_just_outside(limits: ArmLimits, joint: int) -> None:
    checker = LimitChecker(limits)
    tolerances = Tolerances()
    a, j, v = limits.acceleration[joint], limits.jerk[joint], limits.velocity[joint]
    for sign in (1.0, -1.0):
        # acceleration, reached with little jerk
        too_much = a + tolerances.acceleration + 0.1
        for value, expected in ((a, ""), (too_much, "joint_motion_generator_velocity_discontinuity")):
            before = moving(0.0, sign * (value - 1.0), joint)
            assert name(checker.joints(before, after(before, sign * value, joint))) == expected
        # jerk
        for value, expected in ((j, ""), (j * 1.03, "joint_motion_generator_acceleration_discontinuity")):
            before = moving(0.0, 0.0, joint)
            assert name(checker.joints(before, after(before, sign * value * DT, joint))) == expected
        # velocity, away from any stop
        middle = list(HOME)
        middle[joint] = 0.5 * (limits.lower[joint] + limits.upper[joint])
        for value, expected in ((v, ""), (v + 0.01, "joint_motion_generator_velocity_limits_violation")):
            before = moving(sign * value, 0.0, joint, tuple(middle))
            assert name(checker.joints(before, after(before, 0.0, joint))) == expected
        # position
        edge = list(HOME)
        bound = limits.upper[joint] if sign > 0 else limits.lower[joint]
        for off, expected in ((-1e-6, ""), (1e-6, "joint_motion_generator_position_limits_violation")):
            edge[joint] = bound + sign * off
            assert name(checker.joints(at_rest(edge), at_rest(edge))) == expected


def test_the_fr3s_speed_depends_on_where_the_joint_is_and_the_pandas_does_not() -> None:
    for limits, towards in ((FR3, "joint_motion_generator_velocity_limits_violation"), (FER, "")):
        q = list(HOME)
        q[3] = limits.upper[3] - 0.1
        for speed, expected in ((1.0, towards), (-1.0, "")):
            before = moving(speed, 0.0, 3, tuple(q))
            assert name(LimitChecker(limits).joints(before, after(before, 0.0, 3))) == expected


def test_a_violation_has_joint_value_and_limit() -> None:
    before = at_rest(HOME)
    jumped = step_position(before, [HOME[0], HOME[1], HOME[2] + 0.05, *HOME[3:]])
    violation = LimitChecker(FR3).joints(before, jumped)
    assert name(violation) == "joint_motion_generator_velocity_limits_violation"
    assert violation.text == "joint 3: velocity 50 rad/s, limit 2.62 rad/s"


def test_the_first_position_must_be_where_the_arm_is() -> None:
    checker = LimitChecker(FR3)
    for off, expected in ((0.009, ""), (0.011, "joint_position_motion_generator_start_pose_invalid")):
        assert name(checker.start(HOME, [HOME[0] - off, *HOME[1:]])) == expected


def test_torques_their_range_and_their_rate() -> None:
    checker = LimitChecker(FR3)
    zero = [0.0] * 7
    assert checker.torques(zero, [1.0] * 7) is None
    assert name(checker.torques(zero, [1.01, *zero[1:]])) == "controller_torque_discontinuity"
    assert name(checker.torques([12.0] * 7, [*[12.0] * 6, 12.1])) == "tau_j_range_violation"
    assert checker.torques([86.5, *zero[1:]], [87.0, *zero[1:]]) is None


def test_what_is_measured_under_torque_control() -> None:
    checker = LimitChecker(FR3)
    assert checker.measured(HOME, [0.0] * 7) is None
    assert name(checker.measured([3.0, *HOME[1:]], [0.0] * 7)) == "joint_position_limits_violation"
    assert name(checker.measured(HOME, [0.0, 3.0, *[0.0] * 5])) == "joint_velocity_violation"


def test_it_keeps_how_near_to_each_limit_a_motion_came() -> None:
    checker = LimitChecker(FR3)
    sample, way, duration = at_rest(HOME), 0.5, 1.0
    for k in range(1, 1001):
        moved = way * (1.0 - cos(pi * k * DT / duration)) / 2.0
        following = step_position(sample, [HOME[0] + moved, *HOME[1:]])
        assert checker.joints(sample, following) is None
        sample = following
    report = checker.report()
    assert report["velocity"]["joint"] == 1
    assert report["velocity"]["value"] == pytest.approx(way * pi / 2.0, rel=1e-3)
    assert abs(float(str(report["acceleration"]["value"]))) == pytest.approx(way * pi**2 / 2.0, rel=1e-2)
    assert report["velocity"]["share"] == pytest.approx(way * pi / 2.0 / 2.621, rel=1e-3)
    checker.reset()
    assert checker.report()["velocity"]["share"] == 0.0


def test_after_a_lost_command_the_acceleration_stays() -> None:
    sample = moving(0.5, 2.0)
    for k in range(1, 4):
        sample = extrapolate(sample)
        assert (sample.dq[0], sample.ddq[0]) == (pytest.approx(0.5 + 0.002 * k), 2.0)
    assert sample.q[0] == pytest.approx(HOME[0] + DT * (0.502 + 0.504 + 0.506))


@pytest.mark.parametrize(("lost", "times"), [(1, 4.0), (2, 10.0), (3, 25.0), (4, 49.0), (5, 84.0)])
def test_going_on_after_losses_multiplies_the_jerk_that_is_seen(lost: int, times: float) -> None:
    """Why a driver must go on from what the robot took: jerk 1 is seen as 4, 10 ... after 1, 2 ... losses."""
    wanted = [k * (k + 1) * (k + 2) / 6.0 * DT**3 for k in range(40)]  # what differences see as jerk 1
    sample, worst = at_rest((0.0,) * 7), 0.0
    for k, position in enumerate(wanted[1:], 1):
        came = not 10 < k <= 10 + lost
        following = step_position(sample, [position] + [0.0] * 6) if came else extrapolate(sample)
        worst = max(worst, abs(following.ddq[0] - sample.ddq[0]) / DT)
        sample = following
    assert worst == pytest.approx(times, abs=1.0)


def test_an_arm_comes_to_rest_by_itself_within_its_deceleration() -> None:
    samples = [MotionSample(HOME, (1.0, -0.5, *[0.0] * 5), (0.0,) * 7)]
    while samples[-1].moving:
        samples.append(braked(samples[-1], FR3.acceleration))
        assert len(samples) < 200
    assert len(samples) - 1 == pytest.approx(100, abs=1)
    assert all(max(map(abs, sample.ddq)) <= 10.0 + 1e-9 for sample in samples)
    for before, following in pairwise(samples):
        assert following.q == pytest.approx([p + v * DT for p, v in zip(before.q, following.dq, strict=True)])
    assert braked(samples[-1], FR3.acceleration).ddq == (0.0,) * 7
