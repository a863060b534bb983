"""What moves: the arm behind the controller. It takes desired motion or torques every millisecond and is measured."""

from __future__ import annotations

from abc import ABC, abstractmethod
from math import exp

from .model import RigidBody
from .samples import DT, Floats, Sample

__all__ = ["VISCOUS", "IdealPlant", "LaggingPlant", "Plant"]

VISCOUS = (0.5, 0.5, 0.5, 0.5, 0.2, 0.2, 0.2)
"""What is left of joint friction after the robot's own compensation, Nm s/rad. Chosen here."""
_COULOMB = (0.1, 0.1, 0.1, 0.1, 0.05, 0.05, 0.05)
"""The same of Coulomb's kind, Nm."""
_STICKING = 1e-3
"""rad/s, below which Coulomb's friction is like a viscous one."""


class Plant(ABC):
    """An arm. ``q`` rad, ``dq`` rad/s and ``tau`` Nm, each (7,), are what its sensors show."""

    def __init__(self, body: RigidBody, q: Floats) -> None:
        self.body = body
        self.q: Floats = tuple(q)
        self.dq: Floats = (0.0,) * 7
        self.tau: Floats = body.torques(self.q, self.dq, self.dq)

    def place(self, q: Floats) -> None:
        """Stand at ``q`` (7,), rad, from now on."""
        self.q, self.dq = tuple(q), (0.0,) * 7
        self.tau = self.body.torques(self.q, self.dq, self.dq)

    @abstractmethod
    def follow(self, desired: Sample) -> None:
        """Go on for one cycle under the robot's own joint controller."""

    def push(self, torques: Floats) -> None:
        """Go on for one cycle under the client's torques (7,), Nm; the robot carries the arm's weight."""
        friction = [a + b / (abs(v) + _STICKING) for a, b, v in zip(VISCOUS, _COULOMB, self.dq, strict=True)]
        self.dq = self.body.step(self.q, self.dq, torques, friction, DT)
        self.q = [p + v * DT for p, v in zip(self.q, self.dq, strict=True)]
        gravity = self.body.torques(self.q, (0.0,) * 7, (0.0,) * 7)
        self.tau = [a + b for a, b in zip(gravity, torques, strict=True)]

    def close(self) -> None:  # noqa: B027  # most have nothing to let go of
        """Let go of what it holds."""


class IdealPlant(Plant):
    """Is where it is told to be, at once."""

    _last: Sample | None = None

    def place(self, q: Floats) -> None:
        super().place(q)
        self._last = None

    def follow(self, desired: Sample) -> None:
        if desired is self._last:
            return
        self._last = desired
        self.q, self.dq = desired.q, desired.dq
        self.tau = self.body.torques(desired.q, desired.dq, desired.ddq)

    def push(self, torques: Floats) -> None:
        self._last = None
        super().push(torques)


class LaggingPlant(Plant):
    """Follows with a first-order lag of ``lag`` s, as a stiff joint controller does roughly."""

    def __init__(self, body: RigidBody, q: Floats, lag: float) -> None:
        super().__init__(body, q)
        self._share = 1.0 - exp(-DT / lag)

    def follow(self, desired: Sample) -> None:
        before, speed = self.q, self.dq
        self.q = [p + (goal - p) * self._share for p, goal in zip(before, desired.q, strict=True)]
        self.dq = [(new - old) / DT for new, old in zip(self.q, before, strict=True)]
        ddq = [(new - old) / DT for new, old in zip(self.dq, speed, strict=True)]
        self.tau = self.body.torques(self.q, self.dq, ddq)
