"""Torques through the servo: what the driver is given, and how every way to stop ends in a hold by positions."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from servo_kit import Bench
from specs import panda
from torque_kit import NOTHING, Driven, N, one, wheels

from hal.commands import Kind, Session
from hal.driver import Reading, Setpoint
from hal.drivers.mock.robot import MockRobot
from hal.errors import Fault
from hal.kinematics.collision_model import CollisionModel
from hal.servo.collisions import CollisionGuard
from hal.servo.controllers import JointImpedance
from hal.servo.servo import Servo
from hal.specs import BoxSpec, CollisionSpec, WorkspaceSpec
from hal.types import Limited, RobotStatus, Trip

HEAVY = 1e4  # kg m2: no torque makes such an arm fast, so that none is held back


def heavy() -> Driven:
    arm = wheels(mass_matrix=lambda q: HEAVY * np.eye(len(q)))
    here = arm.q.tolist()
    arm.tamper = lambda reading: reading._replace(q=here, dq=NOTHING)
    return arm


def moving() -> Driven:
    """Two wheels are under way."""
    arm = wheels()
    arm.drive(0.1, [5.0, 0.0, 0.0, 0.0, -4.0, 0.0, 0.0])
    assert arm.by_torques
    assert arm.state == (RobotStatus.FOLLOWING, Trip.NONE)
    assert arm.dq[0] > 0.1
    assert arm.dq[4] < -0.1
    return arm


class TestFollowing:
    def test_torques_begin_at_none_and_grow_at_their_rate(self) -> None:
        arm = heavy()
        arm.drive(0.2, [87.0, -20.0, 0.0, 1.0, 12.0, 0.0, 0.0])
        torques = np.array([setpoint.tau for setpoint in arm.given if setpoint.tau is not None])
        assert not torques[0].any(), "the device changes its mode with the first one"
        assert torques[2] == pytest.approx([2 * 990 * arm.dt, -2 * 990 * arm.dt, 0.0, 1.0, 2 * 990 * arm.dt, 0.0, 0.0])
        assert arm.tau == pytest.approx([87.0, -20.0, 0.0, 1.0, 12.0, 0.0, 0.0])
        peaks = arm.audit.peaks()
        assert peaks["torque"] == pytest.approx(1.0)
        assert peaks["torque_rate"] == pytest.approx(0.99)

    def test_torques_beyond_the_limits_are_cut_and_that_is_told(self) -> None:
        arm = heavy()
        arm.drive(0.2, one(0, 80.0))
        assert not arm.limited
        arm.drive(0.2, one(6, -1000.0))
        assert arm.tau[6] == -12.0
        assert arm.limited == Limited.TORQUE

    def test_set_points_say_what_was_measured(self) -> None:
        arm = moving()
        assert (list(arm.setpoint.q), list(arm.setpoint.dq)) == (arm.q.tolist(), arm.dq.tolist())
        assert list(arm.servo.report.q_set) == arm.q.tolist()

    def test_a_joint_is_held_below_the_sessions_speed(self) -> None:
        arm = wheels(tcp_speed=9.0)
        arm.drive(1.0, one(0, 80.0))
        speeds = [reading.dq[0] for reading in arm.readings]
        assert 0.85 < max(speeds) / (0.3 * 2.175) < 0.95
        assert arm.limited & Limited.SPEED
        assert arm.servo.report.trip is Trip.NONE

    def test_the_tcp_is_held_below_its_speed(self) -> None:
        arm = wheels(speed=1.0)
        fastest = 0.0
        for _ in range(200):
            arm.drive(arm.dt, [20.0, 20.0, 0.0, 20.0, 0.0, 0.0, 0.0])
            fastest = max(fastest, arm.tcp_speed)
        assert 0.2 < fastest <= 0.25
        assert arm.limited & Limited.TCP_SPEED

    def test_a_torque_against_something_rigid_is_only_as_great_as_can_be_taken_away_in_time(self) -> None:
        """Should it give way in any tick, the arm does not get faster than the session allows."""
        arm = wheels(tcp_speed=9.0)
        blocked = arm.q.copy()
        arm.tamper = lambda reading: reading._replace(q=blocked.tolist(), dq=NOTHING)
        for k in range(60):
            arm.send(one(0, 87.0))
            arm.setpoint = arm.servo.tick(arm.now, Reading(arm.now, arm.now, k, blocked.tolist(), NOTHING), arm.inbox())
            arm.now += arm.dt
        pushing = arm.tau[0]
        assert 20.0 < pushing < 40.0
        fastest = arm.dt * pushing + sum(max(0.0, pushing - 990.0 * arm.dt * k) * arm.dt for k in range(1, 60))
        assert fastest <= 0.3 * 2.175

    @pytest.mark.parametrize(("mass_matrix", "torque"), [(None, (87.0,) * N), (lambda q: np.eye(N), None)])
    def test_an_arm_that_takes_no_torques_refuses_them(self, mass_matrix: object, torque: object) -> None:
        spec = panda()
        spec = replace(spec, limits=replace(spec.limits, torque=torque))
        bench = Bench(spec)
        bench.servo = Servo(spec, bench.dt, None, mass_matrix)
        bench.servo.anchor(bench.q)
        bench.begin()
        bench.tick()
        refused = bench.send(Kind.JOINT_TORQUE, NOTHING)
        setpoint = bench.tick()
        assert bench.servo.report.refused == refused
        assert setpoint.tau is None

    @pytest.mark.parametrize("values", [[1.0] * 6, [math.nan] * 7, [math.inf] * 7, []])
    def test_torques_that_make_no_sense_are_refused(self, values: list[float]) -> None:
        arm = moving()
        refused = arm.send(values)
        arm.tick()
        assert arm.servo.report.refused == refused

    def test_a_driver_may_change_the_lists_that_it_returned(self) -> None:
        def inertia(q: Sequence[float]) -> np.ndarray:
            return np.diag([2.0 + math.sin(10.0 * x) for x in q])

        def driven(tamper: Callable[[Reading], Reading]) -> list[Setpoint]:
            arm = wheels(mass_matrix=inertia, controller=JointImpedance(stiffness=50.0))
            arm.tamper = tamper
            for _ in range(100):
                arm.send([0.3] * N, Kind.JOINT_VELOCITY)
                arm.tick()
            assert arm.by_torques
            return arm.given

        q, dq = [0.0] * N, [0.0] * N

        def in_place(reading: Reading) -> Reading:
            q[:], dq[:] = reading.q, reading.dq
            return reading._replace(q=q, dq=dq)

        for given, expected in zip(driven(in_place), driven(lambda reading: reading), strict=True):
            assert given.tau == pytest.approx(expected.tau, abs=0.1), "the inertia may be that of a tick later"


class TestStopping:
    WAYS: ClassVar[dict[str, tuple[Callable[[Driven], None], Trip, float]]] = {
        "released": (lambda arm: arm.release(), Trip.NONE, 0.0),
        "stop": (lambda arm: setattr(arm, "stops", 1), Trip.STOP, 0.0),
        "no commands": (lambda arm: None, Trip.COMMAND_LATE, 0.1),
        "app silent": (lambda arm: setattr(arm, "app_alive", False), Trip.COMMAND_LATE, 0.15),
        "fault": (
            lambda arm: setattr(arm, "tamper", lambda r: r._replace(fault=Fault("x", "a cause", "a remedy"))),
            Trip.FAULT,
            0.0,
        ),
        "ended": (lambda arm: arm.servo.close_session(), Trip.NONE, 0.0),
    }

    @pytest.mark.parametrize("way", WAYS)
    def test_it_is_braked_and_then_held_where_it_is(self, way: str) -> None:
        act, trip, patience = self.WAYS[way]
        arm = moving()
        act(arm)
        before = arm.q
        assert arm.until_held() < patience + 0.35
        assert arm.servo.report.trip is trip
        rest = arm.q.copy()
        assert np.abs(rest - before).max() < 0.1
        arm.run(0.5)
        assert not arm.by_torques
        assert arm.q == pytest.approx(rest, abs=1e-3)
        assert arm.q == pytest.approx(arm.servo.report.q_set, abs=1e-9)
        arm.assert_within_limits()

    def test_the_speed_dies_away_and_never_turns_round(self) -> None:
        arm = moving()
        direction = np.sign(arm.dq)
        arm.release()
        speeds = [np.abs(arm.dq).max()]
        while arm.by_torques:
            arm.tick()
            speeds.append(np.abs(arm.dq).max())
            assert (arm.dq * direction >= -1e-9).all()
        ramp = 5  # ticks in which the torques that drove it are taken away
        assert all(after <= before for before, after in zip(speeds[ramp:], speeds[ramp + 1 :], strict=False))

    def test_a_press_counts_once_it_rests_and_follows_new_torques_only(self) -> None:
        arm = moving()
        arm.press_again()
        arm.send(one(0, 5.0), deadline=9.0)
        arm.tick()
        assert arm.state == (RobotStatus.STOPPING, Trip.NONE)
        arm.until_held()
        arm.run(0.2)
        assert not arm.by_torques, "what was sent before the press was granted does not count"
        arm.press_again()
        arm.drive(0.2, one(0, 5.0))
        assert arm.by_torques
        assert arm.dq[0] > 0.1

    def test_a_trip_stays_latched_until_it_rests_whatever_is_pressed(self) -> None:
        arm = moving()
        arm.stops += 1
        arm.tick()
        arm.press_again()
        while arm.by_torques:
            assert arm.servo.report.trip is Trip.STOP
            arm.tick()
        arm.run(2 * arm.dt)
        assert arm.servo.report.trip is Trip.NONE

    def test_what_it_presses_with_is_gone_before_positions_take_over(self) -> None:
        arm = heavy()
        arm.drive(0.2, one(0, 60.0))
        assert arm.tau[0] == pytest.approx(60.0)
        arm.release()
        arm.until_held()
        torques = [setpoint.tau[0] for setpoint in arm.given if setpoint.tau is not None]
        assert abs(torques[-1]) <= 990.0 * arm.dt
        arm.assert_within_limits()

    def test_a_session_that_ends_is_over_once_it_rests(self) -> None:
        arm = moving()
        arm.servo.close_session()
        arm.run(0.5)
        assert arm.setpoint is None
        assert not arm.servo.active
        arm.servo.anchor(arm.q.tolist())
        arm.servo.open_session(Session(2, 0.3, 0.25, True), arm.inbox())

    def test_an_arm_that_was_put_elsewhere_is_held_there(self) -> None:
        arm = moving()
        arm.servo.anchor(panda().home)
        setpoint = arm.tick()
        assert setpoint.tau is None
        assert setpoint.q == pytest.approx(panda().home)


class TestGuards:
    def pushed(self, arm: Driven, push: list[float]) -> None:
        """Somebody pushes with these torques, Nm."""
        driven = arm.driver._driven

        def and_pushed(tau: list[float], dt: float) -> Setpoint:
            moved: Setpoint = driven([x + y for x, y in zip(tau, push, strict=True)], dt)
            return moved._replace(tau=tau)

        arm.driver._driven = and_pushed

    def test_an_arm_that_is_pushed_too_fast_trips(self) -> None:
        arm = wheels(tcp_speed=9.0)
        arm.drive(0.1)
        self.pushed(arm, one(0, 10.0))
        while arm.servo.report.trip is Trip.NONE:
            assert abs(arm.dq[0]) < 0.3 * 2.175 + 0.1
            arm.drive(arm.dt)
        assert arm.state == (RobotStatus.TRIPPED, Trip.LIMIT)
        assert arm.limited & Limited.SPEED

    def test_one_whose_tcp_is_pushed_too_fast_trips(self) -> None:
        arm = wheels(speed=1.0)
        arm.drive(0.1)
        self.pushed(arm, one(3, 10.0))
        while arm.servo.report.trip is Trip.NONE:
            assert arm.tcp_speed < 0.3
            arm.drive(arm.dt)
        assert arm.servo.report.trip is Trip.LIMIT
        assert arm.limited & Limited.TCP_SPEED

    @pytest.mark.parametrize("joint", range(N))
    @pytest.mark.parametrize("direction", [-1.0, 1.0])
    def test_it_stops_before_a_limit_of_position(self, joint: int, direction: float) -> None:
        arm = wheels(speed=1.0, tcp_speed=9.0)
        limits = arm.spec.limits
        for _ in range(3000):
            arm.drive(arm.dt, one(joint, direction * 6.0))
            if arm.servo.report.trip:
                break
        assert arm.servo.report.trip is Trip.LIMIT
        assert arm.servo.report.overrun is Limited.POSITION
        arm.until_held()
        assert (arm.q <= limits.upper).all()
        assert (arm.q >= limits.lower).all()
        edge = limits.upper if direction > 0.0 else limits.lower
        assert abs(arm.q[joint] - edge[joint]) < 0.35
        arm.press_again()
        arm.drive(0.2, one(joint, -direction * 3.0))
        assert arm.state == (RobotStatus.FOLLOWING, Trip.NONE), "it may leave"

    def test_it_stops_before_a_face_of_the_workspace(self) -> None:
        box = WorkspaceSpec((0.0, -0.12, 0.0), (1.0, 0.12, 2.0))
        arm = wheels(box)
        for _ in range(1000):
            arm.drive(arm.dt, one(0, 4.0))
            if arm.servo.report.trip:
                break
        assert arm.servo.report.trip is Trip.LIMIT
        assert arm.servo.report.overrun is Limited.WORKSPACE
        arm.until_held()
        assert 0.05 < arm.servo.kinematics.fk(arm.q)[1] <= 0.12

    def test_an_arm_that_begins_outside_a_limit_may_come_back_in(self) -> None:
        start = list(panda().home)
        start[0] = 2.95  # the limit is 2.8973
        arm = Driven(MockRobot(replace(panda(driver="mock"), initial=tuple(start))))
        arm.drive(0.3, one(0, 3.0))
        assert arm.servo.report.trip is Trip.LIMIT
        arm.until_held()
        assert arm.q[0] < 2.96
        for _ in range(3):  # no way out in small steps
            arm.servo.close_session()
            arm.run(0.1)
            assert not arm.servo.active
            arm.servo.open_session(Session(1, 0.3, 0.25, True), arm.inbox())
            arm.press_again()
            arm.drive(0.3, one(0, 3.0))
            assert arm.servo.report.trip is Trip.LIMIT
            arm.until_held()
            assert arm.q[0] < 2.955
        arm.press_again()
        arm.drive(0.3, one(0, -3.0))
        assert arm.state == (RobotStatus.FOLLOWING, Trip.NONE)
        assert arm.q[0] < 2.94

    def test_an_arm_that_cannot_be_braked_is_left_to_positions_and_that_is_told(self) -> None:
        arm = wheels()
        arm.drive(0.1)
        self.pushed(arm, one(1, 6.0))
        arm.drive(0.05)
        arm.release()
        begun = arm.now
        while arm.by_torques:
            arm.tick()
        assert 0.4 < arm.now - begun < 0.6
        assert arm.servo.report.trip is Trip.LIMIT
        assert arm.dq[1] > 0.1
        assert arm.setpoint.dq[1] == pytest.approx(arm.dq[1], rel=0.5), "positions go on at the speed that it has"
        assert arm.until_held() < 0.2
        arm.assert_within_limits()


class TestMixed:
    def test_torques_wait_for_the_end_of_a_motion(self) -> None:
        arm = wheels()
        for _ in range(60):
            arm.send(one(0, 0.3), Kind.JOINT_VELOCITY)
            arm.tick()
        refused = arm.send(NOTHING)
        arm.tick()
        assert arm.servo.report.refused == refused
        assert arm.state == (RobotStatus.FOLLOWING, Trip.NONE)
        for _ in range(120):
            arm.send(NOTHING, Kind.JOINT_VELOCITY)
            arm.tick()
        arm.drive(0.1)
        assert arm.by_torques

    def test_a_motion_waits_until_a_torque_driven_arm_rests_and_no_torque_is_left(self) -> None:
        arm = moving()
        refused = arm.send(NOTHING, Kind.JOINT_VELOCITY)
        arm.tick()
        assert arm.servo.report.refused == refused
        assert arm.by_torques
        arm.release()
        arm.until_held()
        arm.press_again()
        arm.drive(0.2)
        assert arm.by_torques
        for _ in range(60):
            arm.send(one(0, 0.2), Kind.JOINT_VELOCITY)
            arm.tick()
        assert not arm.by_torques
        assert arm.dq[0] == pytest.approx(0.2, abs=1e-3)
        arm.assert_within_limits()


class TestTheDevice:
    BAD: ClassVar[dict[str, Callable[[Reading], Reading]]] = {
        "not a number": lambda reading: reading._replace(dq=(math.nan,) * N),
        "too few": lambda reading: reading._replace(q=(0.0,) * 3),
        "absurd": lambda reading: reading._replace(dq=(1e9,) * N),
        "torques": lambda reading: reading._replace(tau_commanded=(math.nan,) * N),
    }

    @pytest.mark.parametrize("what", BAD)
    def test_readings_that_cannot_be(self, what: str) -> None:
        """Without speeds nothing can be braked: the torques are taken away, then the device is left alone."""
        arm = moving()
        arm.tamper = self.BAD[what]
        arm.tick()
        assert arm.state == (RobotStatus.TRIPPED, Trip.BAD_READING)
        before = np.abs(arm.tau)
        assert before.max() > 0.0
        arm.run(0.1)
        assert not any(arm.tau)
        arm.run(0.1)
        assert arm.setpoint is None
        arm.tamper = lambda reading: reading
        arm.tick()
        assert arm.setpoint.tau is None, "positions take over where the arm is"
        assert arm.q == pytest.approx(arm.servo.report.q_set, abs=0.01)
        arm.until_held()
        assert arm.servo.report.trip is Trip.BAD_READING
        arm.assert_within_limits()

    def test_torques_that_cannot_be_are_not_stepped_on_from_in_a_fault_either(self) -> None:
        arm = moving()
        fault = Fault("reflex", "a reflex", "recover")
        arm.tamper = lambda reading: reading._replace(tau_commanded=(math.nan,) * N, fault=fault)
        arm.tick()
        assert arm.state == (RobotStatus.FAULT, Trip.FAULT)
        assert np.isfinite(arm.tau).all()

    def test_an_old_reading_counts_as_silence_sooner_than_otherwise(self) -> None:
        arm = moving()
        old = arm.reading
        arm.tamper = lambda reading: old
        begun = arm.now
        while arm.servo.report.trip is Trip.NONE:
            arm.drive(arm.dt, one(0, 3.0))
        assert arm.servo.report.trip is Trip.DEVICE_LOST
        assert arm.now - begun < 0.03
        arm.run(0.05)
        assert not any(arm.tau), "what was right for an old speed may be wrong for the new one"

    @pytest.mark.parametrize("seconds", [0.05, 0.3])
    def test_a_device_that_does_not_answer(self, seconds: float) -> None:
        """Soon it is braked on; later it is left alone, and positions take over where it is."""
        arm = moving()
        arm.silent = True
        arm.tick()
        assert arm.state == (RobotStatus.LOST, Trip.DEVICE_LOST)
        arm.run(seconds)
        assert (arm.setpoint is None) is (seconds > 0.1)
        arm.silent = False
        arm.tick()
        assert arm.by_torques is (seconds < 0.1)
        assert arm.until_held() < 0.35
        arm.drive(0.2, one(0, 3.0))
        assert arm.state == (RobotStatus.TRIPPED, Trip.DEVICE_LOST)

    def test_torques_that_were_lost_do_not_make_the_next_step_greater(self) -> None:
        arm = wheels(tcp_speed=9.0)
        arm.drive(0.05)
        arm.driver.inject(drop=2)
        before = len(arm.driver.log)
        arm.drive(0.1, one(0, 20.0))
        taken = [setpoint.tau[0] for setpoint in list(arm.driver.log)[before::2]]
        steps = np.abs(np.diff([0.0, *taken]))
        assert steps.max() == pytest.approx(990.0 * arm.dt)
        assert max(taken) > 10.0

    def test_a_session_can_end_while_it_does_not_answer(self) -> None:
        arm = moving()
        arm.silent = True
        arm.servo.close_session()
        arm.run(0.3)
        assert (arm.setpoint, arm.servo.active) == (None, False)

    @pytest.mark.parametrize("matrix", [np.zeros((N, N)), np.full((N, N), math.nan), np.eye(3), np.ones((N, N))])
    def test_an_inertia_that_cannot_be_drives_nothing(self, matrix: object) -> None:
        arm = wheels(mass_matrix=lambda q: matrix)
        arm.drive(0.5, one(0, 5.0))
        assert all(not any(setpoint.tau or NOTHING) for setpoint in arm.given)
        assert arm.q == pytest.approx(panda().home)


def test_torques_down_on_a_table_trip_before_its_margin() -> None:
    arm = wheels()
    table = BoxSpec("table", (0.7, 0.0, 0.35), (0.0, 0.0, 0.0, 1.0), (0.5, 1.0, 0.05))
    model = CollisionModel([arm.spec], CollisionSpec(own=False, boxes=(table,)))
    arm.servo.set_guard(CollisionGuard(model, arm.servo.smoother))
    apart = []
    for _ in range(round(3.0 / arm.dt)):
        arm.drive(arm.dt, one(1, 2.0))
        model.place(arm.q)
        apart.append(model.distances().min())
    assert arm.state == (RobotStatus.TRIPPED, Trip.LIMIT)
    assert Limited.COLLISION in arm.limited
    assert not arm.by_torques
    assert apart[0] > 0.03
    assert 0.01 < min(apart) < 0.02
