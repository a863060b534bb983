"""Commands in joint space, made into one tick of motion each: targets, velocities, and the path of ``move_to``.

A motion is told its newest command (``accept``) and asked once per tick to move the smoother (``step``). It keeps no
set-point of its own: after a stop or a re-anchoring it is made to forget (``start``) and goes on from where the arm is.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Sequence
from math import isfinite

from ..commands import CommandRecord
from ..types import Limited
from .envelope import Envelope
from .limits import speed_for
from .smoothing import JointSmoother

__all__ = ["JointTargetMotion", "JointVelocityMotion", "Motion"]

Floats = Sequence[float]


class Motion(ABC):
    """How one kind of command moves the arm."""

    size: int
    """Number of values that a command of this kind has."""

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        self.smoother = smoother
        self.envelope = envelope
        self._wanted: list[float] | None = None
        """Joint speeds of the last tick's goal (n,), rad/s, while goals change in proportion."""

    def start(self) -> None:
        """Forget every command; the next one is the first."""
        self._wanted = None

    def usable(self, values: Floats) -> bool:
        """Can this command be followed at all? (As many values as ``size``, all finite.)"""
        return len(values) == self.size and isfinite(sum(map(abs, values)))

    def reanchored(self) -> None:
        """The set-point is elsewhere than the last step left it; the newest command stays."""
        self._wanted = None

    def too_far(self, values: Floats) -> bool:
        """Is this first target farther from the set-point than a stream may begin?"""
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
        """The same, but first each joint is capped by itself."""
        envelope = self.envelope
        if envelope.lets_pass(dq):
            self._wanted = None
            self.smoother.follow(dq, envelope.guard)
        else:
            self._follow(envelope.cap_joints(dq))


class JointVelocityMotion(Motion):
    """Move the joints at given velocities; each is capped by itself."""

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


class JointTargetMotion(Motion):
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
        """Go there directly (True), or follow as a stream."""
        self._still = True
        """Did the target stand still before the newest command?"""
        self._inside = True
        """Is the target inside the position limits, now and until the deadline?"""
        self._stream_braking = _braking(smoother, *_STREAM)
        self._direct_braking = _braking(smoother, *_DIRECT)

    def start(self) -> None:
        super().start()
        self._command = None
        self._q, self._dq = [], []
        self._still = True
        self._direct = False

    def too_far(self, values: Floats) -> bool:
        return any(abs(x - y) > FIRST_JOINT_STEP for x, y in zip(values, self.smoother.q, strict=False))

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
            q, dq = self._into_limits([x + v * age for x, v in zip(q, dq, strict=True)], dq)
            age = 0.0
        if self._direct and smoother.reach(q, envelope.velocity, envelope.allows):
            self._wanted = None
            return
        self._follow_each(self._approach(q, dq, age))

    def _approach(self, q: list[float], dq: list[float], age: float) -> list[float]:
        """The speed of the target, ``age`` s on, plus what closes the error and can still brake before it is closed."""
        smoother = self.smoother
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
        """Is the target, ``age`` s on, inside the position limits?"""
        limits = zip(q, dq, self.smoother.lower, self.smoother.upper, strict=True)
        return all(low <= x + v * age <= high for x, v, low, high in limits)

    def _into_limits(self, q: list[float], dq: list[float]) -> tuple[list[float], list[float]]:
        """The target, and its speed, cut to the position limits."""
        lower, upper = self.smoother.lower, self.smoother.upper
        inside = [max(low, min(high, x)) for x, low, high in zip(q, lower, upper, strict=True)]
        if any(abs(x - y) > 1e-6 for x, y in zip(q, inside, strict=True)):
            self.envelope.limited |= Limited.POSITION
        return inside, [v if x == y else 0.0 for x, y, v in zip(q, inside, dq, strict=True)]

    def _is_jump(self, t: float, q: list[float]) -> bool:
        """Is the new target farther from the last one than the joints could have followed meanwhile?"""
        before = self._command
        if before is None:
            return True
        period = max(0.0, t - before.t)
        state = zip(q, self._q, self._dq, self.envelope.velocity, strict=True)
        return any(abs(x - x0 - v0 * period) > _JUMP + limit * period for x, x0, v0, limit in state)


FIRST_JOINT_STEP = 0.1
"""A first joint target farther than this from the set-point is refused, rad."""

_GAIN = 8.0
"""Speed per error of a followed target, 1/s. Measured at 50 Hz targets: rms error 0.8 mrad, no chatter."""

_JUMP = 0.05
"""A step of a stream beyond what the joint speed allows counts as a jump from here on, rad."""

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
