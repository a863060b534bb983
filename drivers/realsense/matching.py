"""Which pictures are one capture: what is new, what belongs together, and how captures are numbered.

The library hands over sets in which it fills in the last picture of a stream that sent none (its aggregator does, in
``src/pipeline/aggregator.cpp``), so a set may hold old pictures, or pictures of two moments.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import Enum
from typing import NamedTuple

from .stamps import SYSTEM

__all__ = ["Matcher", "Numbering", "Taken", "Verdict"]

_ORDER = ("depth", "color", "infrared", "infrared_right")


class Taken(NamedTuple):
    """One picture, as far as it matters here."""

    number: int
    """Of the frame, by the camera's own count."""
    stamp: float
    """By the clock of ``domain``, s."""
    domain: str


class Verdict(Enum):
    """What a set of pictures is."""

    NEW = "new"
    REPEATED = "repeated"
    """Its leading picture was handed out before."""
    MISMATCHED = "mismatched"
    """Its pictures were taken at different times, or one of them was handed out before."""


class Matcher:
    """Judges one set after the other.

    The leading stream is the slowest one: it decides what a capture is. The others belong to it where their stamps
    differ by no more than half a period of the fastest stream; stamps of different clocks are not compared. Frames
    without metadata (a kernel without RealSense's patches) are stamped when they arrive, each stream after a delay of
    its own: these may differ by a period of the slowest stream.
    """

    def __init__(self, rates: Mapping[str, float]) -> None:
        self.lead = min(rates, key=lambda name: (rates[name], _ORDER.index(name)))
        self.tolerance = 0.5 / max(rates.values())
        """Of times of capture, s."""
        self.arrival_tolerance = 1.0 / min(rates.values())
        """Of times of arrival, s."""
        self._handed_out: dict[str, int] = {}

    def judge(self, taken: Mapping[str, Taken]) -> Verdict:
        """Of a set of all streams. What is NEW counts as handed out from then on."""
        first = taken[self.lead]
        if self._handed_out.get(self.lead) == first.number:
            return Verdict.REPEATED
        for name, picture in taken.items():
            if self._handed_out.get(name) == picture.number:
                return Verdict.MISMATCHED
            tolerance = self.arrival_tolerance if picture.domain == SYSTEM else self.tolerance
            if picture.domain == first.domain and abs(picture.stamp - first.stamp) > tolerance:
                return Verdict.MISMATCHED
        self._handed_out = {name: picture.number for name, picture in taken.items()}
        return Verdict.NEW


def skew(taken: Mapping[str, Taken]) -> float | None:
    """Return by how much colour was taken later than depth, s; None where the stamps do not show it."""
    color, depth = taken.get("color"), taken.get("depth")
    if color is None or depth is None or color.domain != depth.domain or color.domain == SYSTEM:
        return None
    return color.stamp - depth.stamp


class Numbering:
    """Numbers of captures that go on where the camera's begin anew (a recording that repeats)."""

    def __init__(self) -> None:
        self._offset = 0
        self._last: int | None = None

    def __call__(self, number: int) -> int:
        """The number of a capture, from that of its leading frame; gaps in the one are gaps in the other."""
        if self._last is not None and number <= self._last:
            self._offset += self._last + 1 - number
        self._last = number
        return number + self._offset
