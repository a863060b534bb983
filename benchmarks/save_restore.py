"""States of the simulated world, saved and restored: whether the steps after both agree, and the time that each takes.

    python benchmarks/save_restore.py [--engine mujoco] [--states 50] [--seconds 2]

The rig's arm moves at random between states, its gripper opens and closes, and the cube and the duck are thrown. Each
state is saved, and all are restored in another order, in the same world and in a new one.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from typing import Any

import numpy as np

import hal


def opened(engine: str) -> Any:
    """Return a rig without cameras, in lock-step."""
    return hal.open("panda_table", sim=True, clock="lock_step", engine=engine, pad="none", overrides=["cameras={}"])


def states_of(rig: Any, random: np.random.Generator, count: int, seconds: float) -> list[dict[str, Any]]:
    """Return states of a scene in which everything moves, and what followed each."""
    arm, found = rig.robots["panda"], []
    for _ in range(count):
        rig.world.set_velocity("cube", random.normal(0.0, 0.3, 3), random.normal(0.0, 3.0, 3))
        rig.world.set_velocity("duck", random.normal(0.0, 0.3, 3))
        arm.gripper.start(random.uniform(0.0, 0.08))
        rig.world.reset("panda", q=arm.home + random.normal(0.0, 0.1, 7))
        rig.clock.sleep(random.uniform(0.01, 0.2))
        start = time.perf_counter()
        state = rig.world.save()
        spent = time.perf_counter() - start
        found.append({"save": spent, "state": json.loads(json.dumps(state)), "after": after(rig, seconds)})
    return found


def after(rig: Any, seconds: float) -> list[Any]:
    """Return poses, joints and gripper on the way through the next seconds."""
    arm, seen = rig.robots["panda"], []
    for _ in range(10):
        rig.clock.sleep(seconds / 10)
        poses = {name: (*pose.position, *pose.orientation) for name, pose in rig.world.poses().poses.items()}
        state = arm.state()
        seen.append((poses, state.q.tolist(), state.dq.tolist(), arm.gripper.state().width))
    return seen


def measure(engine: str, count: int, seconds: float) -> None:
    """Print the results of one engine."""
    random = np.random.default_rng(1)
    with opened(engine) as rig, opened(engine) as other:
        states = states_of(rig, random, count, seconds)
        agree, elsewhere, times = 0, 0, []
        for k in random.permutation(count):
            start = time.perf_counter()
            rig.world.restore(states[k]["state"])
            times.append(time.perf_counter() - start)
            agree += after(rig, seconds) == states[k]["after"]
            other.world.restore(states[k]["state"])
            elsewhere += after(other, seconds) == states[k]["after"]
    saves = [one["save"] for one in states]
    size = statistics.median(len(json.dumps(one["state"])) for one in states)
    print(
        f"{engine:10} bit-equal for {seconds:g} s: {agree} of {count}, in a new world {elsewhere} of {count};"
        f" save {1e3 * statistics.median(saves):.2f} ms (max {1e3 * max(saves):.2f}),"
        f" restore {1e3 * statistics.median(times):.2f} ms (max {1e3 * max(times):.2f}), {size / 1e3:.0f} kB"
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
