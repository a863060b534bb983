"""A Franka against the emulator in real time: missed cycles, response times, and their disturbances.

The emulator is a process of its own on this computer and logs its own stalls. It takes a share of the processors that
a robot would not. The reference in the same run is the same servo while the app does nothing but send commands.
"""

from __future__ import annotations

import contextlib
import gc
import threading
import time
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np

import hal
from hal_emulators.control import EmulatorControl

from .kit import Table, emulated_franka, ticks_missed

PATHS = ("drivers/franka", "hal/servo", "hal/host")
HOST = "127.0.8.2"


def compute(stop: threading.Event) -> None:
    """Run a busy thread, like a slow policy."""
    value = 0
    while not stop.is_set():
        value = (value * 31 + 7) % 1000003


def collect(stop: threading.Event) -> None:
    """Run garbage collections over half a million objects."""
    kept = [[k] for k in range(500_000)]
    while not stop.wait(0.2):
        gc.collect()
    kept.clear()


@contextlib.contextmanager
def disturbed(disturb: Callable[[threading.Event], None] | None) -> Iterator[None]:
    """Run a function in a thread during the block."""
    stop = threading.Event()
    if disturb is not None:
        threading.Thread(target=disturb, args=(stop,), daemon=True).start()
    try:
        yield
    finally:
        stop.set()


def drive(robot: str, seconds: float, disturb: Any = None, cameras: bool = False) -> tuple[Any, ...]:
    """Send twists at 50 Hz; return the cells of a row, from the final report of the arm's process."""
    overrides = [f"robots.arm.real.host={HOST}", f"robots.arm.model={robot}", *([] if cameras else ["cameras={}"])]
    began = time.perf_counter()
    with emulated_franka(robot, HOST), hal.open("franka_emulator", pad="none", overrides=overrides) as rig:
        opened = time.perf_counter() - began
        arm, stops = rig.robots["arm"], 0
        arm.move_to(arm.home, unattended=True, speed=0.3)
        with disturbed(disturb), arm.control(rate_hz=50, unattended=True) as control:
            before = rig.statistics()["arm"]["robots"]["arm"]
            with ticks_missed(rig) as host:
                for tick in rig.clock.rate(50):
                    t = tick.elapsed
                    way = [0.05 * np.sin(t), 0.05 * np.cos(1.3 * t), 0.03 * np.sin(0.7 * t)]
                    try:
                        control.send(hal.Twist(way, [0.0, 0.0, 0.2 * np.sin(t)]))
                    except (hal.MotionStopped, hal.RobotFault):
                        stops += 1
                        if arm.state(max_age=2.0).fault:
                            arm.recover()
                        control.rearm()
                    if t > seconds:
                        break
        own = rig.statistics()["arm"]["robots"]["arm"]
        stalls = len(EmulatorControl(HOST).send("stats").get("stalls", []))
    answer = ", ".join(f"{1e6 * own['driver']['received_to_sent_s'][name]:.0f}" for name in ("p50", "p99", "max"))
    rate = own["driver"]["success_rate_min"]
    return round(host["missed"], 2), own["reanchored"] - before["reanchored"], rate, answer, stops, stalls, opened


def run(quick: bool) -> Iterator[Table]:
    """Yield the table."""
    seconds = 1.0 if quick else 60.0
    columns = ("missed, %", "re-anchored", "success rate, least", "answer, us: p50, p99, max", "errors")
    columns += ("stalls of the emulator", "s until the rig was open, the emulator's start included")
    table = Table(f"twists at 50 Hz for {seconds:g} s; the disturbances for a third of it", ("", *columns))
    table.add("FR3, an app that only sends", *drive("fr3", seconds))
    if not quick:
        table.add("a busy Python thread in the app", *drive("fr3", seconds / 3, compute))
        table.add("collections of 500,000 objects in the app", *drive("fr3", seconds / 3, collect))
        table.add("two simulated cameras at 30 Hz", *drive("fr3", seconds / 3, cameras=True))
        table.add("Panda, an app that only sends", *drive("panda", seconds))
    yield table
