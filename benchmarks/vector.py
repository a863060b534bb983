"""Many copies of one rig: ``hal.gym.make_vec`` beside one ``RigEnv``, Gymnasium's AsyncVectorEnv and threads.

    python benchmarks/vector.py [--engine mujoco] [--worlds 16] [--seconds 3] [--rounds 5]

All are open at once and take turns; the medians of steps/s over all worlds are printed, the median of the ratios to one
RigEnv in the same round, and the memory of the processes (PSS: what they share is divided among them) for each world.
The goal is 1.8 on two cores. "independent programs" is what the machine allows: as many as there are cores, each with
one RigEnv and nothing to wait for.
"""

from __future__ import annotations

import argparse
import os
import statistics
import sys
from collections.abc import Callable, Iterable
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np

from hal.gym import RigEnv, make_vec

sys.path.insert(0, str(Path(__file__).resolve().parent))
from gym import BARE, actions, programs, stepping
from lock_step import CONFIG, POLICY_HZ, rate

CORES = len(os.sched_getaffinity(0))
Step = Callable[[], None]


def make(engine: str) -> RigEnv:
    """Return one environment."""
    return RigEnv(CONFIG, sim=True, engine=engine, rate_hz=POLICY_HZ, overrides=BARE)


def memory(processes: Iterable[int]) -> float:
    """Return the proportional set size of processes, MB."""
    lines = (line for pid in processes for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines())
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024


def stepping_all(envs: gymnasium.vector.VectorEnv) -> Step:
    """Return a function that makes one step of all worlds."""
    seen, _ = envs.reset(seed=1)
    action, turn = actions(seen["q"][0]), 0

    def step() -> None:
        nonlocal turn
        turn += 1
        envs.step(np.tile(action(turn), (envs.num_envs, 1)))

    return step


def stepping_in_threads(envs: list[RigEnv], pool: ThreadPoolExecutor) -> Step:
    """Return a function that makes one step of all worlds, shared by a thread for each core."""
    steps = [stepping(env) for env in envs]

    def part(k: int) -> None:
        for step in steps[k::CORES]:
            step()

    return lambda: list(pool.map(part, range(CORES))) and None


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="Many copies of one rig beside one")
    parser.add_argument("--engine", default="pybullet", help="that simulates (%(default)s)")
    parser.add_argument("--worlds", type=int, default=16, help="number of copies (%(default)s)")
    parser.add_argument("--seconds", type=float, default=3.0, help="length of one turn (%(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of all (%(default)s)")
    parser.add_argument("--alone", type=float, metavar="S", help="only print the steps/s of one environment")
    args = parser.parse_args()
    one = make(args.engine)
    if args.alone is not None:
        print(rate(stepping(one), args.alone))
        one.close()
        return
    vector = make_vec(CONFIG, args.worlds, sim=True, engine=args.engine, rate_hz=POLICY_HZ, overrides=BARE)
    theirs = gymnasium.vector.AsyncVectorEnv([partial(make, args.engine)] * args.worlds, context="spawn")
    threaded = [make(args.engine) for _ in range(args.worlds)]
    alone = programs(__file__, "--engine", args.engine, "--alone")
    with ThreadPoolExecutor(CORES) as pool:
        single, together = stepping(one), stepping_all(vector)
        each, threads = stepping_all(theirs), stepping_in_threads(threaded, pool)
        rows: dict[str, tuple[Callable[[], float], Iterable[int]]] = {
            "one RigEnv": (lambda: rate(single, args.seconds), ()),
            f"make_vec, {args.worlds} worlds": (
                lambda: args.worlds * rate(together, args.seconds),
                [child.process.pid for child in vector._children],
            ),
            f"AsyncVectorEnv, {args.worlds} worlds": (
                lambda: args.worlds * rate(each, args.seconds),
                [process.pid for process in theirs.processes],
            ),
            f"{CORES} threads, {args.worlds} worlds": (lambda: args.worlds * rate(threads, args.seconds), ()),
            f"{CORES} independent programs": (lambda: alone(CORES, args.seconds), ()),
        }
        print(f"{args.engine}, {CORES} cores, load {os.getloadavg()[0]:.1f}; no camera, {POLICY_HZ:g} Hz over 240 Hz")
        rounds = [{name: measure() for name, (measure, _) in rows.items()} for _ in range(args.rounds)]
        print(f"{'':30s}{'steps/s':>10s}{'ratio':>8s}{'MB a world':>12s}")
        for name, (_, pids) in rows.items():
            steps = statistics.median(found[name] for found in rounds)
            ratio = statistics.median(found[name] / found["one RigEnv"] for found in rounds)
            print(f"{name:30s}{steps:10.0f}{ratio:8.2f}" + (f"{memory(pids) / args.worlds:12.0f}" if pids else ""))
    for env in (one, vector, theirs, *threaded):
        env.close()


if __name__ == "__main__":
    main()
