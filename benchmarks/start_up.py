"""Time of `import hal` and of `apps/teleop.py --help`, beside an interpreter that does nothing and `import numpy`.

And, in real time and without cameras, that of `hal.open`, and the memory of the process that steps the world; and what
loading a world takes, and what is drawn of it.

python benchmarks/start_up.py [--runs 7]
"""

from __future__ import annotations

import argparse
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

APP = Path(__file__).resolve().parents[1] / "apps" / "teleop.py"
WAYS = {
    "nothing (reference)": ["-c", "pass"],
    "import numpy (reference)": ["-c", "import numpy"],
    "import hal": ["-c", "import hal"],
    "import hal; hal.open": ["-c", "import hal; hal.open"],
    "apps/teleop.py --help": [str(APP), "--help"],
}


def seconds(arguments: list[str]) -> float:
    """Return the wall time of a fresh interpreter, s."""
    start = time.perf_counter()
    subprocess.run([sys.executable, *arguments], check=True, stdout=subprocess.DEVNULL)
    return time.perf_counter() - start


def host_memory() -> tuple[float, float]:
    """Return how long `hal.open` takes, s, and how much memory the world's process holds, MB."""
    import hal

    start = time.perf_counter()
    with hal.open("panda_table", sim=True, overrides=["cameras={}"], pad="none"):
        spent = time.perf_counter() - start
        (child,) = (int(pid) for pid in Path("/proc/thread-self/children").read_text().split())
        pages = int(Path(f"/proc/{child}/statm").read_text().split()[1])
    return spent, pages * resource.getpagesize() / 1e6


WORLD = """
import resource, sys, time
from pathlib import Path
from hal.config import load
from hal.registry import load as load_driver
from hal.drivers.scene.drawn import DrawnWorld
spec = load("panda_table", sim=True).resolve().world
make = DrawnWorld if sys.argv[1] == "drawn" else load_driver(spec.driver, "world")
start = time.perf_counter()
world = make(spec)
pages = int(Path("/proc/self/statm").read_text().split()[1])
print(time.perf_counter() - start, pages * resource.getpagesize() / 1e6)
"""


def load_world(what: str) -> tuple[float, float]:
    """Return how long loading it takes in a fresh process, s, and the memory of that process then, MB."""
    done = subprocess.run([sys.executable, "-c", WORLD, what], check=True, capture_output=True, text=True)
    spent, memory = map(float, done.stdout.split()[-2:])
    return spent, memory


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description="time until something can be used")
    parser.add_argument("--runs", type=int, default=7, help="of each (%(default)s)")
    runs = parser.parse_args().runs
    found = {name: [seconds(arguments) for _ in range(runs)] for name, arguments in WAYS.items()}
    print(f"{'whole process, s':28s}{'median':>10s}{'min':>10s}{'max':>10s}")
    for name, values in found.items():
        print(f"{name:28s}{statistics.median(values):10.3f}{min(values):10.3f}{max(values):10.3f}")
    opened, memory = zip(*(host_memory() for _ in range(runs)), strict=True)
    print(f"hal.open, no cameras: {statistics.median(opened):.2f} s; the world's process: {memory[-1]:.0f} MB")
    for what in ("stepped", "drawn"):
        spent, memory = zip(*(load_world(what) for _ in range(runs)), strict=True)
        print(f"loading the world that is {what}: {statistics.median(spent):.2f} s; the process: {memory[-1]:.0f} MB")


if __name__ == "__main__":
    main()
