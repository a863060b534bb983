"""Statistics of columns and pictures, as a LeRobotDataset keeps them: for training to normalise by."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["PictureStats", "Stats", "column_stats", "merged", "plain"]

Stats = dict[str, NDArray[Any]]
"""``min``, ``max``, ``mean``, ``std``, ``q01`` ... ``q99``, each of the column's shape, and ``count`` (1,)."""

_QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}
_LEVELS = 256
_FINE = 120
"""Rows of pixels of a picture that count, at least: as good for statistics as all of them, and far quicker."""


def column_stats(values: NDArray[Any]) -> Stats:
    """Of a column (rows, n). What was not known (NaN) is left out; where nothing was, NaN stays."""
    table = np.asarray(values, np.float64)
    known = np.isfinite(table)
    found: Stats = {key: np.full(table.shape[1], np.nan) for key in ("min", "max", "mean", "std", *_QUANTILES)}
    for k in range(table.shape[1]):
        numbers = table[known[:, k], k]
        if numbers.size:
            found["min"][k], found["max"][k] = numbers.min(), numbers.max()
            found["mean"][k], found["std"][k] = numbers.mean(), numbers.std()
            for key, value in zip(_QUANTILES, np.quantile(numbers, list(_QUANTILES.values())), strict=True):
                found[key][k] = value
    return found | {"count": np.array([len(table)], np.int64)}


class PictureStats:
    """Of pictures, by a histogram of each colour."""

    def __init__(self) -> None:
        self._seen = np.zeros((3, _LEVELS), np.int64)
        self._pictures = 0

    def add(self, picture: NDArray[np.uint8]) -> None:
        """One picture (H, W, 3) RGB."""
        step = max(1, min(picture.shape[:2]) // _FINE)
        for k in range(3):
            self._seen[k] += np.bincount(picture[::step, ::step, k].ravel(), minlength=_LEVELS)
        self._pictures += 1

    def stats(self) -> Stats:
        """Colours in 0..1, each of shape (3, 1, 1); ``count`` are the pictures that were looked at."""
        levels = np.arange(_LEVELS) / (_LEVELS - 1)
        total = np.maximum(1, self._seen.sum(axis=1))
        mean = self._seen @ levels / total
        std = np.sqrt(np.maximum(0.0, self._seen @ levels**2 / total - mean**2))
        there = self._seen > 0
        share = np.cumsum(self._seen, axis=1) / total[:, None]
        found = {
            "min": levels[there.argmax(axis=1)],
            "max": levels[_LEVELS - 1 - there[:, ::-1].argmax(axis=1)],
            "mean": mean,
            "std": std,
            **{key: levels[(share >= level).argmax(axis=1)] for key, level in _QUANTILES.items()},
        }
        return {key: value.reshape(3, 1, 1) for key, value in found.items()} | {"count": np.array([self._pictures])}


def merged(old: Mapping[str, Any] | None, new: Stats) -> Stats:
    """Statistics of both together. Exact but for the quantiles, which are averaged by how much each part counts."""
    if not old:
        return new
    before = {key: np.asarray(value, np.float64) for key, value in old.items()}
    n, m = float(before["count"][0]), float(new["count"][0])
    weights = np.array([n, m]) / max(1.0, n + m)

    def average(a: NDArray[Any], b: NDArray[Any]) -> NDArray[Any]:
        both = weights[0] * a + weights[1] * b
        return np.where(np.isnan(a), b, np.where(np.isnan(b), a, both))

    mean = average(before["mean"], new["mean"])
    square = average(before["std"] ** 2 + before["mean"] ** 2, new["std"] ** 2 + new["mean"] ** 2)
    return {
        "min": np.fmin(before["min"], new["min"]),
        "max": np.fmax(before["max"], new["max"]),
        "mean": mean,
        "std": np.sqrt(np.maximum(0.0, square - mean**2)),
        **{key: average(before[key], new[key]) for key in _QUANTILES},
        "count": np.array([int(n + m)]),
    }


def plain(stats: Mapping[str, Stats]) -> dict[str, dict[str, list[Any]]]:
    """Return the statistics of each column as lists, ready for JSON.

    A column of which a number was never known in any row has none: JSON has no NaN, and a made-up number would mislead.
    """
    complete = {key: found for key, found in stats.items() if all(np.isfinite(each).all() for each in found.values())}
    return {key: {name: each.tolist() for name, each in found.items()} for key, found in complete.items()}
