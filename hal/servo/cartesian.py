"""Commands for the tcp, made into one tick of joint motion each: twists and poses.

Inverse kinematics runs here, once per tick, seeded from the set-point, so that a clamp or a trip never leaves a goal
behind that has run away. Saturation scales the whole motion: the tcp keeps its direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import isfinite, sqrt

from ..inbox import CommandRecord
from ..quaternion import after_rotation, difference, rotate
from ..types import Limited
from .envelope import Envelope
from .limits import speed_for
from .motions import Motion
from .smoothing import JointSmoother

__all__ = ["PoseMotion", "TwistMotion"]

Floats = Sequence[float]

FIRST_STEP = (0.05, 0.2)
"""A first pose farther than this from the set-point is refused, m and rad."""

_LEAD = (0.05, 0.2)
"""How far a goal may run ahead of the set-point, m and rad."""

_POSE_GAIN = 8.0
"""Speed per error of a pose target, 1/s."""

_TWIST_GAIN = 3.0
"""Speed per drift from the commanded path of a twist, 1/s: slow enough not to be felt as a motion of its own."""

_QUIET = (0.005, 0.02)
"""Below these speeds (m/s, rad/s) a part of the motion that is not commanded any more counts as stopped."""

_POSTURE = 0.5
"""Pull of the posture while the tcp moves, 1/s; it fades with the tcp's speed, so that a still tcp is a still arm."""

_POSTURE_FULL = 0.05
"""Speed (m/s, or rad/s) of the tcp from which on the posture is pulled in full."""

_BRAKE = (0.8, 0.5)
"""Shares of acceleration and jerk with which a pose's approach brakes."""


class _CartesianMotion(Motion):
    """What twists and poses share."""

    def _follow_twist(self, twist: list[float]) -> None:
        """One tick towards this twist (6,) of the tcp, along the base's axes."""
        envelope, smoother = self.envelope, self.smoother
        speed = max(_norm(twist[:3]), _norm(twist[3:]))
        posture = _POSTURE * min(1.0, speed / _POSTURE_FULL)
        dq, singular = envelope.kinematics.velocity(smoother.q, twist, posture)
        if singular:
            envelope.limited |= Limited.SINGULAR
        if not isfinite(sum(dq)):
            dq = [0.0] * smoother.n
        self._follow(envelope.cap_together(self._brake(dq)), together=True)

    def _brake(self, dq: list[float]) -> list[float]:
        """Slow the joint speeds (n,) down where the goal is near."""
        return dq

    def _cap(self, twist: list[float]) -> list[float]:
        """A twist (6,) cut to the tcp speed as a whole, and its linear part to what the workspace leaves."""
        envelope = self.envelope
        speed = _norm(twist[:3])
        cap = envelope.goal_tcp_speed
        if speed > cap:
            envelope.limited |= Limited.TCP_SPEED
            twist = [x * cap / speed for x in twist]
        if envelope.workspace is not None:
            faces = envelope.face_speeds(twist[:3])
            linear = [max(-face, min(face, x)) for x, face in zip(twist[:3], faces, strict=True)]
            if linear != twist[:3]:
                envelope.limited |= Limited.WORKSPACE
                twist = linear + twist[3:]
        return twist


class TwistMotion(_CartesianMotion):
    """Move the tcp along a twist.

    The twist is integrated into a goal pose, so that the path stays straight and the orientation stays put although the
    joints lag and the inverse kinematics is only exact for small steps. The goal is never far ahead of the set-point,
    and none is kept for a part (translation, rotation) that was commanded until now: that part just stops.
    """

    size = 7

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        super().__init__(smoother, envelope)
        self._values: Floats = ()
        self._goal: list[float] = []
        self._held = [False, False]
        """Are the goal's position and orientation to be kept?"""

    def start(self) -> None:
        super().start()
        self._goal = []
        self._held = [True, True]

    def accept(self, command: CommandRecord) -> None:
        self._values = command.values

    def step(self, now: float) -> None:
        smoother, envelope = self.smoother, self.envelope
        if not any(self._values[:6]):
            smoother.follow([0.0] * smoother.n, envelope.stays_inside)
            self.start()
            return
        pose = envelope.kinematics.fk(smoother.q)
        if not self._goal:
            self._goal = list(pose)
        twist = [max(-1e3, min(1e3, x)) for x in self._values[:6]]
        if self._values[6]:
            twist = rotate(pose[3:], twist[:3]) + rotate(pose[3:], twist[3:])
        twist = self._cap(twist)
        self._advance(pose, twist)
        error = difference(pose, self._goal)
        error = self._shorten_lead(pose, error)
        self._follow_twist(self._cap([v + _TWIST_GAIN * e for v, e in zip(twist, error, strict=True)]))

    def _advance(self, pose: Floats, twist: list[float]) -> None:
        """Move the goal by one tick, part by part."""
        dt, goal = self.smoother.dt, self._goal
        linear, angular = twist[:3], twist[3:]
        for part, rate in enumerate((linear, angular)):
            if any(rate):
                self._held[part] = False
            elif not self._held[part]:  # still braking: wherever it comes to rest is the goal
                goal[3 * part : 3 + 4 * part] = pose[3 * part : 3 + 4 * part]
                self._held[part] = self._at_rest(part)
        goal[:3] = [x + dt * v for x, v in zip(goal[:3], linear, strict=True)]
        goal[3:] = after_rotation(goal[3:], [dt * w for w in angular])

    def _at_rest(self, part: int) -> bool:
        rows = self.envelope.kinematics.jacobian(self.smoother.q)[3 * part : 3 * part + 3]
        return _norm((rows @ self.smoother.dq).tolist()) < _QUIET[part]

    def _shorten_lead(self, pose: Floats, error: list[float]) -> list[float]:
        linear, angular = error[:3], error[3:]
        for part, lead in ((linear, _LEAD[0]), (angular, _LEAD[1])):
            distance = _norm(part)
            if distance > lead:
                part[:] = [x * lead / distance for x in part]
                self.envelope.limited |= Limited.LEAD
        if self.envelope.limited & Limited.LEAD:
            self._goal = [x + e for x, e in zip(pose, linear, strict=False)] + after_rotation(pose[3:], angular)
        return linear + angular


class PoseMotion(_CartesianMotion):
    """Bring the tcp to a pose, straight, translation and rotation at once; the joints brake in time."""

    size = 7

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        super().__init__(smoother, envelope)
        self._pose: Floats = ()
        self._rate = _POSE_GAIN
        """Speed per error in this tick, 1/s."""

    def usable(self, values: Floats) -> bool:
        return super().usable(values) and abs(_norm(values[3:]) - 1.0) < 1e-3

    def too_far(self, values: Floats) -> bool:
        error = difference(self.envelope.kinematics.fk(self.smoother.q), values)
        return _norm(error[:3]) > FIRST_STEP[0] or _norm(error[3:]) > FIRST_STEP[1]

    def accept(self, command: CommandRecord) -> None:
        self._pose = command.values

    def step(self, now: float) -> None:
        error = difference(self.envelope.kinematics.fk(self.smoother.q), self._pose)
        scale = 1.0
        for part, lead in ((error[:3], _LEAD[0]), (error[3:], _LEAD[1])):
            distance = _norm(part)
            if scale * distance > lead:
                scale = lead / distance
                self.envelope.limited |= Limited.LEAD
        twist = self._cap([_POSE_GAIN * scale * x for x in error])
        distance = _norm(error)
        self._rate = _norm(twist) / distance if distance > 0.0 else _POSE_GAIN
        self._follow_twist(twist)

    def _brake(self, dq: list[float]) -> list[float]:
        """Slow the whole motion to what the joint with the least reserve can still brake.

        At ``dq`` the goal would be reached in 1 / rate seconds, which tells how far each joint still has to go.
        """
        smoother = self.smoother
        slowest = 1.0
        for v, A, J in zip(dq, smoother.acceleration, smoother.jerk, strict=True):
            if v and self._rate > 0.0:
                cap = speed_for(abs(v) / self._rate, _BRAKE[0] * A, _BRAKE[1] * J)
                slowest = min(slowest, cap / abs(v))
        return dq if slowest == 1.0 else [slowest * v for v in dq]


def _norm(values: Floats) -> float:
    return sqrt(sum([x * x for x in values]))
