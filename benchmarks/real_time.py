"""Real time: missed ticks, frame rates, ages of states and frames, also on a loaded computer; from a pad to the arm."""

from __future__ import annotations

import contextlib
import json
import math
import os
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from typing import Any

import numpy as np

import hal
from hal.errors import MotionStopped
from hal.histogram import Histogram
from hal.host.main import PeriodicPace

from .kit import ENGINES, ROOT, Table, ms, ticks_missed

PATHS = ("hal/host", "hal/servo", "drivers/scene", "drivers/pybullet", "drivers/mujoco")
RATES = (240.0, 1000.0)
PRIORITIES = ("real-time priority", "not permitted", "off (reference)")


def bare(rate_hz: float, seconds: float) -> float:
    """Return the share of ticks that an empty loop misses in this process, %."""
    pacer, end = PeriodicPace(1.0 / rate_hz), time.monotonic() + seconds
    turns = 0
    while time.monotonic() < end:
        pacer.wait()
        turns += 1
    return 100.0 * pacer.missed / (turns + pacer.missed)


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


def drive(engine: str, rate_hz: float, seconds: float, cameras: bool, realtime: bool = True) -> dict[str, Any]:
    """Drive the arm at 50 Hz, and read its state and every frame."""
    overrides = [f"simulation.physics_hz={rate_hz:g}"] + ([] if cameras else ["cameras={}"])
    options: dict[str, Any] = {"clock": "real_time", "pad": "none", "realtime": realtime, "overrides": overrides}
    with hal.open("panda_table", sim=True, engine=engine, **options) as rig:
        arm, ages = rig.robots["panda"], Histogram(1e-4, 5000)
        with arm.control(rate_hz=50) as control, ticks_missed(rig) as host:
            for tick in rig.clock.rate(50):
                control.send(hal.Twist([0.05 * np.sin(tick.elapsed), 0.05 * np.cos(tick.elapsed), 0.0]))
                ages.add(rig.clock.now() - arm.state(max_age=1.0).stamp.t)
                for camera in rig.cameras.values():
                    camera.read_latest(max_age=5.0)
                if tick.elapsed > seconds:
                    break
        period, age = next(iter(rig.statistics().values()))["period_s"], ages.summary()
        counts = [camera.counts() for camera in rig.cameras.values()]
    return {
        "missed, %": round(host["missed"], 3),
        "period, ms, p99 and max": f"{1e3 * period['p99']:.2f}, {1e3 * period['max']:.1f}",
        "age of a state, ms, p50 and p99": f"{1e3 * age['p50']:.1f}, {1e3 * age['p99']:.1f}",
        "frames/s": ", ".join(f"{each.fps:.1f}" for each in counts),
        "age of a frame, ms, p50": ", ".join(f"{1e3 * each.age_p50:.1f}" for each in counts),
    }


WITHOUT_RIGHT = """
import json, sys
from benchmarks.real_time import drive
from child_targets import give_up_right
give_up_right()
print(json.dumps(drive(*json.loads(sys.argv[1]))))
"""


def drive_without_right(*arguments: Any) -> dict[str, Any]:
    """Return the same for a program that has no right to real-time priority."""
    command = [sys.executable, "-c", WITHOUT_RIGHT, json.dumps(arguments)]
    done = subprocess.run(command, check=True, capture_output=True, text=True, cwd=ROOT)
    found: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return found


def follow_stick(rate_hz: float, presses: int, woken: bool) -> list[float]:
    """Return times from the motion of a stick to the first set-point that moves, s, of a loop of 50 Hz.

    It is infinite where none moves within 0.1 s.
    """
    overrides = ["cameras={}", f"simulation.physics_hz={rate_hz:g}", "gamepads.pad={model: auto, driver: mock}"]
    with hal.open("panda_table", sim=True, clock="real_time", overrides=overrides) as rig:
        arm, pad, changed = rig.robots["panda"], rig.gamepads["pad"], threading.Event()
        pad.wake(changed)
        teleop = hal.Teleop(arm)
        with ThreadPoolExecutor(1) as pool, arm.control(deadman=pad.hold("l2"), rate_hz=50) as control:
            moved = pool.submit(_move_stick, rig, presses)
            for tick in rig.clock.rate(50, changed if woken else None):
                with contextlib.suppress(MotionStopped):
                    control.send(teleop.step(pad.state(), tick.dt)[0])
                if moved.done():
                    break
        return moved.result()


def _move_stick(rig: hal.Rig, presses: int) -> list[float]:
    arm, pad, dice, found = rig.robots["panda"], rig.driver("pad"), np.random.default_rng(1), []
    for k in range(presses):
        if arm.state(max_age=5.0).status is not hal.RobotStatus.FOLLOWING:
            pad.release("l2")
            time.sleep(0.1)
            pad.press("l2")
        time.sleep(0.2 + 0.02 * dice.random())  # at rest, and not in step with the loop
        begun = time.monotonic()
        pad.stick("left_x", (-1.0) ** k)  # to and fro, so that no limit stops the arm
        time.sleep(0.1)
        moved = [state.stamp.t for state in arm.states(begun) if abs(state.dq_set).max() > 1e-6]
        pad.stick("left_x", 0.0)
        found.append(moved[0] - begun if moved else math.inf)
    return found


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    seconds, engines, rates = (0.5, ENGINES[:1], RATES[:1]) if quick else (10.0, ENGINES, RATES)
    for engine in engines:
        found = {}
        for rate in rates:
            found[f"{rate:g} Hz, empty loop (reference)"] = {"missed, %": bare(rate, seconds / 2)}
            found[f"{rate:g} Hz, without cameras"] = drive(engine, rate, seconds, False)
            found[f"{rate:g} Hz, with both"] = drive(engine, rate, seconds, True)
        keys = tuple(next(reversed(found.values())))
        table = Table(f"{engine}: an arm at 50 Hz, two 256x256 RGB-D cameras at 30 Hz", ("servo", *keys))
        for name, row in found.items():
            table.add(name, *(row.get(key) for key in keys))
        yield table
    columns = ("servo", "busy programs", *(f"{name}: missed, %; period, ms, p99 and max" for name in PRIORITIES))
    table = Table("both cameras, beside programs that compute all the time", columns)
    for rate in rates:
        for number in (0,) if quick else (0, os.cpu_count() or 1):
            rows = []
            for priority in PRIORITIES[: 1 if quick else None]:
                with busy_programs(number):
                    measure = drive_without_right if priority == "not permitted" else drive
                    rows.append(measure(ENGINES[0], rate, seconds, True, priority != PRIORITIES[2]))
            cells = (f"{row['missed, %']}; {row['period, ms, p99 and max']}" for row in rows)
            table.add(f"{rate:g} Hz", number, *cells)
    yield table
    presses = 1 if quick else 60
    table = Table(
        f"a stick to the first set-point that moves, ms, {presses} times", ("servo", "50 Hz (reference)", "woken")
    )
    for rate in rates:
        table.add(f"{rate:g} Hz", *(ms(follow_stick(rate, presses, woken), 0.5, 0.9) for woken in (False, True)))
    yield table
