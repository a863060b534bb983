"""One motion, from the Move that starts it to whatever ends it: what each command, or its loss, makes of the arm."""

from __future__ import annotations

from collections import deque
from math import copysign, isfinite, sqrt
from typing import NamedTuple

from hal.drivers.franka.flags import flag_index

from .checker import LimitChecker, Violation
from .layouts import CommandPacket
from .moves import MoveOptions
from .protocol import Controller, Generator, Outcome
from .samples import DT, Floats, Sample, by_position, by_velocity, extrapolated

__all__ = ["LOST_LIMIT", "Ending", "Motion"]

LOST_LIMIT = 20
"""So many commands lost in a row end a motion."""
_RATED = 100
"""The success rate is that of so many cycles."""
_APPROACH = 20.0
"""1/s: how fast the asynchronous generator closes in on its target. An assumption, as its whole profile is."""
_COMMUNICATION = flag_index("communication_constraints_violation")


class Ending(NamedTuple):
    """Why a motion is over."""

    outcome: Outcome
    text: str
    flag: int | None = None
    """The error flag that it raises."""


class Motion:
    """A motion that runs. Until its first command the robot waits, and nothing counts as lost (an assumption)."""

    def __init__(self, request: int, options: MoveOptions, start: Sample, begun_at: int, checker: LimitChecker) -> None:
        self.request = request
        """Number of the Move, which is answered once more at the end."""
        self.begun_at = begun_at
        """message_id of the last state before it."""
        self.options = options
        self.external = options.controller is Controller.EXTERNAL
        self.sample = start
        """What is commanded now."""
        self.torques: Floats = (0.0,) * 7
        self.waiting = True
        self.states_shown = 0
        """States that were sent since it began."""
        self.lost_in_row = 0
        self.commands = 0
        self._checker = checker
        self._target: Floats = start.q
        self._in_time = deque([1] * _RATED, _RATED)
        self._successes = _RATED

    @property
    def success_rate(self) -> float:
        """Share of the last 100 cycles that had their command in time; 0 before the first."""
        return 0.0 if self.waiting else self._successes / _RATED

    def step(self, command: CommandPacket | None, q: Floats) -> Ending | None:
        """Go on for one cycle; ``q`` (7,) is where the arm is, rad. Says how the motion ends when it does."""
        if command is not None:
            return self._take(command, q)
        if self.options.asynchronous:
            self._chase()
        elif not self.waiting:
            return self._miss()
        return None

    def _take(self, command: CommandPacket, q: Floats) -> Ending | None:
        self._count(1)
        self.lost_in_row = 0
        self.commands += 1
        if command.finished:
            return Ending(Outcome.SUCCESS, "finished")
        if not isfinite(sum(command.q) + sum(command.dq) + sum(command.tau)):
            return Ending(Outcome.INPUT_ERROR, "a command with a number that is not finite")
        violation = self._generate(command, q)
        if violation is None and self.external:
            violation = self._checker.torques(self.torques, command.tau)
            self.torques = command.tau
        self.waiting = False
        return _reflex(violation)

    def _generate(self, command: CommandPacket, q: Floats) -> Violation | None:
        generator = self.options.generator
        if generator is Generator.NONE:
            return None
        if self.options.asynchronous:
            self._target = command.q
            self._chase()
            return None
        if generator is Generator.JOINT_POSITION:
            if self.waiting:
                violation = self._checker.start(q, command.q)
                if violation is not None:
                    return violation
            sample = by_position(self.sample, command.q)
        else:
            sample = by_velocity(self.sample, command.dq)
        violation = self._checker.joints(self.sample, sample)
        if violation is None:
            self.sample = sample
        return violation

    def _miss(self) -> Ending | None:
        self._count(0)
        self.lost_in_row += 1
        if self.lost_in_row >= LOST_LIMIT:
            text = f"{self.lost_in_row} commands in a row were lost"
            return Ending(Outcome.REFLEX, text, _COMMUNICATION)
        if self.options.generator is not Generator.NONE:
            self.sample = extrapolated(self.sample)
        return None

    def _chase(self) -> None:
        """One cycle of the asynchronous generator: towards the target, within speed and acceleration."""
        speeds = []
        for k, target in enumerate(self._target):
            way, most = target - self.sample.q[k], self._checker.limits.acceleration[k]
            speed = min(self.options.speeds[k], _APPROACH * abs(way), sqrt(most * abs(way)))
            change = copysign(speed, way) - self.sample.dq[k]
            speeds.append(self.sample.dq[k] + max(-most * DT, min(most * DT, change)))
        self.sample = by_velocity(self.sample, speeds)

    def _count(self, success: int) -> None:
        self._successes += success - self._in_time[0]
        self._in_time.append(success)


def _reflex(violation: Violation | None) -> Ending | None:
    return None if violation is None else Ending(Outcome.REFLEX, violation.text, violation.flag)
