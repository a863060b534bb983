"""Recording during real-time driving: lost rows, missed servo ticks, processor time, MB per minute.

    python benchmarks/recording.py [--seconds 20] [--pairs 3] [--size 640x480] [--cameras mock]

Each figure stands beside that of the same drive without a recorder, in the same run. Two simulated cameras of 640x480
are more than two cores draw at 30 Hz, recorder or not; ``--cameras mock`` leaves the drawing out, which is what a real
camera costs: its pictures come from elsewhere.
"""

from __future__ import annotations

import argparse
import os
import tempfile
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

import hal
from hal.recording import Dataset, Recorder
from hal.rig import Rig

FPS = 30
_TICKS = os.sysconf("SC_CLK_TCK")
_NAMES = ("scene", "wrist")
_READ = 300
"""Rows of depth that are read in random order."""


def cpu(pid: int) -> float:
    """Return the processor time that a process has used, s."""
    fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
    return (int(fields[11]) + int(fields[12])) / _TICKS


def drive(rig: Rig, seconds: float, recorder: Recorder | None) -> dict[str, Any]:
    """Send twists at 50 Hz, with or without a recorder."""
    arm = rig.robots["panda"]
    if recorder is not None:
        recorder.start()
    time.sleep(1.0)  # what only the first second costs is not measured
    before = next(iter(rig.statistics().values()))
    frames = {name: camera.counts().frames for name, camera in rig.cameras.items()}
    writer = recorder._child.process.pid if recorder is not None else None
    used = time.process_time(), cpu(writer) if writer else 0.0
    trips = 0
    start = time.monotonic()
    with arm.control(rate_hz=50, unattended=True) as control:
        for tick in rig.clock.rate(50):
            if tick.elapsed > seconds:
                break
            try:
                control.send(hal.Twist([0.05 * np.sin(tick.elapsed), 0.05 * np.cos(tick.elapsed), 0.0]))
            except hal.MotionStopped:  # this machine was busy with something else for 0.1 s
                trips += 1
                control.rearm()
    took = time.monotonic() - start
    after = next(iter(rig.statistics().values()))
    spent = time.process_time() - used[0], (cpu(writer) if writer else 0.0) - used[1]
    ticks, missed = (after[key] - before[key] for key in ("ticks", "missed"))
    found = {
        "missed": missed / (ticks + missed),
        "trips": trips,
        "app": spent[0] / took,
        "writer": spent[1] / took,
        "fps": {name: (camera.counts().frames - frames[name]) / took for name, camera in rig.cameras.items()},
    }
    if recorder is not None:
        saving = time.monotonic()
        recorder.save(wait=True)
        found["saving"] = time.monotonic() - saving
        found["status"] = recorder.status()
    return found


def show(title: str, found: dict[str, Any]) -> None:
    """Print one line."""
    rates = ", ".join(f"{name} {rate:.1f}" for name, rate in found["fps"].items())
    line = f"  {title:18s} missed {100 * found['missed']:.2f} %, app {100 * found['app']:.0f} % of a core"
    if "status" in found:
        line += f", writer {100 * found['writer']:.0f} %"
    print(f"{line}, pictures/s: {rates}" + (f", {found['trips']} commands too late" if found["trips"] else ""))


def report(out: Path, found: dict[str, Any]) -> None:
    """Print what was written to disk."""
    status = found["status"]
    episode = Dataset(out).episodes[-1]
    grid = episode.stamps["grid"]
    minutes = episode.length / FPS / 60
    folders = ("data", "videos", "depth")
    sizes = {
        name: sum(file.stat().st_size for file in (out / name).rglob(f"file-{episode.number:03d}.*")) / 1e6 / minutes
        for name in folders
    }
    shares = ", ".join(f"{name} {size:.1f}" for name, size in sizes.items())
    print(
        f"    rows {status.frames}, dropped {status.dropped}, late {status.late}; largest step of the grid "
        f"{1e3 * np.diff(grid).max():.1f} ms; finished in {found['saving']:.1f} s"
    )
    print(f"    MB per minute: {sum(sizes.values()):.0f} ({shares})")
    rows = np.random.default_rng(0).integers(episode.length, size=_READ)
    took = [_timed(lambda row=row: episode.depth["wrist"][row]) for row in rows.tolist()]
    whole = _timed(lambda: list(episode.depth("wrist")))
    p50, p99 = 1e3 * np.quantile(took[1:], [0.5, 0.99])
    print(
        f"    depth of a random row: p50 {p50:.1f}, p99 {p99:.1f} ms; "
        f"the first one {1e3 * took[0]:.1f} ms; all {episode.length} rows {1e3 * whole:.0f} ms"
    )
    print(f"    the simulation ran at {episode.info['pace'].get('panda', float('nan')):.4f} of real time")
    for name in _NAMES:
        age = (grid - episode.stamps[f"camera.{name}"]) * 1e3
        print(
            f"    {name}: picture is ms older than its row: median {np.median(age):.1f}, most {age.max():.0f}; "
            f"shown again in {episode.info['repeated'][name]} rows"
        )


def _timed(act: Callable[[], object]) -> float:
    start = time.perf_counter()
    act()
    return time.perf_counter() - start


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="recording in real time")
    parser.add_argument("--seconds", type=float, default=20.0, help="length of each drive (%(default)s)")
    parser.add_argument("--pairs", type=int, default=3, help="drives without and with a recorder (%(default)s)")
    parser.add_argument("--size", default="640x480", help="of the pictures (%(default)s)")
    parser.add_argument("--cameras", choices=["sim", "mock"], default="sim", help="drawn, or from a mock (%(default)s)")
    parser.add_argument("--codec", default="auto", help="h264, av1 or auto (%(default)s)")
    parser.add_argument("--rate", type=float, default=240.0, help="of the servo, Hz (%(default)s)")
    args = parser.parse_args()
    width, height = args.size.split("x")
    overrides = [f"simulation.physics_hz={args.rate:g}"]
    for name in _NAMES:
        overrides += [f"cameras.{name}.output.width={width}", f"cameras.{name}.output.height={height}"]
    print(f"servo {args.rate:g} Hz, two {args.cameras} cameras of {args.size}, {FPS} rows/s, {args.seconds:g} s each")
    driver = "mock" if args.cameras == "mock" else None
    without, recording = [], []
    with (
        tempfile.TemporaryDirectory(dir=".") as folder,
        hal.open("panda_table", sim=True, driver=driver, clock="real_time", overrides=overrides, pad="none") as rig,
    ):
        out = Path(folder) / "out"
        with Recorder(rig, out, FPS, "benchmark", codec=args.codec) as recorder:
            for _ in range(args.pairs):
                without.append(drive(rig, args.seconds, None))
                show("without", without[-1])
                recording.append(drive(rig, args.seconds, recorder))
                show("recording", recording[-1])
                report(out, recording[-1])
    misses = [100 * float(np.median([found["missed"] for found in runs])) for runs in (without, recording)]
    rows, lost = (sum(found["status"][k] for found in recording) for k in (2, 4))
    print(f"missed ticks, median: {misses[0]:.2f} % without, {misses[1]:.2f} % recording; lost rows: {lost} of {rows}")


if __name__ == "__main__":
    main()
