"""The arithmetic of torques, against what an arm of that inertia really does."""

from __future__ import annotations

import math
import random

import numpy as np
import pytest
from numpy.typing import NDArray
from specs import panda

from hal.commands import Session
from hal.kinematics.arm import Kinematics
from hal.servo.envelope import Envelope
from hal.servo.smoothing import JointSmoother
from hal.servo.torque_bounds import RATE, ArmInMotion, Inertia, TcpInMotion, TorqueBounds
from hal.specs import WorkspaceSpec
from hal.types import Limited

N = 7
DT = 1e-3
HOME = panda().home
STILL = [0.0] * N


def bounds(
    speed: float = 0.3, tcp_speed: float = 99.0, dt: float = DT, box: WorkspaceSpec | None = None
) -> tuple[TorqueBounds, Envelope]:
    spec = panda()
    envelope = Envelope(JointSmoother(spec.limits, dt), Kinematics(spec.kinematics), box)
    envelope.open(Session(1, speed, tcp_speed, False))
    made = TorqueBounds(spec.limits, dt, envelope)
    made.open_session(HOME)
    return made, envelope


def some_inertia(seed: int) -> Inertia:
    """One as coupled, and as uneven, as that of an arm: heavy joints first, and a light wrist."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(N, N)) * np.sqrt([1.0, 1.0, 0.5, 0.5, 0.05, 0.05, 0.005])[:, None]
    return Inertia(root @ root.T + np.diag([0.2, 0.2, 0.2, 0.2, 0.02, 0.02, 0.004]), N)


def moved(arm: ArmInMotion, tau: list[float], dt: float = DT) -> ArmInMotion:
    """The arm a tick later."""
    dq = np.array(arm.dq) + dt * arm.inertia.inverse @ np.array(tau)
    return ArmInMotion((np.array(arm.q) + dt * dq).tolist(), dq.tolist(), arm.inertia)


@pytest.mark.parametrize("inertia", [0.005, 0.05, 1.0])
def test_a_torque_that_is_allowed_at_rest_can_be_taken_away_in_time(inertia: float) -> None:
    made, envelope = bounds()
    arm = ArmInMotion(HOME, STILL, Inertia(inertia * np.eye(N), N))
    tau = made.allowed([9.0, *STILL[1:]], arm)[0]
    assert envelope.limited == Limited.SPEED if tau < 9.0 else not envelope.limited
    v, most = 0.0, envelope.velocity[0]
    for _ in range(2):  # it acts for a tick, and is seen to have acted after that
        v += DT * tau / inertia
    while tau > 0.0:
        tau = max(0.0, tau - RATE * DT)
        v += DT * tau / inertia
    assert v <= most
    assert v > 0.7 * most or tau == 9.0 or inertia == 1.0, "no less than need be"


@pytest.mark.parametrize("seed", range(20))
def test_joints_that_pull_on_each_other_are_held_back_too(seed: int) -> None:
    rng = random.Random(seed)
    made, envelope = bounds()
    arm = ArmInMotion(HOME, STILL, some_inertia(seed))
    wanted = [rng.uniform(-40.0, 40.0) * (1.0 if joint < 4 else 0.2) for joint in range(N)]
    tau = list(STILL)
    for _ in range(400):
        tau = made.towards(tau, made.allowed(wanted, arm))
        arm = moved(arm, tau)
        assert (np.abs(arm.dq) <= 1.02 * np.array(envelope.velocity)).all()
    assert np.abs(np.array(arm.dq) / envelope.velocity).max() > 0.8
    assert envelope.limited == Limited.SPEED


def test_the_tcp_comes_up_to_its_speed_and_no_farther() -> None:
    made, envelope = bounds(speed=1.0, tcp_speed=0.25)
    arm = ArmInMotion(HOME, STILL, Inertia(np.eye(N), N))
    jacobian = envelope.kinematics.jacobian(HOME)[:3]
    tau, fastest = list(STILL), 0.0
    for _ in range(300):
        tau = made.towards(tau, made.allowed([10.0, 10.0, 0.0, 10.0, 0.0, 0.0, 0.0], arm))
        arm = moved(arm, tau)._replace(q=HOME)
        fastest = max(fastest, float(np.linalg.norm(jacobian @ arm.dq)))
    assert 0.85 < fastest / 0.25 <= 0.95
    assert envelope.limited & Limited.TCP_SPEED
    braking = made.allowed([-10.0, -10.0, 0.0, -10.0, 0.0, 0.0, 0.0], arm)
    assert braking[0] < -5.0, "what slows it down is not held back"


def test_a_joint_that_coasts_too_fast_is_braked_and_does_not_take_the_others_torques_away() -> None:
    made, envelope = bounds()
    dq = [*STILL[:6], 0.93 * envelope.velocity[6]]
    arm = ArmInMotion(HOME, dq, Inertia(np.eye(N), N))
    tau = made.allowed([0.0, 5.0, 0.0, 0.0, 0.0, 0.0, 0.0], arm)
    assert tau[1] == pytest.approx(5.0)
    assert tau[6] < 0.0


def braked(arm: ArmInMotion, tau: list[float], made: TorqueBounds) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Speeds and torques until it rests."""
    share, speeds, torques = 0.0, [arm.dq], [tau]
    while np.abs(arm.dq).max() > 1e-3 or share < 1.0:
        tau, share = made.brake(tau, arm, share)
        arm = moved(arm, tau)
        speeds.append(arm.dq)
        torques.append(tau)
        assert len(speeds) < 1000
    return np.array(speeds), np.array(torques)


@pytest.mark.parametrize("seed", range(20))
def test_the_brake_keeps_rate_and_limits_and_takes_energy_only(seed: int) -> None:
    rng = np.random.default_rng(seed)
    spec, (made, _) = panda(), bounds()
    inertia = some_inertia(seed)
    dq = rng.uniform(-1.0, 1.0, N) * spec.limits.velocity
    tau = (rng.uniform(-0.2, 0.2, N) * np.array(spec.limits.torque)).tolist()
    speeds, torques = braked(ArmInMotion(HOME, dq.tolist(), inertia), tau, made)
    assert np.abs(np.diff(torques, axis=0)).max() <= RATE * DT * (1.0 + 1e-9)
    assert (np.abs(torques) <= np.array(spec.limits.torque) * (1.0 + 1e-9)).all()
    energy = np.einsum("ti,ij,tj->t", speeds, inertia.mass, speeds)
    driving = int(np.ceil(np.abs(tau).max() / (RATE * DT))) + 1
    assert (np.diff(energy[driving:]) <= 1e-9).all()


def test_the_brake_goes_straight() -> None:
    made, _ = bounds()
    inertia = some_inertia(1)
    dq = np.array([0.3, -0.2, 0.1, 0.3, -0.4, 0.5, 0.1])
    speeds, _ = braked(ArmInMotion(HOME, dq.tolist(), inertia), list(STILL), made)
    shares = speeds / dq
    assert np.abs(shares - shares[:, :1]).max() < 0.1
    assert (np.diff(shares[:, 0]) < 0.0).all()


@pytest.mark.parametrize("seed", range(30))
def test_where_an_overrun_is_seen_the_stop_still_ends_inside(seed: int) -> None:
    """An arm that is driven towards a limit, and braked as soon as the next torque would be too much."""
    rng = np.random.default_rng(seed)
    spec = panda()
    made, _ = bounds(speed=1.0)
    lower, upper = np.array(spec.limits.lower), np.array(spec.limits.upper)
    arm = ArmInMotion(HOME, (rng.uniform(-0.5, 0.5, N) * spec.limits.velocity).tolist(), some_inertia(seed))
    wanted = (rng.uniform(-0.3, 0.3, N) * np.array(spec.limits.torque)).tolist()
    tau = list(STILL)
    for _ in range(5000):
        new = made.towards(tau, made.allowed(wanted, arm))
        found = made.overrun(new, arm)
        if found is not None:
            break
        tau = new
        arm = moved(arm, tau)
    assert found in (Limited.POSITION, Limited.SPEED)
    share = 0.0
    for _ in range(1000):
        tau, share = made.brake(tau, arm, share)
        arm = moved(arm, tau)
        assert (np.array(arm.q) <= upper).all()
        assert (np.array(arm.q) >= lower).all()
    assert np.abs(arm.dq).max() < 1e-3


def test_a_face_of_the_workspace_is_looked_at_ahead() -> None:
    x, y, z = Kinematics(panda().kinematics).fk(HOME)[:3]
    made, _ = bounds(speed=1.0, box=WorkspaceSpec((x - 0.1, y - 0.1, z - 0.1), (x + 0.1, y + 0.02, z + 0.1)))
    inertia = Inertia(np.eye(N), N)
    assert made.overrun(STILL, ArmInMotion(HOME, [0.3, *STILL[1:]], inertia)) is None
    assert made.overrun(STILL, ArmInMotion(HOME, [1.6, *STILL[1:]], inertia)) is Limited.WORKSPACE
    assert made.overrun(STILL, ArmInMotion(HOME, [-1.6, *STILL[1:]], inertia)) is None


@pytest.mark.parametrize("bad", [np.zeros((N, N)), np.full((N, N), np.nan), np.eye(6), -np.eye(N), np.ones((N, N))])
def test_what_is_no_inertia_is_refused(bad: NDArray[np.float64]) -> None:
    with pytest.raises(ValueError, match=r"inertia|[Ss]ingular"):
        Inertia(bad, N)


def test_the_torques_of_a_controller_change_in_proportion() -> None:
    made, _ = bounds()
    assert made.together([0.0] * N, [0.5, -0.5, *STILL[2:]]) == [0.5, -0.5, *STILL[2:]]
    tau = made.together([1.0, *STILL[1:]], [11.0, -5.0, *STILL[2:]])
    assert tau == pytest.approx([1.0 + RATE * DT, -0.5 * RATE * DT, *STILL[2:]])


def test_torques_of_a_controller_that_are_no_numbers_are_none() -> None:
    made, envelope = bounds()
    arm = ArmInMotion(HOME, STILL, Inertia(np.eye(N), N))
    tau = np.array([[math.nan, *STILL[1:]], STILL])
    tcp = TcpInMotion((0.0,) * 7, np.zeros((6, N)), np.zeros(3), 0.0, np.zeros(N), np.zeros(N))
    assert made.shared(tau, lambda: np.zeros(3), 0.0, arm, tcp) == STILL
    assert envelope.limited
