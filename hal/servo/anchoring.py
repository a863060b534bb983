"""Does the device follow the set-points it was given? If not, the smoother goes on from what the device says.

A device that misses a set-point goes on by its own rule (a Franka extrapolates with constant acceleration, others
repeat the last one) and reports what it took as ``q_commanded``. Going on from our own set-point would then be a jump.
"""

from __future__ import annotations

from collections.abc import Sequence

from ..robot import Reading
from .smoothing import JointSmoother

__all__ = ["Anchoring"]

Floats = Sequence[float]
Motion = tuple[Floats, Floats, Floats]
"""Positions, speeds and accelerations, rad, s."""

_SAME = 2e-7
"""Set-points that differ less are the same, rad. An FR3 reports them in single precision, rounded by 1.2e-7 near pi;
at 1 kHz what is overlooked looks like a jerk of up to three times this over dt^3, 600 rad/s3."""

_AWAY = 1e-2
"""After a silence, an arm this far from its set-point is taken from where it is, rad (when it cannot say what it
took)."""

_MOVES = 0.02
"""Measured speeds below this are noise, rad/s."""


class Anchoring:
    """Compares what the device took with what it was given, and corrects the smoother."""

    def __init__(self, smoother: JointSmoother) -> None:
        self._smoother = smoother
        self._written = False
        self._taken: tuple[Floats, Floats, Floats | None] | None = None
        """Speed and acceleration of our set-point that the device took last, and the speed it reported for it."""
        self._before: tuple[Floats, Floats | None] | None = None
        """``q_commanded`` and ``dq_commanded`` of the last reading."""
        self._seq: int | None = None
        """Number of the last reading."""
        self._silent = False

    def forget(self) -> None:
        """The smoother was anchored anew; what was written before does not matter any more."""
        self._written = False
        self._taken = None
        self._before = None
        self._silent = False

    def wrote(self) -> None:
        """The smoother's set-point goes to the device."""
        self._written = True

    def lose(self) -> None:
        """The device does not answer, or makes no sense: it may have stopped anywhere."""
        self._silent = True

    def look(self, reading: Reading, sound: bool, sent: Motion | None = None) -> bool:
        """Compare; True when the smoother was corrected. ``sound``: the reading can be trusted.

        ``sent`` is the set-point that the device was given last; the smoother's own when it has not gone on since.
        """
        if not sound:
            self._silent = True
            return False
        last, self._seq = self._seq, reading.seq
        if reading.seq == last or not self._written:  # one that is repeated knows nothing of the last set-point
            return False
        smoother = self._smoother
        q_sent, dq_sent, ddq_sent = (smoother.q, smoother.dq, smoother.ddq) if sent is None else sent
        if self._silent:
            self._silent = False
            return self._resume(reading, q_sent)
        q = reading.q_commanded
        if q is None:
            return False
        corrected = q is not q_sent and _apart(q, q_sent) > _SAME
        if corrected:
            cycles = 1 if last is None else max(1, reading.seq - last)  # more where samples were lost
            dq, ddq = self._device_motion(reading, cycles)
            smoother.anchor(q, dq, ddq)
        else:
            self._taken = (dq_sent, ddq_sent, reading.dq_commanded)
        self._before = (q, reading.dq_commanded)
        return corrected

    def _resume(self, reading: Reading, q_sent: Floats) -> bool:
        """The first reading after a silence: go on from where the arm is, at the speed that was measured, if any."""
        self._taken = self._before = None
        q, allowed = (reading.q, _AWAY) if reading.q_commanded is None else (reading.q_commanded, _SAME)
        if _apart(q, q_sent) <= allowed:
            return False
        moves = max(map(abs, reading.dq)) > _MOVES
        self._smoother.anchor(q, reading.dq if moves else None)
        return True

    def _device_motion(self, reading: Reading, cycles: int) -> tuple[Floats, Floats]:
        """Speed and acceleration to go on with, so that the *device's* sequence keeps the limits.

        A device that repeats its last set-point gets the missed one again, in effect. Otherwise the acceleration is
        the difference of the last two speeds that the device commanded: with that it will compare ours. As to the
        speed, some devices report that at the set-point, some the backward difference, which is the speed half a tick
        earlier; the set-point that was taken last tells which, because there our own speed is known.
        """
        smoother = self._smoother
        dt = smoother.dt
        dq = reading.dq_commanded
        still: Floats = [0.0] * smoother.n
        if self._taken is None or self._before is None or reading.q_commanded is None:
            return (still if dq is None else dq), still
        own, own_ddq, reported = self._taken
        q_before, dq_before = self._before
        if _apart(reading.q_commanded, q_before) <= _SAME:
            return own, own_ddq
        if dq is None or dq_before is None or reported is None:
            return own, still
        limits = smoother.acceleration
        ddq = [max(-A, min(A, (v - v0) / (cycles * dt))) for v, v0, A in zip(dq, dq_before, limits, strict=True)]
        at_point = sum(abs(v - v0) for v, v0 in zip(own, reported, strict=True))
        half_before = sum(abs(v - 0.5 * dt * a - v0) for v, a, v0 in zip(own, own_ddq, reported, strict=True))
        if half_before < at_point:
            dq = [v + 0.5 * dt * a for v, a in zip(dq, ddq, strict=True)]
        return dq, ddq


def _apart(a: Floats, b: Floats) -> float:
    return max(abs(x - y) for x, y in zip(a, b, strict=True))
