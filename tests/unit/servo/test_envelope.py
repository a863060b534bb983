"""Bounds that spare the servo its kinematics: never a wrong "surely", and "surely" most of the time."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from servo_kit import Bench
from specs import PANDA_HOME, iiwa, panda

from hal.commands import Kind
from hal.kinematics.arm import NEAR_SINGULAR, Kinematics
from hal.servo.envelope import TcpReference
from hal.servo.servo import Servo
from hal.servo.smoothing import JointSmoother
from hal.specs import RobotSpec, WorkspaceSpec

Array = np.ndarray[Any, np.dtype[np.float64]]
DT = 1 / 240


def weak_iiwa() -> RobotSpec:
    """KUKA's arm with a tool that points aside, and slow, weak joints."""
    spec = iiwa()
    tool = replace(spec.kinematics, tcp_position=(0.2, 0.03, 0.1), tcp_orientation=(0.0, 0.0, 0.6, 0.8))
    limits = replace(spec.limits, velocity=(1.7,) * 7, acceleration=(4.0,) * 7, jerk=(40.0,) * 7)
    return replace(spec, kinematics=tool, limits=limits)


class Arm:
    """One arm with everything that the bounds are about."""

    def __init__(self, spec: RobotSpec) -> None:
        self.limits = spec.limits
        self.kinematics = Kinematics(spec.kinematics)
        self.smoother = JointSmoother(spec.limits, DT)
        self.random = np.random.default_rng(3)
        self.cap = [0.3 * v for v in spec.limits.velocity]

    def reference(self, box: WorkspaceSpec | None = None) -> TcpReference:
        reference = TcpReference(self.smoother, self.kinematics, box)
        reference.open(self.cap)
        return reference

    def somewhere(self) -> Array:
        return self.random.uniform(self.limits.lower, self.limits.upper)

    def aside(self) -> Array:
        """A way of the joints, rad: from a tenth of a mrad to a whole one."""
        return self.random.normal(size=7) * 10.0 ** self.random.uniform(-4.0, 0.0)

    def speeds(self) -> Array:
        """Joint speeds within the session's, often at it."""
        return np.clip(self.random.normal(size=7), -1.0, 1.0) * self.cap

    def tcp_speed(self, q: Sequence[float], dq: Array) -> float:
        return float(np.linalg.norm(self.kinematics.jacobian(q)[:3] @ dq))


@pytest.fixture(params=["panda", "iiwa"])
def arm(request: pytest.FixtureRequest) -> Arm:
    return Arm(panda() if request.param == "panda" else weak_iiwa())


def test_reach_bounds_the_jacobian_its_change_and_the_way_of_the_tcp(arm: Arm) -> None:
    reach = np.array(arm.kinematics.reach())
    greatest = np.zeros(7)
    for _ in range(1000):
        q, d = arm.somewhere(), arm.aside()
        before, after = arm.kinematics.jacobian(q), arm.kinematics.jacobian(q + d)
        greatest = np.maximum(greatest, np.linalg.norm(before[:3], axis=0))
        way = reach @ np.abs(d) + 1e-12
        assert np.linalg.norm(after[:3] - before[:3], axis=0).max() <= way
        assert np.linalg.norm(np.subtract(arm.kinematics.fk(q + d)[:3], arm.kinematics.fk(q)[:3])) <= way
    assert (greatest <= reach + 1e-12).all()
    assert (greatest[:6] > 0.5 * reach[:6]).all(), "a bound that is far too great proves nothing"
    assert (np.diff(reach) <= 0.0).all()


def test_surely_slower_is_never_wrong(arm: Arm) -> None:
    """References near and far, caps just above and below the true speed, any mixture of the old and the new speeds."""
    proven = missed = 0
    for _ in range(1500):
        q, dq = arm.somewhere(), arm.speeds()
        now = dq * arm.random.choice([0.0, 0.5, 1.0, -0.5])
        if arm.random.random() < 0.5:  # the direction in which the tcp is fastest
            dq = 0.1 * np.linalg.svd(arm.kinematics.jacobian(q)[:3])[2][0]
            now = 0.5 * dq
        reference = arm.reference()
        arm.smoother.anchor((q + arm.aside()).tolist())
        reference.pose_and_jacobian()
        arm.smoother.anchor(q.tolist(), now.tolist())
        mixed = [np.where(arm.random.random(7) < 0.5, dq, now) * arm.random.random(7) for _ in range(3)]
        exact = max(arm.tcp_speed(q, speeds) for speeds in (dq, now, *mixed))
        cap = exact * arm.random.choice([0.5, 0.9, 0.999, 1.1, 1.5, 2.0, 3.0])
        if reference.surely_slower(dq.tolist(), cap):
            proven += 1
            assert exact <= cap
        elif cap > 2.0 * exact:
            missed += 1
    assert proven > 300
    assert missed < 100


def test_surely_stops_slower_is_never_wrong(arm: Arm) -> None:
    """The truth is the proposed step, and then the stop in steps of an eighth, one after the other.

    The reference is near, far or not there at all. Every other time it has just proven a stop that begins nearby.
    """
    smoother = arm.smoother
    fine = JointSmoother(arm.limits, DT / 8)
    q = dq = ddq = np.zeros(7)
    proven = missed = 0
    for k in range(360):
        if k % 2:
            a, b, c = np.eye(3)[arm.random.integers(3)]  # what differs
            change = arm.random.normal(size=7) * 10.0 ** arm.random.uniform(-2.0, 0.0)
            q, dq = q + a * change, dq + b * change
            ddq = ddq + c * (np.array(smoother.acceleration) * arm.random.uniform(-1.0, 1.0, 7) - ddq)
        else:
            q, dq = arm.somewhere(), arm.speeds() * arm.random.choice([0.1, 0.5, 1.0])
            ddq = arm.random.uniform(-1.0, 1.0, 7) * smoother.acceleration * arm.random.choice([0.0, 0.1, 1.0])
            reference = arm.reference()
        if k % 6 in (2, 4):
            smoother.anchor((q + (1e-3, 1.0)[k // 2 % 2] * arm.aside()).tolist())
            reference.pose_and_jacobian()
        smoother.anchor(q.tolist(), dq.tolist(), ddq.tolist())
        goal = (dq * arm.random.uniform(0.5, 1.5, 7)).tolist()
        answers: list[tuple[float, bool]] = []

        def propose(
            proposed: JointSmoother, reference: TcpReference = reference, answers: list[tuple[float, bool]] = answers
        ) -> bool:
            fine.anchor(proposed.q_next, proposed.dq_next, proposed.ddq_next)
            way = np.subtract(arm.kinematics.fk(fine.q)[:3], arm.kinematics.fk(proposed.q)[:3])
            exact = max(float(np.linalg.norm(way)) / DT, arm.tcp_speed(fine.q, np.array(fine.dq)))
            while not fine.at_rest():
                fine.stop()
                exact = max(exact, arm.tcp_speed(fine.q, np.array(fine.dq)))
            for share in arm.random.permutation([0.5, 0.999, 1.1, 1.3, 3.0]):  # the first may move the reference
                answers.append((share, reference.surely_stops_slower(share * exact)))
            return True

        smoother.follow(goal, propose)
        assert not any(answer for share, answer in answers if share < 1.0)
        proven += sum(answer for share, answer in answers if share > 1.0)
        missed += sum(not answer for share, answer in answers if share > 1.2)
    assert proven > 500
    assert missed < 80


def test_the_speed_of_a_steady_stop(arm: Arm) -> None:
    """As soon as the ramps of the braking are short, it is the stop's own."""
    limits = replace(arm.limits, jerk=tuple(1e6 * a for a in arm.limits.acceleration))
    smoother = JointSmoother(limits, 1e-3)
    for _ in range(30):
        q, dq = arm.somewhere(), arm.speeds()
        smoother.anchor(q.tolist(), dq.tolist())
        reference = TcpReference(smoother, arm.kinematics, None)
        reference.open(arm.cap)
        expected = reference.stop_speed(dq.tolist())
        linear = arm.kinematics.jacobian(q)[:3]
        fastest = 0.0
        while not smoother.at_rest():
            fastest = max(fastest, float(np.linalg.norm(linear @ smoother.dq)))
            smoother.stop()
        assert fastest <= expected * 1.001
        assert fastest == pytest.approx(expected, rel=0.02, abs=2e-3)


def test_the_curvature_is_the_change_of_the_jacobian(arm: Arm) -> None:
    for _ in range(20):
        q, d = arm.somewhere(), 1e-6 * arm.random.normal(size=7)
        jacobian = arm.kinematics.jacobian(q)
        change = arm.kinematics.jacobian(q + d)[:3] - jacobian[:3]
        expected = np.tensordot(d, arm.kinematics.curvature(jacobian), 1).T
        assert np.abs(change - expected).max() < 1e-9


def test_surely_inside_is_never_wrong(arm: Arm) -> None:
    """Neither for a stop that begins now nor for one after any step that the smoother can take."""
    proven = outside = 0
    smoother = arm.smoother
    for _ in range(1500):
        q, dq = arm.somewhere(), arm.speeds() * arm.random.choice([0.1, 1.0])
        ddq = arm.random.uniform(-1.0, 1.0, 7) * smoother.acceleration * arm.random.choice([0.0, 0.1, 1.0])
        at = np.array(arm.kinematics.fk(q)[:3])
        half = 10.0 ** arm.random.uniform(-2.0, 0.3)
        box = WorkspaceSpec(tuple(at - half), tuple(at + half * arm.random.uniform(0.2, 1.0, 3)))
        reference = arm.reference(box)
        smoother.anchor((q + arm.aside()).tolist())
        reference.pose_and_jacobian()
        smoother.anchor(q.tolist(), dq.tolist(), ddq.tolist())
        end = arm.kinematics.fk(smoother.stop_end())
        inside = is_inside(end, box)
        outside += not inside
        if reference.surely_stays_inside():
            proven += 1
            assert inside
            smoother.follow((arm.random.choice([-1.0, 0.0, 1.0], 7) * smoother.velocity).tolist())
            assert is_inside(arm.kinematics.fk(smoother.stop_end()), box)
    assert proven > 200
    assert outside > 50


def test_a_stop_that_begins_at_rest_may_still_go_far() -> None:
    """A weak joint that has just begun to speed up needs long to take the acceleration back."""
    spec = weak_iiwa()
    kinematics, smoother = Kinematics(spec.kinematics), JointSmoother(spec.limits, 1e-4)
    smoother.anchor(spec.home, None, [4.0] + [0.0] * 6)
    at = np.array(kinematics.fk(spec.home)[:3])
    way = float(np.linalg.norm(np.subtract(kinematics.fk(smoother.stop_end())[:3], at)))
    assert way > 0.01
    for share, expected in ((0.9, False), (20.0, True)):
        reference = TcpReference(smoother, kinematics, WorkspaceSpec(tuple(at - share * way), tuple(at + share * way)))
        reference.open([0.5] * 7)
        assert reference.surely_inside(0.0) == expected


def test_the_next_step_is_foreseen(arm: Arm) -> None:
    """An arm at rest right before a face is inside, but the stop after its next step need not be."""
    home = arm.kinematics.home.tolist()
    at = np.array(arm.kinematics.fk(home)[:3])
    for half, expected in ((1e-6, False), (0.5, True)):
        box = WorkspaceSpec(tuple((at - half).tolist()), tuple((at + half).tolist()))
        arm.smoother.anchor(home)
        reference = arm.reference(box)
        assert reference.surely_stays_inside() == expected
        arm.smoother.follow(arm.cap)
        assert is_inside(arm.kinematics.fk(arm.smoother.stop_end()), box) == expected


def test_a_margin_is_kept(arm: Arm) -> None:
    proven = 0
    for _ in range(300):
        q = arm.somewhere()
        arm.smoother.anchor(q.tolist(), (0.3 * arm.speeds()).tolist())
        at = np.array(arm.kinematics.fk(q)[:3])
        margin = float(arm.random.uniform(0.0, 0.3))
        box = WorkspaceSpec(tuple(at - 0.3), tuple(at + 0.3))
        reference = arm.reference(box)
        reference.surely_inside(0.0)  # what is known then must not answer for the greater margin
        if reference.surely_inside(margin):
            proven += 1
            end = arm.kinematics.fk(arm.smoother.stop_end())
            assert is_inside(end, WorkspaceSpec(tuple(at - 0.3 + margin), tuple(at + 0.3 - margin)))
    assert 20 < proven < 290


def test_a_joint_faster_than_the_session_proves_nothing(arm: Arm) -> None:
    q = list(arm.kinematics.home)
    box = WorkspaceSpec((-9.0,) * 3, (9.0,) * 3)
    arm.smoother.anchor(q, [1.0 * c for c in arm.cap])
    assert arm.reference(box).surely_stays_inside()
    arm.smoother.anchor(q, [1.01 * c for c in arm.cap])
    assert not arm.reference(box).surely_stays_inside()


def test_singularities_are_seen_although_they_are_not_always_looked_for(arm: Arm) -> None:
    """A slow walk through the whole range, with one object that remembers and the definition beside it."""
    kinematics = arm.kinematics
    seen = {True: 0, False: 0}
    looked = 0
    look = kinematics._is_near_singular

    def counted(*arguments: Any) -> bool:
        nonlocal looked
        looked += 1
        return look(*arguments)

    kinematics._is_near_singular = counted
    for _ in range(20):
        a, b = arm.somewhere(), arm.somewhere()
        for share in np.arange(0.0, 1.0, 0.002):
            q = (a + share * (b - a)).tolist()
            smallest = np.linalg.svd(kinematics.jacobian(q), compute_uv=False)[-1]
            near = kinematics.velocity(q, [0.1, 0.0, 0.0, 0.0, 0.0, 0.0])[1]
            assert near == (smallest < NEAR_SINGULAR) or abs(smallest - NEAR_SINGULAR) < 1e-9
            seen[near] += 1
    assert min(seen.values()) > 300
    assert looked < sum(seen.values())


class Counted(Kinematics):
    """Counts how often the arm's kinematics are computed."""

    computed = 0

    def fk(self, q: Any) -> Any:
        self.computed += 1
        return super().fk(q)

    def jacobian(self, q: Any) -> Any:
        self.computed += 1
        return super().jacobian(q)

    def fk_and_jacobian(self, q: Any) -> Any:
        self.computed += 1
        return super().fk_and_jacobian(q)


def counted_bench(tcp_speed: float) -> tuple[Bench, Counted]:
    spec = replace(panda(), workspace=WorkspaceSpec((0.1, -0.8, 0.0), (0.9, 0.8, 1.2)))
    bench = Bench(spec, speed=0.3, tcp_speed=tcp_speed, begin=False)
    kinematics = Counted(spec.kinematics)
    bench.servo = Servo(spec, bench.dt, kinematics)
    bench.servo.anchor(bench.q)
    bench.begin()
    return bench, kinematics


@pytest.mark.parametrize("kind", [Kind.JOINT_VELOCITY, Kind.JOINT_TARGET])
def test_joint_streams_need_hardly_any_kinematics(kind: Kind) -> None:
    bench, kinematics = counted_bench(0.25)
    ticks = 480
    for k in range(ticks):
        dq = [0.15 * np.sin(k * DT + i) for i in range(7)]
        if kind is Kind.JOINT_VELOCITY:
            bench.send(kind, dq)
        else:
            bench.target([x + v * DT for x, v in zip(bench.q, dq, strict=True)], dq)
        bench.tick()
    assert np.abs(np.subtract(bench.q, PANDA_HOME)).max() > 0.1
    assert bench.limited == 0
    assert 0 < kinematics.computed < ticks / 20


def test_near_the_greatest_speed_they_are_computed_and_the_speed_is_kept() -> None:
    bench, kinematics = counted_bench(0.1)
    fastest = 0.0
    for _ in range(240):
        bench.send(Kind.JOINT_VELOCITY, [0.3, 0.2, 0.0, 0.2, 0.0, 0.0, 0.0])
        bench.tick()
        report = bench.servo.report
        linear = kinematics.jacobian(report.q_set)[:3] @ report.dq_set
        fastest = max(fastest, float(np.linalg.norm(linear)))
    assert 0.09 < fastest <= 0.1
    assert kinematics.computed > 300  # of which 240 are this test's own


def test_a_twist_computes_the_kinematics_once_a_tick() -> None:
    bench, kinematics = counted_bench(0.25)
    for k in range(240):
        bench.send(Kind.TWIST, [0.05 * np.cos(k * DT), 0.05, 0.0, 0.0, 0.0, 0.1, 0.0])
        bench.tick()
    assert np.linalg.norm(np.subtract(kinematics.fk(bench.q)[:3], kinematics.fk(PANDA_HOME)[:3])) > 0.04
    assert kinematics.computed <= 240 + 2


def is_inside(pose: Sequence[float], box: WorkspaceSpec) -> bool:
    return all(low <= x <= high for x, low, high in zip(pose, box.lower, box.upper, strict=False))
