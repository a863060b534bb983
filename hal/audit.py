"""What a driver was really given, judged by backward differences, whoever computed it."""

from __future__ import annotations

from collections.abc import Sequence

from .specs import LimitsSpec

__all__ = ["SetpointAudit"]

_SETTLE = 3
"""Differences up to the third need three samples of history before they mean anything."""


class SetpointAudit:
    """Peaks of a stream of joint set-points, as ratios of the limits; constant memory, a few microseconds a sample.

    Velocity, acceleration and jerk are backward differences over ``dt``: at 1 or below the limit was kept. Position is
    the distance from the middle of the range as a share of half the range: at 1 or below the joint was inside.
    """

    def __init__(self, limits: LimitsSpec, dt: float) -> None:
        ranges = list(zip(limits.lower, limits.upper, strict=True))
        self._middle = [0.5 * (low + high) for low, high in ranges]
        # One factor per joint and derivative turns a plain difference into a ratio of its limit.
        self._factors = [
            (2.0 / (high - low), 1.0 / (dt * v), 1.0 / (dt * dt * a), 1.0 / (dt * dt * dt * j))
            for (low, high), v, a, j in zip(ranges, limits.velocity, limits.acceleration, limits.jerk, strict=True)
        ]
        self._peaks = [0.0] * 4
        self._count = 0
        self._before: list[tuple[float, float, float]] = []
        """The last sample of each joint, and its first and second difference."""
        self.reset()

    def reset(self) -> None:
        """Forget the history, not the peaks: the next sample begins a new stream (a reset of the world)."""
        self._count = 0
        self._before = [(0.0, 0.0, 0.0)] * len(self._middle)

    def add(self, q: Sequence[float]) -> None:
        """One set-point (n,), rad, as it was handed to the driver."""
        settled = self._count >= _SETTLE
        self._count += 1
        top_p, top_v, top_a, top_j = self._peaks
        now = []
        for x, (x1, d1, dd1), middle, (p, v, a, j) in zip(q, self._before, self._middle, self._factors, strict=True):
            d = x - x1
            dd = d - d1
            now.append((x, d, dd))
            ratio = abs(x - middle) * p
            if ratio > top_p:
                top_p = ratio
            if settled:
                ratio = abs(d) * v
                if ratio > top_v:
                    top_v = ratio
                ratio = abs(dd) * a
                if ratio > top_a:
                    top_a = ratio
                ratio = abs(dd - dd1) * j
                if ratio > top_j:
                    top_j = ratio
        self._before = now
        self._peaks = [top_p, top_v, top_a, top_j]

    def peaks(self) -> dict[str, float]:
        """The greatest ratios so far: ``velocity``, ``acceleration``, ``jerk``, ``position``."""
        position, velocity, acceleration, jerk = self._peaks
        return {"velocity": velocity, "acceleration": acceleration, "jerk": jerk, "position": position}
