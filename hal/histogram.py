"""Percentiles of a long run in constant memory."""

from __future__ import annotations


class Histogram:
    """Counts durations in bins; a percentile is the upper edge of its bin, so it is never too small.

    Args:
        width: Width of a bin, s.
        bins: Number of bins; longer durations are counted in the last one. The greatest is kept exactly.
    """

    __slots__ = ("_counts", "_width", "count", "greatest")

    def __init__(self, width: float, bins: int) -> None:
        self._width = width
        self._counts = [0] * bins
        self.count = 0
        self.greatest = 0.0

    def add(self, value: float) -> None:
        """Count one duration, s."""
        index = int(value / self._width)
        counts = self._counts
        counts[index if 0 <= index < len(counts) else (0 if index < 0 else -1)] += 1
        self.count += 1
        if value > self.greatest:
            self.greatest = value

    def percentile(self, share: float) -> float | None:
        """Return the duration that ``share`` (0..1) of all do not exceed, s; None if nothing was counted."""
        if not self.count:
            return None
        wanted, seen = share * self.count, 0
        for index, count in enumerate(self._counts):
            seen += count
            if count and seen >= wanted:
                return min((index + 1) * self._width, self.greatest)
        return self.greatest

    def summary(self) -> dict[str, float | None]:
        """Return p50, p99 and max, s; None if nothing was counted."""
        return {
            "p50": self.percentile(0.5),
            "p99": self.percentile(0.99),
            "max": self.greatest if self.count else None,
        }
