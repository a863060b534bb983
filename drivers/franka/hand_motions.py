"""Command logic of the Franka Hand, one motion at a time. Pure: no clock and no connection.

The hand has two motions of its fingers. ``move`` goes to a width with a fixed force; when an object is in the way, it
is answered minutes later, if at all. ``grasp`` closes until it meets an object and presses with the given force; while
it holds, the hand accepts no second one. (Reported by users: issues 18, 93 and 108 of libfranka, 281 of franka_ros.
That a grasp which meets nothing closes beyond its width follows Franka's own simulation in franka_ros, and issue 130
there; we have not seen it on a hand.) A width is therefore reached like this:

* Opening is a ``move``.
* Closing is a ``grasp`` that accepts any object wider than the target width. An object is held with the requested
  force, and the command ends there. When the fingers pass the target width without an object, the hand gets a stop,
  and a ``move`` opens them again by the overshoot.
* Closing while an object is held is done already.

The newest command replaces the one before. A running motion that does not serve it is stopped, and the next one begins
when that motion has ended. Stops of this hand are known to be ignored, or to release an object, so the states after a
stop are checked.

The hand continues a motion whose client is lost. Such a stray motion is stopped on the next connection if a stop, or
another command, came meanwhile, and only while the states show that the fingers move, or that something blocks a move.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass
from enum import Enum
from typing import NamedTuple, TypeAlias

from hal.errors import Fault
from hal.types import GripperOutcome

_CLOSED = 0.001
"""Width below which the fingers hold nothing, whatever the hand reports, m."""
_SHUT = 0.0005
"""Width above which closed fingers that have not pressed yet may have a thin object between them, m."""
_HOMED = 0.005
"""Largest plausible difference between the hand's greatest width and the rig's, m."""
_CALL_MARGIN = 3.0
"""s that a motion may take beyond its distance and speed: users report a second of overhead for every command."""
_HOMING_TIME = 30.0
"""s"""
_SETTLE_TIME = 1.0
"""s after a stop within which the fingers must come to rest."""
_AT_REST = 0.002
"""Speed below which the fingers are at rest, m/s."""
_REST_TIME = 0.3
"""s without motion after which the fingers count as at rest on a new connection."""
_STOP_TIMEOUT = 2.0
"""s after a motion's bound within which a stop must have ended it; otherwise the connection is restarted."""


# Calls of the client library.


class HandState(NamedTuple):
    """One state of the hand."""

    t: float
    """Time of arrival on the monotonic clock, s."""
    t_hand: float
    """The hand's own clock, s."""
    width: float
    """m"""
    max_width: float
    """m; valid only after homing."""
    is_grasped: bool
    temperature: int
    """Degrees Celsius."""


def is_holding(state: HandState) -> bool:
    """Return whether the fingers press on an object."""
    return state.is_grasped and state.width > _CLOSED


class GripperCall(NamedTuple):
    """A motion, by the name of the library's method, which blocks until the fingers rest."""

    method: str
    arguments: tuple[float, ...]
    bound: float
    """s after which the answer is overdue."""


CallAnswer: TypeAlias = "bool | Fault"
"""True and False are the hand's own answers; a fault stands for an exception of the library."""


class EndedCall(NamedTuple):
    call: GripperCall
    answer: CallAnswer
    stopped: bool
    """Whether a stop was sent for it."""


def _is_pressing(call: GripperCall, state: HandState) -> bool:
    """Return whether a motion is a grasp that presses on an object."""
    return call.method == "grasp" and is_holding(state)


def _move_call(state: HandState, width: float, speed: float) -> GripperCall:
    """Return a motion to ``width`` (m) at ``speed`` (m/s), with the hand's own force."""
    return GripperCall("move", (width, speed), 1.5 * abs(width - state.width) / speed + _CALL_MARGIN)


def _grasp_call(state: HandState, width: float, speed: float, force: float, inner: float, outer: float) -> GripperCall:
    """Return a grasp at ``speed`` (m/s) that holds an object of ``width`` - inner to + outer (m) with ``force`` (N)."""
    distance = max(state.width, abs(width - state.width))
    return GripperCall("grasp", (width, speed, force, inner, outer), 1.5 * distance / speed + _CALL_MARGIN)


_HOMING_CALL = GripperCall("homing", (), _HOMING_TIME)
"""Close, and open completely."""


# Faults of the hand, other than exceptions of the client library.


def _not_homed_fault(max_width: float, expected: float) -> Fault:
    return Fault(
        "not_homed",
        f"the hand's greatest width is unknown: it reports {max_width:.4g} m, the rig file has {expected:.4g} m",
        "remove any object from the fingers and home the hand (gripper.home()); if the fault persists, set the "
        "gripper's width_max in the rig file",
    )


def _holding_fault(action: str) -> Fault:
    return Fault("holding", f"the hand holds an object, and cannot {action} meanwhile", "open the fingers first")


def _no_answer_fault(motion: str, bound: float) -> Fault:
    return Fault(
        "no_answer",
        f"the hand did not end its {motion} within {bound:.1f} s",
        "check that nothing is in the way of its fingers; if the fault persists, switch the hand off and on in Desk",
    )


_STOP_IGNORED = Fault(
    "stop_ignored",
    "the fingers move in spite of a stop (a known problem of this hand: libfranka, issue 18)",
    "keep clear until they rest; the next command begins when this motion has ended",
)
_STOP_RELEASED = Fault(
    "stop_released",
    "the hand released its object on a stop (libfranka, issue 111)",
    "find the object; open the fingers, then grasp it again",
)


def _lost_fault(reason: str) -> Fault:
    return Fault("lost", reason, "check the fingers' position, then send the command again; it is not repeated")


# Commands.


class CommandResult(NamedTuple):
    outcome: GripperOutcome
    fault: Fault | None = None


class WidthRange(NamedTuple):
    """Widths that count as right, m."""

    width_max: float
    """Greatest width in the rig file."""
    tolerance: float
    """Distance from the target at which resting fingers count as arrived."""

    def fault(self, state: HandState) -> Fault | None:
        """Return a fault if the hand's own greatest width does not fit: it is not homed."""
        fits = abs(state.max_width - self.width_max) <= _HOMED
        return None if fits else _not_homed_fault(state.max_width, self.width_max)


class HandCommand(ABC):
    """One command, until its result."""

    def __init__(self, range_: WidthRange) -> None:
        self.range = range_

    @abstractmethod
    def next(self, state: HandState, ended: EndedCall | None) -> GripperCall | CommandResult:
        """Return the next motion, or the result, while the fingers rest; ``ended`` is the command's last motion."""

    @abstractmethod
    def accepts(self, call: GripperCall, state: HandState) -> bool:
        """Return whether a running motion serves this command."""


class WidthCommand(HandCommand):
    """Move the fingers to a width (m), or until they meet an object."""

    def __init__(self, range_: WidthRange, width: float, speed: float, force: float) -> None:
        super().__init__(range_)
        self.width = width
        self.speed = speed
        self.force = force

    def next(self, state: HandState, ended: EndedCall | None) -> GripperCall | CommandResult:
        fault = self.range.fault(state)
        if fault is not None:
            return CommandResult(GripperOutcome.FAILED, fault)
        width = min(self.width, state.max_width)
        call = _move_call(state, width, self.speed) if state.width < width else self._closing_call(state, width)
        answer = _answer_to(call, ended)
        if isinstance(answer, Fault):
            return CommandResult(GripperOutcome.FAILED, answer)
        pressed = answer is not None or is_holding(state)
        near = self.range.tolerance if pressed or width > self.range.tolerance else _SHUT
        if abs(state.width - width) <= near:
            return CommandResult(GripperOutcome.DONE)
        if answer is not None or (state.width > width and is_holding(state)):
            return CommandResult(GripperOutcome.MISSED)
        return call

    def accepts(self, call: GripperCall, state: HandState) -> bool:
        """Accept a motion in the right direction, of an older command too, until it has passed the width.

        That avoids a stop for every small step while an analogue trigger is pulled.
        """
        width = min(self.width, state.max_width)
        if call.method == "move":
            return call.arguments[1] == self.speed and call.arguments[0] <= width  # every move opens
        passed = state.width < width - self.range.tolerance and not is_holding(state)
        return not passed and _same(call, self._closing_call(state, call.arguments[0] if call.arguments else 0.0))

    def _closing_call(self, state: HandState, width: float) -> GripperCall:
        return _grasp_call(state, width, self.speed, self.force, 0.0, self.range.width_max)


class GraspCommand(HandCommand):
    """Close on an object of a certain width and hold it."""

    def __init__(
        self,
        range_: WidthRange,
        width: float,
        speed: float,
        force: float,
        inner: float,
        outer: float,
        held: float | None,
    ) -> None:
        """``held``: force (N) of the present hold; None if unknown, or without one."""
        super().__init__(range_)
        self.numbers = (width, speed, force, inner, outer)
        self.held = held

    def next(self, state: HandState, ended: EndedCall | None) -> GripperCall | CommandResult:
        fault = self.range.fault(state)
        if fault is not None:
            return CommandResult(GripperOutcome.FAILED, fault)
        call = _grasp_call(state, *self.numbers)
        answer = _answer_to(call, ended)
        if isinstance(answer, Fault):
            return CommandResult(GripperOutcome.FAILED, answer)
        if answer is not None:
            return CommandResult(GripperOutcome.DONE if answer else GripperOutcome.MISSED)
        return self._judge_hold(state) if is_holding(state) else call

    def _judge_hold(self, state: HandState) -> CommandResult:
        width, _, force, inner, outer = self.numbers
        if self.held != force:
            return CommandResult(GripperOutcome.FAILED, _holding_fault("change its force"))
        fits = width - inner < state.width < width + outer
        return CommandResult(GripperOutcome.DONE if fits else GripperOutcome.MISSED)

    def accepts(self, call: GripperCall, state: HandState) -> bool:
        return _same(call, _grasp_call(state, *self.numbers))


class HomeCommand(HandCommand):
    """Measure how far the fingers open. A held object would fall."""

    def next(self, state: HandState, ended: EndedCall | None) -> GripperCall | CommandResult:
        answer = _answer_to(_HOMING_CALL, ended)
        if answer is None:
            holds = is_holding(state)
            return CommandResult(GripperOutcome.FAILED, _holding_fault("be homed")) if holds else _HOMING_CALL
        fault = self.range.fault(state)
        if answer is True and fault is None:
            return CommandResult(GripperOutcome.DONE)
        fault = answer if isinstance(answer, Fault) else fault
        return CommandResult(GripperOutcome.FAILED, fault or _not_homed_fault(state.max_width, self.range.width_max))

    def accepts(self, call: GripperCall, state: HandState) -> bool:
        return call.method == "homing"


def _same(one: GripperCall, other: GripperCall) -> bool:
    return (one.method, one.arguments) == (other.method, other.arguments)


def _answer_to(call: GripperCall, ended: EndedCall | None) -> CallAnswer | None:
    """Return the hand's answer if exactly this motion was tried and was not stopped."""
    return ended.answer if ended is not None and _same(ended.call, call) and not ended.stopped else None


# The controller.


class HandAction(Enum):
    STOP = "stop"
    STOP_STRAY = "stop stray"
    """Stop a motion from before the present connection."""
    RECONNECT = "reconnect"


@dataclass
class _RunningCall:
    call: GripperCall
    deadline: float
    stopped_at: float | None = None


@dataclass
class _StopCheck:
    """What the states after a stop are compared with."""

    until: float
    width: float
    held: bool
    """Whether an object was held."""


class HandController:
    """Turns commands into motions, from the states and answers of the hand.

    ``outcome`` and ``fault`` are those of the newest command, ``state`` is the newest state.
    """

    def __init__(self, range_: WidthRange) -> None:
        self.range = range_
        self.outcome = GripperOutcome.NONE
        self.fault: Fault | None = None
        self.state: HandState | None = None
        self.speed = 0.0
        """Rate of change of the width between the last two states, m/s."""
        self._command: HandCommand | None = None
        self._running: _RunningCall | None = None
        self._ended: EndedCall | None = None
        """Last motion since the newest command was given."""
        self._t_ended = -math.inf
        """End of the last motion."""
        self._stop_check: _StopCheck | None = None
        self._stray: _RunningCall | None = None
        """Motion from before the present connection that may still run."""
        self._ends_stray = False
        """Whether a stop, or another command, ends it."""
        self._outdated = False
        """Whether the newest state is from before the connection was lost."""
        self._t_moved = 0.0
        """Time of the newest state in which the fingers moved, or of the first one of a connection, s."""
        self._force: float | None = None
        """Force (N) of the present grasp, if known."""

    @property
    def moving(self) -> bool:
        """Whether a command is being carried out, or the fingers move otherwise."""
        return self._command is not None or abs(self.speed) > _AT_REST

    @property
    def busy(self) -> bool:
        """Whether a motion is running that holds no object."""
        return self._running is not None and not (self.state is not None and is_holding(self.state))

    # Commands.

    def move(self, width: float, speed: float, force: float) -> None:
        self._accept(WidthCommand(self.range, width, speed, force))

    def grasp(self, width: float, speed: float, force: float, inner: float, outer: float) -> None:
        self._accept(GraspCommand(self.range, width, speed, force, inner, outer, self._force))

    def home(self) -> None:
        self._accept(HomeCommand(self.range))

    def stop(self) -> None:
        """Stop the fingers; an object stays held."""
        self._ends_stray = self._stray is not None
        if self._command is not None:
            self._command, self.outcome = None, GripperOutcome.STOPPED

    def _accept(self, command: HandCommand) -> None:
        self._command, self._ended = command, None
        self._ends_stray = self._stray is not None
        self.outcome, self.fault = GripperOutcome.RUNNING, None

    # Events.

    def update(self, state: HandState) -> None:
        before, self.state = self.state, state
        if self._outdated:
            before, self._outdated, self.speed, self._t_moved = None, False, 0.0, state.t
        if before is not None and state.t_hand > before.t_hand:  # after a stall, states arrive in a bunch
            self.speed = (state.width - before.width) / (state.t_hand - before.t_hand)
        if abs(self.speed) > _AT_REST:
            self._t_moved = state.t
        if not state.is_grasped and state.t > self._t_ended:
            self._force = None
        if self._stop_check is not None and before is not None and before.t > self._stop_check.until:
            self._check_stop(self._stop_check, state)

    def _check_stop(self, check: _StopCheck, state: HandState) -> None:
        opened = not state.is_grasped or state.width > check.width + self.range.tolerance
        if abs(self.speed) > _AT_REST:
            self.fault = _STOP_IGNORED
        elif check.held and opened and self._command is None:
            self.fault = _STOP_RELEASED
        if self._running is None:
            self._stop_check = None

    def call_ended(self, answer: CallAnswer, now: float) -> None:
        """Process the hand's answer to the running motion."""
        running, self._running = self._running, None
        if running is None:
            return
        stopped = running.stopped_at is not None
        self._ended, self._t_ended = EndedCall(running.call, answer, stopped), now
        if running.call.method == "grasp" and answer is True:
            self._force = running.call.arguments[2]
            if self._stop_check is not None and self.state is not None:
                # The object was held before the stop; the states had not shown it in time.
                self._stop_check = _StopCheck(now + _SETTLE_TIME, self.state.width, True)

    def connection_lost(self, reason: str) -> None:
        """Fail the present command: nothing is sent a second time, but a stop."""
        if self._running is not None:
            self._stray, self._ends_stray = self._running, self._command is None or self._running.stopped_at is not None
        if self._stray is not None:
            self._stray.stopped_at = None
        self._outdated = True
        self._running = self._ended = self._stop_check = self._force = None
        if self._command is not None:
            self._fail(_lost_fault(reason))

    def _fail(self, fault: Fault) -> None:
        self._command, self.outcome, self.fault = None, GripperOutcome.FAILED, fault

    # Actions.

    def next_action(self, now: float) -> GripperCall | HandAction | None:
        """Return what to send to the hand now; None to let it continue."""
        state = self.state
        if state is None:
            return None
        if self._running is not None:
            return self._supervise(self._running, state, now)
        if self._outdated:
            return None
        if self._stray is not None:
            action = self._watch_stray(self._stray, state, now)
            if self._stray is not None:
                return action
        if self._command is None or state.t <= self._t_ended:
            return None  # no command, or the last state does not show the end of the last motion yet
        step = self._command.next(state, self._ended)
        if isinstance(step, CommandResult):
            self._command, self.outcome = None, step.outcome
            self.fault = step.fault or self.fault
            return None
        self._running, self._stop_check = _RunningCall(step, now + step.bound), None
        return step

    def _watch_stray(self, stray: _RunningCall, state: HandState, now: float) -> HandAction | None:
        """Stop the stray motion if that is due; forget it when it is over, or holds an object."""
        rests = state.t - self._t_moved > _REST_TIME
        due = self._ends_stray and stray.stopped_at is None and not _is_pressing(stray.call, state)
        if due and (abs(self.speed) > _AT_REST or (rests and self._is_blocked(stray.call, state))):
            self._t_moved = state.t
            return self._send_stop(stray, state, now, HandAction.STOP_STRAY)
        awaited = self._command is not None or stray.stopped_at is not None  # otherwise it may begin late
        if _is_pressing(stray.call, state) or (rests and (awaited or now > stray.deadline)):
            self._stray = None
        return None

    def _is_blocked(self, call: GripperCall, state: HandState) -> bool:
        """Return whether fingers at rest may continue a move once what is in their way is gone."""
        there = bool(call.arguments) and abs(state.width - call.arguments[0]) <= self.range.tolerance
        return call.method == "move" and not there and not is_holding(state)

    def _send_stop(self, running: _RunningCall, state: HandState, now: float, action: HandAction) -> HandAction:
        running.stopped_at = now
        self._stop_check = _StopCheck(now + _SETTLE_TIME, state.width, is_holding(state))
        return action

    def _supervise(self, running: _RunningCall, state: HandState, now: float) -> HandAction | None:
        if running.stopped_at is not None:
            if now <= max(running.deadline, running.stopped_at) + _STOP_TIMEOUT:
                return None
            self.connection_lost(f"the hand did not end its {running.call.method} in spite of a stop")
            return HandAction.RECONNECT
        if now > running.deadline and self._command is not None and self._command.accepts(running.call, state):
            self._fail(_no_answer_fault(running.call.method, running.call.bound))
        # Without a command, only a grasp that presses on an object continues: a stop could release it.
        serves = _is_pressing(running.call, state)
        if self._command is not None:
            serves = self._command.accepts(running.call, state)
        if serves:
            return None
        return self._send_stop(running, state, now, HandAction.STOP)
