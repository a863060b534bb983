"""States of the simulated world, saved and restored: whether what follows agrees, and the time that each takes.

    python benchmarks/save_restore.py [--engine mujoco] [--states 50] [--seconds 2]

Each state is one of an arm that a control session moves, over a table with a rolling ball and thrown objects; in every
second one the gripper holds a cube. It is saved, restored at once, and the same commands follow. All states are then
restored in another order, in the same process and in another one, and the same commands follow again. Last, runs with
one save in the middle are compared with the same runs without it.
"""

from __future__ import annotations

import argparse
import multiprocessing
import statistics
import time
from typing import Any

import numpy as np

import hal
from hal.specs import BodySpec
from hal.world import WorldState

UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def opened(engine: str) -> Any:
    """Return a rig without cameras, in lock-step, with a ball on the table."""
    rig = hal.open("panda_table", sim=True, clock="lock_step", engine=engine, pad="none", overrides=["cameras={}"])
    rig.world.set_dynamics("cube", mass=0.2)  # dynamics are no part of a state
    rig.world.add(BodySpec("ball", (0.2, 0.25, 0.655), UPRIGHT, "sphere", radius=0.03, mass=0.1))
    return rig


def stream(rig: Any, velocity: Any, seconds: float) -> list[Any]:
    """Move the arm's tcp at a velocity (3,) m/s, and return poses, joints and the gripper's width on the way."""
    arm, seen = rig.robots["panda"], []
    with arm.control(rate_hz=20) as control:
        for _ in range(round(20 * seconds)):
            control.send(hal.Twist(linear=velocity))
            rig.clock.sleep(0.05)
            poses = {name: (*pose.position, *pose.orientation) for name, pose in rig.world.poses().poses.items()}
            state = arm.state()
            seen.append((poses, state.q.tolist(), state.dq.tolist(), arm.gripper.state().width))
    return seen


def prepare(rig: Any, random: np.random.Generator, held: bool) -> Any:
    """Reset the scene, throw objects, roll the ball, take the cube if it is to be held; return a velocity (3,), m/s."""
    rig.world.reset()
    rig.world.set_velocity("duck", random.normal(0.0, 0.3, 3))
    rig.world.set_velocity("ball", (*random.normal(0.0, 0.2, 2), 0.0))
    arm = rig.robots["panda"]
    if held:
        rig.world.set_pose("cube", rig.world.pose("panda", "panda_hand") @ hal.Pose((0.0, 0.0, 0.1034)))
        earth = rig.world.set_gravity((0.0, 0.0, 0.0))
        arm.gripper.start(0.0)
        rig.clock.sleep(0.6)
        rig.world.set_gravity(earth)
    else:
        rig.world.set_velocity("cube", random.normal(0.0, 0.3, 3), random.normal(0.0, 3.0, 3))
        arm.gripper.start(random.uniform(0.0, 0.08))
    return random.normal(0.0, 0.05, 3)


def states_of(rig: Any, random: np.random.Generator, count: int, seconds: float) -> list[dict[str, Any]]:
    """Return states of a scene in which everything moves, and what followed each of them."""
    found, arm = [], rig.robots["panda"]
    for k in range(count):
        velocity = prepare(rig, random, held=k % 2 == 0)
        with arm.control(rate_hz=20) as control:
            for _ in range(random.integers(2, 6)):
                control.send(hal.Twist(linear=velocity))
                rig.clock.sleep(0.05)
            start = time.perf_counter()
            state = rig.world.save()
            spent = time.perf_counter() - start
            rig.world.restore(state)
        rig.world.restore(state)
        data = state.to_bytes()
        after = stream(rig, -velocity, seconds)
        height = after[-1][0]["cube"][2] if k % 2 == 0 else None
        found.append({"save": spent, "state": data, "velocity": -velocity, "after": after, "height": height})
    return found


def compare(engine: str, states: list[dict[str, Any]], seconds: float, seed: int) -> tuple[int, list[float]]:
    """Return how many states are followed by the same again in a new rig, and the times of the restores, s."""
    agree, times = 0, []
    with opened(engine) as rig:
        for k in np.random.default_rng(seed).permutation(len(states)):
            state = WorldState.from_bytes(states[k]["state"])
            start = time.perf_counter()
            rig.world.restore(state)
            times.append(time.perf_counter() - start)
            agree += stream(rig, states[k]["velocity"], seconds) == states[k]["after"]
    return agree, times


def change_by_a_save(engine: str, seed: int, seconds: float) -> tuple[float, float]:
    """Return by how much one save changes what follows: largest difference of a position, m, and of a joint, rad."""
    ends = []
    for saves in (False, True):
        with opened(engine) as rig:
            velocity = prepare(rig, np.random.default_rng(seed), held=seed % 2 == 0)
            stream(rig, velocity, 0.2)
            if saves:
                rig.world.save()
            ends.append(stream(rig, velocity, seconds)[-1])
    (one, q, *_), (other, p, *_) = ends
    places = (np.abs(np.subtract(one[name][:3], other[name][:3])).max() for name in one)
    return max(places), np.abs(np.subtract(q, p)).max()


def measure(engine: str, count: int, seconds: float) -> None:
    """Print the results of one engine."""
    with opened(engine) as rig:
        states = states_of(rig, np.random.default_rng(1), count, seconds)
    agree, times = compare(engine, states, seconds, 2)
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        elsewhere, _ = pool.apply(compare, (engine, states, seconds, 3))
    changes = [change_by_a_save(engine, seed, seconds) for seed in range(max(1, count // 10))]
    saves = [one["save"] for one in states]
    place, angle = (max(change) for change in zip(*changes, strict=True))
    size = statistics.median(len(one["state"]) for one in states)
    held = [one["height"] > 0.7 for one in states if one["height"] is not None]
    print(
        f"{engine:10} bit-equal for {seconds:g} s: {agree} of {count}, in another process {elsewhere} of {count}"
        f" (cube still held in {sum(held)} of {len(held)});"
        f" save {1e3 * statistics.median(saves):.2f} ms (max {1e3 * max(saves):.2f}),"
        f" restore {1e3 * statistics.median(times):.2f} ms (max {1e3 * max(times):.2f}), {size / 1e3:.0f} kB;"
        f" one save changes what follows by {place:.2g} m, {angle:.2g} rad"
    )


def main() -> None:
    """Print one line for each engine."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", choices=("pybullet", "mujoco"), help="one engine; both by default")
    parser.add_argument("--states", type=int, default=50)
    parser.add_argument("--seconds", type=float, default=2.0)
    arguments = parser.parse_args()
    for engine in [arguments.engine] if arguments.engine else ["pybullet", "mujoco"]:
        measure(engine, arguments.states, arguments.seconds)


if __name__ == "__main__":
    main()
