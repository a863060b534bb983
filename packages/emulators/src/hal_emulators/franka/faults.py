"""Faults of the robot and its network that can be injected by the commands in :mod:`.console`."""

from __future__ import annotations

import random
from collections import deque

from hal_emulators.lines import Losses

from .motion import DT, Floats, MotionSample

_SWING = 0.08
"""Share of its distance from the set-point by which an arm in unrest moves back and forth, a cycle each."""


class SetpointReports:
    """How the arm reports its set-points: correctly, unless a fault is injected."""

    MAX_LAG = 10
    """Largest delay, cycles."""

    def __init__(self, seed: int = 0) -> None:
        self._random = random.Random(seed)
        self._samples: deque[MotionSample] = deque(maxlen=self.MAX_LAG + 1)
        self.clear()

    def clear(self) -> None:
        self.lag = 0
        self.noise = 0.0
        self.measured = False

    def shown(self, sample: MotionSample, q: Floats, dq: Floats) -> MotionSample:
        """Return the set-point that is reported of this cycle's, at the measured ``q`` and ``dq``."""
        self._samples.appendleft(sample)
        if self.measured:
            sample = MotionSample(q, dq, sample.ddq)
        elif self.lag:
            sample = self._samples[min(self.lag, len(self._samples) - 1)]
        if self.noise:
            sample = sample._replace(q=[x + self._random.gauss(0.0, self.noise) for x in sample.q])
        return sample


class Unrest:
    """Keeps an arm that is held by positions from settling: friction, and errors in the model of its weight."""

    def __init__(self) -> None:
        self._offsets: Floats = ()
        self._swing = _SWING

    def set(self, seed: int | None) -> None:
        """Choose how far each joint is off, 0.1 to 1 mrad to either side; None ends the unrest."""
        generator = random.Random(seed)
        signs = () if seed is None else range(7)
        self._offsets = [generator.choice((-1.0, 1.0)) * generator.uniform(1e-4, 1e-3) for _ in signs]

    def shifted(self, sample: MotionSample) -> MotionSample:
        """Return where the arm is held in this cycle in place of ``sample``."""
        if not self._offsets:
            return sample
        self._swing = swing = -self._swing
        return MotionSample(
            [q + (1.0 + 0.5 * swing) * off for q, off in zip(sample.q, self._offsets, strict=True)],
            [dq + swing * off / DT for dq, off in zip(sample.dq, self._offsets, strict=True)],
            sample.ddq,
        )


class InjectedFaults:
    def __init__(self, seed: int) -> None:
        self.states, self.commands = Losses(seed), Losses(seed + 1)
        self.clear()

    def clear(self) -> None:
        self.states.clear()
        self.commands.clear()
        self.silent_until = 0.0
        """End of a silence on the monotonic clock, s."""
        self.truncate = False
        self.slow_reply = 0.0
        self.version = 0
