"""One gripper in a group's cycle: its driver, its mailboxes, and how its newest command goes."""

from __future__ import annotations

import math
import traceback
from collections.abc import Callable

from ..driver import GripperDriver, GripperReading
from ..errors import CommandError, ConfigError, ConnectionLost, DriverMissing, Fault, HalError, NotSupported, RobotFault
from ..servo.watchdog import SILENCE, is_alive
from ..types import GripperOutcome
from .records import AppRecord, GripperAct, GripperCommand, GripperMail

AT_WIDTH = 0.001
"""Largest distance from the target at which fingers at rest have reached it, m."""
_REPEAT = 0.5
"""s for which a stop of a gripper that did not answer is given again once it does: its driver learns late what moves.
"""
_SWITCH_ON = "check that it is on and connected"


class GripperUnit:
    """A gripper with its mailboxes. Its errors are reported in its state and stop nothing else.

    ``allowed_session`` returns the session of the arm that may move at a time (s), 0 for none.
    """

    def __init__(
        self, driver: GripperDriver, mail: GripperMail, allowed_session: Callable[[float], int] = lambda now: 0
    ) -> None:
        self.driver = driver
        self._allowed_session = allowed_session
        self.spec = driver.spec
        self.mail = mail
        self._reading: GripperReading | None = None
        self._moving = self._lost = False
        """Whether the fingers moved in the last reading, and whether the gripper did not answer instead."""
        self._command: GripperCommand | None = None
        self._force = self.spec.force
        """Force of the newest motion, N."""
        self._seq = 0
        self._seq_before = 0
        """Number of the last reading before the newest command."""
        self._outcome = GripperOutcome.NONE
        self._final = False
        """Whether the outcome is decided, whatever the driver reports."""
        self._fault: Fault | None = None
        """Fault of the newest command, if its call failed."""
        self._stops = 0
        self._unheard: float | None = None
        """Until when the last stop is given again, s: infinite until the gripper answers, None if it heard the stop."""
        self._waiting: tuple[int, float] = (0, 0.0)
        """Number of the newest command whose session did not move yet, and when it was seen first, s."""
        self._reason = ""

    def open(self) -> None:
        """Connect. Nothing moves.

        Raises:
            ConnectionLost: If the gripper does not answer; the message has the way to open the rig without it.
        """
        try:
            self.driver.open()
        except (CommandError, ConfigError, DriverMissing, NotSupported):
            raise
        except Exception as error:
            text = str(error) if isinstance(error, HalError) else f"{type(error).__name__}: {error}"
            raise ConnectionLost(
                f"{self.spec.name} cannot be opened: {text}; without this gripper, "
                "`gripper: {enabled: false}` in the arm's entry of the rig switches it off"
            ) from error

    # Per cycle.

    def serve(self, now: float, app: AppRecord) -> None:
        """Stop the fingers if the app stopped the rig, or they may not move any more; start the app's newest command.

        A command that was sent before a stop, or that the gripper does not accept, is dropped: nothing moves later.
        """
        if app.stops != self._stops:
            self._stops = app.stops
            self._stop(self._outcome is GripperOutcome.RUNNING)
        elif self._command is not None and not self._may_move(self._command, now, app):
            self.end_motion()
        command = self.mail.get_command()
        if command is None or command.seq <= self._seq:
            return
        if command.stops < app.stops:
            self._seq = command.seq
            self._end(GripperOutcome.STOPPED)
        elif command.act is GripperAct.STOP or self._may_move(command, now, app):
            self._seq = command.seq
            self._take(command)
        elif self._waiting[0] != command.seq:
            self._waiting = command.seq, now
        elif now - self._waiting[1] > SILENCE:
            self._seq = command.seq
            self.end_motion()
            self._end(GripperOutcome.STOPPED)

    def _may_move(self, command: GripperCommand, now: float, app: AppRecord) -> bool:
        """Return whether the app is alive, and the session that sent a command may move."""
        return is_alive(now, app.t) and command.session in (0, self._allowed_session(now))

    def end_motion(self) -> None:
        """Stop the fingers if they may move, also those whose command has failed; they keep what they hold."""
        running = self._outcome is GripperOutcome.RUNNING
        failed = self._outcome is GripperOutcome.FAILED and (self._moving or self._lost)
        if running or (failed and self._unheard is None):
            self._stop(running)

    def _take(self, command: GripperCommand) -> None:
        if command.act is GripperAct.STOP:
            self._stop(True)
            return
        self._command = command
        self._outcome, self._final, self._fault = GripperOutcome.RUNNING, False, None
        self._seq_before = self._reading.seq if self._reading is not None else -1
        try:
            self._force = command.force or self._force
            if command.act is GripperAct.MOVE:
                self.driver.move(command.width, command.speed, command.force)
            elif command.act is GripperAct.GRASP:
                self.driver.grasp(command.width, command.speed, command.force, command.inner, command.outer)
            else:
                self.driver.home()
        except Exception as error:
            self._fail(error)
        else:
            self._unheard = None

    def _stop(self, ends: bool) -> None:
        """Stop the fingers. ``ends``: whether the newest command is still running."""
        try:
            self.driver.stop()
        except Exception as error:
            self._unheard = math.inf
            if self._outcome is not GripperOutcome.FAILED:  # otherwise why it failed remains
                self._fail(error)
        else:
            if self._lost:
                self._unheard = math.inf
            if ends:
                self._end(GripperOutcome.STOPPED)

    def _fail(self, error: Exception) -> None:
        self._note(error)
        self._end(GripperOutcome.FAILED, _make_fault(error))

    def _end(self, outcome: GripperOutcome, fault: Fault | None = None) -> None:
        self._outcome, self._final, self._fault = outcome, True, fault

    def _note(self, error: Exception) -> None:
        """Print each new error once, to the process's log."""
        reason = f"{type(error).__name__}: {error}"
        if reason != self._reason:
            self._reason = reason
            traceback.print_exception(error)

    def publish(self, now: float) -> None:
        """Publish the newest state; if the gripper does not answer, an old one with the reason as its fault."""
        lost: Fault | None = None
        self._moving = False
        try:
            reading = self.driver.read(now)
            if not math.isfinite(reading.width):
                raise ConnectionLost(f"{self.spec.name} reports a width of {reading.width}")
        except Exception as error:
            self._note(error)
            lost = _make_fault(error)
        else:
            self._reading, self._moving = reading, reading.moving
            self._judge(reading)
            self._repeat_stop(now)
        self._lost = lost is not None
        if self._reading is not None:
            fault = self._fault or lost or self._reading.fault
            self.mail.put(self._reading, self._seq, self._outcome, fault, lost is not None, self._force)

    def _repeat_stop(self, now: float) -> None:
        if self._unheard is not None:
            self._unheard = min(self._unheard, now + _REPEAT)
            if now < self._unheard:
                self._stop(False)
            else:
                self._unheard = None

    def _judge(self, reading: GripperReading) -> None:
        """Decide how the newest command goes: by the driver's outcome, or else by the width."""
        command = self._command
        if command is None or self._final:
            return
        if reading.outcome:
            self._outcome = reading.outcome
        elif not reading.moving and reading.seq != self._seq_before:
            self._end(_judge_rest(command, reading, self.spec.width_min))

    def close(self) -> None:
        """Close the device; it keeps what it holds."""
        self.driver.close()


def _judge_rest(command: GripperCommand, reading: GripperReading, width_min: float) -> GripperOutcome:
    beyond = reading.width - command.width
    if command.act is GripperAct.MOVE:
        there = abs(reading.width - max(command.width, width_min)) <= AT_WIDTH
    elif command.act is GripperAct.GRASP:
        there = -command.inner <= beyond <= command.outer and reading.grasped is not False
    else:
        there = True
    return GripperOutcome.DONE if there else GripperOutcome.MISSED


def _make_fault(error: Exception) -> Fault:
    if isinstance(error, RobotFault):
        return Fault("gripper", error.cause, error.remedy)
    if isinstance(error, ConnectionLost):
        cause, _, remedy = str(error).partition("; ")
        return error.fault or Fault("lost", cause, remedy or _SWITCH_ON)
    if isinstance(error, HalError):
        return Fault("refused", str(error), "")
    return Fault("driver", f"{type(error).__name__}: {error}", "this is a bug in the driver")
