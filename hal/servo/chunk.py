"""Joint targets with times: action chunks, interpolated."""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise
from math import isfinite

from ..commands import CommandRecord
from .envelope import Envelope
from .motions import FIRST_JOINT_STEP, JointTargetMotion
from .smoothing import JointSmoother

__all__ = ["ChunkMotion", "slope"]

Floats = Sequence[float]


_SAME = 1e-6
"""Targets this near in time are one, s: plans on one grid differ by rounding."""


class ChunkMotion(JointTargetMotion):
    """Follow joint targets that are due at given times.

    In between it goes along cubics whose slopes make them monotone (Fritsch and Butland 1984, "A method for
    constructing local monotone piecewise cubic interpolants"): no target is passed by. A new chunk replaces the rest of
    the old one from its own first time on, so the two are joined by such a cubic as well.
    """

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        super().__init__(smoother, envelope)
        self._times: list[float] = []
        self._points: list[list[float]] = []

    def start(self) -> None:
        super().start()
        self._times, self._points = [], []

    def usable(self, values: Floats) -> bool:
        count, rest = divmod(len(values), self.smoother.n + 1)
        times = values[:count]
        rising = all(a < b for a, b in pairwise(times))
        return rest == 0 and count > 0 and rising and isfinite(sum(map(abs, values)))

    def too_far(self, values: Floats) -> bool:
        times, points = self._split(values)
        k = bisect_right(times, 0.0)
        due = points[min(k, len(times) - 1)]
        if 0 < k < len(times):
            s = -times[k - 1] / (times[k] - times[k - 1])
            due = [a + s * (b - a) for a, b in zip(points[k - 1], due, strict=True)]
        return any(abs(x - y) > FIRST_JOINT_STEP for x, y in zip(due, self.smoother.q, strict=True))

    def accept(self, command: CommandRecord) -> None:
        ahead, points = self._split(command.values)
        times = [command.t + age for age in ahead]
        kept = bisect_left(self._times, times[0] - _SAME)
        begin = max(0, bisect_right(self._times, command.t) - 2)  # what led to the present slope, and no more
        self._times = self._times[begin:kept] + times
        self._points = self._points[begin:kept] + points
        if self._times[0] > command.t:  # the first chunk is yet to begin: go there from here
            self._times.insert(0, command.t)
            self._points.insert(0, list(self.smoother.q))
        self._command = command

    def step(self, now: float) -> None:
        q, dq = self._into_limits(*self._due(now))
        self._follow_each(self._approach(q, dq, 0.0))

    def _split(self, values: Floats) -> tuple[list[float], list[list[float]]]:
        """Times and points of a command that is ``usable``."""
        n = self.smoother.n
        count = len(values) // (n + 1)
        return list(values[:count]), [list(values[k : k + n]) for k in range(count, len(values), n)]

    def _due(self, now: float) -> tuple[list[float], list[float]]:
        """Where the arm is to be at ``now``, rad, and how fast, rad/s."""
        times, points = self._times, self._points
        k = bisect_right(times, now)
        if k == len(times):
            return points[-1], [0.0] * self.smoother.n
        if k == 0:
            return points[0], [0.0] * self.smoother.n
        width = times[k] - times[k - 1]
        s = (now - times[k - 1]) / width
        before, after = self._slopes(k - 1), self._slopes(k)
        q, dq = [], []
        for x0, x1, v0, v1 in zip(points[k - 1], points[k], before, after, strict=True):
            # Hermite: x0 + s (a + s (b + s c)), with v0 and v1 per width.
            a, rise = v0 * width, x1 - x0
            b = 3.0 * rise - 2.0 * a - v1 * width
            c = a + v1 * width - 2.0 * rise
            q.append(x0 + s * (a + s * (b + s * c)))
            dq.append((a + s * (2.0 * b + s * 3.0 * c)) / width)
        return q, dq

    def _slopes(self, k: int) -> list[float]:
        """Speed of each joint at target ``k``, rad/s."""
        times, points = self._times, self._points
        if k == 0 or k == len(times) - 1:  # at rest before the first; the last may be the end
            return [0.0] * self.smoother.n
        h0, h1 = times[k] - times[k - 1], times[k + 1] - times[k]
        around = zip(points[k - 1], points[k], points[k + 1], strict=True)
        return [slope((x - before) / h0, (after - x) / h1, h0, h1) for before, x, after in around]


def slope(d0: float, d1: float, h0: float, h1: float) -> float:
    """Slope at a point between secants ``d0`` and ``d1`` over the widths ``h0`` and ``h1``: their weighted harmonic
    mean, 0 where they differ in sign (Fritsch and Butland's formula, in Brodlie's weighting)."""
    if d0 * d1 <= 0.0:
        return 0.0
    share = (h0 + 2.0 * h1) / (3.0 * (h0 + h1))
    return d0 * d1 / (share * d1 + (1.0 - share) * d0)
