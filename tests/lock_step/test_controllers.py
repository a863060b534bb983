"""Controllers through everything: the public interface, the host, the servo and the simulated physics."""

from collections.abc import Iterator

import numpy as np
import pytest
from engines_kit import Engine

import hal
from hal import ControlMode, JointImpedance, JointTarget, Limited, NotSupported, OperationalSpace, RobotStatus, Trip
from hal.drivers.mock.robot import MockRobot

BOTH = pytest.mark.parametrize("controller", [OperationalSpace(), JointImpedance()], ids=["task", "joints"])


@pytest.fixture(scope="module")
def shared(engine: Engine) -> Iterator[hal.Rig]:
    options = {"clock": "lock_step", "pad": "none", "overrides": ["cameras={}"]}
    with hal.open("panda_table", sim=True, engine=engine.name, **options) as opened:
        yield opened


@pytest.fixture
def rig(shared: hal.Rig) -> hal.Rig:
    shared.world.reset()
    shared.clock.sleep(0.2)  # in the first steps of a world the motors take over the arm's weight
    return shared


def follow(rig: hal.Rig, control: hal.Control, target: np.ndarray, seconds: float) -> Limited:
    """Stream joint targets; return what was limited."""
    arm, limited = rig.robots["panda"], Limited.NONE
    begun = rig.clock.now()
    for tick in rig.clock.rate(50.0):
        if tick.t - begun >= seconds:
            break
        q_set = arm.state().q_set
        control.send(JointTarget(q_set + np.clip(target - q_set, -0.09, 0.09)))
        limited |= arm.state().limited
    return limited


def push(arm: hal.Robot, rig: hal.Rig, force: list[float], seconds: float) -> None:
    """Push the hand at the tcp."""
    state = arm.state()
    point = (arm.base @ state.tcp).position
    rig.world.apply_force("panda", force, point, link="panda_hand", duration=seconds)


@BOTH
def test_the_arm_comes_to_rest_at_its_set_point(rig: hal.Rig, controller: hal.OperationalSpace) -> None:
    arm = rig.robots["panda"]
    goal = arm.home + [0.2, 0.1, -0.1, 0.1, 0.2, -0.1, 0.3]
    with arm.control(controller=controller) as control:
        assert arm.state().controller is ControlMode.POSITION
        follow(rig, control, goal, 2.2)
        state = arm.state()
        distance, turn = state.tcp.distance(arm.fk(goal))
        assert distance < 1e-3
        assert turn < 5e-3
        assert state.controller is not ControlMode.POSITION
        assert state.tau_set is not None
    state = arm.state()
    assert (state.controller, state.tau_set, state.status) == (ControlMode.POSITION, None, RobotStatus.IDLE)
    assert state.q == pytest.approx(goal, abs=2e-3)
    assert max(rig.statistics()["simulation"]["robots"]["panda"]["peak"].values()) <= 1.0


@pytest.mark.parametrize("axis", range(3))
def test_a_force_moves_the_tcp_by_the_force_over_the_stiffness(rig: hal.Rig, axis: int) -> None:
    arm = rig.robots["panda"]
    force = [10.0 * (k == axis) for k in range(3)]
    with arm.control(controller=OperationalSpace(stiffness=(500.0, 1000.0, 800.0))) as control:
        follow(rig, control, arm.home, 0.1)
        push(arm, rig, force, 2.0)
        follow(rig, control, arm.home, 1.5)
        state = arm.state()
    moved = state.tcp.position - state.tcp_set.position
    assert moved[axis] == pytest.approx(10.0 / (500.0, 1000.0, 800.0)[axis], rel=0.1)
    assert np.abs(np.delete(moved, axis)).max() < 1e-3


def test_what_was_held_back_does_not_spring(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    goal = arm.home + [0.6, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]
    with arm.control(controller=OperationalSpace(), tcp_speed=0.25) as control:
        follow(rig, control, arm.home, 0.1)
        push(arm, rig, [0.0, -30.0, 0.0], 1.5)
        limited = follow(rig, control, goal, 1.4)
        state, fastest = arm.state(), 0.0
        assert limited & Limited.LEAD
        assert state.tcp.distance(state.tcp_set)[0] < 0.052
        for _ in range(60):
            follow(rig, control, goal, 0.02)
            speeds = [float(np.linalg.norm(each.tcp_twist[:3])) for each in arm.states(rig.clock.now() - 0.021)]
            fastest = max(fastest, *speeds)
        assert 0.1 < fastest <= 0.25
        assert arm.state().tcp.position[1] > state.tcp.position[1] + 0.05


def test_a_released_deadman_leaves_the_arm_compliant_and_a_stop_latches(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    with arm.control(controller=JointImpedance(stiffness=100.0)) as control:
        follow(rig, control, arm.home, 0.1)
        rig.stop()
        rig.clock.sleep(0.1)
        assert (control.trip, arm.state().controller) == (Trip.STOP, ControlMode.JOINT_IMPEDANCE)
        before = arm.state()
        push(arm, rig, [0.0, 8.0, 0.0], 0.5)
        rig.clock.sleep(0.5)
        state = arm.state()
        assert state.q_set == pytest.approx(before.q_set, abs=1e-6)
        assert state.tcp.distance(before.tcp)[0] > 0.01
        control.rearm()
        rig.rearm()
        rig.clock.sleep(0.05)
        follow(rig, control, arm.home, 0.1)
        assert arm.state().status is RobotStatus.FOLLOWING


def test_gains_change_within_a_session(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    with arm.control(controller=OperationalSpace(stiffness=1000.0)) as control:
        follow(rig, control, arm.home, 0.1)
        push(arm, rig, [10.0, 0.0, 0.0], 3.0)
        follow(rig, control, arm.home, 1.0)
        control.set_gains(stiffness=400.0)
        before = arm.state().tau_set
        rig.clock.sleep(1.0 / 240.0)
        assert np.abs(arm.state().tau_set - before).max() < 0.5
        follow(rig, control, arm.home, 1.3)
        state = arm.state()
        assert (state.tcp.position - state.tcp_set.position)[0] == pytest.approx(10.0 / 400.0, rel=0.1)
        for wrong in ({"frame": "tcp"}, {"rate": 100.0}, {"stiffness": -1.0}, {"rotation_stiffness": 1e5}):
            with pytest.raises(hal.CommandError):
                control.set_gains(**wrong)


def test_a_lost_device_ends_the_torques_and_positions_take_over(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    with arm.control(controller=OperationalSpace()) as control:
        follow(rig, control, arm.home + 0.1, 0.4)
        arm.inject(fault="broken")
        rig.clock.sleep(0.6)
        arm.recover()
        rig.clock.sleep(0.3)
        assert (arm.state().controller, control.trip) == (ControlMode.POSITION, Trip.FAULT)
        control.rearm()
        rig.clock.sleep(0.05)
        follow(rig, control, arm.home, 0.3)
        assert arm.state().controller is ControlMode.OPERATIONAL_SPACE


def test_move_to_arrives_with_a_controller(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    state = arm.move_to(arm.home + 0.1, controller=JointImpedance(), speed=0.3)
    assert state.q == pytest.approx(arm.home + 0.1, abs=3e-3)


def test_what_cannot_be_is_refused(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    for wrong in (
        OperationalSpace(posture=(9.0,) * 7),
        OperationalSpace(posture=(0.0,) * 3),
        OperationalSpace(rotation_stiffness=5000.0),
        JointImpedance(stiffness=(100.0,) * 3),
        "impedance",
    ):
        with pytest.raises(hal.CommandError) as found:
            arm.control(controller=wrong)
        assert found.value.code in ("bad_controller", "bad_command")
    with arm.control(controller=OperationalSpace()) as control, pytest.raises(hal.CommandError) as torques:
        control.send(hal.JointTorque([0.0] * 7))
    assert torques.value.code == "torques_by_controller"


def test_an_arm_without_torques_gets_no_controller(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(MockRobot, "modes", frozenset({"position"}))
    with hal.open("panda_table", driver="mock", overrides=["cameras={}"]) as rig, pytest.raises(NotSupported) as found:
        rig.robots["panda"].control(controller=JointImpedance())
    assert found.value.code == "no_torque_mode"
