"""One episode on one sheet: pictures in time, what the arms did when, every joint as commanded and as measured."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from ...types import Limited, RobotStatus, Trip
from ..columns import SETPOINT, STATE
from ..reader import Episode
from .canvas import BLACK, GREY, LIGHT, Canvas, Colour, ticks
from .content import Arm, EpisodeContent, Pictures

__all__ = ["draw_sheet"]

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
    """The axis spans no less, so that noise does not look like motion."""
    arm: Arm


class _Run(NamedTuple):
    """Neighbouring rows with one value."""

    start: float
    end: float
    value: int


def draw_sheet(episode: Episode) -> Image.Image:
    """The sheet, 1600 pixels wide. Errors are those of reading the episode."""
    content = EpisodeContent(episode)
    streams = [stream for stream in content.pictures if stream.what == "rgb"]
    curves = list(_curves(content))
    photo = (_INSIDE - (_PHOTOS - 1) * _BETWEEN) // _PHOTOS
    heights = [round(photo * stream.shape[0] / stream.shape[1]) for stream in streams]
    rows = (len(curves) + 1) // 2
    height = 96 + sum(each + 30 for each in heights) + 70 + len(content.arms) * 44 + rows * (_PANEL + 40) + 20
    canvas = Canvas(_WIDTH, height)
    y = _title(canvas, content)
    for stream, each in zip(streams, heights, strict=True):
        y = _photos(canvas, content, stream, y, photo, each)
    y = _statuses(canvas, content, y)
    _panels(canvas, content, curves, y)
    return canvas.finished()


def _title(canvas: Canvas, content: EpisodeContent) -> float:
    episode = content.episode
    info = episode.info
    mark = {True: "success", False: "failure", None: "not marked"}[episode.success]
    canvas.text(_MARGIN, 22, f"Episode {episode.number}: {episode.task or 'no task given'} ({mark})", 24)
    seed = "" if info.get("seed") is None else f", seed {info['seed']}"
    dropped = f", {info['dropped']} rows dropped" if info.get("dropped") else ""
    length = f"{content.rows} rows at {episode.fps} Hz, {_end(content):.1f} s"
    facts = f"{length}, {info.get('robot_type')}{seed}{dropped}, started {info.get('started')}"
    canvas.text(_MARGIN, 56, facts, 14, GREY)
    if info.get("trouble"):
        canvas.text(_MARGIN, 76, str(info["trouble"])[:180], 14, _STATUS[RobotStatus.TRIPPED])
    return 104


def _photos(canvas: Canvas, content: EpisodeContent, stream: Pictures, y: float, width: int, height: int) -> float:
    """Pictures evenly in time, the first and the last among them."""
    shown = np.unique(np.linspace(0, content.rows - 1, _PHOTOS).round().astype(int)).tolist()
    canvas.text(_MARGIN, y, stream.camera, 14)
    place = 0
    for k, picture in enumerate(stream):
        if k in shown:
            x = _MARGIN + place * (width + _BETWEEN)
            canvas.photo(x, round(y) + 18, picture, width, height)
            canvas.text(x + width, y + 16, f"{content.grid[k]:.2f} s", 12, GREY, "rs")
            place += 1
    return y + height + 30


# What the arms did when.


def _statuses(canvas: Canvas, content: EpisodeContent, y: float) -> float:
    y = _legend(canvas, content, y) + 6
    for arm in content.arms:
        status = content.of(arm, "observation.status").astype(int)
        canvas.text(_MARGIN, y, arm.name, 14)
        for run in _runs(content, status[:, 0]):
            x, width = _span(content, run)
            canvas.box(x, y + 18, width, _STRIP, _STATUS[RobotStatus(run.value)])
        free = 0.0
        for run in _runs(content, status[:, 1]):
            if run.value:
                x, _ = _span(content, run)
                words = f"{Trip(run.value)} at {run.start:.2f} s"
                x = max(x, free)
                canvas.text(x, y + 14, words, 12, _STATUS[RobotStatus.TRIPPED], "ls")
                free = x + canvas.length(words, 12) + 12
        y += 44
    return y + 8


def _legend(canvas: Canvas, content: EpisodeContent, y: float) -> float:
    x: float = _MARGIN
    there = {int(value) for arm in content.arms for value in content.of(arm, "observation.status")[:, 0]}
    limited = Limited(0)
    for arm in content.arms:
        limited |= Limited(int(np.bitwise_or.reduce(_limits(content, arm))))
    items = [(_COMMANDED, "commanded"), (_MEASURED, "measured")]
    items += [(_STATUS[status], str(status)) for status in RobotStatus if status in there]
    items += [(_STOPPED, "stop latched")] if any(_trips(content, arm).any() for arm in content.arms) else []
    items += [(_HELD_BACK, f"held back by the servo ({limited})")] if limited else []
    items += [(_MISSING, "rows dropped")] if content.episode.info.get("gaps") else []
    for colour, words in items:
        canvas.box(x, y + 2, 14, 11, colour)
        canvas.text(x + 20, y, words, 13)
        x += 20 + canvas.length(words) + 22
    return y + 20


def _limits(content: EpisodeContent, arm: Arm) -> NDArray[np.int64]:
    return content.of(arm, "observation.status")[:, 2].astype(np.int64)


def _trips(content: EpisodeContent, arm: Arm) -> NDArray[np.int64]:
    return content.of(arm, "observation.status")[:, 1].astype(np.int64)


def _runs(content: EpisodeContent, values: NDArray[np.int64]) -> Iterator[_Run]:
    """Each lasts until the next one begins."""
    edges = [0, *(np.flatnonzero(np.diff(values)) + 1).tolist(), len(values)]
    times = [*content.grid.tolist(), _end(content)]
    for first, after in pairwise(edges):
        yield _Run(times[first], times[after], int(values[first]))


def _end(content: EpisodeContent) -> float:
    return float(content.grid[-1]) + 1.0 / content.episode.fps


def _span(content: EpisodeContent, run: _Run, left: float = _MARGIN, width: float = _INSIDE) -> tuple[float, float]:
    """Where a run begins, and how wide it is, on an axis from ``left`` on."""
    scale = width / _end(content)
    return left + run.start * scale, (run.end - run.start) * scale


# Joints and grippers.


def _curves(content: EpisodeContent) -> Iterator[_Curve]:
    for arm in content.arms:
        lead = f"{arm.name}: " if arm.lead else ""
        measured, commanded = content.of(arm, STATE), content.of(arm, SETPOINT)
        for k, joint in enumerate(content.joints(arm)):
            yield _Curve(f"{lead}{joint}, rad", measured[:, k], commanded[:, k], 0.02, arm)
        width, target = content.width(arm), content.width(arm, SETPOINT)
        if width is not None and target is not None:
            yield _Curve(f"{lead}gripper, mm", width * 1e3, target * 1e3, 2.0, arm)


def _panels(canvas: Canvas, content: EpisodeContent, curves: list[_Curve], y: float) -> None:
    column = (_INSIDE - _GUTTER) / 2
    for k, curve in enumerate(curves):
        left = _MARGIN + (k % 2) * (column + _GUTTER) + _LEFT
        _panel(canvas, content, curve, left, y + (k // 2) * (_PANEL + 40) + 16, column - _LEFT)


def _panel(canvas: Canvas, content: EpisodeContent, curve: _Curve, left: float, top: float, width: float) -> None:
    canvas.text(left, top - 4, curve.title, 13, BLACK, "ls")
    canvas.box(left, top, width, _PANEL, (250, 250, 250))
    for flags, colour in ((_limits(content, curve.arm), _HELD_BACK), (_trips(content, curve.arm), _STOPPED)):
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
        for part in _known(values):
            canvas.line([at(float(content.grid[k]), float(values[k])) for k in part], colour, thick)


def _range(curve: _Curve) -> tuple[float, float]:
    both = np.concatenate([curve.measured, curve.commanded])
    known = both[np.isfinite(both)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    middle, half = (low + high) / 2, max(high - low, curve.least) * 0.55
    return middle - half, middle + half


def _known(values: NDArray[np.float64]) -> Iterator[list[int]]:
    """Stretches of rows that hold a number."""
    part: list[int] = []
    for k, known in enumerate(np.isfinite(values).tolist()):
        if known:
            part.append(k)
        elif part:
            yield part
            part = []
    if part:
        yield part
