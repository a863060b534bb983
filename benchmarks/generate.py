"""Episodes per second of ``hal generate`` with two workers and with one.

Each row is a whole run: workers that start, episodes of ``examples/pick.py`` (about 4.5 simulated seconds each), the
merge. The goal is 1.8 times as many with two workers; two programs that only count show what the machine allowed.
"""

from __future__ import annotations

import resource
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

from hal.learning.episode_worker import EpisodeRecipe
from hal.learning.generate import generate
from hal.recording import Dataset

from .kit import ROOT, Table, sum_of_programs, timed

PATHS = ("hal/learning/generate.py", "hal/learning/episode_worker.py", "hal/learning/episode.py", "hal/recording")
SPIN = """
import time
end, count = time.perf_counter() + 1.5, 0
while time.perf_counter() < end:
    count += 1
print(count)
"""


def recipe(camera: bool) -> EpisodeRecipe:
    """Return the recipe of the episodes."""
    rig = {"config": "panda_table", "sim": True, "overrides": [] if camera else ["cameras={}"]}
    return EpisodeRecipe(rig, skill="pick:pick", cameras=["scene"] if camera else None)


def processor_time() -> float:
    """Return the processor time that this program and its ended processes have used, s."""
    return sum(sum(resource.getrusage(who)[:2]) for who in (resource.RUSAGE_SELF, resource.RUSAGE_CHILDREN))


def measure(out: Path, camera: bool, episodes: int, workers: int) -> tuple[float, float, int]:
    """Generate a dataset; return episodes per second, processor time of each, s, and the number of lifted cubes."""
    used = processor_time()
    spent = timed(lambda: generate(recipe(camera), out, episodes, workers=workers))
    made = Dataset(out).episodes
    assert [episode.info["info"]["episode"] for episode in made] == list(range(episodes)), "each once, in order"
    return episodes / spent, (processor_time() - used) / episodes, sum(episode.success or False for episode in made)


def run(quick: bool) -> Iterator[Table]:
    """Yield the table."""
    sys.path.append(str(ROOT / "examples"))
    columns = ("", "episodes/s", "processor time of each, s", "lifted", "ratio")
    table = Table("episodes of examples/pick.py", columns)
    for camera, episodes in ((False, 2),) if quick else ((False, 200), (True, 30)):
        with tempfile.TemporaryDirectory() as folder:
            one, two = Path(folder) / "one", Path(folder) / "two"
            what = f"{episodes} episodes{', one 256x256 RGB-D camera' * camera}"
            rate, *rest = measure(one, camera, episodes, 1)
            table.add(f"{what}, 1 worker", rate, *rest)
            double, *rest = measure(two, camera, episodes, 2)
            table.add(f"{what}, 2 workers", double, *rest, double / rate)
    spins = [sum_of_programs(2, "-c", SPIN) / sum_of_programs(1, "-c", SPIN) for _ in range(1 if quick else 3)]
    table.add("2 programs that only count / 1", None, None, None, max(spins))
    yield table
