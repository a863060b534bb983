"""Check `arm.dynamics` against the simulated arms, the emulated Franka arm, and its own definitions; print the worst.

    python benchmarks/dynamics.py [--engines pybullet,mujoco] [--models NAME,...] [--count N] [--seconds S]

Printed are, for every model of an arm and each engine: the difference of the inertia matrices, relative to the inertias
of the two joints, and of the torques of gravity; how far an arm drifts in S seconds that carries itself, with torques
of 0 in a session, from N random positions, and how often it is stopped. Then how far a simulated FR3 and the emulator's
are apart after the same torques for 2 s, without friction.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np

import hal
from hal import registry
from hal.config import load
from hal.config.data_files import data_folder
from hal.driver import Setpoint
from hal.dynamics import Dynamics
from hal.errors import MotionStopped, NotSupported

MODELS = sorted(file.stem for file in data_folder("robots").glob("*.yaml"))
STILL = [0.0] * 7
TURN = np.pi
"""Joints without an end are turned so far, rad."""


def rig_of(model: str) -> dict[str, Any]:
    """Return a rig of one arm; of a model with several, the left one."""
    return {"robots": {"arm": {"model": model} | ({"arm": "left"} if model == "baxter" else {})}}


def positions(limits: Any, count: int, seed: int) -> Any:
    """Return random joint positions (count, n), rad."""
    lower, upper = (np.clip(ends, -TURN, TURN) for ends in (limits.lower, limits.upper))
    room = 0.05 * (upper - lower)
    return np.random.default_rng(seed).uniform(lower + room, upper - room, (count, len(lower)))


def compare(model: str, engine: str, count: int) -> tuple[float, float]:
    """Return the differences from the simulated arm at rest: inertia, relative, and gravity, Nm."""
    plan = load(rig_of(model), sim=True, clock="lock_step", engine=engine).resolve()
    spec = plan.robots[0]
    world = registry.load(engine, "world")(plan.world)
    driver = registry.load(engine, "robot")(spec, world)
    driver.open()
    if spec.gripper is not None:
        registry.load(engine, "gripper")(spec.gripper, world).open()
        world.handle("arm", False)
    dynamics, worst, heaviest = Dynamics.of(spec), 0.0, 0.0
    still = [0.0] * len(spec.joints)
    for q in positions(spec.limits, count, 1):
        mass = np.array(dynamics.mass_matrix(q))
        scale = np.sqrt(np.outer(mass.diagonal(), mass.diagonal()))
        worst = max(worst, float((np.abs(np.array(driver.mass_matrix(q)) - mass) / scale).max()))
        world.reset("arm", q=q.tolist())
        reading = driver.read(0.0)
        driver.write(Setpoint(reading.q, reading.dq, still, still))  # the motors' torques are then those of gravity
        world.step()
        tau = np.array(driver.read(0.0).tau)
        within = np.abs(tau) < np.array(spec.limits.torque or np.inf) - 1e-9
        heaviest = max(heaviest, float(np.abs(tau - dynamics.gravity(q))[within].max(initial=0.0)))
        driver.halt()
    world.close()
    return worst, heaviest


def drift(model: str, engine: str, count: int, seconds: float) -> tuple[float, int] | None:
    """Return how far a joint drifts, rad, and the number of stops; None for an arm that takes no torques."""
    worst, stops = 0.0, 0
    with hal.open(rig_of(model), sim=True, clock="lock_step", engine=engine) as rig:
        arm = rig.robots["arm"]
        if arm.limits.torque is None:
            return None
        for q in positions(arm.limits, count, 2):
            rig.world.reset("arm", q=q)
            rig.clock.sleep(0.2)
            start = arm.state().q
            try:
                with arm.control(rate_hz=50) as control:
                    for tick in rig.clock.rate(50):
                        if tick.elapsed >= seconds:
                            break
                        control.send(hal.JointTorque([0.0] * arm.n))
                        worst = max(worst, float(np.abs(arm.state().q - start).max()))
            except MotionStopped:
                stops += 1
    return worst, stops


def same_torques(engine: str, physics_hz: float, count: int) -> list[float]:
    """Return how far the joints of a simulated FR3 and of the emulator's are apart after 2 s each time, rad."""
    from hal.drivers.franka.emulator.plant import RigidBody

    changes = {"simulation": {"physics_hz": physics_hz}}
    plan = load(rig_of("fr3") | changes, sim=True, clock="lock_step", engine=engine).resolve()
    spec = plan.robots[0]
    world = registry.load(engine, "world")(plan.world)
    driver = registry.load(engine, "robot")(spec, world)
    driver.open()
    world.handle("arm", False)
    body, random, found = RigidBody(Path(spec.urdf)), np.random.default_rng(0), list[float]()
    mass = np.array(Dynamics.of(spec).mass_matrix(spec.home))
    for _ in range(count):
        world.reset("arm")
        emulated, speeds, cycles = list(driver.read(0.0).q), STILL, 0
        rates, phases, sizes = (random.uniform(*ends, 7) for ends in ((0.5, 2.0), (0.0, 6.28), (0.5, 2.0)))
        steps = round(2.0 * physics_hz)
        for k in range(steps):
            tau = (mass @ (sizes * np.sin(6.28 * rates * k / physics_hz + phases))).tolist()
            reading = driver.read(0.0)
            driver.write(Setpoint(reading.q, reading.dq, STILL, tau))
            world.step()
            while 1e-3 * cycles < (k + 1) / physics_hz - 1e-9:
                speeds = body.step(emulated, speeds, tau, STILL, 1e-3)
                emulated = [a + 1e-3 * b for a, b in zip(emulated, speeds, strict=True)]
                cycles += 1
        late = steps / physics_hz - 1e-3 * cycles
        apart = np.subtract(driver.read(0.0).q, emulated) - late * np.array(speeds)
        found.append(float(np.abs(apart).max()))
        driver.halt()
    world.close()
    return found


def main() -> None:
    """Compare, and print the results."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--engines", default="pybullet,mujoco")
    parser.add_argument("--models", default=",".join(MODELS))
    parser.add_argument("--count", type=int, default=20)
    parser.add_argument("--seconds", type=float, default=10.0)
    options = parser.parse_args()
    for engine in options.engines.split(","):
        for model in options.models.split(","):
            try:
                mass, gravity = compare(model, engine, options.count)
                same = f"inertia {mass:.1e}, gravity {gravity:.1e} Nm"
            except NotSupported as error:
                same = f"no dynamics ({error.code})"
            floating = drift(model, engine, options.count, options.seconds)
            text = "takes no torques" if floating is None else f"drift {floating[0]:.5f} rad, {floating[1]} stops"
            print(f"{engine:9}{model:15}{same}, {text}", flush=True)
        for rate in (240.0, 1000.0):
            apart = np.array(same_torques(engine, rate, options.count)) * 1e3
            text = f"{np.median(apart):.4f} mrad apart in the median, {apart.max():.4f} at most"
            print(f"{engine:9}fr3 and emulator, {rate:.0f} Hz: {text}", flush=True)


if __name__ == "__main__":
    main()
