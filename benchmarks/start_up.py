"""Start-up: time of a whole process that imports hal or shows a program's help, and of opening a rig."""

from __future__ import annotations

import subprocess
import sys
import time
from collections.abc import Iterator

import hal

from .kit import ROOT, Table, median, timed

PATHS = ("hal/__init__.py", "hal/rig.py", "hal/host", "apps")
PROGRAMS = {
    "nothing (reference)": ["-c", "pass"],
    "import numpy (reference)": ["-c", "import numpy"],
    "import hal": ["-c", "import hal"],
    "import hal; hal.open": ["-c", "import hal; hal.open"],
    "hal teleop --help": ["-m", "hal.apps.main", "teleop", "--help"],
}


def run_program(words: list[str]) -> None:
    """Run a fresh interpreter."""
    subprocess.run([sys.executable, *words], check=True, stdout=subprocess.DEVNULL, cwd=ROOT)


def open_rig() -> float:
    """Return how long hal.open takes, without cameras, in real time, s."""
    start = time.perf_counter()
    with hal.open("panda_table", sim=True, overrides=["cameras={}"], pad="none"):
        return time.perf_counter() - start


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    runs = range(1 if quick else 7)
    table = Table(f"seconds, {len(runs)} times each", ("", "median", "least", "most"))
    for name, words in PROGRAMS.items():
        found = [timed(lambda words=words: run_program(words)) for _ in runs]
        table.add(f"whole process: {name}", median(found), min(found), max(found))
    found = [open_rig() for _ in runs]
    table.add("hal.open, real time, without cameras", median(found), min(found), max(found))
    yield table
