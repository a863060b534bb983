"""What the benchmarks share: tables, times, and the processes and emulators that they measure."""

from __future__ import annotations

import contextlib
import socket
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

import hal
from hal import registry

ROOT = Path(__file__).resolve().parents[1]
ENGINES = tuple(name for name in registry.ENGINES if not registry.find_missing(name))
"""The engines of the simulation that are installed."""

median = statistics.median


# Tables.


@dataclass
class Table:
    """A table of results. Cells are numbers or text; the name of a row or a column has the unit."""

    title: str
    columns: Sequence[str]
    rows: list[tuple[Any, ...]] = field(default_factory=list)

    def add(self, *cells: Any) -> None:
        """Add a row."""
        self.rows.append(cells)

    def __str__(self) -> str:
        width = len(self.columns)
        rows = ([_text(cell) for cell in row] + [""] * (width - len(row)) for row in self.rows)
        lines = [self.columns, ["---"] * width, *rows]
        return "\n".join([self.title, "", *(f"| {' | '.join(line)} |" for line in lines)])


def compare(title: str, results: Mapping[str, Mapping[str, Any]]) -> Table:
    """Return a table with a column for each of some results, and a row for each of their keys."""
    table = Table(title, ("", *results))
    for key in dict.fromkeys(key for found in results.values() for key in found):
        table.add(key, *(found.get(key) for found in results.values()))
    return table


def _text(cell: Any) -> str:
    if isinstance(cell, float | np.floating):
        return f"{cell:.0f}" if abs(cell) >= 100.0 else f"{cell:.3g}"
    return "" if cell is None else str(cell)


def ms(values: Sequence[float], *shares: float) -> str:
    """Return quantiles of some times (s) in ms, as "median (max)" or as text for each of ``shares``, such as 0.99."""
    if shares:
        return ", ".join(f"p{100 * share:g} {1e3 * np.quantile(values, share):.1f}" for share in shares)
    return f"{1e3 * median(values):.1f} ({1e3 * max(values):.1f})"


# Times.


def timed(action: Callable[[], object]) -> float:
    """Return how long an action takes, s."""
    start = time.perf_counter()
    action()
    return time.perf_counter() - start


def per_second(step: Callable[[], object], seconds: float) -> float:
    """Return how many times a function runs in a second, after ``seconds`` of it."""
    done, start = 0, time.perf_counter()
    while (spent := time.perf_counter() - start) < seconds or not done:
        step()
        done += 1
    return done / spent


def run_in_turns(measures: Mapping[str, Callable[[], float]], rounds: int) -> dict[str, list[float]]:
    """Return what each of some functions returned in each round; a busy computer slows all of them alike."""
    found: dict[str, list[float]] = {name: [] for name in measures}
    for _ in range(rounds):
        for name, measure in measures.items():
            found[name].append(measure())
    return found


def median_ratio(some: Sequence[float], others: Sequence[float]) -> float:
    """Return the median of the ratios round by round."""
    return median(a / b for a, b in zip(some, others, strict=True))


# Processes.


@contextlib.contextmanager
def ticks_missed(rig: hal.Rig) -> Iterator[dict[str, float]]:
    """Yield a dict that has the ``ticks`` and the share ``missed`` of the rig's first group, in %, after the block."""
    found: dict[str, float] = {}
    before = next(iter(rig.statistics().values()))
    yield found
    after = next(iter(rig.statistics().values()))
    ticks, missed = (after[key] - before[key] for key in ("ticks", "missed"))
    found.update(ticks=ticks, missed=100.0 * missed / max(1, ticks + missed))


def sum_of_programs(count: int, *words: str) -> float:
    """Return the sum of what programs print that run at the same time, each ``python words``."""
    command = [sys.executable, *words]
    running = [subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=ROOT) for _ in range(count)]
    return sum(float(program.communicate(timeout=120.0)[0].split()[-1]) for program in running)


@contextlib.contextmanager
def emulated_franka(robot: str, host: str, *options: str) -> Iterator[str]:
    """Run an emulated Franka in a process of its own; yield its address."""
    command = [sys.executable, "-m", "hal_emulators.franka", "--robot", robot, "--host", host, "--quiet"]
    quiet = {"stdin": subprocess.PIPE, "stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL}
    with subprocess.Popen([*command, *options], **quiet) as process:  # type: ignore[call-overload]
        try:
            deadline = time.monotonic() + 20.0
            while not _listens(host):
                if process.poll() is not None or time.monotonic() > deadline:
                    raise RuntimeError(f"the emulator at {host} did not start")
                time.sleep(0.05)
            yield host
        finally:
            process.terminate()
            process.wait(10.0)


def _listens(host: str) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((host, 1339)) == 0
