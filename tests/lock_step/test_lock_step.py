"""A simulation in lock-step, through the public interface: deterministic, and time stands still between waits."""

import json
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from engines_kit import Engine

import hal
from hal import JointTarget, Pose, Twist


@pytest.fixture
def rig(engine: Engine) -> Iterator[hal.Rig]:
    with hal.open("panda_table", sim=True, engine=engine.name, clock="lock_step", pad="none") as opened:
        yield opened


def drive(engine: str, steps: int) -> tuple[bytes, bytes]:
    """Arm and cube after some steps that touch both, as bytes."""
    options = {"clock": "lock_step", "pad": "none", "overrides": ["cameras={}"]}
    with hal.open("panda_table", sim=True, engine=engine, **options) as rig:
        arm = rig.robots["panda"]
        start = arm.state().q
        trace, cube = [], []
        with arm.control(rate_hz=50) as control:
            for k, tick in enumerate(rig.clock.rate(50)):
                control.send(JointTarget(start + 0.2 * np.sin(0.3 * tick.t * np.arange(1, 8))), grip=(k // 50) % 2)
                state = arm.state()
                trace.append(np.concatenate([state.q, state.dq, state.q_set, state.tcp.position]))
                cube.append(rig.world.pose("cube").position)
                if k == steps:
                    break
        assert np.ptp(np.array(trace)[:, 0]) > 0.1, "it moved"
        return np.array(trace).tobytes(), np.array(cube).tobytes()


def test_two_runs_are_equal_to_the_bit(engine: Engine) -> None:
    assert drive(engine.name, 300) == drive(engine.name, 300)


def test_time_stands_still_between_waits(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    before = arm.state()
    assert arm.state().stamp == before.stamp
    rig.clock.sleep(0.1)
    after = arm.state()
    assert after.stamp.t == pytest.approx(before.stamp.t + 0.1, abs=1 / 240)
    frame = rig.cameras["scene"].read()
    assert frame.stamp.t == after.stamp.t, "a frame shows the present"


def test_a_frame_shows_what_the_world_knows(rig: hal.Rig) -> None:
    """The cube's true corner projects onto its picture: pose, K, depth and T_world_camera agree."""
    rig.clock.sleep(0.5)
    frame = rig.cameras["scene"].read()
    top = rig.world.pose("cube").position + [0, 0, 0.03]
    x, y, z = frame.T_world_camera.inverse().matrix()[:3] @ [*top, 1.0]
    u, v, _ = frame.K @ [x / z, y / z, 1.0]
    row, column = round(v + 1.0), round(u)  # just below the top edge
    assert frame.depth[row, column] == pytest.approx(z, abs=0.03)
    red, green, blue = (int(value) for value in frame.color[row, column])
    assert red > green
    assert blue > green


def test_the_arm_pushes_the_cube(rig: hal.Rig) -> None:
    """Robot and objects share one world: contacts, forces, motion."""
    arm = rig.robots["panda"]
    base = Pose([-0.55, 0, 0.6]).inverse()
    rig.clock.sleep(0.5)  # the cube falls onto the table
    beside = base @ Pose(rig.world.pose("cube").position + [-0.1, 0, 0.03], [1, 0, 0, 0])
    arm.gripper.grip(1.0)
    arm.move_to(beside, speed=0.3)
    start = rig.world.pose("cube").position
    with arm.control(rate_hz=50) as control:
        for tick in rig.clock.rate(50):
            control.send(Twist([0.1, 0, 0]))
            if rig.world.contacts("panda", "cube"):
                touched = tick.t
                break
            assert tick.t < 60.0
        for tick in rig.clock.rate(50):
            control.send(Twist([0.1, 0, 0]))
            if tick.t > touched + 0.5:
                break
    assert rig.world.pose("cube").position[0] > start[0] + 0.02


def test_reset_puts_an_arm_somewhere_and_a_session_goes_on_from_there(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    q = arm.home.copy()
    q[0] = 0.7
    rig.world.reset("panda", q=q)
    assert arm.state().q == pytest.approx(q, abs=1e-6)
    assert arm.state().q_set == pytest.approx(q, abs=1e-6)
    with arm.control() as control:
        rig.world.reset("panda")
        control.send(JointTarget(arm.home))
        rig.clock.sleep(0.05)
        assert arm.state().q == pytest.approx(arm.home, abs=2e-3)


def test_an_arm_that_is_pushed_off_its_set_point_is_a_fault_holds_where_it_is_and_recovers(rig: hal.Rig) -> None:
    arm = rig.robots["panda"]
    still = hal.JointVelocity([0.0] * 7)
    with arm.control(rate_hz=50) as control:

        def hold(seconds: float, command: hal.JointVelocity = still) -> None:
            for _ in range(round(seconds * 50)):
                control.send(command)
                rig.clock.sleep(0.02)

        def push(force: float) -> None:
            at = (arm.base @ arm.state().tcp).position
            rig.world.apply_force("panda", [0.0, force, 0.0], at, link="panda_hand", duration=0.3)

        push(30.0)
        hold(0.5)
        assert arm.state().q == pytest.approx(arm.home, abs=1e-3)
        push(100.0)
        with pytest.raises(hal.RobotFault):
            hold(0.3)
        rig.clock.sleep(0.4)
        at = arm.state().q
        rig.clock.sleep(0.2)
        state = arm.state()
        assert state.fault is not None
        assert state.fault.code == "not_following"
        assert state.q == pytest.approx(at, abs=1e-3)
        assert np.abs(state.q - arm.home).max() > 0.1
        arm.recover()
        rig.clock.sleep(0.02)
        control.rearm()
        hold(0.5)
        assert arm.state().q == pytest.approx(state.q, abs=1e-3), "it does not go back by itself"
        hold(0.5, hal.JointVelocity([0.2] + [0.0] * 6))
        assert arm.state().q[0] > state.q[0] + 0.02


def test_dynamics_are_read_back_and_restored(rig: hal.Rig) -> None:
    before = rig.world.dynamics("cube")
    with rig.world.change_dynamics("cube", lateral_friction=0.05, spinning_friction=0.02, mass=1.0):
        now = rig.world.dynamics("cube")
        assert now["lateral_friction"] == pytest.approx(0.05)
        assert now["spinning_friction"] == pytest.approx(0.02)
        assert now["mass"] == pytest.approx(1.0)
    assert rig.world.dynamics("cube") == before


def test_what_a_simulation_changes_of_a_new_body_is_a_note(rig: hal.Rig, tmp_path: Path) -> None:
    urdf = tmp_path / "massless.urdf"
    urdf.write_text(
        '<robot name="m"><link name="shell"><collision><geometry><sphere radius="0.02"/></geometry></collision></link>'
        "</robot>"
    )
    before = list(rig.notes)
    rig.world.add(hal.BodySpec("ball", (0.3, 0.4, 1.0), (0.0, 0.0, 0.0, 1.0), "urdf", urdf=str(urdf)))
    (note,) = [text for text in rig.notes if text not in before]
    assert "shell" in note
    rig.world.remove("ball")


@pytest.mark.parametrize("name", ["iiwa_table", "yam", "yam_emulator", "piper", "piper_emulator", "openarm"])
def test_another_arm_is_only_data(engine: Engine, name: str) -> None:
    options = {"clock": "lock_step", "pad": "none", "overrides": ["cameras={}"]}
    with hal.open(name, sim=True, engine=engine.name, **options) as rig:
        for arm in rig.robots.values():
            goal = arm.home.copy()
            goal[0] += 0.2
            goal[3] += 0.1
            assert arm.move_to(goal, speed=0.3).q == pytest.approx(goal, abs=2e-3)
            if arm.gripper is not None:
                width = 0.4 * arm.gripper.width_max
                arm.gripper.move(width)
                assert arm.gripper.state().width == pytest.approx(width, abs=2e-3)


def test_a_reset_leaves_arms_at_rest_although_one_is_lost(engine: Engine, tmp_path: Path) -> None:
    arms = {name: {"model": "panda", "base": [0, y, 0, 0, 0, 0, 1]} for name, y in (("one", 0.5), ("two", -0.5))}
    file = tmp_path / "rig.yaml"
    file.write_text(json.dumps({"robots": arms}))
    with hal.open(file, sim=True, engine=engine.name, clock="lock_step", pad="none") as rig:
        q = rig.robots["two"].home.copy()
        q[0] = 0.7
        for name in arms:
            rig.world.reset(name, q=q)
        with rig.robots["one"].control() as lost, rig.robots["two"].control() as control:
            lost.send(JointTarget(q))
            control.send(JointTarget(q))
            rig.clock.sleep(0.02)
            rig.robots["one"].inject(disconnect=True)
            rig.clock.sleep(0.02)
            rig.world.reset()
            assert rig.robots["two"].state().q_set == pytest.approx(q - [0.7, 0, 0, 0, 0, 0, 0], abs=1e-6)
            rig.clock.sleep(0.02)
            rig.robots["one"].inject(disconnect=False)
            for _ in range(10):
                rig.clock.sleep(0.01)
                assert max(np.abs(arm.state().dq).max() for arm in rig.robots.values()) < 0.1
