"""Episodes per second of ``hal generate`` with two workers and with one, and what is left after workers were killed.

    python benchmarks/generate.py [--episodes 200] [--kills 5] [--camera] [--ray]

Each row is a whole run of the program's function: workers that start, episodes of ``examples/pick.py`` (about 4.5
simulated seconds each), the merge. The goal is 1.8 times as many with two workers, without cameras and with one camera
(``--camera``, 256x256 RGB-D); two programs that only count show what the machine allowed. A further run kills a worker
with SIGKILL that many times, and must end with every episode once. ``--ray`` adds a run on a local Ray cluster. The
rows and the statistics of all runs are compared, byte by byte.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import signal
import subprocess
import sys
import tempfile
import threading
import time
from pathlib import Path

from hal.learning.episode_worker import EpisodeRecipe
from hal.learning.generate import LocalWorker, StartWorker, generate
from hal.recording import Dataset

EXAMPLES = Path(__file__).resolve().parents[1] / "examples"
BARE = ["cameras={}"]


def recipe(camera: bool) -> EpisodeRecipe:
    """Return the recipe of the episodes."""
    overrides = [] if camera else BARE
    return EpisodeRecipe(
        {"config": "panda_table", "sim": True, "overrides": overrides},
        skill="pick:pick",
        cameras=["scene"] if camera else None,
    )


SPIN = """
import sys, time
end, count = time.perf_counter() + float(sys.argv[1]), 0
while time.perf_counter() < end:
    count += 1
print(count)
"""


def counted(programs: int, seconds: float = 1.5) -> int:
    """Return how far programs that only count get together: what the machine allows."""
    command = [sys.executable, "-c", SPIN, str(seconds)]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True) for _ in range(programs)]
    return sum(int(program.communicate()[0]) for program in running)


class Killer:
    """Kills one of the workers now and then, ``kills`` times in all."""

    def __init__(self, kills: int, period: float) -> None:
        self.left, self._period = kills, period
        self._pids: list[int] = []
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def start_worker(self, recipe: dict, folder: str, index: int) -> LocalWorker:
        """Start a worker that may be killed."""
        worker = LocalWorker(recipe, folder, index)
        self._pids.append(worker.pid)
        return worker

    def _run(self) -> None:
        chance = random.Random(1)
        while self.left and not self._over.wait(self._period * chance.uniform(0.5, 1.5)):
            alive = [pid for pid in self._pids if Path(f"/proc/{pid}").exists()]
            if alive:
                victim = chance.choice(alive)
                os.kill(victim, signal.SIGKILL)
                self._pids.remove(victim)
                self.left -= 1

    def close(self) -> None:
        """Kill no more."""
        self._over.set()
        self._thread.join()


def processor_time() -> float:
    """Return the processor time that this program's processes have used, s, without those that run or were killed."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def timed(name: str, out: Path, args: argparse.Namespace, workers: int, start: StartWorker = LocalWorker) -> float:
    """Generate a dataset; print and return its episodes per second."""
    begun, used = time.perf_counter(), processor_time()
    made = generate(recipe(args.camera), out, args.episodes, workers=workers, start_worker=start)
    spent = time.perf_counter() - begun
    dataset = Dataset(out)
    numbers = [episode.info["info"]["episode"] for episode in dataset.episodes]
    assert numbers == list(range(args.episodes)), "every episode once, in order"
    lifted = sum(episode.success or False for episode in dataset.episodes)
    used = (processor_time() - used) / len(made)
    making = sum(result.wall_s for result in made) / len(made)
    print(
        f"{name:34s}{spent:8.1f} s {args.episodes / spent:7.2f} episodes/s; {making:.2f} s each, "
        f"{used:.2f} s of a processor; {lifted} lifted, {dataset.info['total_frames']} rows",
        flush=True,
    )
    return args.episodes / spent


def differences(one: Path, other: Path) -> int:
    """Return in how many columns and videos two datasets differ."""
    count = int((one / "meta/stats.json").read_bytes() != (other / "meta/stats.json").read_bytes())
    for a, b in zip(Dataset(one).episodes, Dataset(other).episodes, strict=True):
        count += sum(values.tobytes() != b.columns[key].tobytes() for key, values in a.columns.items())
        for camera in a.cameras:
            files = b.files(camera)
            count += sum(file.read_bytes() != files[key].read_bytes() for key, file in a.files(camera).items())
    return count


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="episodes per second with two workers and with one")
    parser.add_argument("--episodes", type=int, default=200, help="of each run (%(default)s)")
    parser.add_argument("--kills", type=int, default=5, help="workers that are killed (%(default)s)")
    parser.add_argument("--camera", action="store_true", help="record one camera")
    parser.add_argument("--ray", action="store_true", help="also on a local Ray cluster of two workers")
    args = parser.parse_args()
    sys.path.append(str(EXAMPLES))
    with tempfile.TemporaryDirectory() as folder:
        root = Path(folder)
        one = timed("1 worker", root / "one", args, 1)
        two = timed("2 workers", root / "two", args, 2)
        print(f"{'2 workers / 1 worker':34s}{two / one:8.2f}")
        print(f"{'2 programs that only count / 1':34s}{max(counted(2) / counted(1) for _ in range(3)):8.2f}")
        runs = ["two"]
        if args.kills:
            killer = Killer(args.kills, args.episodes / two / (args.kills + 2))
            try:
                timed(f"2 workers, {args.kills} kills", root / "killed", args, 2, killer.start_worker)
            finally:
                killer.close()
            assert not killer.left, f"{killer.left} kills were not done in time"
            runs.append("killed")
        if args.ray:
            from hal.learning.ray_workers import RayCluster

            with RayCluster("local", 2) as cluster:
                timed("2 workers of a local Ray cluster", root / "ray", args, 2, cluster.start_worker)
            runs.append("ray")
        for run in runs:
            print(f"columns and videos that differ, 1 worker and {run}: {differences(root / 'one', root / run)}")


if __name__ == "__main__":
    main()
