"""The way of the tcp along poses: straight segments, and corners that are rounded or at which it rests.

A segment leads from one pose to the next: the position on a line, the orientation about one fixed axis (slerp), both in
proportion to the parameter s, so that they arrive together. s is the distance, or :data:`METRES_PER_RADIAN` times the
angle where that is longer.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass
from itertools import zip_longest
from math import ceil, hypot

from ..geometry import apply_rotation, difference

Floats = Sequence[float]

METRES_PER_RADIAN = 0.2
"""Unit of s for a pure rotation, m/rad."""

_SAME = 1e-6
"""Poses nearer than this in s are the same, m."""

STRAIGHT_ON = 1.0 - 1e-9
"""Cosine of the angle between two segments from which on there is no corner."""

REVERSAL = -0.95
"""Cosine of the angle between two segments from which on the corner is not rounded: the way leads back."""


@dataclass(frozen=True)
class Segment:
    """A straight segment."""

    start: list[float]
    """Pose of the tcp at the start (7,)."""
    end: list[float]
    direction: list[float]
    """Way and rotation vector of the tcp for each unit of s (6,), m and rad, along the base's axes."""
    length: float
    """In units of s."""

    @classmethod
    def connect(cls, start: Floats, end: Floats) -> Segment | None:
        """Return the segment between two poses (7,); None if they are the same."""
        way = difference(start, end)
        length = max(hypot(*way[:3]), METRES_PER_RADIAN * hypot(*way[3:]))
        if length < _SAME:
            return None
        return cls(list(start), list(end), [x / length for x in way], length)

    def at(self, s: float) -> list[float]:
        """Return the pose (7,) at ``s`` from the start."""
        return _move_pose(self.start, [x * s for x in self.direction])

    def cosine(self, other: Segment) -> float:
        """Return the cosine of the angle to another segment: of translation and rotation together."""
        a, b = self._weigh(), other._weigh()
        dot = sum(x * y for x, y in zip(a, b, strict=True))
        return dot / (hypot(*a) * hypot(*b))

    def _weigh(self) -> list[float]:
        return self.direction[:3] + [METRES_PER_RADIAN * x for x in self.direction[3:]]


@dataclass(frozen=True)
class Corner:
    """A rounded corner between two segments, from ``cut`` before their common pose to as far behind it.

    Its direction changes from one segment's to the other's by the smooth step w(u) = 3 u^2 - 2 u^3, u = s / (2 cut), so
    there is no jump of curvature. The integral of w is W(u) = u^3 - u^4 / 2: at u, ``cut - 2 cut (u - W)`` of the first
    segment is left, and ``2 cut W`` of the second one is done.
    """

    before: Segment
    after: Segment
    cut: float
    """In units of s."""

    @property
    def length(self) -> float:
        """In units of s."""
        return 2.0 * self.cut

    def at(self, s: float) -> list[float]:
        """Return the pose (7,) at ``s`` from the start."""
        u = s / self.length
        done = u * u * u * (1.0 - 0.5 * u)
        left = self.cut - self.length * (u - done)
        pose = _move_pose(self.after.start, [x * self.length * done for x in self.after.direction])
        return _move_pose(pose, [-x * left for x in self.before.direction])


class TcpLine:
    """A smooth way of the tcp, at whose ends it rests: parts of segments, and corners between them."""

    def __init__(self) -> None:
        self._ends: list[float] = []
        self._parts: list[tuple[Segment | Corner, float]] = []
        """Each part, and its own parameter where s is the end of the part before it."""

    @property
    def length(self) -> float:
        """In units of s."""
        return self._ends[-1] if self._ends else 0.0

    def add(self, part: Segment | Corner, begin: float, length: float) -> None:
        """Add the ``length`` of a part from its own parameter ``begin`` on."""
        self._parts.append((part, begin))
        self._ends.append(self.length + length)

    def at(self, s: float) -> list[float]:
        """Return the pose (7,) of the tcp at ``s`` from the start."""
        k = min(bisect_left(self._ends, s), len(self._ends) - 1)
        part, begin = self._parts[k]
        before = self._ends[k - 1] if k else 0.0
        return part.at(begin + min(s, self._ends[k]) - before)

    def grid(self, step: float) -> list[float]:
        """Return parameters from start to end, at most ``step`` apart, with enough of them for the corners' turns."""
        knots = [0.0]
        for end, (part, _) in zip(self._ends, self._parts, strict=True):
            start = knots[-1]
            turn = 0.5 * (1.0 - part.before.cosine(part.after)) if isinstance(part, Corner) else 0.0
            count = max(ceil((end - start) / step), ceil(12.0 * turn), 2 if isinstance(part, Corner) else 1)
            knots += [start + (end - start) * k / count for k in range(1, count)] + [end]
        return knots


def tcp_lines(poses: Sequence[Floats], blend: float) -> list[TcpLine]:
    """Return the way of the tcp along poses.

    Args:
        poses: Poses (7,) of the tcp, the first one where it is. One that repeats the pose before it counts once.
        blend: Distance before and behind a pose from which on the corner is rounded, m; at most half of a segment.
            With 0, and where the way leads back, the tcp rests at the pose.

    Returns:
        The lines, at the end of each of which the tcp rests; none if there is nothing to move.
    """
    segments: list[Segment] = []
    for pose in poses[1:]:
        segment = Segment.connect(segments[-1].end if segments else poses[0], pose)
        if segment is not None:
            segments.append(segment)
    lines: list[TcpLine] = []
    line, begun = TcpLine(), 0.0
    for segment, after in zip_longest(segments, segments[1:]):
        cosine = segment.cosine(after) if after is not None else -1.0
        cut = 0.0
        if after is not None and cosine > REVERSAL:
            cut = min(blend, 0.5 * segment.length, 0.5 * after.length)
        straight = segment.length - begun - cut
        if straight > _SAME:
            line.add(segment, begun, straight)
        begun = 0.0
        if after is not None and cut > _SAME:
            line.add(Corner(segment, after, cut), 0.0, 2.0 * cut)
            begun = cut
        elif cosine < STRAIGHT_ON:
            lines.append(line)
            line = TcpLine()
    return lines


def _move_pose(pose: Floats, way: Floats) -> list[float]:
    """Return a pose (7,) after a translation and a rotation vector (6,) along the base's axes."""
    x, y, z, *orientation = pose
    return [x + way[0], y + way[1], z + way[2], *apply_rotation(orientation, way[3:])]
