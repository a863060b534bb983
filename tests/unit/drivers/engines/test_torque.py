"""Torques in the physics of each engine: a simulated Panda floats, turns, is stopped, and keeps every bound."""

from __future__ import annotations

import random
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from engines_kit import Engine
from specs import PANDA_HOME, box, iiwa, panda
from torque_kit import NOTHING, N, one, simulated

from hal.config import load
from hal.driver import RobotDriver, Setpoint
from hal.dynamics import Dynamics
from hal.specs import BodySpec
from hal.types import Limited, RobotStatus, Trip
from hal_emulators.franka.plant import RigidBody

STIFFNESS = np.array([0.0, 200.0, 200.0, 200.0, 20.0, 20.0, 2.0])  # Nm per rad, of an arm that keeps its posture
RATES = pytest.mark.parametrize("rate_hz", [240.0, 1000.0])


def opened(engine: Engine, *others: BodySpec, torque: tuple[float, ...] | None = None) -> tuple[Any, Any]:
    """An arm that follows set-points by itself, without a servo."""
    spec = panda()
    if torque is not None:
        spec = replace(spec, limits=replace(spec.limits, torque=torque))
    world = engine.world(spec, *others)
    driver = engine.robot(world)
    driver.open()
    for _ in range(60):
        world.step()
    return world, driver


def torques(driver: RobotDriver, tau: tuple[float, ...] | list[float] = NOTHING) -> Setpoint:
    reading = driver.read(0.0)
    return Setpoint(reading.q, reading.dq, NOTHING, tau)


class TestServed:
    """With the servo above it."""

    @RATES
    def test_a_small_torque_turns_the_wrist_and_a_release_holds_it(self, engine: Engine, rate_hz: float) -> None:
        arm = simulated(engine, rate_hz=rate_hz)
        start = arm.q
        arm.drive(0.5, one(6, 0.3))
        assert arm.q[6] - start[6] > 0.1
        assert arm.dq[6] == pytest.approx(0.9 * 0.3 * 2.61, rel=0.02)
        arm.release()
        let_go = arm.q
        assert arm.until_held() < 0.2
        assert np.abs(arm.q - let_go).max() < 0.05
        rest = arm.q
        arm.run(1.0)
        assert arm.state == (RobotStatus.HOLDING, Trip.NONE)
        assert arm.q == pytest.approx(rest, abs=1e-3)
        arm.assert_within_limits()

    @RATES
    def test_at_full_speed_it_brakes_along_its_way(self, engine: Engine, rate_hz: float) -> None:
        arm = simulated(engine, rate_hz=rate_hz, speed=1.0, tcp_speed=99.0)
        arm.drive(0.3, [20.0, 5.0, -5.0, 5.0, 1.0, -1.0, 0.3])
        assert np.abs(arm.dq / arm.spec.limits.velocity).max() > 0.7
        arm.stops += 1
        before, direction = arm.q, arm.dq / np.linalg.norm(arm.dq)
        assert arm.until_held() < 0.35
        way = arm.q - before
        assert np.linalg.norm(way) < 0.35
        assert way @ direction / np.linalg.norm(way) > 0.95
        assert arm.servo.report.trip is Trip.STOP
        arm.assert_within_limits()

    def test_the_torque_limit_holds_at_the_motors_too(self, engine: Engine) -> None:
        arm = simulated(engine, speed=1.0, tcp_speed=99.0)
        arm.drive(0.3, [500.0, -500.0, 500.0, -500.0, 50.0, 50.0, -50.0])
        applied = np.abs([reading.tau for reading in arm.readings if reading.tau is not None]).max(axis=0)
        assert (applied <= np.array(arm.spec.limits.torque) + 1e-9).all()
        arm.assert_within_limits()

    def test_a_hand_that_pushes_too_fast_trips_it(self, engine: Engine) -> None:
        arm = simulated(engine)
        for _ in range(240):
            arm.send(NOTHING)
            arm.world.apply_force("panda", (0.0, 30.0, 0.0), link="panda_hand")
            arm.tick()
            if arm.servo.report.trip:
                break
        assert arm.servo.report.trip is Trip.LIMIT
        assert arm.limited & (Limited.SPEED | Limited.TCP_SPEED)
        assert arm.tcp_speed < 0.35
        assert arm.until_held() < 0.3

    def test_against_a_wall_it_pushes_and_relaxes_before_positions_take_over(self, engine: Engine) -> None:
        arm = simulated(engine)
        arm.world.add(box("wall", (0.3, 0.22, 0.5), (0.3, 0.02, 0.5)))
        for _ in range(720):
            hold = -STIFFNESS * (arm.q - PANDA_HOME) - 0.1 * STIFFNESS * arm.dq
            arm.drive(arm.dt, [6.0, *hold[1:]])
        assert arm.by_torques
        assert arm.world.contacts("panda", "wall")
        assert np.abs(arm.dq).max() < 0.05
        assert arm.tau[0] == pytest.approx(6.0)
        arm.release()
        arm.until_held()
        arm.run(0.5)
        assert sum(contact["force"] for contact in arm.world.contacts("panda", "wall")) < 20.0
        arm.assert_within_limits()

    def test_an_undeclared_load_sinks_slowly_and_is_held_in_the_end(self, engine: Engine) -> None:
        arm = simulated(engine)
        start = arm.q
        for turn in range(480):
            if turn < 24:
                arm.send(NOTHING)
            elif turn == 24:
                arm.release()
            arm.world.apply_force("panda", (0.0, 0.0, -20.0), link="panda_hand")
            arm.tick()
            if turn > 24 and not arm.by_torques:
                break
        assert arm.servo.report.trip is Trip.LIMIT
        assert np.abs(arm.q - start).max() < 0.2

    @pytest.mark.slow
    @pytest.mark.parametrize("seed", range(12))
    def test_random_torques_keep_every_bound(self, engine: Engine, seed: int) -> None:
        rng = random.Random(seed)
        limits = panda().limits
        start = [
            low + (high - low) * rng.uniform(0.2, 0.8) for low, high in zip(limits.lower, limits.upper, strict=True)
        ]
        speed = rng.choice((0.3, 1.0))
        arm = simulated(engine, start, speed=speed, deadman=False)
        size = [rng.choice((2.0, 10.0, 50.0)) * (1.0 if joint < 4 else 0.15) for joint in range(N)]
        for turn in range(480):
            if turn % 24 == 0:
                tau = [rng.uniform(-x, x) for x in size]
                if rng.random() < 0.2:
                    arm.stops += 1
            arm.drive(arm.dt, tau)
            if arm.servo._is_at_rest() and arm.servo.report.trip:
                arm.rearm()
            assert (arm.q <= limits.upper).all()
            assert (arm.q >= limits.lower).all()
            assert np.abs(arm.dq / limits.velocity).max() <= 1.3 * speed  # predicted, so not exact
            assert arm.tcp_speed <= 0.3  # of 0.25 m/s
        assert any(setpoint.tau for setpoint in arm.given)
        assert arm.audit.peaks()["torque"] <= 1.0
        assert arm.audit.peaks()["torque_rate"] <= 1.0


class TestDriver:
    """The simulated device alone."""

    @pytest.mark.parametrize("model", ["fr3", "iiwa", "yam"])
    def test_it_is_the_arm_that_dynamics_describe(self, engine: Engine, model: str) -> None:
        """Its inertia with open fingers at rest, and its weight: without more torque it stays where it is."""
        plan = load({"robots": {"arm": {"model": model}}}, sim=True, engine=engine.name).resolve()
        assert plan.world is not None
        spec, world = plan.robots[0], engine.world_of(plan.world)
        driver, dynamics = engine.robot(world), Dynamics.of(spec)
        driver.open()
        if spec.gripper is not None:
            engine.gripper(world).open()
            world.handle("arm", False)
        rng = np.random.default_rng(0)
        for _ in range(3):
            q = rng.uniform(spec.limits.lower, spec.limits.upper)
            mass = np.array(dynamics.mass_matrix(q))
            scale = np.sqrt(np.outer(mass.diagonal(), mass.diagonal()))
            assert np.array(driver.mass_matrix(q)) == pytest.approx(mass, rel=0, abs=1e-3 * scale.min())
            if engine.name == "pybullet":  # its own, which has nothing of the code above
                body = world.body("arm")
                everything = [*q, *(body.home[joint] for joint in sorted(body.movable)[len(q) :])]
                own = world.client.calculateInverseDynamics(body.id, everything, *[[0.0] * len(everything)] * 2)
                assert dynamics.gravity(q) == pytest.approx(own[: len(q)], abs=1e-6)
            world.reset("arm", q=q.tolist())
            driver.read(0.0)
            still = [0.0] * len(q)
            for _ in range(120):
                reading = driver.read(0.0)
                driver.write(Setpoint(reading.q, reading.dq, still, still))
                world.step()
            assert driver.read(0.0).q == pytest.approx(q, abs=1e-3)
        world.close()

    def test_the_same_torques_move_a_simulated_fr3_and_the_emulators_alike(self, engine: Engine) -> None:
        """On both they come on top of gravity alone: no Coriolis torques, no drag."""
        spec = load("franka", sim=True).resolve().robots[0]
        world = engine.world(replace(spec, base_position=(0.0, 0.0, 0.0)), physics_hz=1000.0)
        driver, body = engine.robot(world), RigidBody(Path(spec.urdf))
        driver.open()
        world.handle(spec.name, False)
        q, dq, still = list(spec.home), [0.0] * N, [0.0] * N
        mass = np.array(Dynamics.of(spec).mass_matrix(q))
        for turn in range(400):
            tau = (mass @ (4.0 * np.sin(0.005 * turn + np.arange(N)))).tolist()
            driver.write(Setpoint(driver.read(0.0).q, still, still, tau))
            world.step()
            dq = body.step(q, dq, tau, still, 0.001)
            q = [a + 0.001 * b for a, b in zip(q, dq, strict=True)]
        assert np.abs(dq).max() > 0.3
        assert driver.read(0.0).q == pytest.approx(q, abs=1e-4)
        world.close()

    def test_a_reset_and_new_torques_before_the_next_step_leave_nothing_of_the_old_ones(self, engine: Engine) -> None:
        world, driver = opened(engine)
        driver.write(torques(driver, one(0, 50.0)))
        driver.halt()
        driver.write(torques(driver))
        world.step()
        assert np.abs(driver.read(0.0).dq).max() < 1e-3

    def test_damping_of_a_light_wrist_is_stable_and_lets_a_torque_turn_it(self, engine: Engine) -> None:
        """The iiwa has 0.5 Nm s/rad on 0.001 kg m2: pushed, its last joint turns at tau / D."""
        spec = iiwa()
        world = engine.world(spec)
        driver = engine.robot(world)
        driver.open()
        still = [0.0] * N
        for _ in range(240):
            driver.write(Setpoint(driver.read(0.0).q, still, still, [*still[:6], 0.5]))
            world.step()
        assert driver.read(0.0).dq[6] == pytest.approx(1.0, rel=0.02)

    def test_an_arm_on_a_wall_is_carried_in_any_gravity(self, engine: Engine) -> None:
        world = engine.world(panda(base_orientation=(0.0, 0.5**0.5, 0.0, 0.5**0.5)))
        driver = engine.robot(world)
        driver.open()
        for gravity in ((0.0, 0.0, -9.81), (3.0, 5.0, -4.0)):
            world.set_gravity(gravity)
            for _ in range(60):
                driver.write(torques(driver))
                world.step()
            assert driver.read(0.0).q == pytest.approx(PANDA_HOME, abs=2e-3)

    def test_reading_twice_does_not_carry_it_twice(self, engine: Engine) -> None:
        world, driver = opened(engine)
        for _ in range(240):
            driver.write(torques(driver))
            driver.read(0.0)
            driver.read(0.0)
            world.step()
        assert driver.read(0.0).q == pytest.approx(PANDA_HOME, abs=2e-3)

    @pytest.mark.parametrize("how", ["halt", "close", "fault", "disconnect", "position"])
    def test_after_torques_the_motors_hold_the_arm_with_their_speed_limit(self, engine: Engine, how: str) -> None:
        world, driver = opened(engine)
        for _ in range(12):
            driver.write(torques(driver, one(0, 5.0)))
            world.step()
        q = driver.read(0.0).q
        if how in ("halt", "close"):
            getattr(driver, how)()
        elif how == "position":
            driver.write(Setpoint(q, NOTHING, NOTHING))
        else:
            driver.inject(**{how: "too hot"})
        for _ in range(120):
            world.step()
        if how == "close":
            driver.open()
        driver.recover()
        assert driver.read(0.0).q == pytest.approx(q, abs=0.02)
        speeds = []
        for _ in range(24):  # then it is a fault that it does not follow
            driver.write(Setpoint([q[0] + 1.0, *q[1:]], NOTHING, NOTHING))
            world.step()
            speeds.append(driver.read(0.0).dq[0])
        assert driver.read(0.0).q[0] > q[0] + 0.1
        assert max(speeds) <= driver.spec.limits.velocity[0] * 1.001

    def test_a_reset_ends_them(self, engine: Engine) -> None:
        world, driver = opened(engine)
        driver.write(torques(driver, one(0, 5.0)))
        world.reset("panda")
        for _ in range(120):
            world.step()
            driver.read(0.0)
        assert driver.read(0.0).q == pytest.approx(PANDA_HOME, abs=2e-3)

    def test_the_effort_bounds_torque_and_carrying_together(self, engine: Engine) -> None:
        world, driver = opened(engine, torque=(87.0, 5.0, 87.0, 87.0, 12.0, 12.0, 12.0))
        applied = []
        for _ in range(60):
            driver.write(torques(driver, one(1, -4.5)))
            world.step()
            applied.append(driver.read(0.0).tau)
        assert np.abs(applied).max(axis=0)[1] == pytest.approx(5.0)
