"""Cost of the simulated world and its drivers per tick, beside raw PyBullet in the same run.

    python benchmarks/world_tick.py [--hz 240] [--seconds 5]

The scene: floor, table, a Panda that moves at 0.5 rad/s, and 0, 4 or 8 cubes on the table. Raw is the same scene
made by hand with PyBullet's own functions: step, setJointMotorControlArray, getJointStates. Medians in microseconds.
Then the arm alone, with each of the solver's two residuals: how closely it follows, and the time of a step.
"""

from __future__ import annotations

import argparse
import math
import statistics
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "kits"))
from specs import PANDA_HOME, box, data, floor, panda, world_spec

from hal.driver import Setpoint
from hal.drivers.pybullet.engine import load_pybullet
from hal.drivers.pybullet.gripper import PyBulletGripper
from hal.drivers.pybullet.robot import PyBulletRobot
from hal.drivers.pybullet.world import SOLUTION, PyBulletWorld

TABLE = ((0.5, 0.0, -0.3), (0.4, 0.6, 0.3))
SMALL = (0.02, 0.02, 0.02)


def cube_places(count: int) -> list[tuple[float, float, float]]:
    return [(0.35 + 0.1 * (k % 4), -0.3 + 0.5 * (k // 4), 0.02) for k in range(count)]


def motion(t: float) -> tuple[list[float], list[float]]:
    """Return joint positions and velocities of the test motion."""
    q = [home + 0.25 * (1.0 - math.cos(2.0 * t)) for home in PANDA_HOME]
    return q, [0.5 * math.sin(2.0 * t)] * 7


def ours(count: int, hz: float) -> tuple[Any, dict[str, Callable[[], object]]]:
    arm = panda()
    cubes = [box(f"cube{k}", place, SMALL, mass=0.1) for k, place in enumerate(cube_places(count))]
    world = PyBulletWorld(world_spec(box("table", *TABLE), floor(), *cubes, arm, physics_hz=hz))
    mirror = PyBulletWorld(world.spec, mirror=True)
    assert arm.gripper is not None
    driver, gripper = PyBulletRobot(arm, world), PyBulletGripper(arm.gripper, world)
    driver.open()
    gripper.open()

    def write() -> None:
        q, dq = motion(world.t)
        driver.write(Setpoint(q, dq, [0.0] * 7))

    return world, {
        "step": world.step,
        "read": lambda: driver.read(0.0),
        "write": write,
        "gripper read": lambda: gripper.read(0.0),
        "snapshot": world.snapshot,
        "show in a mirror": lambda: mirror.show(world.snapshot()),
    }


def raw(count: int, hz: float) -> tuple[Any, dict[str, Callable[[], object]]]:
    p = load_pybullet()
    c = p.connect(p.DIRECT)
    p.setTimeStep(1.0 / hz, physicsClientId=c)
    p.setGravity(0, 0, -9.81, physicsClientId=c)
    p.createMultiBody(0, p.createCollisionShape(p.GEOM_PLANE, physicsClientId=c), physicsClientId=c)
    shape = p.createCollisionShape(p.GEOM_BOX, halfExtents=TABLE[1], physicsClientId=c)
    p.createMultiBody(0, shape, basePosition=TABLE[0], physicsClientId=c)
    small = p.createCollisionShape(p.GEOM_BOX, halfExtents=SMALL, physicsClientId=c)
    cubes = [p.createMultiBody(0.1, small, basePosition=at, physicsClientId=c) for at in cube_places(count)]
    robot = p.loadURDF(data("franka_panda/panda.urdf"), useFixedBase=True, physicsClientId=c)
    joints = [*range(7), 9, 10]
    for joint, q in zip(joints, [*PANDA_HOME, 0.04, 0.04], strict=True):
        p.resetJointState(robot, joint, q, physicsClientId=c)
    p.setJointMotorControlArray(robot, [9, 10], p.POSITION_CONTROL, targetPositions=[0.04, 0.04], physicsClientId=c)
    steps = 0

    def step() -> None:
        nonlocal steps
        p.stepSimulation(physicsClientId=c)
        steps += 1

    def write() -> None:
        q, dq = motion(steps / hz)
        p.setJointMotorControlArray(
            robot, joints[:7], p.POSITION_CONTROL, targetPositions=q, targetVelocities=dq, physicsClientId=c
        )

    def snapshot() -> None:
        p.getJointStates(robot, joints, physicsClientId=c)
        for cube in cubes:
            p.getBasePositionAndOrientation(cube, physicsClientId=c)

    return None, {
        "step": step,
        "read": lambda: p.getJointStates(robot, joints[:7], physicsClientId=c),
        "write": write,
        "snapshot": snapshot,
    }


def follow(solution: dict[str, Any], hz: float, ticks: int) -> tuple[float, float]:
    """Return the greatest distance of a joint from its set-point, mrad, and the median time of a step, us."""
    arm = panda()
    world = PyBulletWorld(world_spec(arm, physics_hz=hz))
    driver = PyBulletRobot(arm, world)
    driver.open()
    world.client.setPhysicsEngineParameter(**solution)
    worst, times = 0.0, []
    for _ in range(ticks):
        q, dq = motion(world.t)
        driver.write(Setpoint(q, dq, [0.0] * 7))
        start = time.perf_counter()
        world.step()
        times.append(time.perf_counter() - start)
        worst = max(worst, *(abs(a - b) for a, b in zip(driver.read(0.0).q, q, strict=True)))
    world.close()
    return 1e3 * worst, 1e6 * statistics.median(times)


def measure(calls: dict[str, Callable[[], object]], ticks: int) -> dict[str, float]:
    """Return the median of each call, us, called in turn in every tick."""
    times: dict[str, list[float]] = {name: [] for name in calls}
    clock = time.perf_counter
    for _ in range(ticks):
        for name, call in calls.items():
            start = clock()
            call()
            times[name].append(clock() - start)
    return {name: 1e6 * statistics.median(values) for name, values in times.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--hz", type=float, default=240.0, help="physics rate")
    parser.add_argument("--seconds", type=float, default=5.0, help="simulated time per scene")
    arguments = parser.parse_args()
    ticks = round(arguments.seconds * arguments.hz)
    print(f"{'us per call':>18}" + "".join(f"{f'{n} objects':>24}" for n in (0, 4, 8)))
    table: dict[str, list[str]] = {}
    for count in (0, 4, 8):
        (_, our_calls), (_, raw_calls) = ours(count, arguments.hz), raw(count, arguments.hz)
        own, reference = measure(our_calls, ticks), measure(raw_calls, ticks)
        for name, value in own.items():
            beside = f" (raw {reference[name]:5.1f})" if name in reference else " " * 12
            table.setdefault(name, []).append(f"{value:12.1f}{beside}")
    for name, cells in table.items():
        print(f"{name:>18}" + "".join(f"{cell:>24}" for cell in cells))
    print("\nthe arm alone      follows within     step")
    for name, solution in SOLUTION.items():
        worst, step = follow(solution, arguments.hz, ticks)
        print(f"{name:>18}{worst:11.3f} mrad{step:8.1f} us")


if __name__ == "__main__":
    main()
