"""Recording during real-time driving: lost rows, missed servo ticks, processor time, MB per minute.

Each figure stands beside that of the same drive without a recorder. Two simulated cameras of 640x480 are more than two
cores draw at 30 Hz, recorder or not; the mock's show what a real camera costs: its pictures come from elsewhere.
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import hal
from hal.recording import Dataset, Recorder

from .kit import Table, compare, cpu, ms, ticks_missed, timed

PATHS = ("hal/recording", "hal/host", "drivers/scene")
FPS = 30
SIZE = [
    f"cameras.{name}.output.{side}={n}" for name in ("scene", "wrist") for side, n in (("width", 640), ("height", 480))
]


def drive(rig: hal.Rig, seconds: float, recorder: Recorder | None) -> dict[str, Any]:
    """Send twists at 50 Hz, with or without a recorder; return the cells of a column."""
    arm = rig.robots["panda"]
    if recorder is not None:
        recorder.start()
    time.sleep(1.0)  # what only the first second costs is not measured
    frames = [camera.counts().frames for camera in rig.cameras.values()]
    writer = recorder._child.process.pid if recorder is not None else None
    app, used, late = time.process_time(), cpu(writer) if writer else 0.0, 0
    with arm.control(rate_hz=50, unattended=True) as control, ticks_missed(rig) as host:
        for tick in rig.clock.rate(50):
            if tick.elapsed > seconds:
                break
            try:
                control.send(hal.Twist([0.05 * np.sin(tick.elapsed), 0.05 * np.cos(tick.elapsed), 0.0]))
            except hal.MotionStopped:  # this machine was busy with something else for 0.1 s
                late += 1
                control.rearm()
    rates = [
        (camera.counts().frames - before) / seconds for camera, before in zip(rig.cameras.values(), frames, strict=True)
    ]
    found = {
        "ticks missed, %": host["missed"],
        "commands too late": late,
        "processor of the app, %": 100.0 * (time.process_time() - app) / seconds,
        "pictures/s": ", ".join(f"{rate:.1f}" for rate in rates),
    }
    if recorder is not None and writer is not None:
        found["processor of the writer, %"] = 100.0 * (cpu(writer) - used) / seconds
        found["saving, s"] = timed(lambda: recorder.save(wait=True))
        status = recorder.status()
        found["rows, dropped, late"] = f"{status.frames}, {status.dropped}, {status.late}"
    return found


def read_back(out: Path) -> dict[str, Any]:
    """Return what was written to disk, and how long depth takes to read."""
    episode = Dataset(out).episodes[-1]
    minutes = episode.length / FPS / 60
    found: dict[str, Any] = {"the simulation ran at, of real time": f"{episode.info['pace']['panda']:.4f}"}
    for kind in ("data", "videos", "depth"):
        files = (out / kind).rglob(f"file-{episode.number:03d}.*")
        found[f"MB per minute, {kind}"] = sum(file.stat().st_size for file in files) / 1e6 / minutes
    rows = np.random.default_rng(0).integers(episode.length, size=300).tolist()
    took = [timed(lambda row=row: episode.depth["wrist"][row]) for row in rows]
    found["a random row of depth, ms"] = ms(took[1:], 0.5, 0.99)
    found[f"all {episode.length} rows of depth, ms"] = 1e3 * timed(lambda: list(episode.depth("wrist")))
    return found


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    seconds, pairs = (0.5, 1) if quick else (12.0, 3)
    for driver in (None,) if quick else (None, "mock"):
        columns: dict[str, dict[str, Any]] = {}
        with (
            tempfile.TemporaryDirectory() as folder,
            hal.open("panda_table", sim=True, driver=driver, clock="real_time", overrides=SIZE, pad="none") as rig,
            Recorder(rig, Path(folder) / "out", FPS, "benchmark") as recorder,
        ):
            for turn in range(1, pairs + 1):
                columns[f"without, {turn}"] = drive(rig, seconds, None)
                columns[f"recording, {turn}"] = drive(rig, seconds, recorder) | read_back(Path(folder) / "out")
        kind = "simulated" if driver is None else driver
        title = f"two {kind} RGB-D cameras of 640x480, {FPS} rows/s, {seconds:g} s each"
        yield compare(title, columns)
