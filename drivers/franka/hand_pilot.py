"""Carries out what a Franka Hand is asked for, one motion at a time. Pure: time is what it is told.

The newest command wins. A motion on its way that does not lead where it goes is stopped, and the next one begins when
it is over. This hand is known for stops that do nothing, or too much: its states tell what the fingers really did.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from enum import Enum

from hal.types import Fault, GripperOutcome

from . import hand_faults
from .hand_calls import Answer, Call, Ended, Seen
from .hand_errands import Errand, Grasp, Home, Range, Reach, Verdict, is_holding

__all__ = ["HandPilot", "Order"]

_REST = 1.0
"""s after a stop in which the fingers must come to rest."""
_STILL = 0.002
"""m/s: fingers that are slower stand still."""
_STOP_ANSWER = 2.0
"""s after a motion's bound in which a stop must have ended it; else the connection is given up."""


class Order(Enum):
    """What to do with the connection."""

    STOP = "stop"
    RECONNECT = "reconnect"


@dataclass
class _Flight:
    """The motion that is on its way."""

    call: Call
    deadline: float
    stopped_at: float | None = None


@dataclass
class _Watch:
    """What the fingers may do after a stop."""

    until: float
    width: float
    held: bool
    """Was something held?"""


class HandPilot:
    """What is asked of the hand, what it says, and what to do about it. ``outcome`` and ``fault`` are those of the
    newest command.
    """

    def __init__(self, range_: Range) -> None:
        self.range = range_
        self.outcome = GripperOutcome.NONE
        self.fault: Fault | None = None
        self.seen: Seen | None = None
        self.speed = 0.0
        """Of the width between the last two states, m/s."""
        self._errand: Errand | None = None
        self._flight: _Flight | None = None
        self._ended: Ended | None = None
        """The last motion since the newest command came."""
        self._t_ended = -math.inf
        """When the last motion of all was over."""
        self._watch: _Watch | None = None
        self._grip: float | None = None
        """Force (N) of the grasp that holds, where one does."""

    @property
    def moving(self) -> bool:
        """Is a command on its way, or do the fingers move by themselves?"""
        return self._errand is not None or abs(self.speed) > _STILL

    @property
    def busy(self) -> bool:
        """Is a motion on its way, and nothing held by it?"""
        return self._flight is not None and not (self.seen is not None and is_holding(self.seen))

    # What is asked.

    def reach(self, width: float, speed: float, force: float) -> None:
        """Bring the fingers to ``width`` (m), or onto what is in between."""
        self._take(Reach(self.range, width, speed, force))

    def grasp(self, width: float, speed: float, force: float, inner: float, outer: float) -> None:
        """Close on something and hold it."""
        self._take(Grasp(self.range, width, speed, force, inner, outer, self._grip))

    def home(self) -> None:
        """Find out how far the fingers open."""
        self._take(Home(self.range))

    def stop(self) -> None:
        """Stay there. What is held stays held."""
        if self._errand is not None:
            self._errand, self.outcome = None, GripperOutcome.STOPPED

    def _take(self, errand: Errand) -> None:
        self._errand, self._ended = errand, None
        self.outcome, self.fault = GripperOutcome.RUNNING, None

    # What the hand says.

    def see(self, seen: Seen) -> None:
        """A new state."""
        before, self.seen = self.seen, seen
        if before is not None and seen.t > before.t:
            self.speed = (seen.width - before.width) / (seen.t - before.t)
        if not seen.is_grasped and seen.t > self._t_ended:
            self._grip = None
        if self._watch is not None and before is not None and before.t > self._watch.until:
            self._look(self._watch, seen)

    def _look(self, watch: _Watch, seen: Seen) -> None:
        opened = not seen.is_grasped or seen.width > watch.width + self.range.tolerance
        if abs(self.speed) > _STILL:
            self.fault = hand_faults.stop_ignored()
        elif watch.held and opened and self._errand is None:
            self.fault = hand_faults.stop_released()
        if self._flight is None:
            self._watch = None

    def answer(self, answer: Answer, now: float) -> None:
        """How the motion on its way ended."""
        flight, self._flight = self._flight, None
        if flight is None:
            return
        stopped = flight.stopped_at is not None
        self._ended, self._t_ended = Ended(flight.call, answer, stopped), now
        if flight.call.method == "grasp" and answer is True:
            self._grip = flight.call.arguments[2]
            if self._watch is not None and self.seen is not None:
                # It held already when it was told to stop; the states had not shown that in time.
                self._watch = _Watch(now + _REST, self.seen.width, True)

    def lost(self, why: str) -> None:
        """The connection is gone, and with it whatever was asked: nothing is sent a second time."""
        self._flight = self._ended = self._watch = self._grip = None
        if self._errand is not None:
            self._fail(hand_faults.lost(why))

    def _fail(self, fault: Fault) -> None:
        self._errand, self.outcome, self.fault = None, GripperOutcome.FAILED, fault

    # What to do.

    def next_order(self, now: float) -> Call | Order | None:
        """What must go to the hand now; None when it is to go on with what it does."""
        seen = self.seen
        if seen is None:
            return None
        if self._flight is not None:
            return self._supervise(self._flight, seen, now)
        if self._errand is None or seen.t <= self._t_ended:
            return None  # nothing to do, or the last state does not show yet how the last motion ended
        step = self._errand.next(seen, self._ended)
        if isinstance(step, Verdict):
            self._errand, self.outcome = None, step.outcome
            self.fault = step.fault or self.fault
            return None
        self._flight, self._watch = _Flight(step, now + step.bound), None
        return step

    def _supervise(self, flight: _Flight, seen: Seen, now: float) -> Order | None:
        if flight.stopped_at is not None:
            if now <= max(flight.deadline, flight.stopped_at) + _STOP_ANSWER:
                return None
            self.lost(f"the hand did not end its {flight.call.method}, though it was told to stop")
            return Order.RECONNECT
        if now > flight.deadline and self._errand is not None and self._errand.wants(flight.call, seen):
            self._fail(hand_faults.no_answer(flight.call.method, flight.call.bound))
        if self._may_go_on(flight.call, seen):
            return None
        flight.stopped_at = now
        self._watch = _Watch(now + _REST, seen.width, is_holding(seen))
        return Order.STOP

    def _may_go_on(self, call: Call, seen: Seen) -> bool:
        """With nothing to do, only a grasp that presses on something: a stop could make it let go."""
        if self._errand is None:
            return call.method == "grasp" and is_holding(seen)
        return self._errand.wants(call, seen)
