"""Give every arm of a group the guard that keeps it off itself, off the rig's boxes and off the other arms."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from math import isfinite
from typing import TYPE_CHECKING, Protocol

import numpy as np

from ..dynamics import Dynamics
from ..errors import NotSupported
from ..kinematics.collisions import in_one_place
from ..servo.collisions import CollisionGuard, Neighbour
from ..servo.compliance import followable_jerk
from ..servo.smoothing import stop_distance
from ..types import ControlMode, RobotStatus

if TYPE_CHECKING:
    from ..driver import Reading
    from ..servo.servo import Servo
    from ..specs import CollisionSpec, GroupSpec, RobotSpec
    from .records import GroupMemory, RobotMail, ServoRecord

Floats = Sequence[float]

_OLD = 0.004
"""The state of an arm in another process is this old at most while that process keeps its rate, s."""

_TORQUE_STOP = 0.1
"""An arm that is driven by torques stops in at most the way that it has in this time, s."""

_POSES, _HEAVIER = 512, 1.1
"""Random positions in which the inertia of an arm is computed, and the greatest inertia of a joint as a multiple of
that in any of these. Chosen as a margin for all other positions."""

_FOLLOWS_SETPOINT = (RobotStatus.FOLLOWING, RobotStatus.STOPPING, RobotStatus.HOLDING, RobotStatus.TRIPPED)


class GuardedArm(Protocol):
    """An arm in the cycle."""

    spec: RobotSpec
    servo: Servo
    reading: Reading | None


class ArmElsewhere:
    """Where an arm of another process is, by its newest state, and where it ends if it stops now."""

    def __init__(self, spec: RobotSpec, mail: RobotMail) -> None:
        self._acceleration = spec.limits.acceleration
        self._jerk = spec.limits.jerk
        self._compliant_jerk = _find_jerk(spec)
        self._mail = mail
        self._seen: ServoRecord | None = None
        self._stop: tuple[Floats, Floats] = (spec.initial, spec.initial)

    def __call__(self) -> tuple[Floats, Floats]:
        """Return its joint positions (n,), rad, and those at the end of a stop that begins once they are known."""
        record = self._mail.peek()
        if record is None or record is self._seen:
            return self._stop
        self._seen = record
        follows = record.status in _FOLLOWS_SETPOINT
        stops = follows or record.session != 0  # one that is lost or has a fault may still be on its way
        if stops and record.controller is ControlMode.TORQUE:  # its set-point is where it was measured
            self._stop = record.q_set, [q + _TORQUE_STOP * v for q, v in zip(record.q_set, record.dq_set, strict=True)]
            return self._stop
        q: Floats = record.q_set
        if not follows or record.controller is not ControlMode.POSITION:  # it may be elsewhere than its set-point
            state = self._mail.get_state()
            q = self._stop[0] if state is None else state.q.tolist()
        if stops:
            jerk = self._jerk if record.controller is ControlMode.POSITION else self._compliant_jerk
            # On a straight path all joints stop together, and so none of them sooner than by itself.
            limits = zip(record.dq_set, self._acceleration, jerk, strict=True)
            moving = [(A / abs(v), J / abs(v)) for v, A, J in limits if v]
            seconds = _OLD + (stop_distance(1.0, *map(min, zip(*moving, strict=True))) if moving else 0.0)
            self._stop = q, [x + seconds * v for x, v in zip(record.q_set, record.dq_set, strict=True)]
        else:
            self._stop = q, q
        return self._stop


def _find_jerk(spec: RobotSpec) -> Floats:
    """Return the jerks (n,), rad/s3, with which an arm's set-point surely stops in a session with a controller."""
    limits = spec.limits
    if limits.torque is None:
        return limits.jerk
    try:
        dynamics = Dynamics.of(spec)
    except NotSupported:  # no session gets a controller
        return limits.jerk
    poses = np.random.default_rng(0).uniform(limits.lower, limits.upper, (_POSES, len(spec.joints)))
    followable = [followable_jerk(_HEAVIER * dynamics.mass_matrix(q)) for q in poses]
    return [min(each) for each in zip(limits.jerk, *followable, strict=True)]


class _ArmHere:
    """Where an arm of this process is, and where it ends if it stops now."""

    def __init__(self, unit: GuardedArm) -> None:
        self._unit = unit
        self._measured: Floats = unit.spec.initial

    def __call__(self) -> tuple[Floats, Floats]:
        """Return its joint positions (n,), rad, and those at the end of a stop that begins now."""
        unit, servo = self._unit, self._unit.servo
        report, smoother = servo.report, servo.smoother
        if servo.active and report.controller is ControlMode.POSITION:
            return report.q_set, servo.stop_end() if report.q_set is smoother.q else report.q_set
        if servo.active and report.controller is ControlMode.TORQUE:  # its set-point is where it was measured
            return report.q_set, [q + _TORQUE_STOP * v for q, v in zip(report.q_set, report.dq_set, strict=True)]
        q = self._measured if unit.reading is None else unit.reading.q
        if len(q) == smoother.n and isfinite(sum(q)):  # else where it was measured last
            self._measured = q
        return self._measured, servo.stop_end() if servo.active else self._measured


def guard_arms(group: GroupSpec, units: Mapping[str, GuardedArm], others: Iterable[GroupMemory]) -> list[str]:
    """Give the servos of a group's arms their guards.

    Returns:
        Notes for the user: what is not checked, and which arms overlap at the start.
    """
    spec = group.collisions
    if spec is None or not spec.any:
        return []
    mails = {name: mail for memory in others for name, mail in memory.robots.items()}
    around: list[tuple[RobotSpec, Neighbour]] = []
    if spec.arms:
        around += [(unit.spec, _ArmHere(unit)) for unit in units.values()]
        around += [(arm, ArmElsewhere(arm, mails[arm.name])) for arm in group.neighbours if arm.name in mails]
    notes: list[str] = []
    for name, unit in units.items():
        seen = []
        for other in around:
            if other[0] is unit.spec:
                continue
            if not in_one_place(unit.spec, other[0]):
                seen.append(other)
            elif name < other[0].name:
                what = f"{name} and {other[0].name} have their bases in one place"
                notes.append(f"{what}, so they are not checked against each other: set robots.{other[0].name}.base")
        try:
            notes += _guard(unit, seen, spec)
        except NotSupported as error:
            notes.append(f"{name} is not checked for collisions: {error}")
    return list(dict.fromkeys(notes))


def _guard(unit: GuardedArm, others: Sequence[tuple[RobotSpec, Neighbour]], spec: CollisionSpec) -> list[str]:
    """Give one arm its guard; return notes."""
    from ..kinematics.collision_model import CollisionModel

    robots = [unit.spec, *(robot for robot, _ in others)]
    model = CollisionModel(robots, spec)
    model.place([x for robot in robots for x in robot.initial])
    notes = list(model.notes)
    for k in model.touching():
        pair = model.pair(k, 0.0)
        if unit.spec.name < pair.second.partition("/")[0] or "/" not in pair.second:
            notes.append(
                f"{pair.first} and {pair.second} overlap at the start: only motions that part them are allowed"
            )
    unit.servo.set_guard(CollisionGuard(model, unit.servo.smoother, [neighbour for _, neighbour in others]))
    return notes
