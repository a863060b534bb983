"""Whole motions: lines in both worlds (small counts of ``benchmarks/motion.py``), refusals, and speeds."""

import numpy as np
import pytest
from benchmark_kit import load_benchmark

import hal

lines = load_benchmark("motion")


@pytest.mark.parametrize("engine", ["pybullet", "mujoco"])
def test_the_simulated_arm_stays_on_its_line(engine: str) -> None:
    pytest.importorskip(engine)
    found = lines.lines(2, engine)
    assert found["off_set"] <= 5e-4
    assert found["off"] <= 2e-3
    assert found["tilt"] <= 5e-3
    assert found["ratio"] <= 1.3


@pytest.mark.parametrize("controller", [hal.OperationalSpace(), hal.JointImpedance()], ids=["tcp", "joints"])
def test_a_compliant_arm_stays_on_its_line(controller: hal.OperationalSpace | hal.JointImpedance) -> None:
    found = lines.lines(1, controller=controller)
    assert found["off_set"] <= 5e-4
    assert found["off"] <= 2e-3
    assert found["tilt"] <= 5e-3


def test_a_compliant_arm_waits_at_an_obstacle_until_it_is_gone() -> None:
    overrides = {"cameras": {}, "objects": ["objects/floor.yaml", "objects/table.yaml"]}
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=overrides) as rig:
        arm = rig.robots["panda"]
        start = arm.fk(arm.state().q_set)
        goal = hal.Pose(start.position + [0.0, 0.2, 0.0], start.orientation)
        base = hal.Pose(arm.spec.base_position, arm.spec.base_orientation)
        wall = base @ hal.Pose(start.position + [0.0, 0.23, 0.05], [0.0, 0.0, 0.0, 1.0])
        sides = (0.15, 0.01, 0.15)
        rig.world.add(hal.BodySpec("wall", wall.position, wall.orientation, "box", half_extents=sides, fixed=True))
        motion = arm.start_move_to(goal, straight=True, speed=0.5, controller=hal.OperationalSpace())
        rig.clock.sleep(2.0)
        waiting = motion.progress
        rig.clock.sleep(0.3)
        assert motion.progress == waiting < 1.0
        assert 0.01 < np.linalg.norm(arm.state().tcp.position - arm.state().tcp_set.position) < 0.051
        rig.world.remove("wall")
        result = motion.wait(10.0)
        assert result
        assert hal.Limited.LEAD in result.held_back
        assert arm.state().tcp.distance(goal)[0] < 1e-3


def test_lines_that_are_begun_end_and_those_refused_are_impossible() -> None:
    found = lines.checks(6)
    assert found["began"]
    assert found["refused"]
    assert (found["stopped_underway"], found["off"], found["confirmed"]) == (0, 0, 1.0)
    assert found["peak_of_limits"] <= 1.0


def test_poses_out_of_reach_are_refused_before_anything_moves() -> None:
    numbers = np.random.default_rng(1)
    with hal.open("panda_table", driver="mock") as rig:
        arm = rig.robots["panda"]
        for _ in range(4):
            way, turn = numbers.normal(size=3), numbers.normal(size=4)
            place = way / np.linalg.norm(way) * numbers.uniform(0.95, 2.0) + [0.0, 0.0, 0.333]
            for straight in (False, True):
                with pytest.raises(hal.Unreachable):
                    arm.move_to(hal.Pose(place, turn), straight=straight)
        assert len(rig.driver("panda").log) == 0


def test_move_to_keeps_its_share_of_the_speed() -> None:
    peaks = {}
    with hal.open("panda_table", driver="mock", overrides=["robots.panda.tcp_speed=3.0"]) as rig:
        arm = rig.robots["panda"]
        goal = arm.home + np.array([0.5, 0.15, -0.2, 0.25, 0.15, -0.25, 0.4])
        log = rig.driver("panda").log
        for speed, tcp_speed in ((0.02, None), (0.2, None), (1.0, 0.25)):
            log.clear()
            arm.move_to(goal, speed=speed, tcp_speed=tcp_speed)
            q = np.array([setpoint.q for setpoint in log])
            dt = 1.0 / rig._local.spec.rate_hz
            tcp = np.array([arm.kinematics.fk(x)[:3] for x in q])
            peaks[speed] = float((np.abs(np.diff(q, axis=0)).max(axis=0) / dt / np.array(arm.limits.velocity)).max())
            fastest = float(np.linalg.norm(np.diff(tcp, axis=0), axis=1).max() / dt)
            arm.move_to(arm.home, speed=0.5)
    assert peaks[0.2] / peaks[0.02] == pytest.approx(10.0, rel=0.01)
    assert 0.2 < fastest <= 0.25
