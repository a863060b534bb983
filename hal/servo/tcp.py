"""What can be said about the tcp without computing it anew: where it was a moment ago, and how far it can have got.

Forward kinematics and a Jacobian in every tick would cost more than all the rest of it. Most ticks need neither: the
tcp is nowhere near a face of the workspace or its greatest speed, and a bound that costs a few multiplications proves
it. Only where the bound does not are they computed.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import inf

from ..kinematics import Kinematics
from ..specs import WorkspaceSpec
from .limits import stop_displacement
from .smoothing import JointSmoother

__all__ = ["TcpReference"]

Floats = Sequence[float]

_SAME = 2e-3
"""The Jacobian is computed anew when the tcp may have moved this far, m: it errs by 2 mm/s per rad/s."""


class TcpReference:
    """The tcp at a joint position nearby."""

    def __init__(self, smoother: JointSmoother, kinematics: Kinematics, workspace: WorkspaceSpec | None) -> None:
        self._smoother = smoother
        self._kinematics = kinematics
        self._workspace = workspace
        self._reach = kinematics.reach()
        self._at: Floats = ()
        self._jacobian: list[list[float]] = []
        self._clearance = inf
        """Distance of the tcp from the nearest face of the workspace, m; negative outside."""
        self._stops: list[tuple[float, float, float]] = []
        self._still = 0.0
        self._step = 0.0
        """Farthest that one tick can move the tcp, and the end of its stop, m."""
        self._proof: Floats = ()
        """The set-point from which the next step was proven to be inside."""

    def open(self, velocity: Floats) -> None:
        """A session begins whose joints keep below ``velocity`` (n,), rad/s."""
        smoother = self._smoother
        self._stops = []
        self._still = self._step = 0.0
        self._proof = ()
        # The way of a stop is convex in the speed, so its chord from rest to the greatest speed lies above it; the
        # acceleration at which the stop begins is taken to be the worst.
        for reach, cap, A, J in zip(self._reach, velocity, smoother.acceleration, smoother.jerk, strict=True):
            rest, full = stop_displacement(0.0, A, A, J), stop_displacement(cap, A, A, J)
            self._still += reach * rest
            slope = reach * (full - rest) / cap
            self._stops.append((reach, cap, slope))
            # Twice, for a joint that for a moment is a little faster than the session allows.
            self._step += 2.0 * (reach * cap + slope * A) * smoother.dt

    def forget(self) -> None:
        """Compute it anew next time."""
        self._at = ()

    def velocity(self, dq: Floats) -> list[float]:
        """Linear velocity (3,) in m/s of the tcp when the joints of the set-point move so, along the base's axes."""
        if not self._at or self._moved(self._smoother.q) > _SAME:
            self._look()
        return [sum([j * v for j, v in zip(row, dq, strict=True)]) for row in self._jacobian]

    def surely_slower(self, dq: Floats, cap: float) -> bool:
        """Does the tcp keep below ``cap`` (m/s) when the joints move so? False: not proven."""
        bound = 0.0
        for reach, v in zip(self._reach, dq, strict=True):
            bound += reach * v if v > 0.0 else -reach * v
        if bound <= cap:
            return True
        if not self._at:
            self._look()
        x, y, z = (sum([j * v for j, v in zip(row, dq, strict=True)]) for row in self._jacobian)
        rest = cap - self._moved(self._smoother.q) * sum(map(abs, dq))
        return rest > 0.0 and x * x + y * y + z * z <= rest * rest

    def surely_inside(self, margin: float) -> bool:
        """Would the tcp, stopped now, stay ``margin`` (m) off every face of the workspace? False: not proven."""
        smoother = self._smoother
        margin = max(margin, self._step)
        proven = self._proven(margin)
        if not proven and (not self._at or self._moved(smoother.q) > _SAME):  # look again from here before giving up
            self._look()
            proven = self._proven(margin)
        self._proof = smoother.q if proven else ()
        return proven

    def surely_stays_inside(self) -> bool:
        """Does a stop after the step that is proposed end inside the workspace? False: not proven."""
        return self._proof is self._smoother.q or self.surely_inside(0.0)

    def _proven(self, margin: float) -> bool:
        if not self._at:
            return False
        # Clearance where the reference is, less the way from there and that of the stop.
        left = self._clearance - self._still - margin
        smoother = self._smoother
        state = zip(smoother.q, self._at, smoother.dq, self._stops, strict=True)
        for q, at, v, (reach, cap, slope) in state:
            if not -cap <= v <= cap:
                return False
            left -= reach * abs(q - at) + slope * abs(v)
        return left > 0.0

    def _moved(self, q: Floats) -> float:
        """Greatest distance in m between the tcp at ``q`` and that of the reference."""
        if not self._at:
            return inf
        total = 0.0
        for reach, x, at in zip(self._reach, q, self._at, strict=True):
            total += reach * (x - at) if x > at else reach * (at - x)
        return total

    def _look(self) -> None:
        q = self._smoother.q
        self._at = list(q)
        self._jacobian = self._kinematics.jacobian(q)[:3].tolist()
        box = self._workspace
        if box is not None:
            at = self._kinematics.fk(q)
            sides = zip(at, box.lower, box.upper, strict=False)
            self._clearance = min([min(x - low, high - x) for x, low, high in sides])
