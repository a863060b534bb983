"""A motion along a planned path: its limits, its stops on the path, and paths that are refused."""

from __future__ import annotations

import contextlib
import random
from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import pytest
from errors_kit import raises_code
from servo_kit import Bench, tightened
from specs import PANDA_HOME, panda

from hal.commands import PATH_KNOTS, PathSection
from hal.errors import CommandError, Unreachable
from hal.geometry import apply_rotation, difference
from hal.kinematics.arm import Kinematics
from hal.motion.planning import PathPlanner
from hal.servo.path import JointPath, ZonePlanner
from hal.specs import WorkspaceSpec
from hal.types import Limited, RobotStatus, Trip

SPEC = panda()
ARM = Kinematics(SPEC.kinematics)
PLANNER = PathPlanner(ARM, SPEC.limits.lower, SPEC.limits.upper)
START = ARM.fk(PANDA_HOME)
WAY = np.array([0.1, 0.25, -0.2])
GOAL = [*np.add(START[:3], WAY), *apply_rotation(START[3:], (0.2, -0.1, 0.3))]
PLAN = PLANNER.plan_poses(PANDA_HOME, [GOAL])


def bench_of(sections: tuple[PathSection, ...] = PLAN.sections, **terms) -> Bench:
    bench = Bench(**{"begin": False, "tcp_speed": 0.25, "kinematics": ARM} | terms)
    bench.session = bench.session._replace(path=sections)
    return bench


def finish(bench: Bench, most: float = 10.0) -> float:
    begun = bench.now
    while not bench.servo.report.arrived:
        bench.tick()
        assert bench.now - begun < most
    return bench.now - begun


def along(q: Sequence[float]) -> float:
    """Way of the tcp along the line at joint positions ``q``, m."""
    return float(np.subtract(ARM.fk(q)[:3], START[:3]) @ WAY / np.linalg.norm(WAY))


def off_line(bench: Bench) -> tuple[float, float]:
    """Greatest distance of a set-point from the line, m, and from its orientation there, rad."""
    away, turned = 0.0, 0.0
    whole = np.array(difference(START, GOAL))
    for q in bench.history:
        pose = ARM.fk(q)
        share = float(np.subtract(pose[:3], START[:3]) @ WAY / (WAY @ WAY))
        there = [*np.add(START[:3], share * WAY), *apply_rotation(START[3:], share * whole[3:])]
        error = difference(pose, there)
        away, turned = max(away, np.linalg.norm(error[:3])), max(turned, np.linalg.norm(error[3:]))
    return float(away), float(turned)


@pytest.mark.parametrize("rate_hz", [240.0, 1000.0])
@pytest.mark.parametrize("share", [1.0, 0.1])
def test_the_tcp_goes_straight_within_every_limit(rate_hz: float, share: float) -> None:
    spec = replace(SPEC, limits=tightened(SPEC.limits, share, share))
    bench = bench_of(spec=spec, rate_hz=rate_hz)
    bench.begin()
    took = finish(bench)
    away, turned = off_line(bench)
    assert away < 2e-4
    assert turned < 1e-3
    bench.assert_within_limits()
    tcp = np.array([ARM.fk(q)[:3] for q in bench.history])
    fastest = np.linalg.norm(np.diff(tcp, axis=0), axis=1).max() * rate_hz
    assert 0.24 < fastest <= 0.25
    assert took < 1.2 * np.linalg.norm(WAY) / 0.25 if share == 1.0 else took < 3.0
    assert bench.q == pytest.approx(PLAN.sections[-1].q[-1], abs=1e-12)
    assert bench.limited is Limited.NONE


@pytest.mark.parametrize("cause", ["deadman", "trip", "lost"])
def test_a_stop_is_made_on_the_line_and_the_motion_continues_on_it(cause: str) -> None:
    """At random times, also while it speeds up or brakes."""
    numbers = random.Random(1)
    for _ in range(8):
        bench = bench_of(deadman=cause == "deadman")
        if cause == "deadman":
            bench.press()
        bench.begin()
        for _ in range(3):
            bench.run(numbers.uniform(0.0, 0.5))
            progress, foretold = bench.servo.report.progress, bench.servo.stop_end()
            if cause == "deadman":
                bench.release()
            elif cause == "trip":
                bench.stops += 1
            else:
                bench.lose()
            bench.until_rest(0.5)
            assert progress <= bench.servo.report.progress < progress + 0.2
            assert along(bench.q) - 1e-6 < along(foretold) < along(bench.q) + 0.02
            assert bench.status in (RobotStatus.HOLDING, RobotStatus.TRIPPED)
            bench.run(0.05)
            if cause == "deadman":
                bench.press()
            else:
                bench.rearm()
        finish(bench)
        away, turned = off_line(bench)
        assert away < 2e-4
        assert turned < 1e-3
        bench.assert_within_limits()


SINGULAR = [-2.477, -1.531, 1.802, -1.124, 1.258, 0.809, 2.27]
BESIDE = [0.605, 0.094, 0.104, -0.4905, 0.7433, 0.3433, -0.2999]
"""Start, rad, and goal of a line near a singularity."""


def test_a_line_near_a_singularity_takes_little_longer_than_the_least_time() -> None:
    sections = PLANNER.plan_poses(SINGULAR, [BESIDE]).sections
    bench = bench_of(sections, spec=replace(SPEC, home=tuple(SINGULAR)))
    bench.begin()
    assert finish(bench) < 1.3 * 0.467  # optimal_time() of benchmarks/motion.py
    bench.assert_within_limits()


def random_line(numbers: np.random.Generator) -> tuple[PathSection, ...]:
    """Sections of a line of up to 20 cm from anywhere."""
    while True:
        q = numbers.uniform(SPEC.limits.lower, SPEC.limits.upper).tolist()
        start, way, turn = ARM.fk(q), numbers.normal(0.0, 0.07, 3), numbers.normal(0.0, 0.2, 3)
        with contextlib.suppress(Unreachable):
            return PLANNER.plan_poses(q, [[*np.add(start[:3], way), *apply_rotation(start[3:], turn)]]).sections


def test_limits_hold_along_any_line_with_pauses() -> None:
    numbers = np.random.default_rng(1)
    lines = [PLANNER.plan_poses(SINGULAR, [BESIDE]).sections, *(random_line(numbers) for _ in range(6))]
    for sections in lines:
        bench = bench_of(sections, spec=replace(SPEC, home=sections[0].q[0]), deadman=True)
        bench.press()
        bench.begin()
        while not bench.servo.report.arrived:
            bench.run(numbers.uniform(0.0, 0.5))
            bench.release()
            bench.until_rest(1.0)
            bench.press()
        assert bench.q == pytest.approx(sections[-1].q[-1], abs=1e-12)
        bench.assert_within_limits()


def test_an_arm_beside_its_path_comes_back_to_it_and_one_far_away_does_not() -> None:
    bench = bench_of()
    bench.begin()
    bench.run(0.5)
    bench.q = [x + 0.01 for x in bench.q]
    bench.servo.anchor(bench.q)
    bench.audit.reset()
    finish(bench)
    bench.assert_within_limits()
    bench = bench_of()
    bench.begin()
    bench.run(0.5)
    progress = bench.servo.report.progress
    bench.q = [x + 0.1 for x in bench.q]
    bench.servo.anchor(bench.q)
    bench.run(1.0)
    assert bench.servo.report.off_path
    assert bench.servo.report.progress == progress > 0.0
    assert not bench.moving


@pytest.mark.parametrize("seconds", [0.0, 0.5])
def test_a_motion_without_a_plan_ends(seconds: float, monkeypatch: pytest.MonkeyPatch) -> None:
    bench = bench_of()
    bench.begin()
    bench.run(seconds)
    monkeypatch.setattr(ZonePlanner, "through", lambda *_: None)
    bench.run(2.0)
    assert bench.servo.report.off_path
    assert bench.servo.report.progress < 1.0
    assert not bench.moving
    bench.assert_within_limits()


def test_sections_follow_each_other_with_a_rest_in_between() -> None:
    middle = [x + 0.2 for x in PANDA_HOME]
    plan = PLANNER.plan_joints(PANDA_HOME, [middle, PANDA_HOME])
    assert len(plan.sections) == 2
    bench = bench_of(plan.sections, tcp_speed=1e9)
    bench.begin()
    finish(bench)
    bench.assert_within_limits()
    assert min(np.abs(np.subtract(q, middle)).max() for q in bench.history) == 0.0


NAN = float("nan")
KNOT, NEXT = tuple(PANDA_HOME), tuple(x + 0.01 for x in PANDA_HOME)


@pytest.mark.parametrize(
    ("sections", "code"),
    [
        ((), "bad_path"),
        ((PathSection((0.0,), (KNOT,)),), "bad_path"),
        ((PathSection((0.0, 1.0), (KNOT, NEXT[:6])),), "bad_path"),
        ((PathSection((0.0, 1.0), (KNOT, (NAN, *NEXT[1:]))),), "bad_path"),
        ((PathSection((0.0, NAN), (KNOT, NEXT)),), "bad_path"),
        ((PathSection((0.0, 0.0), (KNOT, NEXT)),), "bad_path"),
        ((PathSection((0.0, 1.0), (KNOT, NEXT)), PathSection((0.0, 1.0), (KNOT, NEXT))), "bad_path"),
        ((PathSection(tuple(map(float, range(PATH_KNOTS + 1))), (KNOT,) * (PATH_KNOTS + 1)),), "path_too_long"),
        ((PathSection((0.0, 1.0), (tuple(x + 0.05 for x in KNOT), NEXT)),), "start_moved"),
        ((PathSection((0.0, 1.0), (KNOT, (*NEXT[:3], 0.0, *NEXT[4:]))),), "joint_limit"),
        ((PathSection((0.0, 1.0), (KNOT, (1.5, *NEXT[1:]))),), "outside_workspace"),
    ],
)
def test_a_path_that_no_planner_makes_is_refused(sections: tuple[PathSection, ...], code: str) -> None:
    bench = bench_of(sections, spec=replace(SPEC, workspace=WorkspaceSpec((-1.0, -0.2, 0.0), (1.0, 0.2, 1.0))))
    with raises_code(CommandError, code):
        bench.begin()
    bench.run(0.1)
    assert not bench.servo.active


def test_the_spline_goes_through_its_knots_with_continuous_derivatives() -> None:
    path = JointPath(PLAN.sections[0])
    for s, q in zip(path.s[1:-1], path.q[1:-1], strict=True):
        before, after = path.at(s - 1e-9), path.at(s)
        assert after[0] == pytest.approx(q, abs=1e-12)
        for x, y in zip(before[1:], after[1:], strict=True):
            assert x == pytest.approx(y, abs=1e-4)
    assert path.nearest(path.at(0.123)[0], 0.1) == pytest.approx(0.123, abs=1e-9)


def test_the_trip_of_a_motion_is_latched() -> None:
    bench = bench_of()
    bench.begin()
    bench.run(0.3)
    bench.stops += 1
    bench.run(1.0)
    assert (bench.trip, bench.moving, bench.servo.report.arrived) == (Trip.STOP, False, False)
