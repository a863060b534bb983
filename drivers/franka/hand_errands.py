"""What a Franka Hand is asked for, in the motions that it knows. Pure: no clock, no connection.

The hand knows two motions of its fingers. ``move`` goes to a width, with a force that nobody can choose; when something
is in the way, it is answered minutes later, if ever. ``grasp`` closes until it meets something and presses with the
force that it was given; while it holds, the hand takes no second one. (As users report: issues 18, 93, 108 of
libfranka, 281 of franka_ros. That a grasp goes on past its width where it meets nothing is how Franka's own simulation
in franka_ros has it, and issue 130 there; not seen on a hand by us.) So a width is reached like this:

* opening is a ``move``;
* closing is a ``grasp`` of anything wider than the width that was asked for. What is met is held, with the force asked
  for, and that is the end. When the fingers pass their width and have met nothing, the hand is told to stop, and a
  ``move`` opens them again by as much as they went too far;
* closing where something is held already is nothing to do.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import NamedTuple

from hal.types import Fault, GripperOutcome

from . import hand_faults
from .hand_calls import Answer, Call, Ended, Seen, grasp, homing, move

__all__ = ["Errand", "Grasp", "Home", "Range", "Reach", "Verdict", "is_holding"]

_CLOSED = 0.001
"""m; fingers that are closer together hold nothing, whatever the hand says."""
_SHUT = 0.0005
"""m; shut fingers that are farther apart, and have not pressed yet, may have something thin between them."""
_HOMED = 0.005
"""m by which the greatest width may differ from the rig's and still make sense."""


def is_holding(seen: Seen) -> bool:
    """Is something between the fingers that they press on?"""
    return seen.is_grasped and seen.width > _CLOSED


class Verdict(NamedTuple):
    """How a command ended."""

    outcome: GripperOutcome
    fault: Fault | None = None


class Range(NamedTuple):
    """What counts as right, m."""

    width_max: float
    """The rig's."""
    tolerance: float
    """Fingers that rest so close to where they should be are there."""

    def trouble(self, seen: Seen) -> Fault | None:
        """What is wrong with the hand's own greatest width."""
        fits = abs(seen.max_width - self.width_max) <= _HOMED
        return None if fits else hand_faults.not_homed(seen.max_width, self.width_max)


class Errand(ABC):
    """One command, until its verdict."""

    def __init__(self, range_: Range) -> None:
        self.range = range_

    @abstractmethod
    def next(self, seen: Seen, ended: Ended | None) -> Call | Verdict:
        """What now, while the fingers rest? ``ended`` is the last motion since the command came."""

    @abstractmethod
    def wants(self, call: Call, seen: Seen) -> bool:
        """Does a motion that is on its way still lead where this errand goes?"""


class Reach(Errand):
    """Bring the fingers to a width (m), or as far as what is between them."""

    def __init__(self, range_: Range, width: float, speed: float, force: float) -> None:
        super().__init__(range_)
        self.width = width
        self.speed = speed
        self.force = force

    def next(self, seen: Seen, ended: Ended | None) -> Call | Verdict:
        trouble = self.range.trouble(seen)
        if trouble is not None:
            return Verdict(GripperOutcome.FAILED, trouble)
        width = min(self.width, seen.max_width)
        call = move(seen, width, self.speed) if seen.width < width else self._closing(seen, width)
        answer = _answer_to(call, ended)
        if isinstance(answer, Fault):
            return Verdict(GripperOutcome.FAILED, answer)
        pressed = answer is not None or is_holding(seen)
        near = self.range.tolerance if pressed or width > self.range.tolerance else _SHUT
        if abs(seen.width - width) <= near:
            return Verdict(GripperOutcome.DONE)
        if answer is not None or (seen.width > width and is_holding(seen)):
            return Verdict(GripperOutcome.MISSED)
        return call

    def wants(self, call: Call, seen: Seen) -> bool:
        """One in the right direction goes on, even if an older command began it, until it has passed the width.

        That spares the fingers a stop for each of the steps in which a trigger is pulled.
        """
        width = min(self.width, seen.max_width)
        if call.method == "move":
            return call.arguments[1] == self.speed and call.arguments[0] <= width  # every move opens
        passed = seen.width < width - self.range.tolerance and not is_holding(seen)
        return not passed and _same(call, self._closing(seen, call.arguments[0] if call.arguments else 0.0))

    def _closing(self, seen: Seen, width: float) -> Call:
        return grasp(seen, width, self.speed, self.force, 0.0, self.range.width_max)


class Grasp(Errand):
    """Close on something of a certain width and hold it."""

    def __init__(
        self, range_: Range, width: float, speed: float, force: float, inner: float, outer: float, held: float | None
    ) -> None:
        """``held``: the force (N) of the hold that the hand has now, where that is known."""
        super().__init__(range_)
        self.numbers = (width, speed, force, inner, outer)
        self.held = held

    def next(self, seen: Seen, ended: Ended | None) -> Call | Verdict:
        trouble = self.range.trouble(seen)
        if trouble is not None:
            return Verdict(GripperOutcome.FAILED, trouble)
        call = grasp(seen, *self.numbers)
        answer = _answer_to(call, ended)
        if isinstance(answer, Fault):
            return Verdict(GripperOutcome.FAILED, answer)
        if answer is not None:
            return Verdict(GripperOutcome.DONE if answer else GripperOutcome.MISSED)
        return self._hold_on(seen) if is_holding(seen) else call

    def _hold_on(self, seen: Seen) -> Verdict:
        width, _, force, inner, outer = self.numbers
        if self.held != force:
            return Verdict(GripperOutcome.FAILED, hand_faults.holding("take another force"))
        fits = width - inner < seen.width < width + outer
        return Verdict(GripperOutcome.DONE if fits else GripperOutcome.MISSED)

    def wants(self, call: Call, seen: Seen) -> bool:
        return _same(call, grasp(seen, *self.numbers))


class Home(Errand):
    """Find out how far the fingers open. What they hold would fall."""

    def next(self, seen: Seen, ended: Ended | None) -> Call | Verdict:
        answer = _answer_to(homing(), ended)
        if answer is None:
            holds = is_holding(seen)
            return Verdict(GripperOutcome.FAILED, hand_faults.holding("be homed")) if holds else homing()
        trouble = self.range.trouble(seen)
        if answer is True and trouble is None:
            return Verdict(GripperOutcome.DONE)
        fault = answer if isinstance(answer, Fault) else trouble
        return Verdict(GripperOutcome.FAILED, fault or hand_faults.not_homed(seen.max_width, self.range.width_max))

    def wants(self, call: Call, seen: Seen) -> bool:
        return call.method == "homing"


def _same(one: Call, other: Call) -> bool:
    return (one.method, one.arguments) == (other.method, other.arguments)


def _answer_to(call: Call, ended: Ended | None) -> Answer | None:
    """The hand's answer where just this was tried and came to its own end."""
    return ended.answer if ended is not None and _same(ended.call, call) and not ended.stopped else None
