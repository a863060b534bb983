"""Datasets of many episodes: how fast they open, are read at random, continued and curated, and what the index takes.

A few short episodes of a mock rig with two small cameras are recorded, and merged with themselves, ten at a time. At
most 1,024 files may be open. Every figure stands beside those of datasets with a tenth and a hundredth of the episodes,
and random pictures beside PyAV by hand.
"""

from __future__ import annotations

import resource
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

import hal
from hal.recording import Dataset, Episode, Recorder, delete_episodes, mark_episodes, merge, pack

from .kit import ROOT, Table, compare, timed

PATHS = ("hal/recording",)
FPS, SECONDS, RECORDED = 20, 1.0, 10
CAMERAS = ("scene", "wrist")
OPEN_FILES = 1024


def record(rig: hal.Rig, out: Path, episodes: int) -> float:
    """Record short episodes; return the time of the last one's saving, s."""
    spent = 0.0
    with Recorder(rig, out, FPS, "benchmark") as recorder:
        for seed in range(episodes):
            recorder.start(seed=seed)
            with rig.robots["panda"].control(rate_hz=50, unattended=True) as control:
                for tick in rig.clock.rate(50):
                    if tick.elapsed > SECONDS:
                        break
                    control.send(hal.Twist([0.0, 0.0, 0.05 * (-1) ** seed]))
            spent = timed(lambda: recorder.save(success=True, wait=True))
    return spent


def random_rows(out: Path, count: int) -> Iterator[tuple[Episode, str, int]]:
    """Yield random rows, each with one of the cameras; the same ones every time."""
    dice = np.random.default_rng(1)
    episodes = Dataset(out).episodes
    for _ in range(count):
        episode = episodes[dice.integers(len(episodes))]
        yield episode, CAMERAS[dice.integers(2)], int(dice.integers(episode.length))


def read_frames(out: Path, count: int) -> None:
    """Read pictures of random rows."""
    for episode, camera, row in random_rows(out, count):
        episode.frame(camera, row)


def read_numbers(out: Path, count: int) -> None:
    """Read the numbers of random rows."""
    for episode, _, row in random_rows(out, count):
        assert np.isfinite(episode.columns["action"][row]).all()


def read_frames_by_hand(out: Path, count: int, keep_open: bool) -> None:
    """Read pictures of random rows with PyAV alone; the files are opened each time, or kept open."""
    import av

    opened: dict[Path, Any] = {}
    for episode, camera, row in random_rows(out, count):
        path = episode.files(camera)["color"]
        container = opened.get(path) or av.open(str(path))
        stream: Any = container.streams.video[0]
        wanted = round((episode.first_picture(path) + row) / (FPS * stream.time_base))
        container.seek(wanted, stream=stream)
        picture = next(frame for frame in container.decode(stream) if frame.pts >= wanted)
        assert picture.to_ndarray(format="rgb24").ndim == 3
        if keep_open:
            opened[path] = container
        else:
            container.close()


def read_all(out: Path) -> tuple[Episode, ...]:
    """Open a dataset and read the metadata of each episode, as a list does."""
    episodes = Dataset(out).episodes
    assert all(episode.info["length"] == episode.length for episode in episodes)
    return episodes


def memory(out: Path) -> list[float]:
    """Return the memory, kB an episode, of the metadata of all episodes, and after a row of each was read."""
    command = [sys.executable, "-c", "import sys; from benchmarks.datasets import *; print_memory(Path(sys.argv[1]))"]
    done = subprocess.run([*command, out], capture_output=True, text=True, check=True, cwd=ROOT)
    return [float(number) for number in done.stdout.split()]


def print_memory(out: Path) -> None:
    """Print what :func:`memory` returns, of this process."""
    episodes = read_all(out)[:1]
    for row in range(2):
        read_row(episodes[0], row)  # loads the libraries
    before = resident()
    episodes = read_all(out)
    print((resident() - before) / len(episodes))
    for episode in episodes:
        read_row(episode, 1)
    print((resident() - before) / len(episodes))


def read_row(episode: Episode, row: int) -> None:
    """Read the numbers, a picture and the depth of a row."""
    assert np.isfinite(episode.columns["action"][row]).all()
    for camera in CAMERAS:
        assert episode.frame(camera, row).shape[:2] == episode.depth[camera][row].shape


def resident() -> float:
    """Return the memory that this process takes, kB."""
    pages = int(Path("/proc/self/statm").read_text(encoding="ascii").split()[1])
    return pages * resource.getpagesize() / 1e3


def measure(rig: hal.Rig, part: Path, out: Path, frames: int) -> dict[str, float]:
    """Return the figures of a dataset made of ten times a part; of times s, of sizes kB an episode."""
    rows = {"merge ten": timed(lambda: merge([part] * 10, out))}
    episodes = len(Dataset(out))
    rows["open"] = timed(lambda: Dataset(out))
    rows["open, and read the metadata of all episodes"] = timed(lambda: read_all(out))
    read_frames(out, 1)  # loads the libraries
    rows[f"{frames} random pictures"] = timed(lambda: read_frames(out, frames))
    rows["with PyAV by hand, files kept open"] = timed(lambda: read_frames_by_hand(out, frames, True))
    rows["with PyAV by hand, files opened each time"] = timed(lambda: read_frames_by_hand(out, frames, False))
    rows[f"numbers of {frames} random rows"] = timed(lambda: read_numbers(out, frames))
    rows["memory of all metadata, kB"], rows["memory after reading a row of each, kB"] = memory(out)
    for kind in ("meta", "episodes", "data", "videos"):
        rows[f"{kind}/, kB"] = folder_size(out / kind) / episodes
    rows["append: save one more"] = record(rig, out, 2)
    rows["pack after that"] = timed(lambda: pack(out))
    rows["mark one"] = timed(lambda: mark_episodes(out, {episodes // 2: False}))
    rows["mark a hundred"] = timed(lambda: mark_episodes(out, dict.fromkeys(range(0, episodes, episodes // 100), None)))
    rows["delete the last one"] = timed(lambda: delete_episodes(out, [episodes + 1]))
    rows["delete the first one"] = timed(lambda: delete_episodes(out, [0]))
    return rows


def folder_size(folder: Path) -> float:
    """Return the size of the files in a folder, kB."""
    return sum(path.stat().st_size for path in folder.rglob("*") if path.is_file()) / 1e3


def run(quick: bool) -> Iterator[Table]:
    """Yield the table."""
    most, frames = (100, 20) if quick else (10_000, 5000)
    resource.setrlimit(resource.RLIMIT_NOFILE, (OPEN_FILES, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    overrides = [f"cameras.{name}.output.{side}={64}" for name in CAMERAS for side in ("width", "height")]
    found: dict[str, dict[str, float]] = {}
    with (
        tempfile.TemporaryDirectory() as folder,
        hal.open("panda_table", driver="mock", overrides=overrides) as rig,
    ):
        part, episodes = Path(folder) / "part", RECORDED
        record(rig, part, RECORDED)
        recorded = {f"{kind}/, kB": folder_size(part / kind) / RECORDED for kind in ("meta", "episodes")}
        found[f"{RECORDED} episodes as they are recorded"] = recorded
        while (episodes := episodes * 10) <= most:
            out = Path(folder) / str(episodes)
            found[f"{episodes} episodes"] = measure(rig, part, out, frames)
            part = out
    yield compare(f"episodes of {SECONDS:g} s with two cameras, at most {OPEN_FILES} open files; times in s", found)
