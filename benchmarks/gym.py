"""``RigEnv`` in lock-step beside PyBullet by hand, and many worlds in processes and threads.

Goals: 0.55 of PyBullet by hand without a camera, 4 times its renderer with two of 256x256, and 1.8 times as many steps
on two cores as on one.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np

from hal.gym import EnvSettings, RigEnv, make_vec

from .kit import ENGINES, Table, median, median_ratio, per_second, run_in_turns, sum_of_programs
from .lock_step import CONFIG, POLICY_HZ, by_hand

PATHS = (
    "hal/learning/gym.py",
    "hal/learning/spaces.py",
    "hal/learning/vector.py",
    "hal/servo",
    "hal/host",
    "drivers/pybullet",
    "drivers/mujoco",
)
CORES = len(os.sched_getaffinity(0))
BARE = ("cameras={}",)
ALONE = "from benchmarks.gym import *; print(step_alone({engine!r}, {seconds}))"
Step = Callable[[], None]


def make(engine: str = "auto", cameras: bool = False) -> RigEnv:
    """Return one environment in lock-step."""
    return RigEnv(CONFIG, EnvSettings(rate_hz=POLICY_HZ), sim=True, engine=engine, overrides=() if cameras else BARE)


def stepping(env: RigEnv | gymnasium.vector.VectorEnv) -> Step:
    """Return a function that makes one step of an environment, or of all of a vector, with ``lock_step``'s motion."""
    seen, _ = env.reset(seed=1)
    count = getattr(env, "num_envs", None)
    start = seen["q"] if count is None else seen["q"][0]
    phases, turn = np.arange(start.size), 0

    def step() -> None:
        nonlocal turn
        turn += 1
        q = start + 0.05 * np.sin(turn / POLICY_HZ + phases) - 0.05 * np.sin(phases)
        action = np.append(q, 0.0).astype(np.float32)
        env.step(action if count is None else np.tile(action, (count, 1)))

    return step


def step_alone(engine: str, seconds: float) -> float:
    """Return steps/s of one environment; programs that do nothing else print it."""
    env = make(engine)
    found = per_second(stepping(env), seconds)
    env.close()
    return found


def beside_pybullet(seconds: float, rounds: int) -> Table:
    """Return steps/s of RigEnv on each engine beside PyBullet's by hand."""
    table = Table(f"steps/s at 20 Hz, medians of {rounds} rounds", ("", "RigEnv", "PyBullet by hand", "ratio"))
    for cameras, engine in itertools.product((False, True), ENGINES):
        env, own = make(engine, cameras), make("pybullet", cameras)
        assert own.rig.plan.world is not None
        with by_hand(own.rig.plan.world, cameras) as reference:
            pair = {"ours": stepping(env), "theirs": reference}
            measures = {key: partial(per_second, step, seconds) for key, step in pair.items()}
            mine, theirs = run_in_turns(measures, rounds).values()
        for each in (env, own):
            each.close()
        name = f"{engine}, {'two 256x256 RGB-D cameras' if cameras else 'no camera'}"
        table.add(name, median(mine), median(theirs), median_ratio(mine, theirs))
    return table


def memory(processes: Iterable[int]) -> float:
    """Return the proportional set size of processes, MB."""
    lines = (line for pid in processes for line in Path(f"/proc/{pid}/smaps_rollup").read_text().splitlines())
    return sum(int(line.split()[1]) for line in lines if line.startswith("Pss:")) / 1024


def many_worlds(engine: str, worlds: int, seconds: float, rounds: int) -> Table:
    """Return steps/s of all worlds together, those of ways that make many of them beside one RigEnv."""
    one, threaded = make(engine), [make(engine) for _ in range(worlds)]
    vector = make_vec(partial(make, engine), worlds)
    asynchronous = gymnasium.vector.AsyncVectorEnv([partial(make, engine)] * worlds, context="spawn")
    steps = [stepping(env) for env in threaded]
    with ThreadPoolExecutor(CORES) as pool:

        def step_threads() -> None:
            list(pool.map(lambda k: [step() for step in steps[k::CORES]], range(CORES)))

        single, all_of_vector, all_of_async = stepping(one), stepping(vector), stepping(asynchronous)
        measures: dict[str, Callable[[], float]] = {
            "one RigEnv": lambda: per_second(single, seconds),
            "make_vec": lambda: worlds * per_second(all_of_vector, seconds),
            "AsyncVectorEnv": lambda: worlds * per_second(all_of_async, seconds),
            f"{CORES} threads": lambda: worlds * per_second(step_threads, seconds),
            f"{CORES} independent programs of one world": lambda: sum_of_programs(
                CORES, "-c", ALONE.format(engine=engine, seconds=seconds)
            ),
        }
        found = run_in_turns(measures, rounds)
    processes = {
        "make_vec": [child.process.pid for child in vector._children],
        "AsyncVectorEnv": [process.pid for process in asynchronous.processes],
    }
    table = Table(f"{engine}: steps/s of {worlds} worlds together", ("", "steps/s", "ratio", "MB a world"))
    for name, rates in found.items():
        size = memory(processes[name]) / worlds if name in processes else None
        table.add(name, median(rates), median_ratio(rates, found["one RigEnv"]), size)
    for env in (one, vector, asynchronous, *threaded):
        env.close()
    return table


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    seconds, rounds, worlds = (0.1, 1, 2) if quick else (4.0, 5, 16)
    if "pybullet" in ENGINES:
        yield beside_pybullet(seconds, rounds)
    engines = ENGINES[:1] if quick else ENGINES
    for engine in engines:
        yield many_worlds(engine, worlds, seconds, rounds)
