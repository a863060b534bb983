"""One millisecond of commanded motion, and how the next one follows from it, with a command or without."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

__all__ = ["DT", "Sample", "at_rest", "braked", "by_position", "by_velocity", "extrapolated"]

DT = 1e-3
"""The control cycle, s."""

Floats = Sequence[float]


class Sample(NamedTuple):
    """Desired joint positions (7,), rad, and their backward differences over one cycle, rad/s and rad/s2."""

    q: Floats
    dq: Floats
    ddq: Floats

    @property
    def moving(self) -> bool:
        """Is any joint to move?"""
        return any(self.dq)


def at_rest(q: Floats) -> Sample:
    """Standing at ``q`` (7,), rad."""
    return Sample(q, (0.0,) * 7, (0.0,) * 7)


def by_position(before: Sample, q: Floats) -> Sample:
    """The next sample where positions are commanded."""
    dq = [(new - old) / DT for new, old in zip(q, before.q, strict=True)]
    ddq = [(new - old) / DT for new, old in zip(dq, before.dq, strict=True)]
    return Sample(q, dq, ddq)


def by_velocity(before: Sample, dq: Floats) -> Sample:
    """The next sample where velocities are commanded."""
    q = [old + new * DT for old, new in zip(before.q, dq, strict=True)]
    ddq = [(new - old) / DT for new, old in zip(dq, before.dq, strict=True)]
    return Sample(q, dq, ddq)


def extrapolated(before: Sample) -> Sample:
    """The next sample where the command was lost: with the acceleration of the last one."""
    dq = [v + a * DT for v, a in zip(before.dq, before.ddq, strict=True)]
    q = [p + v * DT for p, v in zip(before.q, dq, strict=True)]
    return Sample(q, dq, before.ddq)


def braked(before: Sample, deceleration: Floats) -> Sample:
    """The next sample of an arm that comes to rest by itself, with ``deceleration`` (7,), rad/s2, in every joint."""
    if not before.moving:
        return before if not any(before.ddq) else at_rest(before.q)
    dq = [
        0.0 if abs(v) <= a * DT else v - a * DT if v > 0.0 else v + a * DT
        for v, a in zip(before.dq, deceleration, strict=True)
    ]
    return by_velocity(before, dq)
