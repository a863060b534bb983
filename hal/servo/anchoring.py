"""Follow what the device does with its set-points, by the device's own rule; continue from there where one was lost.

A device that extrapolates (a Franka, see :attr:`.RobotDriver.extrapolates`) continues at constant acceleration through
the cycles for which it got no set-point, and counts its cycles. So between two readings only two things can have
happened: it *took* the last set-point in the first of these cycles, or it *lost* that one too; it extrapolated the
rest. Both are computed here, from what was given. **A report never moves the set-point:** it only selects one of the
two, and only if it fits. Reports that fit neither change nothing; if they are farther than :data:`NOISIEST` from
everything that was given lately, they are counted, and too many of them are a fault.

Any other device stays where its last set-point put it, and takes the next one as it comes: nothing is corrected.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from math import inf
from typing import Any

from ..driver import Reading, Setpoint
from ..errors import Fault
from ..types import Trip
from .smoothing import JointSmoother, stop_peak
from .watchdog import SILENCE

Floats = Sequence[float]
LATEST = 5
"""Largest age of a report, cycles."""

NOISIEST = 1e-4
"""Largest distance of a report from the set-points of the last :data:`LATEST` cycles, rad: noise, rounding and
quantisation together."""

MISMATCHES = 20
"""More reports than this in :data:`_WINDOW` cycles that are farther off are a fault."""

_WINDOW = 100
"""Cycles."""

_LONGEST = 20
"""A device that got no set-point for so many cycles has stopped by itself."""

_ROUNDED = 4e-7
"""A report of the device's own set-point is this exact, rad: an FR3 reports in single precision, and what it continues
from may be off by another rounding."""

_ROUNDED_STEP = 1.5e-10
"""The same for the speed that it reports, as the way of one cycle, rad: at 1 kHz and 2 rad/s."""

_CLOSE = 1e-8
"""A lost set-point is recognised if the reported speed fits it to this, as the way of one cycle, rad, or:"""
_CLOSER = 10.0
"""so many times as well as a set-point that was taken."""

_AWAY = 1e-2
"""After a silence, an arm this far from its set-point restarts from its measured position, rad (if it does not report
its set-points)."""

_RESTED = 16
"""Number of readings of an arm at rest that are averaged, since starting from a noisy position is a step."""

_OVERSHOOT = 5e-3
"""A device that continued by itself may be so near to a limit that its stop ends this far beyond, rad."""

_OVERSPEED = 1.01
"""The same for its speed, as a share of the limit."""


class Anchoring:
    """What one device did with its set-points; corrects the smoother of one arm."""

    def __init__(self, smoother: JointSmoother, extrapolates: bool = False) -> None:
        self._smoother = smoother
        self._extrapolates = extrapolates
        self.fault: Fault | None = None
        """Set if reports and set-points do not fit each other, until :meth:`recover`."""
        self._seq: int | None = None
        """Number of the last reading."""
        self._cycle = 0
        """The device's cycles so far."""
        self._rest: list[float] = []
        """Position at which the device holds while nothing is streamed, rad: the mean of its last reports."""
        self._rested: Floats = ()
        """The last of these reports."""
        self._rests = 0
        self._steps = 0.0
        """Number of these reports, and the difference between two consecutive ones, rad."""
        self.reset_statistics()
        self.recover()
        self.forget()

    def reset_statistics(self) -> None:
        """Set the counters to zero."""
        self.lost = 0
        """Set-points that the device did not take."""
        self.skipped = 0
        """Cycles of the device for which none was computed, because its reading came too late or not at all."""
        self.mismatches = 0
        """Number of reports that fit none of the last set-points."""
        self.error = 0.0
        """Largest distance of the other reports from what the device should report, rad."""

    def recover(self) -> None:
        """Clear the fault."""
        self.fault = None
        self._odd: deque[int] = deque()
        """Cycles of the recent mismatches."""

    def statistics(self) -> dict[str, Any]:
        """Return the counters and the error as plain values."""
        return {
            "lost": self.lost,
            "skipped": self.skipped,
            "mismatches": self.mismatches,
            "report_error": self.error,
        }

    def note_rest(self, q: Floats | None) -> None:
        """Note that nothing is streamed, and that the device reports ``q`` (n,) as its commanded position, rad."""
        if q is None or len(q) != len(self._rest) or not _apart(q, self._rest) <= NOISIEST:
            self._rest = [] if q is None else list(q)
            self._rests, self._steps = 1, 0.0
        else:
            self._rests = n = min(self._rests + 1, _RESTED)
            self._rest = [x + (y - x) / n for x, y in zip(self._rest, q, strict=True)]
            self._steps = max(0.8 * self._steps, _apart(q, self._rested))  # a few cycles of memory
        self._rested = () if q is None else q

    def start_position(self, q: Floats) -> Floats:
        """Return the position (n,) to start from if the device last reported ``q``, rad: without mere noise."""
        rest = self._rest
        if len(rest) != len(q) or _apart(q, rest) > min(NOISIEST, 3.0 * self._steps):
            return q
        return rest

    def forget(self) -> None:
        """Forget what was given: the smoother was anchored again, and the device rests there."""
        smoother = self._smoother
        q = smoother.q
        self._given: deque[Floats] = deque([q] * (LATEST + 1), LATEST + 1)
        """Newest first; a late report shows one of these."""
        self._motion = Setpoint(q, smoother.dq, smoother.ddq)
        """The set-point that was given last."""
        steps = [smoother.dt * v for v in smoother.dq]
        self._track: list[Floats] = [[x - k * step for x, step in zip(q, steps, strict=True)] for k in range(3)]
        """Where the device was in its last three cycles, newest first, rad."""
        self._dq: Floats | None = None
        """Its speed in the newest of them, as it reports it, rad/s; None if that does not fit."""
        self._fresh = True
        """Whether nothing was given since."""
        self._silent = False
        """Whether the device may have stopped anywhere."""
        self._withheld = False
        """Whether the driver held the last set-point back."""
        self._away = 0
        """Cycles since the device answered last."""

    def note_given(self, setpoint: Setpoint) -> None:
        """Note that this set-point is written to the device."""
        self._motion = setpoint
        self._given.appendleft(setpoint[0])
        self._fresh = False

    def note_withheld(self) -> None:
        """Note that the last set-point was not passed on: the device is where it reports to be."""
        self._silent = self._withheld = True

    def note_silence(self) -> None:
        """Note that the device did not answer in this cycle. It stops by itself if that lasts."""
        self._away += 1
        if self._away * self._smoother.dt >= SILENCE:
            self._silent = True

    def check_report(self, reading: Reading, device: Trip) -> bool:
        """Compare a reading with what was given.

        Returns:
            Whether the smoother was corrected.
        """
        before, self._seq = self._seq, reading.seq
        if self._fresh:
            return False
        cycles = 1 if before is None else reading.seq - before
        if self.fault is not None or device is Trip.BAD_READING:
            self._note_taken()  # nothing else is known
        elif device is Trip.FAULT:
            self._silent = True
        elif device or cycles == 0:  # an old reading
            self.note_silence()
        elif self._silent:
            return self._resume(reading)
        else:
            self._away = 0
            self._cycle += max(1, cycles)
            if self._extrapolates:
                return self._find_lost(reading, max(1, cycles))
            if reading.q_commanded is not None and reading.q_commanded is not self._given[0]:
                self._judge(reading, _apart(reading.q_commanded, self._given[0]))
        return False

    def _note_taken(self) -> None:
        """Note that the device took the last set-point."""
        self._track, self._dq = [self._motion[0], *self._track[:2]], None

    def _find_lost(self, reading: Reading, cycles: int) -> bool:
        """Find out what the device did in its last ``cycles``; returns whether the smoother was corrected."""
        q, dq = reading.q_commanded, reading.dq_commanded
        assert q is not None  # by the contract of a device that extrapolates
        self.skipped += cycles - 1
        if cycles >= _LONGEST:
            return self._resume(reading)
        took = _extrapolate([self._motion[0], *self._track], cycles - 1)
        off, step_off = self._distances(q, dq, took)
        if cycles == 1 and off <= _ROUNDED and step_off <= _ROUNDED_STEP:
            self._track, self._dq = took[:3], dq
            self.error = max(self.error, off)
            return False
        lost = _extrapolate(self._track, cycles)
        lost_off, lost_step_off = self._distances(q, dq, lost)
        # The speeds distinguish a small loss from none: they are a thousand times as exact as the positions.
        close = max(cycles * _CLOSE, step_off / _CLOSER)
        is_lost = lost_off <= cycles * _ROUNDED and lost_step_off < min(step_off, close)
        track, count, start = took, cycles - 1, self._motion[0]
        if is_lost:
            track, count, start, off, step_off = lost, cycles, self._track[0], lost_off, lost_step_off
        self._judge(reading, off)
        self.lost += count
        agreed = step_off <= cycles * _ROUNDED
        if agreed and dq is not None and self._dq is not None:
            track = self._refine(start, cycles, int(is_lost), self._dq, dq)
        self._dq = dq if agreed else None
        if count and not self._allows(at := self._state(track)):
            self._note_taken()
            return False
        self._track = track[:3]
        if count:
            self._smoother.anchor(*at[:3])
        return count > 0

    def _refine(self, q: Floats, cycles: int, more: int, before: Floats, dq: Floats) -> list[Floats]:
        """Return where the device was in its last three cycles, newest first, by the speeds that it reports.

        They are more exact than the positions, so that what was too small to be noticed does not grow. In all
        ``cycles`` the speed changed by the same, from ``before`` to ``dq`` (n,), rad/s.

        Args:
            q: The position (n,), rad, after which it extrapolated: the one before these cycles, or the set-point.
            cycles: Number of cycles.
            more: Number of cycles, beyond ``cycles`` - 1, for which it extrapolated.
            before: Speed before these cycles.
            dq: Speed after them.
        """
        dt, count = self._smoother.dt, cycles - 1 + more
        middle = cycles - 0.5 * (count - 1)  # of the cycles in which it extrapolated, counted from 1
        steps = [(v - v0) / cycles for v, v0 in zip(dq, before, strict=True)]
        a = [x + dt * count * (v0 + middle * step) for x, v0, step in zip(q, before, steps, strict=True)]
        b = [x - dt * v for x, v in zip(a, dq, strict=True)]
        return [a, b, [x - dt * (v - step) for x, v, step in zip(b, dq, steps, strict=True)]]

    def _distances(self, q: Floats, dq: Floats | None, track: Sequence[Floats]) -> tuple[float, float]:
        """Return how far a report is from the newest position of ``track``, and its speed from the last step, rad."""
        dt = self._smoother.dt
        step = inf
        if dq is not None:
            step = max([abs(x - y - dt * v) for x, y, v in zip(track[0], track[1], dq, strict=True)])
        return _apart(q, track[0]), step

    def _judge(self, reading: Reading, off: float) -> None:
        """Count a report that is ``off`` (rad) from what the device should report, if nothing else explains it."""
        q = reading.q_commanded
        assert q is not None
        off = min(off, *[_apart(q, given) for given in self._given])
        if off <= NOISIEST:
            self.error = max(self.error, off)
        elif _apart(q, reading.q) > _ROUNDED:  # else it reports measured positions as commanded ones
            self.mismatches += 1
            self._odd.append(self._cycle)
            while self._odd[0] <= self._cycle - _WINDOW:
                self._odd.popleft()
            if len(self._odd) > MISMATCHES:
                self._fail(q)

    def _fail(self, reported: Floats) -> None:
        sent = self._given[0]
        k = max(range(len(sent)), key=lambda i: abs(reported[i] - sent[i]))
        self.fault = Fault(
            "SETPOINT_MISMATCH",
            f"by its reports, the arm does not follow its set-points: {len(self._odd)} of {_WINDOW} reports fit none; "
            f"joint {k + 1} was sent {sent[k]:.6f} rad and reported {reported[k]:.6f} rad",
            "check that the arm reports the positions that it was commanded, each joint in its place, at most "
            f"{LATEST} cycles late and within {NOISIEST:g} rad, and that its network loses nothing",
        )

    def _state(self, track: Sequence[Floats]) -> Setpoint:
        """Position, speed and acceleration at the end of positions a cycle apart, newest first.

        Backward differences, as the device takes them: the speed between the last two is that half a cycle earlier.
        """
        smoother = self._smoother
        dt = smoother.dt
        dq, ddq = [], []
        for a, b, c, most in zip(*track[:3], smoother.acceleration, strict=True):
            acceleration = max(-most, min(most, (a - 2.0 * b + c) / (dt * dt)))
            ddq.append(acceleration)
            dq.append((a - b) / dt + 0.5 * dt * acceleration)
        return Setpoint(track[0], dq, ddq)

    def _allows(self, at: Setpoint) -> bool:
        """Return whether the arm can continue from here within the limits, or not farther outside than now."""
        smoother = self._smoother
        for q, v, a, q0, v0, a0, low, high, most, A, J in zip(
            *at[:3],
            *self._motion[:3],
            smoother.lower,
            smoother.upper,
            smoother.velocity,
            smoother.acceleration,
            smoother.jerk,
            strict=True,
        ):
            if abs(v + 0.5 * a * abs(a) / J) > max(_OVERSPEED * most, abs(v0 + 0.5 * a0 * abs(a0) / J)):
                return False
            if q + stop_peak(v, a, A, J) > max(high + _OVERSHOOT, q0 + stop_peak(v0, a0, A, J)):
                return False
            if q - stop_peak(-v, -a, A, J) < min(low - _OVERSHOOT, q0 - stop_peak(-v0, -a0, A, J)):
                return False
        return True

    def _resume(self, reading: Reading) -> bool:
        """Handle the first reading after a silence: if the arm is not at its set-point, start at rest from where it is.

        The arm stopped by itself, or is doing so. A set-point at rest brakes an arm that still moves, while one that
        began at a speed in a single bad reading would run away, with the dead-man released as well.
        """
        withheld = self._withheld
        self._silent = self._withheld = False
        self._away = 0
        q, allowed = reading.q_commanded, _ROUNDED
        if q is None:
            q, allowed = reading.q, _AWAY
        elif withheld:  # it has surely not moved
            q, allowed = self.start_position(q), 0.0
        if _apart(q, self._motion[0]) <= allowed:
            self._note_taken()
            return False
        self._smoother.anchor(q)
        self.forget()
        return True


def _extrapolate(track: list[Floats], cycles: int) -> list[Floats]:
    """Return positions a cycle apart, newest first, extended by ``cycles`` at constant acceleration, rad."""
    for _ in range(cycles):
        track = [[3.0 * (a - b) + c for a, b, c in zip(*track[:3], strict=True)], *track]
    return track


def _apart(a: Floats, b: Floats) -> float:
    return max([abs(x - y) for x, y in zip(a, b, strict=True)])
