"""Motions of the tcp: twists and poses.

Inverse kinematics runs here, once per tick, seeded from the set-point, so that a clamp or a trip never leaves a goal
behind that has run away. Saturation scales the whole motion: the tcp keeps its direction.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import hypot, isfinite

from ..commands import FIRST_STEP_DISTANCE, FIRST_STEP_TURN, CommandRecord
from ..geometry import apply_rotation, difference, rotate
from ..types import Limited
from .envelope import Envelope
from .joint import ServoMotion
from .smoothing import JointSmoother, speed_for

Floats = Sequence[float]

_LEAD = (0.05, 0.2)
"""How far a goal may run ahead of the set-point, m and rad."""

_POSE_GAIN = 8.0
"""Speed per error of a pose target, 1/s."""

_TWIST_GAIN = 3.0
"""Speed per drift from the commanded path of a twist, 1/s: slow enough not to be felt as a motion of its own."""

_QUIET = (0.005, 0.02)
"""Below these speeds (m/s, rad/s) a part of the motion that is not commanded any more counts as stopped."""

_ABSURD = 1e3
"""Twists are cut to this, m/s and rad/s, so that their squares stay finite."""

_POSTURE = 0.5
"""Pull of the posture while the tcp moves, 1/s; it fades with the tcp's speed, so that a still tcp is a still arm."""

_POSTURE_FULL = 0.05
"""Speed (m/s, or rad/s) of the tcp from which on the posture is pulled in full."""

_BRAKE = (0.8, 0.5)
"""Shares of acceleration and jerk with which a pose's approach brakes."""


class _CartesianMotion(ServoMotion):
    """Base class of twists and poses."""

    cartesian = True

    def _follow_twist(self, twist: list[float]) -> None:
        """Follow a twist (6,) of the tcp for one tick, along the base's axes, m/s and rad/s."""
        envelope, smoother = self.envelope, self.smoother
        speed = max(hypot(*twist[:3]), hypot(*twist[3:]))
        posture = _POSTURE * min(1.0, speed / _POSTURE_FULL)
        dq, near_singular = envelope.kinematics.velocity(smoother.q, twist, posture, envelope.pose_and_jacobian()[1])
        if near_singular:
            envelope.limited |= Limited.SINGULAR
        if not isfinite(sum(dq)):
            dq = [0.0] * smoother.n
        self._follow(envelope.cap_together(self._brake(dq)), together=True)

    def _brake(self, dq: list[float]) -> list[float]:
        """Return joint speeds (n,) slowed down near the goal, rad/s."""
        return dq

    def _cap(self, twist: list[float]) -> list[float]:
        """Return a twist (6,) cut to the tcp speed as a whole, and its linear part to what the workspace leaves."""
        envelope = self.envelope
        speed = hypot(*twist[:3])
        cap = envelope.goal_tcp_speed
        if speed > cap:
            envelope.limited |= Limited.TCP_SPEED
            twist = [x * cap / speed for x in twist]
        if not envelope.far_from_faces():
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
        self._twist: list[float] = []
        """The commanded twist (6,), m/s and rad/s."""
        self._along_tcp: float = 0.0
        """Whether it is along the axes of the tcp (not 0)."""
        self._moving = False
        """Whether it is not 0."""
        self._goal: list[float] = []
        self._held = [False, False]
        """Whether the goal's position and orientation are held."""

    def start(self) -> None:
        super().start()
        self._goal = []
        self._held = [True, True]

    def accept(self, command: CommandRecord) -> None:
        *twist, self._along_tcp = command.values
        if hypot(*twist) > _ABSURD:
            twist = [max(-_ABSURD, min(_ABSURD, x)) for x in twist]
        self._twist = twist
        self._moving = any(twist)

    def step(self, now: float) -> None:
        envelope = self.envelope
        if not self._moving:
            self.smoother.settle(envelope.guard)
            self.start()
            return
        pose, _ = envelope.pose_and_jacobian()
        if not self._goal:
            self._goal = list(pose)
        twist = self._twist
        if self._along_tcp:
            twist = rotate(pose[3:], twist[:3]) + rotate(pose[3:], twist[3:])
        twist = self._cap(twist)
        self._advance(pose, twist)
        error = difference(pose, self._goal)
        error = self._shorten_lead(pose, error)
        self._follow_twist(self._cap([v + _TWIST_GAIN * e for v, e in zip(twist, error, strict=True)]))

    def _advance(self, pose: Floats, twist: list[float]) -> None:
        """Move the goal by one tick, position and orientation separately."""
        dt, goal = self.smoother.dt, self._goal
        angular = twist[3:]
        for part, rate in enumerate((twist[:3], angular)):
            if any(rate):
                self._held[part] = False
            elif not self._held[part]:  # still braking: wherever it comes to rest is the goal
                goal[3 * part : 3 + 4 * part] = pose[3 * part : 3 + 4 * part]
                self._held[part] = self._is_at_rest(part)
        x, y, z, *orientation = goal
        vx, vy, vz, wx, wy, wz = twist
        self._goal = [x + dt * vx, y + dt * vy, z + dt * vz, *apply_rotation(orientation, (dt * wx, dt * wy, dt * wz))]

    def _is_at_rest(self, part: int) -> bool:
        _, jacobian = self.envelope.pose_and_jacobian()
        return hypot(*jacobian[3 * part : 3 * part + 3].dot(self.smoother.dq).tolist()) < _QUIET[part]

    def _shorten_lead(self, pose: Floats, error: list[float]) -> list[float]:
        linear, angular = error[:3], error[3:]
        shortened = False
        for part, lead in ((linear, _LEAD[0]), (angular, _LEAD[1])):
            distance = hypot(*part)
            if distance > lead:
                part[:] = [x * lead / distance for x in part]
                shortened = True
        if not shortened:
            return error
        self.envelope.limited |= Limited.LEAD
        self._goal = [x + e for x, e in zip(pose, linear, strict=False)] + apply_rotation(pose[3:], angular)
        return linear + angular


class PoseMotion(_CartesianMotion):
    """Brings the tcp to a pose, straight, translation and rotation at once; the joints brake in time."""

    size = 7

    def __init__(self, smoother: JointSmoother, envelope: Envelope) -> None:
        super().__init__(smoother, envelope)
        self._pose: Floats = ()
        self._rate = _POSE_GAIN
        """Speed per error in this tick, 1/s."""

    def usable(self, values: Floats) -> bool:
        return super().usable(values) and abs(hypot(*values[3:]) - 1.0) < 1e-3

    def too_far(self, values: Floats) -> bool:
        error = difference(self.envelope.kinematics.fk(self.smoother.q), values)
        return hypot(*error[:3]) > FIRST_STEP_DISTANCE or hypot(*error[3:]) > FIRST_STEP_TURN

    def accept(self, command: CommandRecord) -> None:
        self._pose = command.values

    def step(self, now: float) -> None:
        at, _ = self.envelope.pose_and_jacobian()
        error = difference(at, self._pose)
        scale = 1.0
        for part, lead in ((error[:3], _LEAD[0]), (error[3:], _LEAD[1])):
            distance = hypot(*part)
            if scale * distance > lead:
                scale = lead / distance
                self.envelope.limited |= Limited.LEAD
        twist = self._cap([_POSE_GAIN * scale * x for x in error])
        distance = hypot(*error)
        self._rate = hypot(*twist) / distance if distance > 0.0 else _POSE_GAIN
        self._follow_twist(twist)

    def _brake(self, dq: list[float]) -> list[float]:
        """Slow the whole motion to what the joint with the least reserve can still brake.

        At ``dq`` the goal would be reached in 1 / rate seconds, which gives the way that each joint still has to go.
        """
        smoother = self.smoother
        slowest = 1.0
        for v, A, J in zip(dq, smoother.acceleration, smoother.jerk, strict=True):
            if v and self._rate > 0.0:
                cap = speed_for(abs(v) / self._rate, _BRAKE[0] * A, _BRAKE[1] * J)
                slowest = min(slowest, cap / abs(v))
        return dq if slowest == 1.0 else [slowest * v for v in dq]
