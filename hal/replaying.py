"""A recorded episode once more: through the servo, under the same limits and the same dead-man as a person."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from .commands import JointChunk
from .control import Control
from .course import Course
from .deviation import Deviation
from .errors import CommandError
from .handover import follows
from .types import Limited, RobotStatus

if TYPE_CHECKING:
    from .deadman import Deadman
    from .rig import Rig
    from .robot import Robot

__all__ = ["Player"]

Array = NDArray[np.float64]

RATE_HZ = 50.0
_EVERY = 5
"""A chunk is sent every so many turns."""
_AHEAD = 0.4
"""s of set-points in a chunk: the longest that the arm goes on while this program does not turn."""
_RAMP = 0.3
"""s in which playing comes to its speed: a pause may have been in the middle of a motion."""
_JOIN = 0.3
"""s, at least, in which the arm is brought from where it rests to where it goes on."""
_SETTLE = 0.5
"""s that the last set-point is held."""


@dataclass(frozen=True, slots=True)
class Stretch:
    """Playing without a pause: the episode's time ``s`` against the clock's ``t``."""

    t: float
    """When it begins, s on the clock."""
    s: float
    """Where, s since the first row."""
    speed: float

    def place(self, t: float) -> float:
        """``s`` at ``t``; before the beginning, the beginning."""
        spent = t - self.t
        if spent <= 0.0:
            return self.s
        return self.s + self.speed * (spent * spent / (2.0 * _RAMP) if spent < _RAMP else spent - _RAMP / 2.0)

    def time(self, s: float) -> float:
        """``t`` at ``s``."""
        ahead = max(0.0, s - self.s) / self.speed
        return self.t + (math.sqrt(2.0 * _RAMP * ahead) if ahead < _RAMP / 2.0 else ahead + _RAMP / 2.0)


class Player:
    """Plays one episode.

    While the dead-man is not held, the episode's time stands still: what was sent ahead is dropped, and after a new
    press the arm goes back to where it was let go of, and on from there. A trip ends it: MotionStopped.
    """

    def __init__(
        self,
        rig: Rig,
        robot: Robot,
        course: Course,
        *,
        speed: float = 1.0,
        deadman: Deadman | None = None,
        unattended: bool = False,
    ) -> None:
        """``speed`` is above 0 and at most 1. Raises CommandError where the arm cannot do it."""
        course.check(robot, speed)
        self.rig, self.robot, self.course, self.speed = rig, robot, course, speed
        self._deadman, self._unattended = deadman, unattended
        self.deviation = Deviation(course.joints)
        """Of what was measured from what was measured then, at the same times of the episode."""
        self.limited = Limited.NONE
        """What the servo held back."""
        self.pauses = 0
        self.place = 0.0
        """How far it is, s since the first row."""
        self.finished = False

    def approach(self, patience: float = 60.0) -> None:
        """Drive to the first set-point, and put the things of a simulated world where they lay.

        Raises what :meth:`hal.robot.Robot.move_to` raises, and CommandError where a thing is not there.
        """
        there = set(self.rig.world.bodies) if self.rig.has_world else set(self.course.objects)
        if missing := [name for name in self.course.objects if name not in there]:
            raise CommandError(f"the episode's world has {', '.join(missing)}, and this one has not")
        spec = self.robot.spec
        self.robot.move_to(
            self._inside(self.course.q_set[0]),
            deadman=self._deadman,
            unattended=self._unattended,
            speed=None if spec.attended else spec.speed,
            patience=patience,
        )
        if self.rig.has_world:
            for name, pose in self.course.objects.items():
                self.rig.world.reset(name, pose=pose)

    def play(self, on_turn: Callable[[Player, bool], None] = lambda player, plays: None) -> None:
        """To the end. ``on_turn(player, does it play?)`` is called 50 times a second.

        Raises MotionStopped after a trip, RobotFault, ConnectionLost; the arm is at rest then.
        """
        clock, stretch, turn = self.rig.clock, None, 0
        seen = clock.now()
        control = self.robot.control(deadman=self._deadman, rate_hz=RATE_HZ, unattended=self._unattended)
        with control:
            for tick in clock.rate(RATE_HZ):
                if not follows(control):
                    if stretch is not None:
                        self._measure(stretch, seen)
                        self.pauses += 1
                    stretch, seen = None, tick.t
                    on_turn(self, False)
                    continue
                if stretch is None:
                    stretch, turn = self._begin(tick.t), 0
                if turn % _EVERY == 0:
                    self._send(control, stretch, tick.t, first=turn == 0)
                turn += 1
                seen = self._measure(stretch, seen)
                self._grip(control)
                on_turn(self, True)
                if tick.t >= stretch.time(self.course.duration) + _SETTLE / 2.0:
                    self.finished = True
                    return

    def _inside(self, q: Array) -> Array:
        """Rounding may have brought a set-point out of the limits."""
        limits = self.robot.limits
        found: Array = np.clip(q, limits.lower, limits.upper)
        return found

    def _begin(self, now: float) -> Stretch:
        """Go on from ``place``; the arm rests near it, and gets the time that it needs to be brought there slowly."""
        state, spec = self.robot.state(), self.robot.spec
        away = np.abs(self.course.at(self.course.q_set, self.place) - state.q_set)
        slowly = spec.move_speed * np.asarray(spec.limits.velocity)
        return Stretch(now + _JOIN + 2.0 * float((away / slowly).max()), self.place, self.speed)

    def _send(self, control: Control, stretch: Stretch, now: float, first: bool) -> None:
        """The rows that are due from now on, and the one before."""
        course = self.course
        begin = max(0, int(np.searchsorted(course.t, stretch.place(now), side="right")) - 1)
        last = int(np.searchsorted(course.t, stretch.place(now + _AHEAD), side="right")) + 1
        times, points = [], []
        if first:
            times, points = [now], [self.robot.state().q_set]
        if now < stretch.t:  # from where it rests to where it begins
            times.append(stretch.t)
            points.append(course.at(course.q_set, stretch.s))
        for k in range(begin, min(last, len(course.t))):
            if course.t[k] > stretch.s:
                times.append(stretch.time(float(course.t[k])))
                points.append(course.q_set[k])
        if last >= len(course.t):
            times.append(max(now, stretch.time(course.duration)) + _SETTLE)
            points.append(course.q_set[-1])
        control.send(JointChunk(times, points))

    def _measure(self, stretch: Stretch, seen: float) -> float:
        """Compare what was measured since ``seen`` with the recording; returns the time of the newest state."""
        course = self.course
        for state in self.robot.states(after=max(seen, stretch.t)):
            seen = state.stamp.t
            if state.status is not RobotStatus.FOLLOWING:
                continue  # braking, for a pause or for good
            self.place = min(stretch.place(seen), course.duration)
            if stretch.place(seen) <= course.duration:
                off = state.q - course.at(course.q, self.place)
                self.deviation.add(off, state.tcp.position - course.at(course.tcp, self.place))
            self.limited |= state.limited
        return seen

    def _grip(self, control: Control) -> None:
        gripper, width = self.robot.gripper, self.course.width_at(self.place)
        if gripper is not None and width is not None:
            control.send(None, width=float(np.clip(width, 0.0, gripper.width_max)))
