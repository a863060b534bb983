"""Controllers: their laws against known answers, and what ends a session of theirs through the servo."""

from __future__ import annotations

import math
from collections.abc import Callable
from itertools import pairwise
from typing import Any, ClassVar

import numpy as np
import pytest
from errors_kit import raises_code
from numpy.typing import NDArray
from specs import panda
from torque_kit import NOTHING, Driven, N, one, wheels

from hal.commands import Kind, Session
from hal.dynamics import Dynamics
from hal.errors import CommandError, Fault
from hal.geometry import apply_rotation, difference, rotate
from hal.kinematics.arm import Kinematics
from hal.servo.controllers import (
    RAMP,
    Controller,
    ControllerLaw,
    JointImpedance,
    OperationalSpace,
    controller_data,
    replace_gains,
    resolve,
)
from hal.servo.torque_bounds import ArmInMotion, Inertia, TcpInMotion
from hal.types import ControlMode, Limited, RobotStatus, Trip

Array = NDArray[np.float64]
DT = 1e-3
SPEC = panda()
KINEMATICS = Kinematics(SPEC.kinematics)
DYNAMICS = Dynamics.of(SPEC)
HOME = np.array(SPEC.home)
MASS = DYNAMICS.mass_matrix(HOME)
JACOBIAN = KINEMATICS.jacobian(HOME)


class Applied:
    """A law at home, to which a set-point, a speed and the distance of the tcp are given."""

    def __init__(self, controller: Controller, **more: Any) -> None:
        self.law = ControllerLaw(resolve(controller, SPEC, KINEMATICS, 1.0 / DT), N, DT, SPEC.limits.velocity, **more)

    def torques(
        self,
        away: Any = NOTHING,
        lag: Any = NOTHING,
        acceleration: Any = NOTHING,
        error: Any = (0.0,) * 6,
        mass: Array = MASS,
    ) -> Array:
        """Return all torques (n,), Nm; the arm moves at ``-lag`` while its set-point rests."""
        setpoint = (HOME + away, np.zeros(N), np.array(acceleration))
        rows = self.law.torques(*in_motion(HOME, -np.array(lag), mass), setpoint, list(error))
        return np.asarray(rows.sum(axis=0), np.float64)


def in_motion(q: Array, dq: Array, mass: Array) -> tuple[ArmInMotion, TcpInMotion]:
    """Return the measured state of an arm, and of its tcp."""
    pose, jacobian = KINEMATICS.fk_and_jacobian(q)
    arm = ArmInMotion(q.tolist(), dq.tolist(), Inertia(mass, N))
    velocity = jacobian[:3] @ dq
    return arm, TcpInMotion(pose, jacobian, velocity, float(np.linalg.norm(velocity)), q, dq)


def test_joint_springs_pull_with_their_stiffness() -> None:
    stiffness = (100.0, 80.0, 60.0, 50.0, 40.0, 30.0, 20.0)
    away = [0.01, -0.02, 0.0, 0.03, 0.01, -0.01, 0.02]
    tau = Applied(JointImpedance(stiffness=stiffness)).torques(away)
    assert tau == pytest.approx(np.multiply(stiffness, away), abs=1e-9)


@pytest.mark.parametrize("ratio", [0.5, 1.0])
def test_a_damper_of_a_joint_by_itself_has_its_ratio(ratio: float) -> None:
    masses = np.array([1.0, 1.2, 0.8, 0.9, 0.2, 0.3, 0.1])
    tau = Applied(JointImpedance(stiffness=50.0, damping_ratio=ratio)).torques(lag=[0.1] * N, mass=np.diag(masses))
    assert tau == pytest.approx(0.1 * 2.0 * ratio * np.sqrt(50.0 * masses), rel=1e-9)


def test_a_rate_accelerates_every_joint_alike() -> None:
    tau = Applied(JointImpedance(rate=100.0)).torques([0.01] * N)
    assert np.linalg.solve(MASS, tau) == pytest.approx([1.0] * N, rel=1e-9)


def test_the_acceleration_of_the_set_point_and_coriolis_torques_are_fed_forward() -> None:
    dq, acceleration = [0.3, -0.2, 0.4, 0.1, 0.5, -0.3, 0.2], [1.0, 0.0, -2.0, 0.5, 0.0, 1.0, 0.0]
    controller = JointImpedance(stiffness=50.0)
    damped = Applied(controller).torques(lag=[-v for v in dq])
    fed = Applied(controller, dynamics=DYNAMICS).torques(lag=[-v for v in dq], acceleration=acceleration) - damped
    expected = DYNAMICS.inverse(HOME, dq, acceleration) - DYNAMICS.gravity(HOME)
    assert fed == pytest.approx(expected, abs=1e-9)


def test_friction_that_the_arm_compensates_is_added() -> None:
    controller, lag = JointImpedance(stiffness=50.0), [-0.2] * N
    more = Applied(controller, friction=[0.5] * N).torques(lag=lag) - Applied(controller).torques(lag=lag)
    assert more == pytest.approx([0.1] * N)


@pytest.mark.parametrize("axis", range(6))
def test_the_tcp_is_pulled_with_its_stiffness_along_the_base(axis: int) -> None:
    controller = OperationalSpace(stiffness=(500.0, 700.0, 900.0), rotation_stiffness=(20.0, 30.0, 40.0))
    error = [0.01 * (k == axis) for k in range(6)]
    force = (500.0, 700.0, 900.0, 20.0, 30.0, 40.0)[axis] * np.array(error)
    assert Applied(controller).torques(error=error) == pytest.approx(JACOBIAN.T @ force, abs=1e-9)


def test_gains_along_the_tcp_turn_with_it() -> None:
    q = HOME + [0.3, 0.2, -0.4, 0.1, 0.5, -0.3, 0.6]
    pose, jacobian = KINEMATICS.fk_and_jacobian(q)
    controller = OperationalSpace(stiffness=(100.0, 100.0, 1000.0), rotation_stiffness=10.0, frame="tcp")
    law = Applied(controller).law
    along, across = (rotate(pose[3:], axis) for axis in ((0.0, 0.0, 1.0), (0.0, 1.0, 0.0)))
    for direction, stiffness in ((along, 1000.0), (across, 100.0)):
        error = [0.01 * x for x in direction] + [0.0] * 3
        arm, tcp = in_motion(q, np.zeros(N), DYNAMICS.mass_matrix(q))
        tau = law.torques(arm, tcp, (q, np.zeros(N), np.zeros(N)), error).sum(axis=0)
        assert tau == pytest.approx(jacobian[:3].T @ (stiffness * np.array(error[:3])), abs=1e-9)
        ease, gain = jacobian[:3] @ arm.inertia.solve(tau), law.gain()
        assert gain @ ease > 0.9 * np.linalg.norm(gain) * np.linalg.norm(ease) > 0.0
        assert np.linalg.norm(gain) <= law.most_gain < np.inf


def test_what_is_too_light_for_the_rate_is_softened() -> None:
    """Beyond the rate's frequencies, a spring is as soft, and a damper as weak, as one period can bear."""
    applied, masses = Applied(JointImpedance(stiffness=50.0)), np.full(N, 1e-4)
    assert applied.torques(lag=[0.1] * N, mass=np.diag(masses)) == pytest.approx(0.1 * 0.9 * masses / DT)
    soft = Applied(JointImpedance(stiffness=50.0)).torques([1e-4] * N, mass=np.diag(0.1 * masses))
    assert soft == pytest.approx(1e-4 * 1.5 / DT**2 * 0.1 * masses)


def test_position_only_leaves_the_orientation_free() -> None:
    controller = OperationalSpace(stiffness=800.0, position_only=True)
    tau = Applied(controller).torques(error=[0.0, 0.01, 0.0, 0.5, 0.5, 0.5])
    assert tau == pytest.approx(JACOBIAN[:3].T @ [0.0, 8.0, 0.0], abs=1e-9)


def test_the_posture_does_not_accelerate_the_tcp() -> None:
    posture = tuple(HOME + [0.3, -0.2, 0.3, 0.1, -0.3, 0.2, 0.3])
    tau = Applied(OperationalSpace(posture=posture, posture_stiffness=10.0)).torques()
    accelerations = np.linalg.solve(MASS, tau)
    assert np.abs(accelerations).max() > 0.5, "the elbow moves"
    # Inertias at the tcp of more than 200 kg and 20 kg m2 are not believed, which leaves a little.
    assert np.abs(JACOBIAN @ accelerations).max() < 0.02 * np.abs(accelerations).max()


def test_a_spring_of_the_orientation_is_no_longer_than_what_it_may_turn_the_tcp_with() -> None:
    applied = Applied(OperationalSpace(rotation_stiffness=50.0))
    near, far = (np.abs(applied.torques(error=[0.0] * 5 + [x])).max() for x in (0.5, 1.0))
    assert far == pytest.approx(near), "longer springs pull no harder"


def test_new_gains_take_effect_within_the_ramp() -> None:
    applied = Applied(JointImpedance(stiffness=100.0))
    applied.law.set_gains(replace_gains(applied.law.controller, {"stiffness": (20.0,) * N}))
    found = [applied.torques([0.01] * N)[0] for _ in range(round(RAMP / DT) + 2)]
    assert found[0] == pytest.approx(1.0, abs=0.01)
    assert found[-1] == pytest.approx(0.2)
    assert max(abs(a - b) for a, b in pairwise(found)) < 0.01


@pytest.mark.parametrize(
    "gains",
    [
        {"stiffness": -1.0},
        {"stiffness": 1e9},
        {"stiffness": math.nan},
        {"damping_ratio": 0.0},
        {"rate": 10.0},
        {"x": 1},
    ],
)
def test_gains_out_of_range_are_refused(gains: dict[str, float]) -> None:
    with pytest.raises(CommandError):
        replace_gains(resolve(JointImpedance(), SPEC, KINEMATICS, 240.0), gains)


@pytest.mark.parametrize("controller", [OperationalSpace(), JointImpedance()], ids=["task", "joints"])
def test_default_gains_suit_every_arm_and_those_that_were_passed_are_refused(controller: Controller) -> None:
    """At 50 Hz the defaults of a Panda are too stiff, as those of a light arm are at 240 Hz."""
    gains = ("stiffness", "rotation_stiffness")
    usual, soft = resolve(controller, SPEC, KINEMATICS, 1000.0), resolve(controller, SPEC, KINEMATICS, 50.0)
    passed = {name: getattr(usual, name) for name in gains if hasattr(usual, name)}
    shares = [np.divide(getattr(soft, name), passed[name]) for name in passed]
    assert np.concatenate(shares) == pytest.approx(shares[0][0])
    assert shares[0][0] < 0.9
    assert resolve(soft, SPEC, KINEMATICS, 50.0) == soft
    with raises_code(CommandError, "bad_controller"):
        resolve(type(controller)(**passed), SPEC, KINEMATICS, 50.0)


def test_a_light_joint_in_the_null_space_has_a_softer_posture() -> None:
    found = [resolve(OperationalSpace(position_only=True), SPEC, KINEMATICS, hz) for hz in (20.0, 240.0)]
    assert 0.0 < getattr(found[0], "posture_stiffness") < 10.0  # noqa: B009  # of a union
    assert getattr(found[1], "posture_stiffness") == 10.0  # noqa: B009


def test_an_inertia_that_no_arm_has_is_refused() -> None:
    for wrong in (-np.eye(N), np.full((N, N), math.nan), np.eye(N) - 2.0 * np.ones((N, N)) / N, np.eye(6)):
        with pytest.raises(ValueError, match="inertia"):
            Inertia(wrong, N)


CONTROLLERS = pytest.mark.parametrize("controller", [OperationalSpace(), JointImpedance()], ids=["task", "joints"])


def compliant(controller: Controller, **how: Any) -> Driven:
    """An arm under way, by the torques of a controller."""
    arm = wheels(controller=controller, **how)
    for _ in range(20):
        arm.send([0.2] + [0.0] * 6, Kind.JOINT_VELOCITY)
        arm.tick()
    assert arm.by_torques
    assert arm.state == (RobotStatus.FOLLOWING, Trip.NONE)
    return arm


class TestStopping:
    STAYS: ClassVar[dict[str, tuple[Callable[[Driven], None], Trip]]] = {
        "released": (lambda arm: arm.release(), Trip.NONE),
        "stop": (lambda arm: setattr(arm, "stops", 1), Trip.STOP),
        "deadline missed": (lambda arm: None, Trip.COMMAND_LATE),
    }

    @CONTROLLERS
    @pytest.mark.parametrize("way", STAYS)
    def test_a_stop_ends_the_set_point_and_the_controller_holds_it(self, way: str, controller: Controller) -> None:
        act, trip = self.STAYS[way]
        arm = compliant(controller)
        act(arm)
        arm.run(0.6)
        assert arm.servo.report.trip is trip
        assert arm.by_torques
        assert arm.servo.report.controller is not ControlMode.POSITION
        assert np.abs(arm.dq).max() < 0.01
        rest = arm.servo.report.q_set
        arm.run(0.1)
        assert arm.servo.report.q_set == rest

    ENDS: ClassVar[dict[str, tuple[Callable[[Driven], None], Trip]]] = {
        "position is no number": (
            lambda arm: setattr(arm, "tamper", lambda r: r._replace(q=[math.nan] * N)),
            Trip.BAD_READING,
        ),
        "speed is no number": (
            lambda arm: setattr(arm, "tamper", lambda r: r._replace(dq=[math.nan] * N)),
            Trip.BAD_READING,
        ),
        "old reading": (
            lambda arm: setattr(arm, "tamper", lambda r, t=arm.now: r._replace(t=t)),
            Trip.DEVICE_LOST,
        ),
        "no answer": (lambda arm: setattr(arm, "silent", True), Trip.DEVICE_LOST),
        "fault": (
            lambda arm: setattr(arm, "tamper", lambda r: r._replace(fault=Fault("x", "a cause", "a remedy"))),
            Trip.FAULT,
        ),
        "inertia is no number": (
            lambda arm: setattr(arm.servo._torque, "_mass_matrix", lambda q: np.full((N, N), math.nan)),
            Trip.NONE,
        ),
    }

    @CONTROLLERS
    @pytest.mark.parametrize("way", ENDS)
    def test_an_unknown_arm_gets_no_torques(self, way: str, controller: Controller) -> None:
        act, trip = self.ENDS[way]
        arm = compliant(controller)
        act(arm)
        for _ in range(round(0.5 / arm.dt)):
            arm.send([0.2] + [0.0] * 6, Kind.JOINT_VELOCITY)
            arm.tick()
        assert not arm.by_torques
        if trip:
            assert arm.servo.report.trip is trip
        for setpoint in arm.given:
            assert setpoint.tau is None or math.isfinite(sum(setpoint.tau))
        assert arm.audit.peaks()["torque"] <= 1.0
        assert arm.audit.peaks()["torque_rate"] <= 1.0


@CONTROLLERS
def test_no_torque_exceeds_its_limit(controller: Controller) -> None:
    """An arm that something holds far behind its set-point; a weak wrist reaches its limit first."""
    strong = type(controller)(stiffness=3000.0) if isinstance(controller, OperationalSpace) else controller
    arm = wheels(controller=strong)
    here = (arm.q + 0.0).tolist()
    arm.tamper = lambda reading: reading._replace(q=here, dq=NOTHING)
    for _ in range(200):
        arm.send([0.4] * N, Kind.JOINT_VELOCITY)
        arm.tick()
    assert arm.limited & Limited.LEAD
    peaks = arm.audit.peaks()
    assert peaks["torque"] <= 1.0
    assert peaks["torque_rate"] <= 1.0


def test_a_set_point_that_is_held_back_continues_at_the_speed_of_the_arm() -> None:
    arm = compliant(JointImpedance(stiffness=100.0))
    here = arm.q.tolist()
    arm.tamper = lambda reading: reading._replace(q=here, dq=NOTHING)
    for _ in range(300):
        arm.send([0.3] + [0.0] * 6, Kind.JOINT_VELOCITY)
        arm.tick()
    away = difference(KINEMATICS.fk(here), KINEMATICS.fk(arm.servo.report.q_set))
    assert math.hypot(*away[:3]) <= 0.05 + 1e-3
    assert arm.servo.report.dq_set[0] < 0.1, "it does not move ahead of an arm that does not move"


def test_the_jerk_of_a_set_point_is_what_torques_can_follow() -> None:
    arm = wheels(controller=JointImpedance(), rate_hz=1000.0)
    jerks = []
    before = np.zeros(N)
    for k in range(300):
        arm.send([0.3 if k < 150 else -0.3] + [0.0] * 6, Kind.JOINT_VELOCITY)
        arm.tick()
        now = np.array(arm.servo.report.ddq_set)
        jerks.append(np.abs(now - before).max() / arm.dt)
        before = now
    assert max(jerks) * MASS[0, 0] <= 0.51 * 990.0
    arm.servo.close_session()
    arm.run(1.0)
    assert not arm.servo.active
    arm.servo.open_session(Session(2, 0.3, 0.25, True), arm.inbox())
    assert arm.servo.smoother.jerk == pytest.approx(SPEC.limits.jerk, rel=1e-4)


def test_a_motion_that_is_held_back_does_not_keep_the_speed_of_a_pushed_arm() -> None:
    arm = compliant(JointImpedance(stiffness=100.0))
    chosen = controller_data(arm.servo._compliance._law.controller)
    arm.servo.close_session()
    arm.run(0.5)
    assert not arm.servo.active
    goal = tuple(arm.q + [0.5, *NOTHING[1:]])
    arm.servo.open_session(Session(2, 0.3, 0.25, False, goal, controller=chosen), arm.inbox())
    arm.run(0.3)
    here = arm.q.tolist()
    arm.tamper = lambda reading: reading._replace(q=here, dq=[0.1, *NOTHING[1:]])
    while not arm.servo.report.limited & Limited.LEAD:
        arm.tick()
    assert arm.servo.report.dq_set[0] > 0.05
    there = [here[0] + 0.005, *here[1:]]  # pushed on, but not so far that the motion continues
    arm.tamper = lambda reading: reading._replace(q=there, dq=NOTHING)
    arm.run(0.2)
    assert not any(arm.servo.report.dq_set)
    away = difference(KINEMATICS.fk(there), KINEMATICS.fk(arm.servo.report.q_set))
    assert 0.04 < math.hypot(*away[:3]) < 0.051


def test_a_pushed_arm_is_stopped_by_positions_at_once_and_as_hard_as_the_arm_can() -> None:
    arm = compliant(JointImpedance())
    assert arm.servo.smoother.jerk[0] < 0.5 * SPEC.limits.jerk[0]
    compliance = arm.servo._compliance
    strays, compliance.strays = compliance.strays, lambda: Limited.COLLISION
    arm.tick()
    compliance.strays = strays
    assert not arm.by_torques
    assert arm.state == (RobotStatus.TRIPPED, Trip.LIMIT)
    assert arm.servo.report.dq_set[0] > 0.05
    assert arm.servo.smoother.jerk == pytest.approx(SPEC.limits.jerk, rel=1e-4)
    arm.run(0.3)
    assert not any(arm.servo.report.dq_set)
    arm.press_again()
    for _ in range(3):
        arm.send([0.2] + [0.0] * 6, Kind.JOINT_VELOCITY)
        arm.tick()
    assert arm.by_torques
    assert arm.servo.smoother.jerk[0] < 0.5 * SPEC.limits.jerk[0]


def test_bare_torques_may_follow_a_controller_where_the_arm_stands() -> None:
    arm = compliant(OperationalSpace())
    here = arm.q.tolist()
    arm.tamper = lambda reading: reading._replace(q=here, dq=NOTHING)
    arm.servo.close_session()
    arm.run(1.0)
    assert not arm.servo.active
    arm.servo.open_session(Session(1, 0.3, 0.25, False), arm.inbox())
    arm.drive(0.1, one(6, 0.5))
    assert arm.by_torques
    assert arm.tau[6] == pytest.approx(0.5)


@CONTROLLERS
def test_an_arm_that_is_faster_than_it_may_be_trips(controller: Controller) -> None:
    arm = compliant(controller)
    fast = [0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.05 * SPEC.limits.velocity[6]]
    arm.tamper = lambda reading: reading._replace(dq=fast)
    arm.tick()
    assert arm.state == (RobotStatus.TRIPPED, Trip.LIMIT)
    assert arm.limited & Limited.SPEED


def test_torques_change_in_proportion() -> None:
    arm = compliant(JointImpedance(stiffness=(900.0, 700.0, 500.0, 300.0, 20.0, 20.0, 20.0)))
    pushed = (arm.q + [0.01, 0.012, 0.014, 0.02, 0.0, 0.0, 0.0]).tolist()
    arm.tamper = lambda reading: reading._replace(q=pushed, dq=NOTHING)
    arm.send([0.2] + [0.0] * 6, Kind.JOINT_VELOCITY)
    for _ in range(3):
        arm.tick()
    late = np.abs(np.diff([setpoint.tau for setpoint in arm.given[-4:]], axis=0)) > 0.999 * 990.0 * arm.dt
    assert late.any()
    assert late.sum(axis=1).max() == 1


def test_a_turn_of_the_tcp_is_the_rotation_vector() -> None:
    pose = KINEMATICS.fk(HOME)
    turned = (*pose[:3], *apply_rotation(pose[3:], (0.0, 0.02, 0.0)))
    tau = Applied(OperationalSpace()).torques(error=difference(pose, turned))
    assert tau == pytest.approx(JACOBIAN.T @ [0.0, 0.0, 0.0, 0.0, 50.0 * 0.02, 0.0], abs=1e-9)
