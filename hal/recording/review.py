"""Review of a dataset: its statistics, and a sheet per episode with pictures, status, and every joint over time."""

from __future__ import annotations

import base64
import io
import json
import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass, field
from html import escape
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ..errors import DatasetError
from ..types import Limited, RobotStatus, Trip
from .dataset import Dataset, Episode
from .exporters.content import ArmColumns, EpisodeContent, PictureStream
from .layout import SETPOINT, STATE, count_bytes, make_finite
from .metadata import simulated_pace

# Drawing.

Colour = tuple[int, int, int]
BLACK: Colour = (30, 30, 30)
GREY: Colour = (120, 120, 120)
LIGHT: Colour = (225, 225, 225)
_ANCHORS = {"l": "start", "m": "middle", "r": "end"}
_RISE = {"a": 0.95, "m": 0.35, "s": 0.0}
"""Distance of a text's baseline below the point that its anchor names, as a share of its size."""


class SheetCanvas:
    """A white SVG picture. Coordinates are in pixels from the upper left corner."""

    def __init__(self, width: int, height: int) -> None:
        size = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}" font-family="sans-serif"'
        self._parts = [f'<svg xmlns="http://www.w3.org/2000/svg" {size}>']
        self.box(0, 0, width, height, (255, 255, 255))

    def line(self, points: Sequence[tuple[float, float]], colour: Colour, width: float = 1.0) -> None:
        """Draw a line from point to point."""
        places = " ".join(f"{x:.1f},{y:.1f}" for x, y in points)
        self._parts.append(f'<polyline points="{places}" fill="none" stroke="rgb{colour}" stroke-width="{width}"/>')

    def box(self, x: float, y: float, width: float, height: float, colour: Colour) -> None:
        """Draw a filled rectangle, at least one pixel wide."""
        size = f'width="{max(1.0, width):.1f}" height="{max(1.0, height):.1f}"'
        self._parts.append(f'<rect x="{x:.1f}" y="{y:.1f}" {size} fill="rgb{colour}"/>')

    def text(self, x: float, y: float, words: str, size: int = 13, colour: Colour = BLACK, anchor: str = "la") -> None:
        """Draw a text; ``anchor``: left, middle or right (l, m, r), then ascender, middle or baseline (a, m, s)."""
        place = f'x="{x:.1f}" y="{y + _RISE[anchor[1]] * size:.1f}" text-anchor="{_ANCHORS[anchor[0]]}"'
        self._parts.append(f'<text {place} font-size="{size}" fill="rgb{colour}">{escape(words)}</text>')

    def photo(self, x: int, y: int, picture: NDArray[np.uint8], width: int, height: int) -> None:
        """Draw a picture (H, W, 3) RGB, scaled."""
        data = io.BytesIO()
        Image.fromarray(picture).resize((width, height), Image.Resampling.BOX).save(data, "jpeg", quality=85)
        source = f"data:image/jpeg;base64,{base64.b64encode(data.getvalue()).decode()}"
        self._parts.append(f'<image x="{x}" y="{y}" width="{width}" height="{height}" href="{source}"/>')

    @staticmethod
    def length(words: str, size: int = 13) -> float:
        """Return about the width of a text, pixels."""
        return 0.56 * size * len(words)

    def image(self) -> str:
        """Return the picture as SVG."""
        return "\n".join([*self._parts, "</svg>"])


def ticks(low: float, high: float, most: int) -> list[float]:
    """Return round numbers in a range, at most ``most``."""
    span = high - low
    for exponent in range(-9, 10):
        for mantissa in (1.0, 2.0, 5.0):
            step = mantissa * 10.0**exponent
            if span / step <= most - 1:
                first = int(np.ceil(low / step - 1e-9))
                last = int(np.floor(high / step + 1e-9))
                return [k * step for k in range(first, last + 1)]
    return [low, high]


# Summary of a dataset.

_WATCHED = ("robot.", "gripper.", "camera.")
"""Sources that measure continuously; a pad reports only changes."""
_IDLE = 0.02
"""Speed, rad/s; that of :func:`~.curation.find_motion`."""


@dataclass(frozen=True)
class SourceTiming:
    """Regularity of the true times of a source, ms."""

    source: str
    period: float
    """Mean time between two samples that differ."""
    jitter: float
    """Standard deviation of the period."""
    longest: float
    age: float
    """Mean age of a sample when its row was due."""
    oldest: float
    repeated: int
    """Rows with the same sample as the row before."""


@dataclass(frozen=True)
class EpisodeSummary:
    """One episode in numbers."""

    number: int
    rows: int
    seconds: float
    success: bool | None
    dropped: int
    trips: int
    """Number of stops that were latched."""
    task: str
    trouble: str
    pace: float | None
    """Pace of a simulation as a share of real time; None in lock-step, and without a simulation."""
    jerk: float
    """Root mean square of the jerk of all joints' set-points, rad/s3; NaN for fewer than four rows."""
    idle: float
    """Share of the rows in which no joint's set-point is faster than 0.02 rad/s."""


@dataclass(frozen=True)
class DatasetSummary:
    """A dataset, or some of its episodes, in numbers."""

    path: str
    fps: int
    robot_type: str
    episodes: list[EpisodeSummary]
    rows: int
    seconds: float
    successes: int
    failures: int
    unmarked: int
    dropped: int
    bytes: int
    timing: list[SourceTiming]
    broken: list[str] = field(default_factory=list)
    """Errors of episodes that cannot be read."""


def summarize(dataset: Dataset, episodes: Iterable[Episode] | None = None) -> DatasetSummary:
    """Read every row of these episodes, or of all, and return their statistics. Pictures are counted, not decoded."""
    lines: list[EpisodeSummary] = []
    broken: list[str] = []
    times: dict[str, list[tuple[NDArray[np.float64], NDArray[np.float64]]]] = {}
    for episode in dataset.episodes if episodes is None else episodes:
        try:
            line, stamps = measure_episode(episode), episode.stamps
        except DatasetError as error:
            broken.append(str(error))
            continue
        lines.append(line)
        for source, stamp in stamps.items():
            if source.startswith(_WATCHED):
                times.setdefault(source, []).append((stamp, stamps["grid"]))
    return DatasetSummary(
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
        bytes=count_bytes(dataset.root),
        timing=[_measure_timing(source, parts) for source, parts in times.items()],
        broken=broken,
    )


def summary_as_json(found: DatasetSummary) -> str:
    """Return a summary as one JSON object; unknown numbers are null."""
    return json.dumps(make_finite(asdict(found)), indent=2)


def measure_episode(episode: Episode) -> EpisodeSummary:
    """Read every row of an episode, and count its pictures. Raises DatasetError."""
    episode.check_pictures()
    content = EpisodeContent(episode)
    tripped = np.column_stack([_read_status(content, arm)[1] != 0 for arm in content.arms])
    jerk, idle = _measure_motion(content)
    return EpisodeSummary(
        number=episode.number,
        rows=episode.length,
        seconds=float(np.ptp(episode.stamps["grid"])) + 1.0 / episode.fps,
        success=episode.success,
        dropped=int(episode.info.get("dropped") or 0),
        trips=int(tripped[0].sum() + np.sum(tripped[1:] & ~tripped[:-1])),
        task=episode.task,
        trouble=episode.trouble,
        pace=simulated_pace(episode.info),
        jerk=jerk,
        idle=idle,
    )


def _measure_motion(content: EpisodeContent) -> tuple[float, float]:
    """Return the jerk and the idle share of an episode, see :class:`EpisodeSummary`."""
    fps = content.episode.fps
    joints = np.concatenate([content.of(arm, SETPOINT) for arm in content.arms], axis=1).astype(np.float64)
    jerks = np.diff(joints, 3, axis=0) * fps**3
    fastest = np.abs(np.diff(joints, axis=0)).max(axis=1, initial=0.0) * fps
    jerk = float(np.sqrt(np.mean(jerks**2))) if jerks.size else math.nan
    return jerk, float(np.mean(fastest <= _IDLE)) if fastest.size else 1.0


def _measure_timing(source: str, parts: Sequence[tuple[NDArray[np.float64], NDArray[np.float64]]]) -> SourceTiming:
    """Return the regularity of a source from its times, and when its rows were due, in each episode."""
    steps = np.concatenate([np.diff(stamps[np.isfinite(stamps)]) for stamps, _ in parts])
    ages = np.concatenate([(grid - stamps)[np.isfinite(stamps)] for stamps, grid in parts])
    longest, period, jitter = _measure(1e3 * steps[steps != 0.0])
    oldest, age, _ = _measure(1e3 * ages)
    return SourceTiming(source, period, jitter, longest, age, oldest, int(np.sum(steps == 0.0)))


def _measure(values: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the greatest value, the mean and the standard deviation; NaN without values."""
    if not values.size:
        return math.nan, math.nan, math.nan
    return float(values.max()), float(values.mean()), float(values.std())


_WIDTH, _MARGIN = 1600, 40
_INSIDE = _WIDTH - 2 * _MARGIN
_PHOTOS, _BETWEEN = 8, 6
_STRIP, _PANEL, _LEFT, _GUTTER = 18, 118, 52, 36
_MEASURED: Colour = (0, 90, 181)
_COMMANDED: Colour = (240, 140, 30)
_STOPPED: Colour = (250, 205, 200)
_HELD_BACK: Colour = (255, 241, 190)
_MISSING: Colour = (215, 205, 235)
_STATUS: dict[RobotStatus, Colour] = {
    RobotStatus.IDLE: (215, 215, 215),
    RobotStatus.FOLLOWING: (95, 175, 105),
    RobotStatus.STOPPING: (240, 180, 70),
    RobotStatus.HOLDING: (150, 190, 225),
    RobotStatus.TRIPPED: (215, 60, 50),
    RobotStatus.FAULT: (150, 30, 90),
    RobotStatus.LOST: (60, 60, 60),
}


class _Curve(NamedTuple):
    title: str
    measured: NDArray[np.float64]
    commanded: NDArray[np.float64]
    least: float
    """Smallest span of the axis, so that noise does not look like motion."""
    arm: ArmColumns


class _Run(NamedTuple):
    """Neighbouring rows with one value."""

    start: float
    end: float
    value: int


def draw_sheet(episode: Episode) -> str:
    """Return the sheet of an episode as SVG, 1600 pixels wide. Errors are those of reading the episode."""
    content = EpisodeContent(episode)
    streams = [stream for stream in content.pictures if stream.what == "rgb"]
    curves = list(_curves(content))
    photo = (_INSIDE - (_PHOTOS - 1) * _BETWEEN) // _PHOTOS
    heights = [round(photo * stream.shape[0] / stream.shape[1]) for stream in streams]
    rows = (len(curves) + 1) // 2
    height = 96 + sum(each + 30 for each in heights) + 70 + len(content.arms) * 44 + rows * (_PANEL + 40) + 20
    canvas = SheetCanvas(_WIDTH, height)
    y = _title(canvas, content)
    for stream, each in zip(streams, heights, strict=True):
        y = _photos(canvas, content, stream, y, photo, each)
    y = _statuses(canvas, content, y)
    _panels(canvas, content, curves, y)
    return canvas.image()


def _title(canvas: SheetCanvas, content: EpisodeContent) -> float:
    episode = content.episode
    info = episode.info
    mark = {True: "success", False: "failure", None: "not marked"}[episode.success]
    canvas.text(_MARGIN, 22, f"Episode {episode.number}: {episode.task or 'no task given'} ({mark})", 24)
    seed = "" if info.get("seed") is None else f", seed {info['seed']}"
    dropped = f", {info['dropped']} rows dropped" if info.get("dropped") else ""
    length = f"{content.rows} rows at {episode.fps} Hz, {_end(content):.1f} s"
    facts = f"{length}, {info.get('robot_type')}{seed}{dropped}, started {info.get('started')}"
    canvas.text(_MARGIN, 56, facts, 14, GREY)
    if episode.trouble:
        canvas.text(_MARGIN, 76, episode.trouble[:180], 14, _STATUS[RobotStatus.TRIPPED])
    return 104


def _photos(
    canvas: SheetCanvas, content: EpisodeContent, stream: PictureStream, y: float, width: int, height: int
) -> float:
    """Draw pictures evenly spaced in time, the first and the last among them."""
    shown = np.unique(np.linspace(0, content.rows - 1, _PHOTOS).round().astype(int)).tolist()
    canvas.text(_MARGIN, y, stream.camera, 14)
    for place, k in enumerate(shown):
        x = _MARGIN + place * (width + _BETWEEN)
        canvas.photo(x, round(y) + 18, content.episode.frame(stream.camera, k), width, height)
        canvas.text(x + width, y + 16, f"{content.grid[k]:.2f} s", 12, GREY, "rs")
    return y + height + 30


def _statuses(canvas: SheetCanvas, content: EpisodeContent, y: float) -> float:
    y = _legend(canvas, content, y) + 6
    for arm in content.arms:
        status, trips, _ = _read_status(content, arm)
        canvas.text(_MARGIN, y, arm.name, 14)
        for run in _runs(content, status):
            x, width = _span(content, run)
            canvas.box(x, y + 18, width, _STRIP, _STATUS[RobotStatus(run.value)])
        free = 0.0
        for run in _runs(content, trips):
            if run.value:
                x, _ = _span(content, run)
                words = f"{Trip(run.value)} at {run.start:.2f} s"
                x = max(x, free)
                canvas.text(x, y + 14, words, 12, _STATUS[RobotStatus.TRIPPED], "ls")
                free = x + canvas.length(words, 12) + 12
        y += 44
    return y + 8


def _legend(canvas: SheetCanvas, content: EpisodeContent, y: float) -> float:
    x: float = _MARGIN
    status, trips, limits = np.concatenate([_read_status(content, arm) for arm in content.arms], axis=1)
    limited = Limited(int(np.bitwise_or.reduce(limits)))
    items = [(_COMMANDED, "commanded"), (_MEASURED, "measured")]
    items += [(_STATUS[one], str(one)) for one in RobotStatus if one in status]
    items += [(_STOPPED, "stop latched")] if trips.any() else []
    items += [(_HELD_BACK, f"held back by the servo ({limited})")] if limited else []
    items += [(_MISSING, "rows dropped")] if content.episode.info.get("gaps") else []
    for colour, words in items:
        canvas.box(x, y + 2, 14, 11, colour)
        canvas.text(x + 20, y, words, 13)
        x += 20 + canvas.length(words) + 22
    return y + 20


def _read_status(content: EpisodeContent, arm: ArmColumns) -> NDArray[np.int64]:
    """Return the status, the trip and the limits (3, rows) of an arm."""
    columns: NDArray[np.int64] = content.of(arm, "rig.status").astype(np.int64).T
    return columns


def _runs(content: EpisodeContent, values: NDArray[np.int64]) -> Iterator[_Run]:
    """Yield the runs of equal values; each lasts until the next one begins."""
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    times = [*content.grid.tolist(), _end(content)]
    for first, after in pairwise(edges):
        yield _Run(times[first], times[after], int(values[first]))


def _end(content: EpisodeContent) -> float:
    return float(content.grid[-1]) + 1.0 / content.episode.fps


def _span(content: EpisodeContent, run: _Run, left: float = _MARGIN, width: float = _INSIDE) -> tuple[float, float]:
    """Return start and width of a run on an axis that begins at ``left``."""
    scale = width / _end(content)
    return left + run.start * scale, (run.end - run.start) * scale


def _curves(content: EpisodeContent) -> Iterator[_Curve]:
    for arm in content.arms:
        lead = f"{arm.name}: " if arm.lead else ""
        measured, commanded = content.of(arm, STATE), content.of(arm, SETPOINT)
        for k, joint in enumerate(content.joints(arm)):
            yield _Curve(f"{lead}{joint}, rad", measured[:, k], commanded[:, k], 0.02, arm)
        width, target = content.width(arm), content.width(arm, SETPOINT)
        if width is not None and target is not None:
            yield _Curve(f"{lead}gripper, mm", width * 1e3, target * 1e3, 2.0, arm)


def _panels(canvas: SheetCanvas, content: EpisodeContent, curves: list[_Curve], y: float) -> None:
    column = (_INSIDE - _GUTTER) / 2
    for k, curve in enumerate(curves):
        left = _MARGIN + (k % 2) * (column + _GUTTER) + _LEFT
        _panel(canvas, content, curve, left, y + (k // 2) * (_PANEL + 40) + 16, column - _LEFT)


def _panel(canvas: SheetCanvas, content: EpisodeContent, curve: _Curve, left: float, top: float, width: float) -> None:
    canvas.text(left, top - 4, curve.title, 13, BLACK, "ls")
    canvas.box(left, top, width, _PANEL, (250, 250, 250))
    _, trips, limits = _read_status(content, curve.arm)
    for flags, colour in ((limits, _HELD_BACK), (trips, _STOPPED)):
        for run in _runs(content, (flags != 0).astype(np.int64)):
            if run.value:
                x, wide = _span(content, run, left, width)
                canvas.box(x, top, wide, _PANEL, colour)
    for gap in content.episode.info.get("gaps") or ():
        x, wide = _span(content, _Run(gap["from_s"], gap["to_s"] + 1.0 / content.episode.fps, 1), left, width)
        canvas.box(x, top, wide, _PANEL, _MISSING)
    low, high = _range(curve)

    def at(t: float, value: float) -> tuple[float, float]:
        return left + t * width / _end(content), top + _PANEL * (high - value) / (high - low)

    for tick in ticks(low, high, 5):
        _, y = at(0.0, tick)
        canvas.line([(left, y), (left + width, y)], LIGHT)
        canvas.text(left - 6, y, f"{tick:.4g}", 11, GREY, "rm")
    for tick in ticks(0.0, _end(content), 12):
        x, _ = at(tick, low)
        canvas.line([(x, top), (x, top + _PANEL)], LIGHT)
        canvas.text(x, top + _PANEL + 3, f"{tick:g} s", 11, GREY, "ma")
    for values, colour, thick in ((curve.commanded, _COMMANDED, 3.0), (curve.measured, _MEASURED, 1.4)):
        edges = np.flatnonzero(np.diff(np.isfinite(values), prepend=False, append=False))
        for start, end in edges.reshape(-1, 2):  # a run of rows that hold a number
            points = zip(content.grid[start:end].tolist(), values[start:end].tolist(), strict=True)
            canvas.line([at(t, value) for t, value in points], colour, thick)


def _range(curve: _Curve) -> tuple[float, float]:
    both = np.concatenate([curve.measured, curve.commanded])
    known = both[np.isfinite(both)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    middle, half = (low + high) / 2, max(high - low, curve.least) * 0.55
    return middle - half, middle + half
