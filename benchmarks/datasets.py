"""Datasets of many episodes: how fast they open, are read at random, continued and curated, and what the index takes.

    python benchmarks/datasets.py [--episodes 1000] [--frames 5000]

A few short episodes of a mock rig with two small cameras are recorded, and merged with themselves. At most 1,024 files
may be open. Every figure stands beside that of a dataset with a tenth of the episodes.
"""

from __future__ import annotations

import argparse
import resource
import shutil
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np

import hal
from hal.recording import Dataset, Recorder, delete_episodes, mark_episodes, merge, pack

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


def timed(action: Callable[[], object]) -> float:
    """Return how long an action takes, s."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def random_frames(out: Path, count: int) -> None:
    """Read pictures of random rows."""
    dice = np.random.default_rng(1)
    episodes = Dataset(out).episodes
    for _ in range(count):
        episode = episodes[dice.integers(len(episodes))]
        episode.frame(CAMERAS[dice.integers(2)], int(dice.integers(episode.length)))


def read_all(out: Path) -> None:
    """Open a dataset and read the metadata of each episode, as a list does."""
    for episode in Dataset(out).episodes:
        assert episode.info["length"] == episode.length


def report(rig: hal.Rig, part: Path, folder: Path, episodes: int, frames: int) -> None:
    """Print one column of the table."""
    out = folder / str(episodes)
    rows = {"merge": timed(lambda: merge([part] * (episodes // RECORDED), out))}
    rows["open"] = timed(lambda: Dataset(out))
    rows["open, and read the metadata of all episodes"] = timed(lambda: read_all(out))
    rows[f"{frames} random frames"] = timed(lambda: random_frames(out, frames))
    rows["append: save one more"] = record(rig, out, 2)
    rows["pack after that"] = timed(lambda: pack(out))
    rows["mark one"] = timed(lambda: mark_episodes(out, {episodes // 2: False}))
    rows["delete the last one"] = timed(lambda: delete_episodes(out, [episodes + 1]))
    rows["delete the first one"] = timed(lambda: delete_episodes(out, [0]))
    print(f"{episodes} episodes of {SECONDS:g} s with two cameras, at most {OPEN_FILES} open files")
    for name, seconds in rows.items():
        print(f"  {name:48s} {seconds:8.3f} s")
    for kind in ("meta/episodes", "data", "videos"):
        files = [path for path in (out / kind).rglob("*") if path.is_file()]
        size = sum(path.stat().st_size for path in files) / episodes / 1e3
        print(f"  {kind:24s} {len(files):4d} files, {size:6.1f} kB an episode")


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="datasets of many episodes")
    parser.add_argument("--episodes", type=int, default=1000, help="of the larger dataset (%(default)s)")
    parser.add_argument("--frames", type=int, default=5000, help="pictures that are read (%(default)s)")
    args = parser.parse_args()
    resource.setrlimit(resource.RLIMIT_NOFILE, (OPEN_FILES, resource.getrlimit(resource.RLIMIT_NOFILE)[1]))
    overrides = [f"cameras.{name}.output.{side}={64}" for name in CAMERAS for side in ("width", "height")]
    folder = Path(tempfile.mkdtemp())
    try:
        with hal.open("panda_table", driver="mock", overrides=overrides) as rig:
            record(rig, folder / "part", RECORDED)
            files = [path for path in (folder / "part/meta/episodes").rglob("*") if path.is_file()]
            size = sum(path.stat().st_size for path in files) / RECORDED / 1e3
            print(f"{RECORDED} episodes as they are recorded: {size:.1f} kB an episode in meta/episodes")
            for episodes in (args.episodes // 10, args.episodes):
                report(rig, folder / "part", folder, episodes, args.frames)
    finally:
        shutil.rmtree(folder)


PATHS = ("hal/recording",)


def run(quick: bool) -> list[object]:
    """Return the table: a row for each line that :func:`main` prints."""
    from contextlib import redirect_stdout
    from io import StringIO
    from unittest import mock

    from .kit import Table  # this file is also run by its path

    printed, words = StringIO(), ["--episodes", "100", "--frames", "20"] if quick else []
    with redirect_stdout(printed), mock.patch("sys.argv", ["datasets", *words]):
        main()
    return [Table("datasets of many episodes", ("",), [(line,) for line in printed.getvalue().splitlines()])]


if __name__ == "__main__":
    main()
