"""A simulated arm on each engine: it follows set-points closely, keeps its speed and torque, holds, reports faults."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engines_kit import Engine
from errors_kit import raises_code
from numpy.typing import NDArray
from specs import IIWA_HOME, PANDA_HOME, box, floor, iiwa, panda

from hal import registry
from hal.driver import RobotDriver, Setpoint
from hal.errors import CommandError
from hal.specs import BodySpec, RobotSpec

ZERO = (0.0,) * 7
DIRECTION = np.array([1.0, 0.5, -1.0, 0.5, 1.0, 0.5, 1.0])


def opened(engine: Engine, spec: RobotSpec | None = None, *others: BodySpec, hz: float = 240.0) -> tuple[Any, Any]:
    """Return a world with an arm, and the arm's driver, open."""
    world = engine.world(*others, spec or panda(), physics_hz=hz)
    driver = engine.robot(world)
    driver.open()
    return world, driver


def swing(t: float, home: NDArray[np.float64]) -> Setpoint:
    """A smooth motion from rest at home, at 1 rad/s at its fastest, t seconds after its start."""
    amplitude, rate = 0.5, 2.0
    q = home + amplitude * (1.0 - math.cos(rate * t)) * DIRECTION
    dq = amplitude * rate * math.sin(rate * t) * DIRECTION
    return Setpoint(q.tolist(), dq.tolist(), ZERO)


def follow(world: Any, driver: RobotDriver, seconds: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Swing; the errors (ticks, 7) of the readings against the set-points before them, and the speeds."""
    home = np.array(driver.spec.initial)
    errors, speeds = [], []
    for tick in range(round(seconds / world.dt)):
        setpoint = swing(tick * world.dt, home)
        driver.write(setpoint)
        world.step()
        reading = driver.read(world.t)
        errors.append(np.subtract(reading.q, setpoint.q))
        speeds.append(reading.dq)
    return np.array(errors), np.array(speeds)


class TestFollowing:
    @pytest.mark.parametrize("hz", [240.0, 1000.0])
    @pytest.mark.parametrize(("spec", "home"), [(panda, PANDA_HOME), (iiwa, IIWA_HOME)])
    def test_smooth_motion_is_followed_within_0_1_mrad(self, engine: Engine, spec, home, hz: float) -> None:
        world, driver = opened(engine, spec(), hz=hz)
        errors, speeds = follow(world, driver, 1.5)
        assert np.abs(speeds).max() == pytest.approx(1.0, abs=0.02)  # it did move
        assert np.abs(errors).max() < 1e-4

    def test_with_two_kilograms_in_the_hand(self, engine: Engine) -> None:
        world, driver = opened(engine)
        load_hand(world)
        for _ in range(120):
            world.step()
        errors, speeds = follow(world, driver, 1.5)
        assert np.abs(speeds).max() > 0.9
        assert np.abs(errors).max() < 2e-3

    @pytest.mark.parametrize("joint", range(7))
    def test_a_joint_whose_set_point_jumps_moves_no_faster_than_its_limit(self, engine: Engine, joint: int) -> None:
        world, driver = opened(engine)
        target = list(PANDA_HOME)
        target[joint] += 1.5
        speeds = []
        for _ in range(24):  # then it is a fault
            driver.write(Setpoint(target, ZERO, ZERO))
            world.step()
            speeds.append(abs(driver.read(0.0).dq[joint]))
        assert 1.5 < max(speeds) <= driver.spec.limits.velocity[joint] * 1.001

    def test_set_points_at_the_speed_limit_are_followed_and_not_overtaken(self, engine: Engine) -> None:
        world, driver = opened(engine)
        limit, home, rate = np.array(driver.spec.limits.velocity), np.array(PANDA_HOME), 3.0
        speeds, errors = [], []
        for tick in range(480):
            t = tick * world.dt
            q, dq = home + limit / rate * (1.0 - math.cos(rate * t)), limit * math.sin(rate * t)
            driver.write(Setpoint(q.tolist(), dq.tolist(), ZERO))
            world.step()
            reading = driver.read(0.0)
            speeds.append(np.abs(reading.dq))
            errors.append(np.subtract(reading.q, q))
        peak = np.max(speeds, axis=0) / limit
        assert peak.min() > 0.99
        assert peak.max() < 1.001
        assert np.abs(errors).max() < 1e-3

    def test_the_torque_limit_holds(self, engine: Engine) -> None:
        weak = panda()
        weak = replace(weak, limits=replace(weak.limits, torque=(87.0, 5.0, 87.0, 87.0, 12.0, 12.0, 12.0)))
        world, driver = opened(engine, replace(weak, initial=(0.0, 0.9, 0.0, -0.8, 0.0, 1.6, 0.785)))
        torques = []
        for _ in range(60):
            world.step()
            torques.append(driver.read(0.0).tau)
        assert np.abs(torques).max(axis=0)[1] == pytest.approx(5.0)
        assert driver.read(0.0).q[1] > 1.0  # 5 Nm do not carry the arm

    def test_a_joint_without_effort_limit_is_driven_with_a_warning(self, engine: Engine, tmp_path: Path) -> None:
        urdf = tmp_path / "arm.urdf"
        urdf.write_text(ONE_JOINT)
        limits = replace(panda().limits, torque=None)
        one = {name: (getattr(limits, name)[0],) for name in ("lower", "upper", "velocity", "acceleration", "jerk")}
        spec = panda(
            urdf=str(urdf), joints=("j",), initial=(0.5,), home=(0.0,), gripper=None, limits=replace(limits, **one)
        )
        world, driver = opened(engine, spec)
        for _ in range(240):
            world.step()
        assert "panda: no effort limit of j; 200 Nm (N) is used" in world.warnings
        assert driver.read(0.0).q == pytest.approx([0.5], abs=1e-3)


ONE_JOINT = """<robot name="arm">
<link name="base"><inertial>
<mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial></link>
<link name="bar"><inertial><origin xyz="0.3 0 0"/><mass value="1"/>
<inertia ixx="0.01" iyy="0.01" izz="0.01" ixy="0" ixz="0" iyz="0"/></inertial></link>
<joint name="j" type="revolute"><parent link="base"/><child link="bar"/><axis xyz="0 1 0"/>
<limit lower="-2" upper="2" effort="0" velocity="0"/></joint></robot>"""


def load_hand(world: Any) -> None:
    """Make the hand 2 kg heavier, as with the cube in it."""
    world.set_dynamics("panda", "panda_hand", mass=world.dynamics("panda", "panda_hand")["mass"] + 2.0)


class TestHolding:
    def test_it_does_not_sag(self, engine: Engine) -> None:
        for weight in (False, True):
            world, driver = opened(engine)
            if weight:
                load_hand(world)
            for _ in range(960):
                world.step()
            assert np.abs(np.subtract(driver.read(0.0).q, PANDA_HOME)).max() < 2e-3
            assert np.abs(driver.read(0.0).tau or ZERO).max() > 10.0  # it carries its own weight

    def test_it_stops_at_a_wall_within_its_torques(self, engine: Engine) -> None:
        world, driver = opened(engine, None, box("wall", (0.5, 0.2, 0.5), (0.3, 0.02, 0.5)))
        home, torques, deepest = np.array(PANDA_HOME), [], 0.0
        for tick in range(480):
            angle = min(0.5 * tick * world.dt, 1.0)
            driver.write(Setpoint([angle, *home[1:]], [0.5 if angle < 1.0 else 0.0, *ZERO[1:]], ZERO))
            world.step()
            torques.append(driver.read(0.0).tau)
            deepest = min([deepest, *(contact["distance"] for contact in world.contacts("panda", "wall"))])
        assert world.contacts("panda", "wall")
        assert deepest > -0.003
        assert world.pose("panda", "panda_hand")["position"][1] < 0.18
        reading = driver.read(0.0)
        assert reading.fault is not None
        assert reading.fault.code == "not_following"
        assert reading.q == pytest.approx(reading.q_commanded, abs=0.02), "it does not push on"
        assert (np.abs(torques).max(axis=0) <= np.array(driver.spec.limits.torque) + 1e-9).all()


class TestReadings:
    def test_two_arms_do_not_disturb_each_other(self, engine: Engine) -> None:
        left, right = panda("left"), iiwa("right", base_position=(0.0, 1.5, 0.0))
        world = engine.world(floor(), left, right)
        one, other = engine.robot(world, "left"), engine.robot(world, "right")
        one.open()
        other.open()
        errors, _ = follow(world, one, 1.0)
        assert np.abs(errors).max() < 1e-4
        assert other.read(0.0).q == pytest.approx(IIWA_HOME, abs=1e-3)


def test_a_world_is_needed(engine: Engine) -> None:
    with raises_code(CommandError, "world_missing"):
        registry.load(engine.name, "robot")(panda(), None)
