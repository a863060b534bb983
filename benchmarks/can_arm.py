"""Arms on a CAN bus against the emulator with gravity: at rest, on the recorded tour, after the end of a program.

    python benchmarks/can_arm.py [rest] [tour] [ends] [--rig yam|piper] [--runs 20]

* rest: places the arm at random poses and compares where the plant stands with where it was sent; with the plant as the
  driver's model has it, with friction, and with friction and 20 % more mass.
* tour: the recorded drive through ``hal-teleop``, simulated and emulated; how far apart the ends are, and the largest
  distance between set-point and plant on the way.
* ends: an arm at 0.4 rad/s under gravity, whose app is killed, whose host is killed, or whose bus is cut; its greatest
  speed afterwards.
"""

from __future__ import annotations

import argparse
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

import hal
from hal.geometry import Pose
from hal.kinematics.arm import Kinematics

ROOT = Path(__file__).resolve().parents[1]
sys.path[:0] = [str(ROOT / "tests" / "kits"), str(ROOT / "tests" / "wire")]
from calm_tour import write_tour  # noqa: E402
from can_kit import EmulatorProcess  # noqa: E402

SPEED = 0.4
"""Of the joint that moves when a program ends, rad/s."""
WAYS = ("app killed", "host killed", "bus cut")

APP = """
import json, os, sys
import hal
rig_name, joint, speed, *overrides = json.loads(sys.argv[1])
with hal.open(rig_name, sim=False, pad="none", overrides=overrides) as rig:
    arm = rig.robots["arm"]
    arm.move_to(arm.home, speed=0.5, unattended=True)
    with arm.control(rate_hz=50, unattended=True) as control:
        start = rig.clock.now()
        for tick in rig.clock.rate(50):
            dq = [0.0] * len(arm.home)
            dq[joint] = speed if int((tick.t - start) / 1.0) % 2 == 0 else -speed
            control.send(hal.JointVelocity(dq))
            if tick.t - start > 0.5 and not getattr(rig, "told", False):
                rig.told = True
                print(json.dumps([host.child.process.pid for host in rig._hosts]), flush=True)
"""


class Rest(NamedTuple):
    """An arm at rest at one pose."""

    distance: float
    """From the plant's tcp to where it was sent, m."""
    speed: float
    """Greatest joint speed over half a second, rad/s."""


def rest(rig_name: str, poses: int, masses: float, friction: float, seed: int = 1) -> list[Rest]:
    """Return how an arm rests at random poses; ``masses`` and ``friction`` are factors on those of the plant."""
    random = np.random.default_rng(seed)
    found = []
    with EmulatorProcess(rig_name, "robots.arm.workspace=null") as emulator:
        emulator.execute(f"masses {masses}")
        emulator.execute(f"friction {friction}")
        with hal.open(rig_name, sim=False, pad="none", overrides=emulator.overrides) as rig:
            arm = rig.robots["arm"]
            limits = arm.spec.limits
            chain = Kinematics(arm.spec.kinematics)
            lower, upper = np.array(limits.lower), np.array(limits.upper)
            for _ in range(poses):
                goal = lower + (upper - lower) * random.uniform(0.15, 0.85, len(lower))
                arm.move_to(goal, speed=0.8, unattended=True)
                time.sleep(0.7)
                emulator.execute("stats reset")
                time.sleep(0.5)
                state, stats = emulator.execute("state"), emulator.execute("stats")
                distance, _ = chain.pose(state["q"]).distance(chain.pose(goal))
                found.append(Rest(distance, max(stats["peak_speed"])))
    return found


class Tour(NamedTuple):
    """A recorded drive, simulated and emulated."""

    apart: float
    """Distance of the ends, m."""
    turned: float
    """Angle between the ends, rad."""
    travel: float
    """Way of the simulated tcp, m."""
    trips: list[Any]
    """Trips and faults of both."""


def tour(rig_name: str, friction: float = 1.0) -> Tour:
    """Drive the recorded tour twice through the app."""
    with tempfile.TemporaryDirectory() as folder, EmulatorProcess(rig_name) as emulator:
        emulator.execute(f"friction {friction}")
        pad = write_tour(Path(folder) / "calm.jsonl")
        lock_step = ["--sim", "--set", "cameras={}", "--set", "simulation.clock=lock_step"]
        emulated = ["--real", *(word for override in emulator.overrides for word in ("--set", override))]
        reports = []
        for options in (lock_step, emulated):
            report = Path(folder) / "report.json"
            command = [sys.executable, str(ROOT / "apps" / "teleop.py"), "--config", rig_name, "--pad", str(pad)]
            command += ["--speed", "0.3", "--report", str(report), *options]
            done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
            if done.returncode:
                raise SystemExit(done.stdout + done.stderr)
            reports.append(json.loads(report.read_text()))
    ends = [Pose(report["tcp_end"]["position"], report["tcp_end"]["orientation"]) for report in reports]
    trips = [trip for report in reports for trip in (*report["trips"], *report["faults"])]
    return Tour(*ends[0].distance(ends[1]), reports[0]["tcp_travel_m"], trips)


def tracking(rig_name: str, seconds: float = 8.0) -> list[float]:
    """Return distances between the set-point's tcp and the plant's at the same time, m, in a motion of all axes."""
    with (
        EmulatorProcess(rig_name, "robots.arm.workspace=null") as emulator,
        hal.open(rig_name, sim=False, pad="none", overrides=emulator.overrides) as rig,
    ):
        arm = rig.robots["arm"]
        chain = Kinematics(arm.spec.kinematics)
        distances: list[float] = []
        done = threading.Event()

        def watch() -> None:
            while not done.wait(0.01):
                before = np.array(arm.state().q_set)
                q = emulator.execute("state")["q"]
                after = np.array(arm.state().q_set)
                distances.append(chain.pose(q).distance(chain.pose(0.5 * (before + after)))[0])

        arm.move_to(arm.home, speed=0.5, unattended=True)
        with arm.control(rate_hz=50, unattended=True) as control:
            thread = threading.Thread(target=watch)
            thread.start()
            start = rig.clock.now()
            for tick in rig.clock.rate(50):
                t = tick.t - start
                x, y, z = 0.15 * np.cos(1.3 * t), 0.15 * np.cos(1.7 * t), 0.12 * np.cos(2.1 * t)
                control.send(hal.Twist([x, y, z], [0.0, 0.0, 0.3 * np.cos(t)]))
                if t > seconds:
                    break
            done.set()
            thread.join()
    return distances


class End(NamedTuple):
    """What an arm did after its program was ended in motion."""

    before: float
    """Greatest joint speed in the moment of the end, rad/s."""
    after: float
    """Greatest joint speed afterwards, rad/s."""
    sunk: float
    """Largest way of a joint in the time that was watched, rad."""
    last: float
    """Greatest joint speed at its end, rad/s."""


def end(rig_name: str, way: str, seconds: float = 6.0, joint: int = 1, speed: float = SPEED) -> End:
    """End a program while its arm moves, and watch the arm for some seconds."""
    with EmulatorProcess(rig_name) as emulator:
        arguments = json.dumps([rig_name, joint, speed, *emulator.overrides, "robots.arm.speed=0.5"])
        app = subprocess.Popen([sys.executable, "-c", APP, arguments], stdout=subprocess.PIPE, text=True)
        try:
            assert app.stdout is not None
            line = app.stdout.readline()
            if not line:
                raise SystemExit("the app ended before its arm moved")
            (host,) = json.loads(line)
            before = emulator.execute("state")
            if way == "bus cut":
                emulator.execute("cut on")
            else:
                os.kill(app.pid if way == "app killed" else host, signal.SIGKILL)
            emulator.execute("stats reset")
            time.sleep(seconds)
            after, stats = emulator.execute("state"), emulator.execute("stats")
        finally:
            app.kill()
            app.wait()
            app.stdout.close()
    ways = np.abs(np.array(after["q"]) - np.array(before["q"]))
    return End(max(map(abs, before["dq"])), max(stats["peak_speed"]), ways.max(), max(map(abs, after["dq"])))


def main() -> None:
    """Print the tables."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("what", nargs="*", choices=["rest", "tour", "ends", []], default=["rest", "tour", "ends"])
    parser.add_argument("--rig", choices=["yam", "piper"], default="yam")
    parser.add_argument("--runs", type=int, default=20, help="poses, and ends of each kind (%(default)s)")
    options = parser.parse_args()
    if "rest" in options.what:
        for name, masses, friction in (
            ("plant as the model", 1.0, 0.0),
            ("plant with friction", 1.0, 1.0),
            ("20 % heavier, no friction", 1.2, 0.0),
            ("20 % heavier, with friction", 1.2, 1.0),
        ):
            found = rest(options.rig, options.runs, masses, friction)
            distances = sorted(1e3 * one.distance for one in found)
            print(
                f"  {name:28s} at rest, {len(found)} poses: off by mm median {distances[len(found) // 2]:.2f} "
                f"max {distances[-1]:.2f}; fastest joint {max(one.speed for one in found):.4f} rad/s",
                flush=True,
            )
    if "tour" in options.what:
        drive = tour(options.rig)
        print(
            f"  tour of {drive.travel:.2f} m: ends {1e3 * drive.apart:.2f} mm and {drive.turned:.4f} rad apart; "
            f"trips {drive.trips}"
        )
        lags = sorted(1e3 * x for x in tracking(options.rig))
        print(f"  tracking: mm p50 {lags[len(lags) // 2]:.2f} max {lags[-1]:.2f} ({len(lags)} samples)", flush=True)
    if "ends" in options.what:
        for way in WAYS:
            ends = [end(options.rig, way) for _ in range(options.runs)]
            print(
                f"  {way:12s} {len(ends)} x: before {min(e.before for e in ends):.2f} to "
                f"{max(e.before for e in ends):.2f}, afterwards at most {max(e.after for e in ends):.3f} rad/s, "
                f"after 6 s {max(e.last for e in ends):.3f} rad/s; sunk {max(e.sunk for e in ends):.2f} rad",
                flush=True,
            )


if __name__ == "__main__":
    main()
