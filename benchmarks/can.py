"""Arms on an emulated CAN bus with gravity: at rest, on a drive, after the end of a program, and missed cycles."""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from can_kit import EmulatorProcess
from can_proofs import WAYS, end, rest, tour, tracking

import hal

from .kit import ROOT, Table, median, ticks_missed

sys.path.append(str(ROOT / "tests" / "wire"))
from calm_tour import write_tour

PATHS = ("drivers/can",)
PLANTS = {
    "plant as the model": (1.0, 0.0),
    "plant with friction": (1.0, 1.0),
    "20 % heavier, no friction": (1.2, 0.0),
    "20 % heavier, with friction": (1.2, 1.0),
}
OPENARM = {"model": "openarm_left", "base": {"position": [0, 0, 0.7], "orientation": [-0.7071068, 0, 0, 0.7071068]}}
"""7 motors and that of its hand, at 500 Hz; a cycle is incomplete if a reply is not there by the next one."""


def cycles(seconds: float) -> dict[str, Any]:
    """Move all joints and the gripper of an OpenArm, and return the figures of the arm's process."""
    with tempfile.TemporaryDirectory() as folder:
        file = Path(folder) / "rig.yaml"
        file.write_text(yaml.safe_dump({"sim": False, "robots": {"arm": OPENARM}}))
        emulator = EmulatorProcess(str(file))
        with emulator, hal.open(str(file), pad="none", overrides=emulator.overrides) as rig:
            arm = rig.robots["arm"]
            centre, limits = arm.home, arm.spec.limits
            arm.move_to(centre, unattended=True, speed=0.3)
            room = np.minimum(np.array(limits.upper) - centre, centre - np.array(limits.lower))
            swing, rates = np.clip(0.8 * room, 0.0, 0.15), np.linspace(0.7, 1.7, len(centre))
            with arm.control(rate_hz=50, unattended=True) as control:
                before = rig.statistics()["arm"]["robots"]["arm"]["driver"]
                with ticks_missed(rig) as host:
                    for tick in rig.clock.rate(50):
                        if tick.elapsed > seconds:
                            break
                        grip = 0.5 + 0.4 * np.sin(0.8 * tick.elapsed)
                        control.send(hal.JointTarget(centre + swing * np.sin(rates * tick.elapsed)), grip=grip)
                after = rig.statistics()["arm"]["robots"]["arm"]["driver"]
    counted = {name: after[name] - before[name] for name in ("cycles", "incomplete", "missing", "late")}
    took = after["read_and_write_s"]
    return {
        f"cycles that the host missed, of {host['ticks']}, %": host["missed"],
        "cycles in which a reply was not there in time, %": 100.0 * counted["incomplete"] / max(1, counted["cycles"]),
        "replies lost": counted["missing"] - counted["late"],
        **{f"read and write, ms, {name}": 1e3 * took[name] for name in ("p50", "p99", "max")},
    }


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    runs = 1 if quick else 20
    found = [] if quick else rest("yam", runs, list(PLANTS.values()))  # tests/wire/test_can_gravity.py has a short one
    table = Table(f"a YAM at rest, {runs} poses", ("plant", "off by, mm, median", "largest", "fastest joint, rad/s"))
    for name, each in zip(PLANTS, found, strict=False):
        distances = [1e3 * one.distance for one in each]
        table.add(name, median(distances), max(distances), max(one.speed for one in each))
    yield table
    table = Table("the plant's tcp behind the set-point's, in a motion of all axes", ("", "mm, median", "largest"))
    for rig in ("yam",) if quick else ("yam", "piper"):
        lags = [1e3 * lag for lag in tracking(rig, 1.0 if quick else 8.0)]
        table.add(rig, median(lags), max(lags))
    yield table
    table = Table("ends of one recorded drive, simulated and emulated", ("", "apart, mm", "rad", "trips"))
    for rig in () if quick else ("yam", "piper"):
        with tempfile.TemporaryDirectory() as folder:
            drive = tour(rig, write_tour(Path(folder) / "calm.jsonl"), Path(folder))
        table.add(f"{rig}, {drive.travel:.2f} m", 1e3 * drive.apart, drive.turned, len(drive.trips))
    yield table
    columns = ("", "joint speed before, rad/s", "greatest afterwards", "after 5 s", "sunk, rad")
    table = Table(f"a YAM whose shoulder moves, {runs} times each", columns)
    for way in () if quick else WAYS:
        ends = [end("yam", way) for _ in range(runs)]
        table.add(way, *(max(getattr(one, name) for one in ends) for name in ("before", "after", "last", "sunk")))
    yield table
    table = Table("an OpenArm at 500 Hz, in real time", ("", ""))
    for row in cycles(1.0 if quick else 60.0).items():
        table.add(*row)
    yield table
