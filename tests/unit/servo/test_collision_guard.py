"""The servo keeps an arm off itself, off boxes and off other arms, whatever is commanded."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from hal.commands import NO_INBOX, PATIENCE, CommandRecord, Inbox, Kind, PathSection, Session
from hal.config import load
from hal.driver import Reading
from hal.geometry import Pose
from hal.kinematics.arm import Kinematics
from hal.kinematics.collision_model import CollisionModel
from hal.servo.audit import SetpointAudit
from hal.servo.collisions import CollisionGuard, Neighbour
from hal.servo.servo import Servo
from hal.servo.smoothing import stop_phases, stop_step
from hal.specs import BoxSpec, CollisionSpec, LimitsSpec, RobotSpec
from hal.types import Limited

RATE_HZ = 240.0
TABLE = BoxSpec("table", (0.55, 0.0, -0.025), (0.0, 0.0, 0.0, 1.0), (1.5, 1.0, 0.05))
OVER_THE_TABLE = (0.0, 0.45, 0.0, -2.1, 0.0, 2.55, 0.785)
"""The hand points down, some 15 cm above the table."""
Values = Callable[[float], Sequence[float]]


@pytest.fixture(scope="module")
def panda() -> RobotSpec:
    return load({"robots": {"arm": {"model": "panda"}}}, sim=True, driver="mock").resolve().robots[0]


@pytest.fixture(scope="module")
def bar(panda: RobotSpec, tmp_path_factory: pytest.TempPathFactory) -> RobotSpec:
    """Return a bar on one joint: its end comes nearer as fast as any part of it can: no bound is too careful."""
    urdf = tmp_path_factory.mktemp("bar") / "bar.urdf"
    urdf.write_text(
        """<robot name="bar"> <link name="base"/> <link name="bar"> <collision> <origin xyz="0.5 0 0"/>
        <geometry> <box size="1 0.02 0.02"/> </geometry> </collision> </link>
        <joint name="turn" type="revolute"> <parent link="base"/> <child link="bar"/> <axis xyz="0 0 1"/>
        <limit lower="-3" upper="3" velocity="2" effort="1"/> </joint> </robot>"""
    )
    limits = LimitsSpec((-3.0,), (3.0,), (2.0,), (15.0,), (150.0,))
    one = {"joints": ("turn",), "home": (0.0,), "urdf": str(urdf)}
    kinematics = replace(
        panda.kinematics, lower=limits.lower, upper=limits.upper, base_link=None, tcp_link="bar", **one
    )
    return replace(panda, name="bar", initial=(0.0,), limits=limits, kinematics=kinematics, gripper=None, **one)


class Bench:
    """A servo whose set-points are taken at once."""

    def __init__(
        self, spec: RobotSpec, collisions: CollisionSpec | None, others: Sequence[tuple[RobotSpec, Neighbour]] = ()
    ) -> None:
        self.spec = spec
        self.servo = Servo(spec, 1.0 / RATE_HZ)
        self.model = CollisionModel([spec, *(r for r, _ in others)], collisions or CollisionSpec(own=False))
        if collisions is not None:
            self.servo.set_guard(CollisionGuard(self.model, self.servo.smoother, [n for _, n in others]))
        self.others = [neighbour for _, neighbour in others]
        self.seen = Limited.NONE
        self.nearest = math.inf
        self.track: list[list[float]] = []

    def distance(self) -> float:
        self.model.place([*self.servo.smoother.q, *(x for other in self.others for x in other()[0])])
        return float((self.model.distances() - self.model.margins).min(initial=math.inf))

    def start(self, q: Sequence[float], **motion: Any) -> None:
        """Open a session, with a motion if there is one (``move_to``, ``path``)."""
        servo = self.servo
        servo.anchor(list(q))
        servo.open_session(Session(1, 0.3, 0.25, False)._replace(**motion), NO_INBOX)
        self.audit = SetpointAudit(self.spec.limits, 1.0 / RATE_HZ)
        self.now, self.seq = 10.0, 0
        self.seen, self.nearest, self.track = Limited.NONE, math.inf, []

    def run(self, seconds: float, kind: Kind | None = None, values: Values | None = None) -> None:
        servo, command = self.servo, None
        for k in range(round(seconds * RATE_HZ)):
            self.now += 1.0 / RATE_HZ
            if kind is not None and values is not None and k % 5 == 0:
                self.seq += 1
                given = tuple(values(k / RATE_HZ))
                command = CommandRecord(self.seq, 1, self.now, self.now + 0.1, kind, given)
            reading = Reading(self.now, self.now, self.seq, servo.smoother.q, servo.smoother.dq)
            setpoint = servo.tick(self.now, reading, Inbox(command, None, 0, 0, self.now))
            assert setpoint is not None
            self.audit.add_setpoint(setpoint)
            self.seen |= servo.report.limited
            self.nearest = min(self.nearest, self.distance())
            self.track.append(list(setpoint.q))


def twist(*values: float) -> Values:
    return lambda _: (*values, *([0.0] * (6 - len(values))), 0.0)


def test_a_stream_into_the_table_stops_before_the_margin_and_can_leave(panda: RobotSpec) -> None:
    bench = Bench(panda, CollisionSpec(boxes=(TABLE,)))
    bench.start(OVER_THE_TABLE)
    bench.run(1.5, Kind.TWIST, twist(0.0, 0.0, -0.25))
    assert -1e-4 < bench.nearest < 2e-3
    assert Limited.COLLISION in bench.seen
    assert bench.servo.smoother.at_rest()
    assert max(bench.audit.peaks().values()) <= 1.0 + 1e-6
    before = bench.distance()
    bench.run(0.25, Kind.TWIST, twist(0.0, 0.0, 0.2))
    assert bench.distance() > before + 0.005


def test_a_second_session_in_which_one_joint_moves_is_checked(panda: RobotSpec) -> None:
    bench = Bench(panda, CollisionSpec(boxes=(TABLE,)))
    bench.start(OVER_THE_TABLE)
    bench.run(0.1, Kind.JOINT_VELOCITY, lambda _: [0.0] * 7)
    bench.servo.close_session()
    bench.servo.tick(bench.now, Reading(bench.now, bench.now, 0, OVER_THE_TABLE, [0.0] * 7), NO_INBOX)
    bench.start(OVER_THE_TABLE)
    bench.run(1.5, Kind.JOINT_VELOCITY, lambda _: [0.0, 0.6, 0.0, 0.0, 0.0, 0.0, 0.0])
    assert -1e-4 < bench.nearest < 5e-3
    assert Limited.COLLISION in bench.seen


def test_random_streams_never_get_under_a_margin(panda: RobotSpec) -> None:
    rng = np.random.default_rng(8)
    stopped = 0
    for _ in range(6):
        bench = Bench(panda, CollisionSpec(boxes=(TABLE,)))
        bench.start(OVER_THE_TABLE)
        goals = rng.uniform(-0.6, 0.6, (8, 7)) + [0.0, 0.5, 0.0, 0.0, 0.0, 0.0, 0.0]
        bench.run(1.2, Kind.JOINT_VELOCITY, lambda t, goals=goals: goals[int(t / 0.15)])  # type: ignore[misc]
        assert bench.nearest > -1e-4
        assert max(bench.audit.peaks().values()) <= 1.0 + 1e-6
        stopped += Limited.COLLISION in bench.seen
    assert stopped >= 3


def test_far_from_everything_the_set_points_are_the_same_to_the_bit(panda: RobotSpec) -> None:
    checked, free = Bench(panda, CollisionSpec(boxes=(TABLE,))), Bench(panda, None)
    for bench in (checked, free):
        bench.start(panda.home)
        bench.run(0.6, Kind.TWIST, twist(0.1, 0.2, 0.1))
        bench.run(0.6, Kind.JOINT_VELOCITY, lambda t: [0.3 * math.sin(5.0 * t + k) for k in range(7)])
    assert checked.track == free.track


@pytest.mark.parametrize("inside", [0.004, 0.015])  # m; the margin is 0.01, so the second one overlaps
def test_an_arm_that_starts_inside_the_margin_may_only_leave(panda: RobotSpec, inside: float) -> None:
    box = BoxSpec("box", (0.5, 0.0, -0.1), (0.0, 0.0, 0.0, 1.0), (0.3, 0.3, 0.1))
    bench = Bench(panda, CollisionSpec(boxes=(box,)))
    bench.start(OVER_THE_TABLE)
    while bench.distance() > 1e-3 - inside:  # raise the box, which is under the hand
        box = replace(box, position=(0.5, 0.0, box.position[2] + max(1e-3, 0.5 * (bench.distance() + inside))))
        bench = Bench(panda, CollisionSpec(boxes=(box,)))
        bench.start(OVER_THE_TABLE)
    before = bench.distance()
    assert before == pytest.approx(-inside, abs=2e-3)
    bench.run(0.4, Kind.TWIST, twist(0.0, 0.0, -0.1))
    bench.run(0.4, Kind.JOINT_VELOCITY, lambda t: [0.1 * math.sin(9.0 * t + k) for k in range(7)])
    assert bench.nearest > before - 1e-4
    assert Limited.COLLISION in bench.seen
    bench.run(0.6, Kind.TWIST, twist(0.0, 0.0, 0.1))
    assert bench.distance() > before + 0.005


def test_move_to_waits_for_an_arm_in_its_way(panda: RobotSpec) -> None:
    other = replace(panda, name="other", base_position=(1.15, 0.0, 0.0), base_orientation=(0.0, 0.0, 1.0, 0.0))
    away, in_the_way = (0.0, -1.0, 0.0, -2.6, 0.0, 1.6, 0.8), (0.0, 0.3, 0.0, -1.9, 0.0, 2.2, 0.8)
    at = list(in_the_way)
    bench = Bench(panda, CollisionSpec(), [(other, lambda: (at, at))])
    goal = (0.0, 0.5, 0.0, -1.6, 0.0, 2.1, 0.785)
    bench.start(panda.home, move_to=goal)
    bench.run(2.5)
    assert not bench.servo.report.arrived
    assert bench.nearest > -1e-4
    assert Limited.COLLISION in bench.servo.report.limited
    assert not bench.servo.report.off_path
    way, track = np.subtract(goal, panda.home), np.subtract(bench.track, panda.home)
    assert 0.05 < (track @ way).max() / (way @ way) < 0.95
    assert np.abs(track - np.outer(track @ way / (way @ way), way)).max() < 1e-9  # its stops were on its way
    at[:] = away
    bench.run(8.0)
    assert bench.servo.report.arrived


def test_move_to_is_given_up_if_what_is_in_its_way_stays(panda: RobotSpec) -> None:
    other = replace(panda, name="other", base_position=(1.15, 0.0, 0.0), base_orientation=(0.0, 0.0, 1.0, 0.0))
    at = (0.0, 0.3, 0.0, -1.9, 0.0, 2.2, 0.8)
    bench = Bench(panda, CollisionSpec(), [(other, lambda: (at, at))])
    bench.start(panda.home, move_to=(0.0, 0.5, 0.0, -1.6, 0.0, 2.1, 0.785))
    bench.run(PATIENCE + 4.0)
    assert bench.servo.report.off_path
    assert not bench.servo.report.arrived
    assert bench.servo.smoother.at_rest()


@pytest.mark.parametrize("planned", [False, True])
def test_a_motion_stops_on_its_path_before_what_is_in_its_way(bar: RobotSpec, planned: bool) -> None:
    limits = replace(bar.limits, jerk=(20.0,), velocity=(5.0,))  # so small that the stop is a long one
    bench = Bench(replace(bar, limits=limits), CollisionSpec(own=False, boxes=(POST,)))
    start, end = (-0.7,), (1.0,)
    section = PathSection((0.0, 0.8, 1.7), (start, (0.1,), end))
    bench.start(start, **({"path": (section,)} if planned else {"move_to": end}))
    bench.run(3.0)
    assert -1e-4 < bench.nearest < 0.02
    assert Limited.COLLISION in bench.servo.report.limited
    assert not bench.servo.report.off_path
    assert max(bench.audit.peaks().values()) <= 1.0 + 1e-6


def test_what_comes_between_an_arm_and_the_end_of_its_stop_stops_it(bar: RobotSpec) -> None:
    slow = replace(bar, limits=replace(bar.limits, jerk=(20.0,), velocity=(5.0,)))
    other = replace(bar, name="other", base_position=(1.9, 0.0, 0.0), base_orientation=(0.0, 0.0, 1.0, 0.0))
    at = [2.0]
    bench = Bench(slow, CollisionSpec(), [(other, lambda: (at, at))])
    bench.start((-1.0,), move_to=(1.0,))
    while bench.servo.smoother.q[0] < -0.1:
        bench.run(0.02)
    here, end = bench.servo.smoother.q[0], bench.servo.stop_end()[0]
    assert end > here + 0.15
    at[0] = -0.5 * (here + end)  # its own end is at this height, between the two
    bench.run(0.02)
    assert Limited.COLLISION in bench.seen


class MeasuredArm:
    """The guard of an arm that follows torques: it is told where the arm is measured."""

    def __init__(self, panda: RobotSpec, low: float, share: float = 1.0) -> None:
        """Put the arm at ``low`` m above the margin of the table, or below it, when torques begin."""
        self.model = CollisionModel([panda], CollisionSpec(own=False, boxes=(TABLE,)))
        smoother = Servo(panda, 1.0 / RATE_HZ).smoother
        smoother.anchor(list(OVER_THE_TABLE))
        guard = CollisionGuard(self.model, smoother)
        guard.open(panda.limits.velocity)
        self.guard, self.measured = guard, guard.measured
        self.solver = Kinematics(panda.kinematics)
        self.q = list(OVER_THE_TABLE)
        self.q = self.lower(self.distance(self.q) - 0.01 - low)
        self.measured.start(self.q, share)

    def distance(self, q: Sequence[float]) -> float:
        self.model.place(q)
        return float(self.model.distances().min())

    def lower(self, way: float) -> list[float]:
        """Return the joint positions that have the hand lower by ``way``, m."""
        pose = list(self.solver.fk(self.q))
        pose[2] -= way
        return self.solver.solve(Pose(pose[:3], pose[3:]), np.array(self.q)).tolist()


def test_a_measured_arm_may_not_end_inside_a_margin(panda: RobotSpec) -> None:
    arm = MeasuredArm(panda, 0.02)
    assert arm.measured.allows(arm.q, [arm.lower(0.018)])
    assert not arm.measured.allows(arm.q, [arm.lower(0.022)])
    assert not arm.measured.allows(arm.q, [arm.lower(-0.05), arm.lower(0.022)])
    assert MeasuredArm(panda, 0.02, 0.5).measured.allows(arm.q, [arm.lower(0.024)])


def test_a_measured_arm_inside_a_margin_may_only_leave_and_not_come_back(panda: RobotSpec) -> None:
    arm = MeasuredArm(panda, -0.004)
    assert arm.measured.allows(arm.q, [arm.q])
    assert not arm.measured.allows(arm.q, [arm.lower(0.002)])
    away = arm.lower(-0.003)
    assert arm.measured.allows(arm.q, [away])
    assert arm.measured.allows(away, [away])
    assert not arm.measured.allows(away, [arm.q])


def test_a_measured_arm_at_its_margin_may_tremble(panda: RobotSpec) -> None:
    arm = MeasuredArm(panda, 2e-4)
    assert arm.measured.allows(arm.q, [arm.lower(5e-4)])
    assert not arm.measured.allows(arm.q, [arm.lower(2e-3)])


def test_a_measured_arm_creeps_no_nearer_by_beginning_again_and_again(panda: RobotSpec) -> None:
    arm = MeasuredArm(panda, 2e-4)
    for step in (9e-4, 3e-4, 3e-4, 3e-4):  # the first one ends where it may tremble to
        lower = arm.lower(step)
        assert arm.measured.allows(arm.q, [lower]) == (step == 9e-4)
        arm.q = lower
        arm.measured.start(arm.q, 1.0)
        assert arm.measured.allows(arm.q, [arm.lower(-1e-3)])
    arm.q = arm.lower(-0.02)
    arm.measured.start(arm.q, 1.0)
    assert arm.measured.allows(arm.q, [arm.lower(0.017)])
    assert not arm.measured.allows(arm.q, [arm.lower(0.019)])


def test_a_compliant_arm_is_checked_off_its_set_point(panda: RobotSpec) -> None:
    arm = MeasuredArm(panda, 0.02, 0.5)
    still = [0.0] * 7
    assert arm.guard.allows_arm(arm.q, still, 0.06)
    assert not arm.guard.allows_arm(arm.lower(0.026), still, 0.06)
    speed = (np.subtract(arm.lower(0.01), arm.q) / 0.01 * 0.5).tolist()  # 0.5 m/s down
    assert not arm.guard.allows_arm(arm.q, speed, 0.06)
    assert arm.guard.allows_arm(arm.q, [-v for v in speed], 0.06)


POLES = tuple(
    BoxSpec(f"pole{k}", (0.5, y, 0.5), (0.0, 0.0, 0.0, 1.0), (0.01, 0.01, 1.0)) for k, y in enumerate((-0.4, 0.3))
)


POST = BoxSpec("post", (0.9, 0.3, 0.0), (0.0, 0.0, 0.0, 1.0), (0.01, 0.01, 1.0))
"""Beside the end of the bar."""

_FAST = 8.0
"""No part of an arm is faster, m/s."""


class Stops:
    """Steps that a guard is asked for, and the distances in the stops after them."""

    def __init__(self, spec: RobotSpec, boxes: tuple[BoxSpec, ...], other: RobotSpec | None = None) -> None:
        limits = replace(spec.limits, jerk=(150.0,) * len(spec.joints))  # so small that joints go on, and turn back
        self.spec = replace(spec, limits=limits)
        self.model = CollisionModel([spec, other] if other else [spec], CollisionSpec(own=False, boxes=boxes))
        self.smoother = Servo(self.spec, 1.0 / RATE_HZ).smoother
        self.elsewhere: list[Sequence[float]] = [other.home, other.home] if other else []
        others: list[Neighbour] = [lambda: (self.elsewhere[0], self.elsewhere[1])] if other else []
        self.guard = CollisionGuard(self.model, self.smoother, others)
        self.guard.open(limits.velocity)

    def room(self, q: Sequence[float], share: float = 0.0) -> float:
        """Return the smallest distance less margin, m, with the other arm at this share of its stop."""
        there = np.array(self.elsewhere)
        between = (1.0 - share) * there[0] + share * there[1] if len(there) else []
        self.model.place([*q, *between])
        return float((self.model.distances() - self.model.margins).min())

    def propose(self, q: Sequence[float], dq: Sequence[float], ddq: Sequence[float]) -> bool:
        """Return whether the guard allows a step that ends so."""
        self.smoother.q_next, self.smoother.dq_next, self.smoother.ddq_next = list(q), list(dq), list(ddq)
        return self.guard.allows()

    def least_room(self) -> float:
        """Return the smallest room in the stop after the proposed step, m."""
        smoother = self.smoother
        step = zip(
            smoother.q_next, smoother.dq_next, smoother.ddq_next, smoother.acceleration, smoother.jerk, strict=True
        )
        joints = list(step)
        duration = max(stop_phases(v, a, A, J)[3] for _, v, a, A, J in joints)
        least, t = math.inf, 0.0
        while t < 1.02 * duration:
            place = [stop_step(x, v, a, A, J, t)[0] for x, v, a, A, J in joints]
            room = min(self.room(place, share) for share in ((0.0, 0.5, 1.0) if self.elsewhere else (0.0,)))
            least = min(least, room)
            t += max(0.02 * duration, room / _FAST)
        return least


@pytest.mark.parametrize("moving", [False, True])
@pytest.mark.parametrize(("arm", "middle"), [("panda", OVER_THE_TABLE), ("bar", (0.0,))])
def test_no_stop_of_an_accepted_step_enters_a_margin(
    arm: str, middle: Sequence[float], moving: bool, request: pytest.FixtureRequest
) -> None:
    spec: RobotSpec = request.getfixturevalue(arm)
    n, apart = len(spec.joints), 1.0 if arm == "panda" else 1.9
    other = replace(spec, name="other", base_position=(apart, 0.0, 0.0), base_orientation=(0.0, 0.0, 1.0, 0.0))
    boxes = (TABLE, *POLES) if arm == "panda" else (POST,)
    stops = Stops(spec, () if moving else boxes, other if moving else None)
    low, high = np.array(spec.limits.lower), np.array(spec.limits.upper)
    fastest, hardest = np.array(spec.limits.velocity), 0.999 * np.array(spec.limits.acceleration)
    rng = np.random.default_rng(2)
    accepted = refused = 0
    for _ in range(40 if arm == "bar" else 12):
        start = np.clip(middle + rng.normal(0.0, 0.4, n), low, high)
        stops.elsewhere[:] = [spec.home, spec.home] if moving else []
        if stops.room(start) < 0.0:
            continue
        stops.smoother.anchor(start.tolist())
        stops.propose(start, 1e-3 * fastest, np.zeros(n))  # from what is known here follows what is near it
        for _ in range(12):
            if moving:
                there = np.array(spec.home) + rng.choice([0.0, 0.05, 0.3]) * rng.normal(size=n)
                stops.elsewhere[:] = [there, there + rng.choice([0.0, 0.3]) * rng.normal(size=n)]
                if min(stops.room(start, share) for share in (0.0, 0.5, 1.0)) < 0.0:
                    continue
            q = np.clip(start + rng.choice([0.0, 0.02, 0.2]) * rng.normal(size=n), low, high)
            dq = rng.choice([0.05, 0.3, 1.0]) * rng.uniform(-fastest, fastest)
            if not stops.propose(q, dq, rng.uniform(-hardest, hardest)):
                refused += 1
                continue
            accepted += 1
            assert stops.least_room() > -2e-5
    assert accepted > 50
    assert refused >= 20


@pytest.mark.parametrize("what", ["moved", "fast", "accelerates"])
def test_nothing_is_taken_for_far_after_a_change(panda: RobotSpec, what: str) -> None:
    stops = Stops(panda, POLES[1:])
    q, slowly, still = list(OVER_THE_TABLE), [0.05, *[0.0] * 6], [0.0] * 7
    while stops.room(q) > 0.02:
        q[0] += 1e-3
    stops.smoother.anchor(q)
    assert stops.propose(q, slowly, still)
    assert not stops.propose(q, [2.0, *[0.0] * 6], still)
    assert stops.propose(q, slowly, still)
    if what == "moved":
        while stops.room(q) > 1e-5:
            q[0] += 1e-3
    changed = {
        "moved": (q, slowly, still),
        "fast": (q, [1.0, *[0.0] * 6], still),
        "accelerates": (q, slowly, [14.0, *[0.0] * 6]),
    }
    assert not stops.propose(*changed[what])


def test_an_arm_slows_down_for_another_one_that_comes_nearer(panda: RobotSpec) -> None:
    other = replace(panda, name="other", base_position=(1.2, 0.0, 0.0), base_orientation=(0.0, 0.0, 1.0, 0.0))
    stops, goal = Stops(panda, (), other), [0.0, 0.5, *[0.0] * 5]
    stops.smoother.anchor(list(OVER_THE_TABLE))
    assert stops.guard.slow(goal) == goal
    stops.elsewhere[1] = np.add(other.home, [0.0, 0.3, 0.0, 0.15, 0.0, 0.15, 0.0])
    assert stops.room(OVER_THE_TABLE, 1.0) > 0.1, "it stops far enough away for every step to be allowed"
    assert stops.guard.slow(goal)[1] < 0.5 * goal[1]


@pytest.mark.parametrize("moved", [False, True])
def test_another_arm_is_not_taken_for_far_after_it_moved_or_set_off(panda: RobotSpec, moved: bool) -> None:
    other = replace(panda, name="other", base_position=(1.2, 0.0, 0.0), base_orientation=(0.0, 0.0, 1.0, 0.0))
    stops = Stops(panda, (), other)
    q, slowly = list(OVER_THE_TABLE), [0.0, 0.05, *[0.0] * 5]
    stops.smoother.anchor(q)
    assert stops.propose(q, slowly, [0.0] * 7)
    near = (0.0, 0.7, 0.0, -1.6, 0.0, 2.3, 0.8)
    stops.elsewhere[:] = [near, near] if moved else [stops.elsewhere[0], near]
    assert stops.room(q, 1.0) < 0.0
    assert not stops.propose(q, slowly, [0.0] * 7)


def test_an_arm_inside_a_margin_does_not_pass_through_what_is_near(panda: RobotSpec) -> None:
    q, x, y, _ = list(OVER_THE_TABLE), *Kinematics(panda.kinematics).fk(OVER_THE_TABLE)[:3]
    stops = Stops(panda, (replace(POLES[0], position=(x + 0.118, y, 0.3), size=(0.01, 0.01, 0.6)),))
    q[6] = min(np.linspace(q[6] - 1.5, q[6] + 1.5, 301), key=lambda turn: stops.room([*q[:6], turn])) - 0.1
    stops.smoother.anchor(q)
    still = [0.0] * 7
    assert stops.room(q) < 0.0
    assert not stops.propose(q, [*still[:6], 1.8], still)
    assert stops.room(stops.smoother.stop_end_next()) > stops.room(q)
    assert not stops.propose(q, [*still[:6], 0.1], still)
    assert stops.propose(q, [*still[:6], -0.1], still)
