"""Permission to move: the dead-man, the heartbeats, the deadline of a command, stops and faults of one session.

Every comparison is written so that a number that is not finite counts as the bad case.
"""

from __future__ import annotations

from ..commands import CommandRecord, DeadmanRecord, Inbox, Session
from ..errors import Fault
from ..types import Trip

SILENCE = 0.150
"""Longest time from the last sign of life of the dead-man's pad, of the app or of the device to the stop, s."""

PAD_SILENCE = SILENCE - 0.030
"""A dead-man whose newest sign of life is older than this does not count, s. The rest of :data:`SILENCE` is for a servo
that runs late on a loaded machine."""

_HARMLESS_AT_REST = (Trip.DEADMAN_LOST, Trip.DEADMAN_SILENT, Trip.APP_SILENT)
"""While the dead-man is released these latch nothing."""

_NONE = Trip.NONE  # the one that is named in every tick; it is zero, and so false; a global is found faster

_AHEAD = 1.0
"""A sign of life may be this far in the future before it counts as invalid, s."""

WITHHELD = 0.3
"""Longest time for which a driver may hold back the set-points of an arm that is to move, s."""
WITHHELD_FAULT = Fault(
    "SETPOINTS_WITHHELD",
    f"the arm was to move, but for {WITHHELD:g} s its driver passed no set-point on",
    "check that the arm is at rest, and in its own software that it accepts motions",
)


class Watchdog:
    """Decides once per tick whether the arm may move.

    With a dead-man, motion is allowed from a press until its release, and a trip is cleared by a release and a new
    press. A dead-man that is already held when the session opens does not count (it may be taped down, or held from
    before), except for ``move_to``, whose goal is known. Without a dead-man, motion is allowed from the start and a
    trip is cleared by ``control.rearm()``. The cause of the trip must be gone first: a press or a rearm that came while
    it lasted does not count. A stop by ``rig.stop()`` replaces every trip but a fault, is shown once the fault is
    cleared, and is itself cleared only by a later press or by a rearm that acknowledges it.
    """

    def __init__(self, dt: float = 0.0) -> None:
        """Make a watchdog whose limits hold although silence is only noticed every ``dt`` s, in :meth:`update`."""
        self._silence = SILENCE - dt
        self._pad_silence = PAD_SILENCE - dt
        self.session: Session | None = None
        self.trip = Trip.NONE
        """Reason of the latched stop; ``Trip.NONE`` if none is latched."""
        self.t_trip = 0.0
        """Time at which it was latched, s."""
        self.allowed = False
        """Whether the arm may move in this tick."""
        self.renewed = False
        """Whether the permission was granted in this tick. Commands that were sent before do not count any more."""
        self.stops = 0
        """Number of calls of ``rig.stop()`` that were seen."""
        self._stopped = False
        """Whether one of them is not acknowledged."""
        self._presses = 0
        self.rearms = 0
        """Number of the rearms that were handled; one waits until the arm is at rest."""
        self._command: CommandRecord | None = None
        """The command that the arm follows."""
        self._refused = 0
        """Number of the newest command that the arm cannot follow."""

    def open_session(self, session: Session, inbox: Inbox) -> None:
        """Open a session. Presses and rearms count from those in ``inbox``, stops from those that the app knew of."""
        self.session = session
        self.trip = Trip.NONE
        self.allowed = self.renewed = self._stopped = False
        self._command = None
        self.rearms = inbox.rearms
        self.stops = inbox.acknowledged
        deadman = inbox.deadman
        # For move_to, a dead-man that is held already is as good as pressed now.
        known = session.is_motion and deadman is not None and deadman.held
        self._presses = (deadman.presses if deadman is not None else 0) - int(known)

    def close_session(self) -> None:
        """Close the session."""
        self.session = None
        self.allowed = False
        self.trip = Trip.NONE

    def expect(self, command: CommandRecord | None) -> None:
        """Expect the next command before the deadline of this one; None if none is due."""
        self._command = command

    def refuse(self, command: CommandRecord) -> None:
        """Note that the arm does not follow a command, so that it does not count as one in time."""
        self._refused = command.seq

    def update(self, now: float, inbox: Inbox, at_rest: bool, device: Trip = Trip.NONE, late: bool = False) -> bool:
        """Decide for one tick at ``now``, s; motion only starts from a set-point at rest.

        ``device`` is the trip that the device causes; ``late`` says that the last tick was too long ago.

        Returns:
            :attr:`allowed`.
        """
        self.renewed = False
        session = self.session
        if session is None:
            return False
        stopped = inbox.stops != self.stops
        self.stops, self._stopped = inbox.stops, self._stopped or stopped
        deadman = inbox.deadman
        cause = self._cause(now, session, inbox, stopped, device, late)
        if cause and cause in _HARMLESS_AT_REST and session.deadman and not self.allowed and not self.trip:
            # Nothing moves, and nothing will before a new press: no trip. A press during the silence is not one.
            self._presses = self._presses if deadman is None else deadman.presses
            return False
        if cause:
            self._latch(cause, now)
        if self._stopped and cause is not Trip.FAULT:
            self.trip = Trip.STOP  # also after a fault that hid it
        if self.trip:
            self._try_to_clear(session, inbox, at_rest, cause)
        elif session.deadman:
            assert deadman is not None
            self._follow_deadman(deadman, at_rest)
        elif not self.allowed and at_rest:
            self.allowed = self.renewed = True
        return self.allowed

    def _cause(self, now: float, session: Session, inbox: Inbox, stopped: bool, device: Trip, late: bool) -> Trip:
        """Return the gravest reason that forbids motion in this tick; ``Trip.NONE`` if there is none."""
        if device:
            return device
        if stopped:
            return Trip.STOP
        if late and self.allowed:
            return Trip.HOST_LATE
        if session.deadman:
            if inbox.deadman is None or not inbox.deadman.connected:
                return Trip.DEADMAN_LOST
            if not is_alive(now, inbox.deadman.t_alive, self._pad_silence):
                return Trip.DEADMAN_SILENT
        if not is_alive(now, inbox.t_app, self._silence):
            return Trip.APP_SILENT
        if self.allowed and self._is_late(now, session, inbox.command):
            released = session.deadman and inbox.deadman is not None and not inbox.deadman.held
            if not released:
                return Trip.COMMAND_LATE
        return _NONE

    def _is_late(self, now: float, session: Session, newest: CommandRecord | None) -> bool:
        """Return whether a command is due, and neither the one that is followed nor a newer one is still in time.

        After one that was refused, a newer one counts once it is followed.
        """
        followed = self._command
        if followed is None or is_timely(now, followed):
            return False
        if newest is None or newest.session != session.id or newest.seq <= followed.seq:
            return True
        if self._refused > followed.seq:
            return True
        return not is_timely(now, newest)

    def _latch(self, cause: Trip, now: float) -> None:
        if self.trip is Trip.NONE or cause is Trip.FAULT:
            self.t_trip = now if self.trip is Trip.NONE else self.t_trip
            self.trip = cause
        self.allowed = False
        self._command = None

    def _try_to_clear(self, session: Session, inbox: Inbox, at_rest: bool, cause: Trip) -> None:
        self.allowed = False
        deadman = inbox.deadman
        presses = self._presses if deadman is None else deadman.presses
        if cause is not Trip.NONE:
            self._presses, self.rearms = presses, inbox.rearms
            return
        if not at_rest:
            return
        if session.deadman:
            if deadman is not None and deadman.held and presses != self._presses:
                self._grant(presses)
        elif inbox.rearms != self.rearms:
            self.rearms = inbox.rearms
            if not self._stopped or inbox.acknowledged == inbox.stops:
                self._grant(presses)

    def _follow_deadman(self, deadman: DeadmanRecord, at_rest: bool) -> None:
        if self.allowed and not (deadman.held and deadman.presses == self._presses):
            # Released, or released and pressed again between two ticks: stop first in both cases.
            self.allowed = False
            self._command = None
        elif not self.allowed and deadman.held and deadman.presses != self._presses and at_rest:
            self._grant(deadman.presses)

    def _grant(self, presses: int) -> None:
        self.trip = Trip.NONE
        self._stopped = False
        self._presses = presses
        self._command = None
        self.allowed = self.renewed = True


def is_timely(now: float, command: CommandRecord) -> bool:
    """Return whether a command is before its deadline and not from the future."""
    return command.t - _AHEAD <= now <= command.deadline


def is_alive(now: float, sign: float, silence: float = SILENCE) -> bool:
    """Return whether the last sign of life (s) is recent enough, and not from the future."""
    return -_AHEAD <= now - sign <= silence
