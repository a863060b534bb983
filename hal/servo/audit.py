"""Check of the set-points that a driver was given, by backward differences, independent of the servo."""

from __future__ import annotations

from collections.abc import Sequence
from math import inf, isnan

import numpy as np
from numpy.typing import NDArray

from ..driver import Setpoint
from ..specs import LimitsSpec

_HISTORY = 3
"""Differences up to the third need three samples before the one that they belong to."""
_TORQUE_RATE = 1000.0
"""Greatest rate of a torque, Nm/s: what a Franka's interface takes."""
_BATCH = 128
"""Number of samples that are checked at a time: one by one they would cost the servo's loop fifty times as much."""


class SetpointAudit:
    """Peaks of a stream of joint set-points, as ratios of the limits; constant memory.

    Velocity, acceleration and jerk are backward differences over ``dt``: at 1 or below the limit was kept. Position is
    the distance from the middle of the range as a share of half the range: at 1 or below the joint was inside.

    An arm that is driven by torques has no such set-points: there the torques, and their rates, are what is judged.
    """

    def __init__(self, limits: LimitsSpec, dt: float) -> None:
        lower, upper = np.array(limits.lower), np.array(limits.upper)
        self._middle = 0.5 * (lower + upper)
        # Each turns a plain difference of positions into a ratio of its limit.
        self._half_range = 0.5 * (upper - lower)
        self._limits = [
            dt * np.array(limits.velocity),
            dt * dt * np.array(limits.acceleration),
            dt * dt * dt * np.array(limits.jerk),
        ]
        self._peaks = [0.0] * 4
        self._torque_limits = None if limits.torque is None else np.array(limits.torque)
        self._torque_step = _TORQUE_RATE * dt
        self._torque_peaks: list[float] = []
        """Peaks of torque and of its rate; empty before the first torques."""
        self._tau: NDArray[np.float64] = np.empty(0)
        """The last torques that were judged, Nm; empty at the beginning of a stream of them."""
        self._pending_tau: list[float] = []
        self._history: NDArray[np.float64] = np.empty((0, len(lower)))
        self._pending: list[float] = []
        self._full = _BATCH * len(lower)

    def reset(self) -> None:
        """Forget the history, not the peaks: the next sample begins a new stream (a reset of the world)."""
        self._judge()
        self._judge_torques()
        self._history = self._history[:0]
        self._tau = np.empty(0)

    def add_setpoint(self, setpoint: Setpoint) -> None:
        """Add a set-point of any kind, as it was handed to the driver."""
        if setpoint.tau is None:
            if self._pending_tau or len(self._tau):  # positions start again from where torques moved the arm
                self.reset()
            self.add(setpoint.q)
            return
        self._pending_tau.extend(setpoint.tau)
        if len(self._pending_tau) >= self._full:
            self._judge_torques()

    def _judge_torques(self) -> None:
        if not self._pending_tau:
            return
        tau = np.array(self._pending_tau, float).reshape(-1, len(self._middle))
        self._pending_tau = []
        before = self._tau if len(self._tau) else np.zeros(len(self._middle))
        self._tau = tau[-1]
        torque = rate = inf
        if self._torque_limits is not None and np.isfinite(tau).all():
            torque = float((np.abs(tau) / self._torque_limits).max())
            rate = float(np.abs(np.diff(tau, axis=0, prepend=before[None])).max()) / self._torque_step
        peaks = self._torque_peaks or [0.0, 0.0]
        self._torque_peaks = [max(peaks[0], torque), max(peaks[1], rate)]

    def add(self, q: Sequence[float]) -> None:
        """Add joint positions (n,), rad, as they were handed to the driver."""
        self._pending.extend(q)
        if len(self._pending) >= self._full:
            self._judge()

    def _judge(self) -> None:
        if not self._pending:
            return
        new = np.array(self._pending, float).reshape(-1, len(self._middle))
        self._pending = []
        self._raise_to(0, new - self._middle, self._half_range)
        samples = np.concatenate([self._history, new])
        # The first samples of a stream have no past: a leap to where it begins is not a motion.
        count = len(samples) - max(len(self._history), _HISTORY)
        if count > 0:
            differences = samples
            for order, limit in enumerate(self._limits, start=1):
                differences = differences[1:] - differences[:-1]
                self._raise_to(order, differences[-count:], limit)
        self._history = samples[-_HISTORY:]

    def _raise_to(self, which: int, values: NDArray[np.float64], limit: NDArray[np.float64]) -> None:
        ratio = float((np.abs(values).max(axis=0) / limit).max())
        if not ratio <= self._peaks[which]:
            self._peaks[which] = inf if isnan(ratio) else ratio

    def peaks(self) -> dict[str, float]:
        """Return the greatest ratios so far: ``velocity``, ``acceleration``, ``jerk``, ``position``.

        Also ``torque`` and ``torque_rate`` if there were torques.
        """
        self._judge()
        self._judge_torques()
        position, velocity, acceleration, jerk = self._peaks
        peaks = {"velocity": velocity, "acceleration": acceleration, "jerk": jerk, "position": position}
        return peaks | dict(zip(("torque", "torque_rate"), self._torque_peaks, strict=False))
