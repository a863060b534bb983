"""Motions in joint space that follow streams: targets, velocities and chunks of targets.

A motion accepts its newest command (``accept``) and moves the smoother once per tick (``step``). It keeps no set-point
of its own: after a stop or a re-anchoring it is reset (``start``) and continues from where the arm is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from bisect import bisect_left, bisect_right
from collections.abc import Sequence
from itertools import pairwise
from math import isfinite

from ..commands import FIRST_STEP_ANGLE, CommandRecord
from ..types import Limited
from .envelope import Envelope
from .smoothing import JointSmoother, speed_for

Floats = Sequence[float]


class ServoMotion(ABC):
    """Base class of all motions: how one kind of command moves the arm."""

    size: int
    """Number of values in a command of this kind."""
    cartesian = False
    """Whether each step needs the Jacobian at the set-point."""

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        self.smoother = smoother
        self.envelope = envelope
        self._wanted: list[float] | None = None
        """Joint speeds (n,) of the last tick's goal, rad/s, while goals change in proportion; else None."""

    def start(self) -> None:
        """Discard every command; the next one is the first."""
        self._wanted = None

    def usable(self, values: Floats) -> bool:
        """Return whether a command can be followed at all: ``size`` values, all finite."""
        return len(values) == self.size and isfinite(sum(map(abs, values)))

    def reanchored(self) -> None:
        """Note that the set-point is not where the last step left it; the newest command stays valid."""
        self._wanted = None

    def too_far(self, values: Floats) -> bool:
        """Return whether a first target is farther from the set-point than a stream may begin."""
        return False

    @abstractmethod
    def accept(self, command: CommandRecord) -> None:
        """Follow this command from now on; it is ``usable``."""

    @abstractmethod
    def step(self, now: float) -> None:
        """Advance the smoother by one tick."""

    def _follow(self, dq: list[float], together: bool = False) -> None:
        """One tick towards these joint speeds (n,), no faster than the tcp may go.

        With ``together``, and where the tcp is near its greatest speed, all joints change speed in proportion. Left to
        themselves, those with acceleration to spare would run ahead: the tcp would leave its line, and on the way from
        one permitted speed to another it could be too fast.
        """
        smoother, envelope = self.smoother, self.envelope
        dq, fast = envelope.cap_tcp(dq)
        if together or fast:
            self._wanted = dq = envelope.in_proportion(dq, smoother.dq if self._wanted is None else self._wanted)
        else:
            self._wanted = None
        smoother.follow(dq, envelope.guard, together)
        if smoother.held_back or smoother.guarded:
            self._wanted = None

    def _follow_each(self, dq: list[float]) -> None:
        """Follow joint speeds (n,), rad/s, each capped by itself first."""
        envelope = self.envelope
        if envelope.lets_pass(dq):
            self._wanted = None
            self.smoother.follow(dq, envelope.guard)
        else:
            self._follow(envelope.cap_joints(dq))


class JointVelocityMotion(ServoMotion):
    """Moves the joints at given velocities; each is capped by itself."""

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        super().__init__(smoother, envelope)
        self.size = smoother.n
        self._dq: list[float] = []

    def start(self) -> None:
        super().start()
        self._dq = [0.0] * self.size

    def accept(self, command: CommandRecord) -> None:
        self._dq = list(command.values)

    def step(self, now: float) -> None:
        self._follow_each(self._dq)


class JointTargetMotion(ServoMotion):
    """Follow a stream of joint targets, or go to one that is held.

    A moving target is followed at its own speed plus a correction of the error: smooth, since the speed changes little
    from tick to tick. That would creep into a target that stands still, so one that is held is reached by Ruckig's
    time-optimal motion instead. A target without speed counts as held when it is repeated, when the one before had a
    speed or was held itself, and when it is too far for any arm to follow as a stream. So a stream of bare positions,
    even at 10 Hz, is smoothed and not reached one by one.
    """

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        super().__init__(smoother, envelope)
        self.size = 2 * smoother.n
        self._command: CommandRecord | None = None
        self._q: list[float] = []
        self._dq: list[float] = []
        self._direct = False
        """Whether the arm goes there directly; else it follows as a stream."""
        self._still = True
        """Whether the target stood still before the newest command."""
        self._inside = True
        """Whether the target is inside the position limits, now and until the deadline."""
        self._jerk: Floats = ()
        """Jerk limits (n,), rad/s3, of which these are made; a controller has others."""
        self._stream_braking: list[tuple[float, float, float, float]] = []
        self._direct_braking: list[tuple[float, float, float, float]] = []

    def start(self) -> None:
        super().start()
        self._command = None
        self._q, self._dq = [], []
        self._still = True
        self._direct = False

    def too_far(self, values: Floats) -> bool:
        return any(abs(x - y) > FIRST_STEP_ANGLE for x, y in zip(values, self.smoother.q, strict=False))

    def accept(self, command: CommandRecord) -> None:
        n = self.smoother.n
        q, dq = list(command.values[:n]), list(command.values[n:])
        before = self._command
        moving = any(dq)
        same = before is not None and q == self._q
        halts = any(self._dq) or self._still
        self._direct = not moving and (same or halts or self._is_jump(command.t, q))
        self._still = not moving and (same or before is None)
        self._command, self._q, self._dq = command, q, dq
        # It moves along a straight line: inside at both ends is inside.
        self._inside = self._is_inside(q, dq, 0.0) and (
            not moving or self._is_inside(q, dq, command.deadline - command.t)
        )

    def step(self, now: float) -> None:
        assert self._command is not None
        age = max(0.0, min(now, self._command.deadline) - self._command.t)
        smoother, envelope = self.smoother, self.envelope
        q, dq = self._q, self._dq
        if not self._inside:
            q, dq = self._clip_to_limits([x + v * age for x, v in zip(q, dq, strict=True)], dq)
            age = 0.0
        if self._direct and smoother.reach(q, envelope.velocity, envelope.allows):
            self._wanted = None
            return
        self._follow_each(self._approach(q, dq, age))

    def _approach(self, q: list[float], dq: list[float], age: float) -> list[float]:
        """Return the target's speed (n,) ``age`` s on, plus what closes the error and still brakes in time, rad/s."""
        smoother = self.smoother
        if self._jerk is not smoother.jerk:
            self._jerk = smoother.jerk
            self._stream_braking = _braking(smoother, *_STREAM)
            self._direct_braking = _braking(smoother, *_DIRECT)
        braking = self._direct_braking if self._direct else self._stream_braking
        ahead = 2.0 * smoother.dt
        twice_ahead = ahead + ahead
        goal = []
        for x, v, x_set, v_set, (A, J, b, c) in zip(q, dq, smoother.q, smoother.dq, braking, strict=True):
            error = x + v * age - x_set
            distance = abs(error)
            speed = _GAIN * error
            # Not always can that be braked on the way; mostly it can, with room to spare (see _braking).
            if distance * (b * distance + c) + twice_ahead * abs(v_set - v) > 0.0:
                closing = v_set - v if error > 0.0 else v - v_set
                most = speed_for(distance - ahead * max(0.0, closing), A, J)
                if abs(speed) > most:
                    speed = most if error > 0.0 else -most
            goal.append(v + speed)
        return goal

    def _is_inside(self, q: list[float], dq: list[float], age: float) -> bool:
        """Return whether the target, ``age`` s on, is inside the position limits."""
        limits = zip(q, dq, self.smoother.lower, self.smoother.upper, strict=True)
        return all(low <= x + v * age <= high for x, v, low, high in limits)

    def _clip_to_limits(self, q: list[float], dq: list[float]) -> tuple[list[float], list[float]]:
        """Return the target and its speed, cut to the position limits."""
        lower, upper = self.smoother.lower, self.smoother.upper
        inside = [max(low, min(high, x)) for x, low, high in zip(q, lower, upper, strict=True)]
        if any(abs(x - y) > 1e-6 for x, y in zip(q, inside, strict=True)):
            self.envelope.limited |= Limited.POSITION
        return inside, [v if x == y else 0.0 for x, y, v in zip(q, inside, dq, strict=True)]

    def _is_jump(self, t: float, q: list[float]) -> bool:
        """Return whether the new target is farther from the last one than the joints could have moved meanwhile."""
        before = self._command
        if before is None:
            return True
        period = max(0.0, t - before.t)
        state = zip(q, self._q, self._dq, self.envelope.velocity, strict=True)
        return any(abs(x - x0 - v0 * period) > _JUMP + limit * period for x, x0, v0, limit in state)


_GAIN = 8.0
"""Speed per error of a followed target, 1/s. Measured at 50 Hz targets: rms error 0.8 mrad, no chatter."""

_JUMP = 0.05
"""A step of a stream larger than this, beyond what the joint speed allows, counts as a jump, rad."""

_STREAM = (0.8, 0.5)
_DIRECT = (0.9, 0.7)
"""Shares of acceleration and jerk with which a target's approach brakes."""


def _braking(smoother: JointSmoother, share: float, jerk_share: float) -> list[tuple[float, float, float, float]]:
    """Per joint: A and J, these shares of acceleration and jerk, then b and c of a quick test.

    A stop from speed s is no longer than s (s/A + A/J) / 2, whether its braking reaches A or not (`stop_distance`, and
    the inequality of the means). So a joint that approaches over the distance d at s = _GAIN d stops within a way w of
    it when s (s/A + A/J) <= 2 w, that is d (b d + c) + 2 (d - w) <= 0.
    """
    limits = [(share * a, jerk_share * j) for a, j in zip(smoother.acceleration, smoother.jerk, strict=True)]
    return [(A, J, _GAIN * _GAIN / A, _GAIN * A / J - 2.0) for A, J in limits]


_SAME = 1e-6
"""Targets this near in time are the same, s: plans on one grid differ by rounding."""


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
        return any(abs(x - y) > FIRST_STEP_ANGLE for x, y in zip(due, self.smoother.q, strict=True))

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
        q, dq = self._clip_to_limits(*self._due(now))
        self._follow_each(self._approach(q, dq, 0.0))

    def _split(self, values: Floats) -> tuple[list[float], list[list[float]]]:
        """Return times (k,), s, and points (k, n), rad, of a command that is ``usable``."""
        n = self.smoother.n
        count = len(values) // (n + 1)
        return list(values[:count]), [list(values[k : k + n]) for k in range(count, len(values), n)]

    def _due(self, now: float) -> tuple[list[float], list[float]]:
        """Return joint positions (n,), rad, and speeds (n,), rad/s, that are due at ``now``."""
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
        """Return the speed (n,) at target ``k``, rad/s."""
        times, points = self._times, self._points
        if k == 0 or k == len(times) - 1:  # at rest before the first; the last may be the end
            return [0.0] * self.smoother.n
        h0, h1 = times[k] - times[k - 1], times[k + 1] - times[k]
        around = zip(points[k - 1], points[k], points[k + 1], strict=True)
        return [slope((x - before) / h0, (after - x) / h1, h0, h1) for before, x, after in around]


def slope(d0: float, d1: float, h0: float, h1: float) -> float:
    """Return the slope between secants ``d0`` and ``d1`` over the widths ``h0`` and ``h1``.

    It is their weighted harmonic mean, and 0 if they differ in sign (Fritsch and Butland's formula, in Brodlie's
    weighting).
    """
    if d0 * d1 <= 0.0:
        return 0.0
    share = (h0 + 2.0 * h1) / (3.0 * (h0 + h1))
    return d0 * d1 / (share * d1 + (1.0 - share) * d0)
