"""Real time: missed servo ticks, frame rates, ages of states and frames, with both cameras of the built-in rig.

    python benchmarks/real_time.py [--seconds 20] [--rates 240 1000] [--loaded] [--engine mujoco]

The reference in the same run is the same rig without cameras, and a bare pacer at the same rate that does nothing. With
``--loaded``: both cameras, with and without as many busy programs as there are processors, with real-time priority,
where it is refused, and (the reference) where it is not asked for.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "kits"))
from child_targets import give_up_right

import hal
from hal import registry
from hal.histogram import Histogram
from hal.host.main import PeriodicPace


def bare(rate_hz: float, seconds: float) -> float:
    """Return the share of ticks that an empty loop misses in this process."""
    pacer, end = PeriodicPace(1.0 / rate_hz), time.monotonic() + seconds
    turns = 0
    while time.monotonic() < end:
        pacer.wait()
        turns += 1
    return pacer.missed / (turns + pacer.missed)


@contextlib.contextmanager
def busy_programs(number: int) -> Iterator[None]:
    """Run other programs that compute without a pause."""
    programs = [subprocess.Popen([sys.executable, "-c", "while True: pass"]) for _ in range(number)]
    try:
        yield
    finally:
        for program in programs:
            program.kill()
            program.wait()


def run(engine: str, rate_hz: float, seconds: float, cameras: bool, realtime: bool = True) -> dict[str, Any]:
    """Drive the arm at 50 Hz, and read its state and every frame."""
    overrides = [f"simulation.physics_hz={rate_hz:g}"] + ([] if cameras else ["cameras={}"])
    with hal.open(
        "panda_table",
        sim=True,
        engine=engine,
        clock="real_time",
        overrides=overrides,
        pad="none",
        realtime=realtime,
    ) as rig:
        arm = rig.robots["panda"]
        before = next(iter(rig.statistics().values()))
        ages = Histogram(1e-4, 5000)
        start = rig.clock.now()
        with arm.control(rate_hz=50) as control:
            for tick in rig.clock.rate(50):
                turn = tick.t - start
                control.send(hal.Twist([0.05 * np.sin(turn), 0.05 * np.cos(turn), 0.0]))
                state = arm.state(max_age=1.0)
                ages.add(rig.clock.now() - state.stamp.t)
                for camera in rig.cameras.values():
                    camera.read_latest(max_age=5.0)
                if turn > seconds:
                    break
        after = next(iter(rig.statistics().values()))
        ticks = after["ticks"] - before["ticks"]
        missed = after["missed"] - before["missed"]
        return {
            "missed": missed / (ticks + missed),
            "period": after["period_s"],
            "scheduling": after["scheduling"],
            "age": ages.summary(),
            "cameras": {name: camera.counts() for name, camera in rig.cameras.items()},
            "renderer": rig.renderer,
        }


def loaded(engine: str, rates: list[float], seconds: float) -> None:
    """Print the missed ticks with and without load, by scheduling; gives up the right to real-time priority."""
    for asked in ("asked for", "refused", "not asked for"):
        if asked == "refused":
            give_up_right()
        for rate_hz in rates:
            for number in (0, os.cpu_count() or 1):
                with busy_programs(number):
                    found = run(engine, rate_hz, seconds, True, realtime=asked != "not asked for")
                period, frames = found["period"], [f"{counts.fps:.1f}" for counts in found["cameras"].values()]
                print(
                    f"  priority {asked:13s}  {rate_hz:4g} Hz, {number} busy programs: "
                    f"missed {100 * found['missed']:.3f} %, period ms p99 {1e3 * period['p99']:.2f} "
                    f"max {1e3 * period['max']:.1f}, frames/s {', '.join(frames)} ({found['scheduling']})",
                    flush=True,
                )


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="missed ticks, frame rates and ages in real time")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each run (%(default)s)")
    parser.add_argument("--rates", type=float, nargs="+", default=[240.0, 1000.0], help="servo rates, Hz")
    parser.add_argument("--loaded", action="store_true", help="the loaded computer instead")
    parser.add_argument("--engine", choices=registry.ENGINES, default="auto", help="of the simulated world")
    args = parser.parse_args()
    if args.loaded:
        loaded(args.engine, args.rates, args.seconds)
        return
    for rate_hz in args.rates:
        print(f"\nservo {rate_hz:g} Hz, {args.seconds:g} s each")
        print(f"  bare pacer            missed {100 * bare(rate_hz, args.seconds / 2):.2f} %")
        for cameras in (False, True):
            found = run(args.engine, rate_hz, args.seconds, cameras)
            name = "with both cameras" if cameras else "without cameras"
            period, age = found["period"], found["age"]
            print(
                f"  {name:20s}  missed {100 * found['missed']:.2f} %, period ms p50 {1e3 * period['p50']:.2f} "
                f"p99 {1e3 * period['p99']:.2f} max {1e3 * period['max']:.1f}, state age ms p50 {1e3 * age['p50']:.1f} "
                f"p99 {1e3 * age['p99']:.1f}"
            )
            for camera, counts in found["cameras"].items():
                print(
                    f"    {camera:18s}  {counts.fps:.1f} frames/s, {counts.dropped} dropped, "
                    f"age ms p50 {1e3 * counts.age_p50:.1f}  ({found['renderer']})"
                )


if __name__ == "__main__":
    main()
