"""What a dataset is like, in numbers: how much, how well it went, how the joints moved, how even the times are."""

from __future__ import annotations

import json
import math
from collections.abc import Iterable, Iterator
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import DatasetError
from ..columns import ACTION, STATE
from ..pace import simulated_pace
from ..reader import Dataset, Episode

__all__ = ["EpisodeLine", "Spread", "Summary", "Timing", "as_json", "summary"]

_WATCHED = ("robot.", "gripper.", "camera.")
"""Sources that measure all the time; a pad speaks when it is touched."""


@dataclass(frozen=True)
class Spread:
    """One number of a column, over all rows: rad, or m of a gripper's width."""

    name: str
    min: float
    max: float
    mean: float
    std: float


@dataclass(frozen=True)
class Timing:
    """How even the true times of a source are, ms."""

    source: str
    period: float
    """Mean time between two samples that differ."""
    jitter: float
    """Standard deviation of that."""
    longest: float
    age: float
    """How old a sample was when its row was due, on average."""
    oldest: float
    repeated: int
    """Rows with the same sample as the row before."""


@dataclass(frozen=True)
class EpisodeLine:
    """One episode."""

    number: int
    rows: int
    seconds: float
    success: bool | None
    dropped: int
    trips: int
    """How often a stop was latched in it."""
    task: str
    trouble: str
    pace: float | None
    """How fast a simulation's time passed, as a share of real time; None in lock-step, and without one."""


@dataclass(frozen=True)
class Summary:
    """All of a dataset, or of the episodes that were asked for."""

    path: str
    fps: int
    robot_type: str
    episodes: list[EpisodeLine]
    rows: int
    seconds: float
    successes: int
    failures: int
    unmarked: int
    dropped: int
    bytes: int
    state: list[Spread]
    action: list[Spread]
    timing: list[Timing]
    broken: list[str] = field(default_factory=list)
    """Episodes that cannot be read, and why."""


def summary(dataset: Dataset, episodes: Iterable[Episode] | None = None) -> Summary:
    """Read every row of these episodes, else of all. Pictures are counted, not decoded."""
    lines: list[EpisodeLine] = []
    broken: list[str] = []
    states, actions = _Moments(), _Moments()
    names: list[str] = []
    times: dict[str, _Times] = {}
    for episode in dataset.episodes if episodes is None else episodes:
        try:
            line, columns, stamps = _line(episode), episode.columns, episode.stamps
            parts = columns[STATE], columns[ACTION]
            episode.check_pictures()
        except DatasetError as error:
            broken.append(str(error))
            continue
        lines.append(line)
        names = episode.names(STATE)
        states.add(parts[0])
        actions.add(parts[1])
        for source, stamp in stamps.items():
            if source.startswith(_WATCHED):
                times.setdefault(source, _Times()).add(stamp, stamps["grid"])
    return Summary(
        path=str(dataset.root),
        fps=dataset.fps,
        robot_type=str(dataset.info.get("robot_type")),
        episodes=lines,
        rows=sum(line.rows for line in lines),
        seconds=sum(line.seconds for line in lines),
        successes=sum(line.success is True for line in lines),
        failures=sum(line.success is False for line in lines),
        unmarked=sum(line.success is None for line in lines),
        dropped=sum(line.dropped for line in lines),
        bytes=_bytes(dataset.root),
        state=states.spreads(names),
        action=actions.spreads(names),
        timing=[found.timing(source) for source, found in times.items()],
        broken=broken,
    )


def as_json(found: Summary) -> str:
    """As one JSON object; what is not known is null."""

    def plain(value: Any) -> Any:
        if isinstance(value, float):
            return value if math.isfinite(value) else None
        if isinstance(value, dict):
            return {key: plain(each) for key, each in value.items()}
        if isinstance(value, list):
            return [plain(each) for each in value]
        return value

    return json.dumps(plain(asdict(found)), indent=2)


def _line(episode: Episode) -> EpisodeLine:
    status, names = episode.columns["observation.status"], episode.names("observation.status")
    trips = 0
    for k, name in enumerate(names):
        if name.split(".")[-1] == "trip":
            tripped = status[:, k] != 0
            trips += int(tripped[0]) + int(np.sum(tripped[1:] & ~tripped[:-1]))
    return EpisodeLine(
        number=episode.number,
        rows=episode.length,
        seconds=float(np.ptp(episode.stamps["grid"])) + 1.0 / episode.fps,
        success=episode.success,
        dropped=int(episode.info.get("dropped") or 0),
        trips=trips,
        task=episode.task,
        trouble=str(episode.info.get("trouble") or ("recovered" if episode.info.get("recovered") else "")),
        pace=simulated_pace(episode.info),
    )


def _bytes(folder: Path) -> int:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file())


class _Moments:
    """Least, most, mean and spread of columns that come in parts. What was not known (NaN) does not count."""

    def __init__(self) -> None:
        self._parts: list[NDArray[np.float64]] = []

    def add(self, values: NDArray[Any]) -> None:
        self._parts.append(np.asarray(values, np.float64))

    def spreads(self, names: list[str]) -> list[Spread]:
        if not self._parts:
            return []
        table = np.concatenate(self._parts)
        return [Spread(name, *_of(table[:, k])) for k, name in enumerate(names)]


def _of(values: NDArray[np.float64]) -> Iterator[float]:
    known = values[np.isfinite(values)]
    for measure in (np.min, np.max, np.mean, np.std):
        yield float(measure(known)) if known.size else math.nan


class _Times:
    """Of one source."""

    def __init__(self) -> None:
        self._periods: list[NDArray[np.float64]] = []
        self._ages: list[NDArray[np.float64]] = []
        self._repeated = 0

    def add(self, stamps: NDArray[np.float64], grid: NDArray[np.float64]) -> None:
        known = np.isfinite(stamps)
        steps = np.diff(stamps[known])
        self._repeated += int(np.sum(steps == 0.0))
        self._periods.append(steps[steps != 0.0])
        self._ages.append((grid - stamps)[known])

    def timing(self, source: str) -> Timing:
        periods, ages = np.concatenate(self._periods) * 1e3, np.concatenate(self._ages) * 1e3
        _, longest, period, jitter = _of(periods)
        _, oldest, age, _ = _of(ages)
        return Timing(source, period, jitter, longest, age, oldest, self._repeated)
