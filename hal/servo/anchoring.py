"""Compare what the device reports with what it was given, and correct the smoother where a set-point was lost.

**A report never moves the set-point by itself.** It only selects what happened, out of a few things that are computed
from the set-points that were given:

* the device took the set-point, maybe so many cycles ago (*lag*) and with so much *noise*: nothing is done;
* a set-point was lost, and the device continued at constant acceleration, as a Franka does: the smoother continues from
  there, as computed here, not as reported;
* nothing explains the report: it is counted as a mismatch and changes nothing. Too many of those are a fault.

Lag and noise are learned in the first cycles of a session in which the set-point moves. Until then nothing is corrected
that a lag would explain. Three kinds of lost set-points change nothing: on a device whose reports come late, since a
correction would come late, too; on one with so much noise that the report does not show a loss clearly; and on one that
repeats the last set-point, since its report of a loss is the same as a late report.
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

__all__ = ["LATEST", "MISMATCHES", "NOISIEST", "Anchoring"]

Floats = Sequence[float]
LATEST = 5
"""Largest age of a report, cycles."""

NOISIEST = 1e-4
"""Largest distance of reports from the set-points, rad: noise, rounding and quantisation together."""

MISMATCHES = 20
"""More unexplained reports than this in :data:`_WINDOW` cycles are a fault."""

_LOSSES = 40
"""More lost set-points than this in :data:`_WINDOW` cycles are a fault: such a link cannot drive an arm."""

_WINDOW = 100
"""Cycles."""

_SAME = 2e-7
"""Set-points that differ less are the same, rad. An FR3 reports them in single precision, rounded by 1.2e-7 near pi;
at 1 kHz what is overlooked looks like a jerk of up to three times this over dt^3, 600 rad/s3."""

_CONTINUED = 4e-7
"""Largest distance between the report of a device that continued by itself and where that is computed to be, rad: two
roundings."""

_CLEAR = 4.0
"""One set-point explains a report if every other one is this many times as far from it. Noisy reports show a lost
set-point only if they are this many times the tolerance away from what was given."""

_SURE = 4
"""Number of consecutive reports that only one lag explains until it is accepted; the same for measured positions."""

_AWAY = 1e-2
"""After a silence, an arm this far from its set-point restarts from its measured position, rad (if it does not report
what it took)."""

_RESTED = 16
"""Number of readings of an arm at rest that are averaged, since starting from a noisy position is a step."""

_OVERSHOOT = 5e-3
"""A device that continued by itself may be so near to a limit that its stop ends this far beyond, rad."""

_OVERSPEED = 1.01
"""The same for its speed, as a share of the limit."""


class Anchoring:
    """Learns from its reports what one device does with its set-points; corrects the smoother of one arm."""

    def __init__(self, smoother: JointSmoother, repeats: bool = False) -> None:
        """Anchor one smoother; with ``repeats`` the device repeats a lost set-point, and no loss is corrected."""
        self._smoother = smoother
        self._repeats = repeats
        self.fault: Fault | None = None
        """Set if reports and set-points do not fit each other, until :meth:`recover`."""
        self._seq: int | None = None
        """Number of the last reading."""
        self._cycle = 0
        """Number of readings that were compared so far."""
        self._rest: list[float] = []
        """Position at which the device holds while nothing is streamed, rad: the mean of its last reports."""
        self._rested: Floats = ()
        """The last of these reports."""
        self._rests = 0
        self._steps = 0.0
        """Number of these reports, and the difference between two consecutive ones, rad."""
        self.reset_statistics()
        self.relearn()
        self.forget()

    def reset_statistics(self) -> None:
        """Set the counters to zero. What was learned stays."""
        self.mismatches = 0
        """Number of reports that were neither the set-point at the known lag nor a lost set-point that was corrected.
        """

    def relearn(self) -> None:
        """Learn again how the device reports: what was learned may be wrong, or the device another one."""
        self.lag: int | None = None
        """Age of the reports in cycles; None until it is known."""
        self.noise = 0.0
        """Largest difference between a report and the set-point that it shows, rad."""
        self.measured = False
        """Whether the device reports measured positions as commanded ones, which do not show what it took."""
        self._tolerance = _SAME
        self._hint = 0
        self._hints = 0
        """The lag that the last readings point to, and the number of such readings in a row."""
        self._doubt = 0.0
        """Largest distance (rad) of these readings from the set-points that they point to."""
        self._as_measured = 0
        self._odd: deque[tuple[int, float]] = deque()
        """Cycle and distance (rad) of the recent mismatches."""
        self._lost: deque[int] = deque()
        """Cycles of the recent lost set-points."""

    def recover(self) -> None:
        """Clear the fault, and learn again how the device reports."""
        self.fault = None
        self.relearn()

    def statistics(self) -> dict[str, Any]:
        """Return what is known of the device, as plain values."""
        if self.measured:
            reports = "measured positions"
        else:
            reports = "set-points" if self.lag is not None else "not known yet"
        return {
            "reports": reports,
            "report_lag": self.lag,
            "report_noise": self.noise,
            "mismatches": self.mismatches,
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
        # Newest first; the device may report any of these.
        self._given: deque[Floats] = deque([q] * (LATEST + 1), LATEST + 1)
        self._motion = Setpoint(q, smoother.dq, smoother.ddq)
        """The set-point that was given last."""
        self._at = self._motion
        """Where the device is, as far as is known: what it took last, or where it continued to."""
        steps = [smoother.dt * v for v in smoother.dq]
        self._track: deque[Floats] = deque(
            [[x - k * step for x, step in zip(q, steps, strict=True)] for k in range(3)], maxlen=3
        )
        """Where it was in the last three cycles, rad; the newest is that of ``_at``."""
        self._fresh = True
        """Whether nothing was given since."""
        self._starts = False
        """Whether the set-point that was given last is the first one of a motion that begins at rest."""
        self._waits = 0
        """Number of cycles for which a motion that begins has waited for the device."""
        self.waiting = False
        """Whether the set-point is to stay in this cycle."""
        self._last: Reading | None = None
        self._before: Reading | None = None
        """The last reading and the one before."""
        self._silent = False
        """Whether the device may have stopped anywhere."""
        self._withheld = False
        """Whether the driver held the last set-point back."""
        self._away = 0
        """Cycles since the device answered last."""

    def note_given(self, setpoint: Setpoint) -> None:
        """Note that this set-point is written to the device."""
        before, self._motion = self._motion, setpoint
        self._starts = not (any(before[1]) or any(before[2]))
        self._given.appendleft(setpoint[0])
        self._fresh = False

    def note_withheld(self) -> None:
        """Note that the driver did not pass the last set-point on: the device is where it reports to be."""
        self._silent = self._withheld = True

    def note_silence(self) -> None:
        """Note that the device did not answer in this cycle. It stops by itself if that lasts."""
        self._away += 1
        if self._away * self._smoother.dt >= SILENCE:
            self._silent = True

    def check_report(self, reading: Reading, device: Trip) -> bool:
        """Compare a reading with what was given.

        Args:
            reading: The newest reading.
            device: The trip that the device causes.

        Returns:
            Whether the smoother was corrected.
        """
        last, self._seq = self._seq, reading.seq
        if device or self._fresh or reading.seq == last:
            self._pass_over(device)
            return False
        self._cycle += 1
        self._away = 0
        if self._silent:
            return self._resume(reading)
        q = reading.q_commanded
        if q is None or self.measured:
            return False
        corrected = self._compare(reading, q, last)
        self._before, self._last = self._last, reading
        return corrected

    def _compare(self, reading: Reading, q: Floats, last: int | None) -> bool:
        lag, given = self.lag, self._given
        if q is given[0] and lag == 0:
            self._took()
            return False
        if self._starts:
            if not lag and self._wait(q):
                return True
        else:
            self._waits = 0
        if lag is not None:
            off = _apart(q, given[lag])
            if off <= self._tolerance:
                if off > self.noise:
                    self.noise = off
                self._took()
                self._hints = self._as_measured = 0
                return False
        elif q is given[0] is not given[1]:  # it reports the very object
            self.lag = 0
            self._took()
            return False
        return self._explain(reading, q, 1 if last is None else max(1, reading.seq - last))

    def _pass_over(self, device: Trip) -> None:
        """Skip a reading that shows nothing of the last set-point."""
        if self._fresh:
            return
        if self.fault is not None or device is Trip.BAD_READING:
            self._cycle += 1
            self._took()  # nothing else is known
        elif device is Trip.FAULT:
            self._silent = True
        else:
            self.note_silence()  # it is an old one

    def _took(self) -> None:
        """Note that the device has what it was given last."""
        self._at = motion = self._motion
        self._track.appendleft(motion[0])

    def _wait(self, q: Floats) -> bool:
        """Return whether the set-point waits in this cycle: a motion begins, and the device reports that it rests.

        It lost the set-point, or its reports are late. In both cases the smallest step from rest may be repeated, and
        the motion may begin again from there.
        """
        given, rests = self._given[0], self._track[0]
        before = None if self._last is None else self._last.q_commanded
        if self._waits >= LATEST or given == rests:
            return False
        if _apart(q, before or rests) > min(_SAME, 0.5 * _apart(q, given)) or _apart(q, rests) > _SAME:
            return False
        self._waits += 1
        self._smoother.anchor(given)
        self._motion = Setpoint(given, self._smoother.dq, self._smoother.ddq)
        self.waiting = True
        return True

    def _explain(self, reading: Reading, q: Floats, cycles: int) -> bool:
        """Explain a report that is not the set-point at the known lag; ``cycles`` since the last reading."""
        apart = [_apart(q, sent) for sent in self._given]
        nearest = min(apart)
        lag = self.lag
        explained = nearest <= self._tolerance if lag is None else lag > 0
        if not explained and self._continued(q, reading.dq_commanded, cycles, apart):
            self.lag = 0
            return self._correct(q)
        self._took()
        self._learn(apart, nearest)
        if lag is None and nearest <= self._tolerance:
            return False
        if self.lag == lag:
            if _apart(q, reading.q) <= _SAME:
                self._as_measured += 1
                self.measured = self._as_measured >= _SURE
            if self._repeats and nearest <= self._tolerance:  # an older set-point: this one is lost, or the report late
                self.mismatches += 1
                self._count_lost(q)
            else:
                self._mismatch(reading, nearest if lag is None else apart[lag])
        return False

    def _learn(self, apart: Sequence[float], nearest: float) -> None:
        """Learn which lag this report points to, if only one explains it."""
        others = sorted(apart)[1]
        if nearest > NOISIEST or others < _CLEAR * max(nearest, _SAME):
            return
        lag = apart.index(nearest)
        self._hints = self._hints + 1 if lag == self._hint else 1
        self._hint = lag
        self._doubt = max(nearest, self._doubt) if self._hints > 1 else nearest
        if self._hints >= _SURE:
            self.lag = lag
            self.noise = max(self.noise, self._doubt)
            self._tolerance = max(self._tolerance, min(2.0 * self._doubt, NOISIEST))

    def _mismatch(self, reading: Reading, off: float) -> None:
        """Count a report that nothing explains, and that is ``off`` (rad) from the set-point."""
        self.mismatches += 1
        if self.measured:
            return
        odd = self._odd
        odd.append((self._cycle, off))
        while odd[0][0] <= self._cycle - _WINDOW:
            odd.popleft()
        if len(odd) <= MISMATCHES:
            return
        worst = max(distance for _, distance in odd)
        odd.clear()
        if worst <= NOISIEST:  # it is only noise, more than was thought
            self.noise = max(self.noise, worst)
            self._tolerance = min(2.0 * worst, NOISIEST)
        else:
            self._fail(reading.q_commanded, f"{MISMATCHES + 1} of {_WINDOW} reports fit no set-point")

    def _fail(self, reported: Floats | None, what: str) -> None:
        sent = self._given[0]
        detail = ""
        if reported is not None and len(reported) == len(sent):
            k = max(range(len(sent)), key=lambda i: abs(reported[i] - sent[i]))
            detail = f": joint {k + 1} was sent {sent[k]:.6f} rad and reported {reported[k]:.6f} rad"
        self.fault = Fault(
            "SETPOINT_MISMATCH",
            f"by its reports, the arm does not follow its set-points: {what}{detail}",
            "check that the arm reports the positions that it was commanded, each joint in its place, at most "
            f"{LATEST} cycles late and within {NOISIEST:g} rad, and that its network loses nothing",
        )

    # A set-point was lost.

    def _continued(self, q: Floats, dq: Floats | None, cycles: int, apart: Sequence[float]) -> bool:
        """Return whether the device continued by itself to here; then this is where it is from now on.

        ``apart`` holds the distances of ``q`` from each of the last set-points, rad.
        """
        off = apart[0]
        if self._repeats or (self._tolerance > _CONTINUED and off < _CLEAR * self._tolerance):
            return False
        limit = max(_CONTINUED if self.lag == 0 else _SAME, self._tolerance)
        dt = self._smoother.dt
        track, exact = self._refined()
        best = _continued(track, cycles)
        if cycles == 1 and exact and dq is not None:  # speeds distinguish a small loss from none, and from noise
            missed = max([abs(x - y - dt * v) for x, y, v in zip(best[0], track[0], dq, strict=True)])
            took = max([abs(x - y - dt * v) for x, y, v in zip(self._motion[0], track[0], dq, strict=True)])
            limit = limit if missed <= 0.25 * took else 0.0
        elif min(apart[1:]) <= self._tolerance:  # the report may be late
            return False
        else:
            limit = min(limit, 0.5 * off)
        if cycles > 1:  # it may have taken the set-point in the first of these: nothing is given without a reading
            best = min(best, _continued([self._motion[0], *track], cycles - 1), key=lambda track: _apart(q, track[0]))
        if _apart(q, best[0]) > limit or _apart(best[0], track[0]) <= _SAME:  # one that rests has begun no motion
            return False
        at = self._state(best)
        if not self._allows(at):
            return False
        self._at = at
        self._track.extendleft(reversed(best[:3]))
        return True

    def _refined(self) -> tuple[list[Floats], bool]:
        """Return where the device was, newest first, and whether its speeds confirm that.

        A loss may have been too small to be noticed. Speeds that are the differences of positions are more exact than
        these, which were rounded.
        """
        track, dt = list(self._track), self._smoother.dt
        refined: list[Floats] = [track[0]]
        for before, after, reading in zip(track[1:], track, (self._last, self._before), strict=False):
            dq = None if reading is None else reading.dq_commanded
            if dq is None or max([abs(y - x - dt * v) for x, y, v in zip(before, after, dq, strict=True)]) > _CONTINUED:
                return track, False
            refined.append([x - dt * v for x, v in zip(refined[-1], dq, strict=True)])
        return refined, True

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

    def _correct(self, q: Floats) -> bool:
        """Continue from where the device is; it reported ``q``."""
        if not self._count_lost(q):
            self._at = self._motion
            return False
        self._smoother.anchor(*self._at[:3])
        return True

    def _count_lost(self, q: Floats) -> bool:
        """Count a lost set-point after which the device reported ``q``.

        Returns:
            False, with the fault set, if there are too many.
        """
        lost = self._lost
        lost.append(self._cycle)
        while lost[0] <= self._cycle - _WINDOW:
            lost.popleft()
        if len(lost) > _LOSSES:
            self._fail(q, f"it lost, or reported late, {len(lost)} of {_WINDOW}")
            return False
        return True

    def _resume(self, reading: Reading) -> bool:
        """Handle the first reading after a silence: if the arm is not at its set-point, start at rest from where it is.

        The arm stopped by itself, or is doing so. A set-point at rest brakes an arm that still moves, while one that
        began at a speed in a single bad reading would run away, with the dead-man released as well.
        """
        withheld = self._withheld
        self._silent = self._withheld = False
        q_sent = self._motion[0]
        q, allowed = reading.q_commanded, self._tolerance
        if q is None or self.measured:
            q, allowed = reading.q, _AWAY
        if withheld:
            allowed = max(allowed, min(NOISIEST, 3.0 * self._steps))
        if _apart(q, q_sent) <= allowed:
            self._took()
            return False
        if not withheld:
            self._mismatch(reading, inf)
        self._smoother.anchor(q)
        self.forget()
        return True


def _continued(track: list[Floats], cycles: int) -> list[Floats]:
    """Return positions a cycle apart, newest first, extended by ``cycles`` at constant acceleration, rad."""
    for _ in range(min(cycles, MISMATCHES)):
        track = [[3.0 * (a - b) + c for a, b, c in zip(*track[:3], strict=True)], *track]
    return track


def _apart(a: Floats, b: Floats) -> float:
    return max([abs(x - y) for x, y in zip(a, b, strict=True)])
