"""Proofs on an emulated CAN arm with gravity: at rest, on a recorded drive, after the end of its program.

Each starts an emulator of its own, on a rig with one arm "arm".
"""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from can_kit import EmulatorProcess

import hal
from hal.geometry import Pose
from hal.kinematics.arm import Kinematics

_TELEOP = Path(__file__).resolve().parents[2] / "apps" / "teleop.py"
SPEED = 0.4
"""Of the joint that moves when a program ends, rad/s."""
_NO_TABLE = ("robots.arm.workspace=null", "collisions.boxes=[]")

APP = """
import json, os, sys
import hal
rig_name, joint, speed, *overrides = json.loads(sys.argv[1])
with hal.open(rig_name, sim=False, pad="none", overrides=overrides) as rig:
    arm = rig.robots["arm"]
    arm.move_to(arm.home, speed=0.5, unattended=True)
    with arm.control(rate_hz=10, unattended=True) as control:  # a busy computer may be late
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


def rest(
    rig_name: str, poses: int, plants: Sequence[tuple[float, float]], *more: str, reach: float = 0.4
) -> list[list[Rest]]:
    """Return how an arm rests at random poses, for each plant.

    Args:
        rig_name: The rig.
        poses: How many poses, the same for each plant.
        plants: Factors on the masses and on the friction of the plant.
        more: Further overrides of the rig, for the driver and the plant.
        reach: Largest distance of a joint from home, rad.
    """
    found = []
    with (
        EmulatorProcess(rig_name, *_NO_TABLE, *more) as emulator,
        hal.open(rig_name, sim=False, pad="none", overrides=emulator.overrides) as rig,
    ):
        arm = rig.robots["arm"]
        chain = Kinematics(arm.spec.kinematics)
        lower, upper = np.array(arm.spec.limits.lower) + 0.05, np.array(arm.spec.limits.upper) - 0.05
        for masses, friction in plants:
            emulator.execute(f"masses {masses}")
            emulator.execute(f"friction {friction}")
            random = np.random.default_rng(1)
            found.append([])
            for _ in range(poses):
                goal = np.clip(arm.home + random.uniform(-reach, reach, len(lower)), lower, upper)
                arm.move_to(goal, speed=0.8, unattended=True)
                time.sleep(0.7)
                emulator.execute("stats reset")
                time.sleep(0.5)
                state, stats = emulator.execute("state"), emulator.execute("stats")
                distance, _ = chain.pose(state["q"]).distance(chain.pose(goal))
                found[-1].append(Rest(distance, max(stats["peak_speed"])))
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


def tour(rig_name: str, pad: Path, folder: Path) -> Tour:
    """Drive the recording of a pad twice through the app, with reports in a folder."""
    with EmulatorProcess(rig_name) as emulator:
        lock_step = ["--sim", "--set", "cameras={}", "--set", "simulation.clock=lock_step"]
        emulated = ["--real", *(word for override in emulator.overrides for word in ("--set", override))]
        reports = []
        for options in (lock_step, emulated):
            report = folder / "report.json"
            command = [sys.executable, str(_TELEOP), "--config", rig_name, "--pad", str(pad)]
            command += ["--speed", "0.3", "--report", str(report), *options]
            done = subprocess.run(command, capture_output=True, text=True, timeout=100, check=False)
            if done.returncode:
                raise SystemExit(done.stdout + done.stderr)
            reports.append(json.loads(report.read_text()))
    ends = [Pose(report["tcp_end"]["position"], report["tcp_end"]["orientation"]) for report in reports]
    trips = [trip for report in reports for trip in (*report["trips"], *report["faults"])]
    return Tour(*ends[0].distance(ends[1]), reports[0]["tcp_travel_m"], trips)


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


def end(rig_name: str, way: str, seconds: float = 5.0, joint: int = 1, speed: float = SPEED) -> End:
    """End a program while its arm moves, and watch the arm for some seconds."""
    with EmulatorProcess(rig_name) as emulator:
        arguments = json.dumps([rig_name, joint, speed, *emulator.overrides, "robots.arm.speed=0.5"])
        app = subprocess.Popen(
            [sys.executable, "-c", APP, arguments], stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True
        )
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
