"""A Franka against the emulator in real time: missed cycles, response times, and their disturbances.

    python benchmarks/franka.py [--robot fr3|panda] [--seconds 60] [--disturbances]

The emulator is a process of its own on this computer and logs its own stalls. It takes a share of the processors that
a robot would not. The reference in the same run is the same servo while the app does nothing but send commands.
"""

from __future__ import annotations

import argparse
import contextlib
import gc
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from typing import Any

import numpy as np

import hal
from hal.drivers.franka.emulator.control import EmulatorControl

STALL = 0.02
"""s; as many cycles without a command as the robot's controller allows."""


@contextlib.contextmanager
def emulator(robot: str, host: str) -> Iterator[EmulatorControl]:
    """An emulator in a process of its own."""
    command = [sys.executable, "-m", "hal.drivers.franka.emulator", "--robot", robot, "--host", host, "--quiet"]
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.DEVNULL) as process:
        try:
            deadline = time.monotonic() + 10.0
            while not _listens(host):
                if process.poll() is not None or time.monotonic() > deadline:
                    raise SystemExit(f"the emulator at {host} did not start")
                time.sleep(0.05)
            yield EmulatorControl(host)
        finally:
            process.terminate()
            process.wait(5.0)


def _listens(host: str) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((host, 1339)) == 0


def busy(stop: threading.Event) -> None:
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


def drive(
    host: str, robot: str, seconds: float, *, disturb: str | None = None, cameras: bool = False
) -> dict[str, Any]:
    """Send twists at 50 Hz, and return the final report of the arm's process."""
    model = "fr3" if robot == "fr3" else "panda"
    overrides = [f"robots.arm.real.host={host}", f"robots.arm.model={model}"]
    overrides += [] if cameras else ["cameras={}"]
    began = time.perf_counter()
    with hal.open("franka_emulator", pad="none", overrides=overrides) as rig:
        opened = time.perf_counter() - began
        arm = rig.robots["arm"]
        arm.move_to(arm.home, unattended=True, speed=0.3)
        stop = threading.Event()
        target = {"busy": busy, "collect": collect}.get(disturb or "")
        thread = threading.Thread(target=target, args=(stop,), daemon=True) if target else None
        if thread:
            thread.start()
        trips: list[str] = []
        control = arm.control(rate_hz=50, unattended=True)
        before = rig.statistics()["arm"]
        start = rig.clock.now()
        with control:
            for tick in rig.clock.rate(50):
                turn = tick.t - start
                twist = hal.Twist(
                    [0.05 * np.sin(turn), 0.05 * np.cos(1.3 * turn), 0.03 * np.sin(0.7 * turn)],
                    [0.0, 0.0, 0.2 * np.sin(turn)],
                )
                try:
                    control.send(twist)
                except (hal.MotionStopped, hal.RobotFault) as error:
                    trips.append(f"{turn:.1f} s: {error}")
                    if arm.state(max_age=2.0).fault:
                        arm.recover()
                    control.rearm()
                if turn > seconds:
                    break
        after = rig.statistics()["arm"]
        stop.set()
        own = after["robots"]["arm"]
        return {
            "opened": opened,
            "cycles": after["ticks"] - before["ticks"],
            "missed": after["missed"] - before["missed"],
            "reanchored": own["reanchored"] - before["robots"]["arm"]["reanchored"],
            "driver": own["driver"],
            "trips": trips,
        }


def show(name: str, found: dict[str, Any], stalls: list[Any]) -> None:
    """Print one line of the table."""
    driver, cycles = found["driver"], found["cycles"]
    answer = driver["received_to_sent_s"]
    rate = driver["success_rate_min"]
    print(
        f"  {name:34s} cycles {cycles}, missed {100 * found['missed'] / max(1, cycles + found['missed']):.2f} %, "
        f"re-anchored {found['reanchored']}, success rate min {'-' if rate is None else f'{rate:.2f}'}, "
        f"answer us p50 {1e6 * answer['p50']:.0f} p99 {1e6 * answer['p99']:.0f} max {1e6 * answer['max']:.0f}"
    )
    print(
        f"  {'':34s} ready {found['opened']:.2f} s after hal.open; errors {len(found['trips'])}; "
        f"the emulator's own stalls of 20 ms and more: {len(stalls)}"
    )
    for trip in found["trips"]:
        print(f"  {'':34s}   {trip}")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="a Franka against the emulator in real time")
    parser.add_argument("--robot", choices=["fr3", "panda"], default="fr3")
    parser.add_argument("--seconds", type=float, default=60.0, help="length of the first run; the others take a third")
    parser.add_argument("--disturbances", action="store_true", help="also a busy thread, collections, two cameras")
    parser.add_argument("--host", default="127.0.8.2", help="loopback address of the emulator (%(default)s)")
    args = parser.parse_args()
    runs: list[tuple[str, float, dict[str, Any]]] = [("an app that only sends", args.seconds, {})]
    if args.disturbances:
        third = args.seconds / 3
        runs += [
            ("a busy Python thread in the app", third, {"disturb": "busy"}),
            ("collections of 500k objects", third, {"disturb": "collect"}),
            ("two simulated cameras at 30 Hz", third, {"cameras": True}),
        ]
    print(f"{args.robot}, real time, default scheduling")
    for name, seconds, options in runs:
        with emulator(args.robot, args.host) as control:
            found = drive(args.host, args.robot, seconds, **options)
            stalls = control.send("stats").get("stalls", [])
        show(name, found, stalls)


if __name__ == "__main__":
    main()
