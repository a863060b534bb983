"""``RigEnv`` in lock-step beside PyBullet by hand, in several processes, and the freshness of its observations.

    python benchmarks/gym.py [--seconds 4] [--rounds 5] [--engine mujoco]

Each part has its reference in the same run; rounds alternate and the medians are printed. The references of lock-step
are those of ``benchmarks/lock_step.py``: PyBullet's own functions for the same scene, one motor command and one reading
per step, and with cameras PyBullet's own renderer. The goals: 0.55 of PyBullet by hand without a camera, 4 times its
renderer with two of 256x256, 1.8 times as many steps with two processes as with one, and no observation twice. The last
rows of the second part are what the machine allowed at the time: two independent environments, and two programs that
only count.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path

import gymnasium
import numpy as np

import hal
from hal import registry
from hal.learning.gym import RigEnv

sys.path.insert(0, str(Path(__file__).resolve().parent))
from lock_step import CONFIG, POLICY_HZ, by_hand, rate

BARE = ("cameras={}",)


def make(engine: str, cameras: bool = False) -> RigEnv:
    """Return one environment in lock-step."""
    return RigEnv(CONFIG, sim=True, engine=engine, rate_hz=POLICY_HZ, overrides=() if cameras else BARE)


def actions(start: np.ndarray) -> Callable[[int], np.ndarray]:
    """Return the motion of ``lock_step.py`` around the joint positions ``start``, rad."""
    phases = np.arange(start.size)

    def action(turn: int) -> np.ndarray:
        q = start + 0.05 * np.sin(turn / POLICY_HZ + phases) - 0.05 * np.sin(phases)
        return np.append(q, 0.0).astype(np.float32)

    return action


def stepping(env: RigEnv) -> Callable[[], None]:
    """Return a function that makes one step of the environment."""
    seen, _ = env.reset(seed=1)
    action, turn = actions(seen["q"]), 0

    def step() -> None:
        nonlocal turn
        turn += 1
        env.step(action(turn))

    return step


def lock_step(engine: str, cameras: bool, seconds: float, rounds: int) -> tuple[float, float, float]:
    """Return steps/s of RigEnv and of PyBullet by hand, and the median of their ratios."""
    env = make(engine, cameras)
    assert env.rig.plan.world is not None
    reference, disconnect = by_hand(env.rig.plan.world, cameras, every_tick=False)
    step = stepping(env)
    pairs = [(rate(step, seconds), rate(reference, seconds)) for _ in range(rounds)]
    env.close()
    disconnect()
    mine, theirs = (statistics.median(values) for values in zip(*pairs, strict=True))
    return mine, theirs, statistics.median(a / b for a, b in pairs)


def together(engine: str, count: int, seconds: float, cameras: bool = False) -> float:
    """Return the total steps/s of ``count`` in one ``AsyncVectorEnv``; each step waits for the slowest."""
    envs = gymnasium.vector.AsyncVectorEnv([partial(make, engine, cameras)] * count, context="spawn")
    try:
        seen, _ = envs.reset(seed=1)
        action, turn = actions(seen["q"][0]), 0

        def step() -> None:
            nonlocal turn
            turn += 1
            envs.step(np.tile(action(turn), (count, 1)))

        return count * rate(step, seconds)
    finally:
        envs.close()


SPINS = """
import sys, time
seconds = float(sys.argv[1])
end, count = time.perf_counter() + seconds, 0
while time.perf_counter() < end:
    count += 1
print(count / seconds)
"""


def alone(engine: str, seconds: float) -> float:
    """Return steps/s of one independent environment."""
    env = make(engine)
    found = rate(stepping(env), seconds)
    env.close()
    return found


def programs(*command: str) -> Callable[[int, float], float]:
    """Return a function that sums what independent programs print that run at the same time."""

    def measure(count: int, seconds: float) -> float:
        line = [sys.executable, *command, str(seconds)]
        running = [subprocess.Popen(line, stdout=subprocess.PIPE, text=True) for _ in range(count)]
        return sum(float(program.communicate(timeout=seconds + 60.0)[0].split()[-1]) for program in running)

    return measure


def scaling(measure: Callable[[int, float], float], seconds: float, rounds: int) -> tuple[float, float, float]:
    """Return the measure of two, of one, and the median of their ratios."""
    pairs = [(measure(2, seconds), measure(1, seconds)) for _ in range(rounds)]
    two, one = (statistics.median(values) for values in zip(*pairs, strict=True))
    return two, one, statistics.median(a / b for a, b in pairs)


def freshness(driver: str | None, seconds: float) -> tuple[int, int, int]:
    """Return steps in real time, and those with an old or repeated picture, and with an old or repeated state."""

    def real_time(*_: object, **options: object) -> hal.Rig:
        return hal.open(CONFIG, sim=True if driver is None else None, driver=driver, clock="real_time", pad="none")

    RigEnv._open = staticmethod(real_time)  # type: ignore[assignment]  # simulated rigs run in lock-step otherwise
    env = RigEnv(rate_hz=POLICY_HZ, action="twist")
    steps = old_pictures = old_states = 0
    try:
        env.reset(seed=1)
        last: dict[str, int] = {}
        last_t = -np.inf
        end = env.rig.clock.now() + seconds
        while env.rig.clock.now() < end:
            sent = env.rig.clock.now()
            env.step(np.array([0.02, 0, 0, 0, 0, 0, 0], np.float32))
            assert env.observation is not None
            stamps = {name: moment.frame.stamp for name, moment in env.observation.cameras.items()}
            old_pictures += any(stamp.t <= sent or last.get(name) == stamp.seq for name, stamp in stamps.items())
            last = {name: stamp.seq for name, stamp in stamps.items()}
            t = env.observation.robots[env.robot.name].stamp.t
            old_states += t <= sent or t <= last_t
            last_t = t
            steps += 1
    finally:
        env.close()
    return steps, old_pictures, old_states


def main() -> None:
    """Print all parts."""
    parser = argparse.ArgumentParser(description="RigEnv beside raw PyBullet, in processes, and its observations")
    parser.add_argument("--seconds", type=float, default=4.0, help="length of one round (%(default)s)")
    parser.add_argument("--rounds", type=int, default=5, help="rounds of each (%(default)s)")
    parser.add_argument("--alone", type=float, metavar="S", help="only print the steps/s of one environment")
    parser.add_argument("--engine", choices=("auto", *registry.ENGINES), default="auto", help="of the simulated world")
    args = parser.parse_args()
    if args.alone is not None:
        print(alone(args.engine, args.alone))
        return
    load = os.getloadavg()[0]
    print(f"{os.cpu_count()} cores, load {load:.1f}; steps/s at {POLICY_HZ:g} Hz, medians of {args.rounds} rounds")
    print(f"{'':30s}{'RigEnv':>12s}{'reference':>14s}{'ratio':>8s}{'goal':>8s}")
    for cameras, name, goal in ((False, "no camera", 0.55), (True, "two 256x256 RGB-D cameras", 4.0)):
        mine, theirs, ratio = lock_step(args.engine, cameras, args.seconds, args.rounds)
        print(f"{name:30s}{mine:12.1f}{theirs:14.1f}{ratio:8.2f}{goal:8.2f}", flush=True)
    for name, measure in (
        ("two in an AsyncVectorEnv, one", partial(together, args.engine)),
        ("... with two cameras each", partial(together, args.engine, cameras=True)),
        ("two programs, one", programs(__file__, "--engine", args.engine, "--alone")),
        ("... that only count", programs("-c", SPINS)),
    ):
        two, one, ratio = scaling(measure, args.seconds, args.rounds)
        print(f"{name:30s}{two:12.1f}{one:14.1f}{ratio:8.2f}{1.8:8.2f}", flush=True)
    print("\nin real time: fresh observations")
    for driver, name in (("mock", "mocks"), (None, "simulation")):
        steps, pictures, states = freshness(driver, 3.0 * args.seconds)
        old = f"{pictures} old pictures, {states} old states"
        print(f"{name:30s}{100.0 * (steps - pictures) / steps:9.1f} %  of {steps} steps; {old}", flush=True)


if __name__ == "__main__":
    main()
