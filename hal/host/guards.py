"""Give every arm of a group the guard that keeps it off itself, off the rig's boxes and off the other arms."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Protocol

from ..errors import NotSupported
from ..geometry import Pose
from ..servo.collisions import CollisionGuard, Neighbour

if TYPE_CHECKING:
    from ..driver import Reading
    from ..servo.servo import Servo
    from ..specs import CollisionSpec, RobotSpec

__all__ = ["GuardedArm", "guard_arms"]

_SAME_PLACE = 1e-3
"""Two arms whose bases are this near, m, have been given no places."""


class GuardedArm(Protocol):
    """An arm in the cycle."""

    spec: RobotSpec
    servo: Servo
    reading: Reading | None


def guard_arms(units: Mapping[str, GuardedArm], spec: CollisionSpec | None) -> list[str]:
    """Give the servos of some arms their guards.

    Returns:
        Notes for the user: what is not checked, and which arms overlap at the start.
    """
    if spec is None or not spec.any:
        return []
    notes: list[str] = []
    for name, unit in units.items():
        others = [other for other in units.values() if other is not unit] if spec.arms else []
        seen = [other for other in others if not _same_place(unit.spec, other.spec)]
        for other in others:
            if other not in seen and name < other.spec.name:
                notes.append(
                    f"{name} and {other.spec.name} have their bases in one place, so they are not checked against "
                    f"each other: set robots.{other.spec.name}.base"
                )
        try:
            notes += _guard(unit, seen, spec)
        except NotSupported as error:
            notes.append(f"{name} is not checked for collisions: {error}")
    return list(dict.fromkeys(notes))


def _guard(unit: GuardedArm, others: Sequence[GuardedArm], spec: CollisionSpec) -> list[str]:
    """Give one arm its guard; return notes."""
    from ..kinematics.collision_model import CollisionModel

    robots = [unit.spec, *(other.spec for other in others)]
    model = CollisionModel(robots, spec)
    model.place([x for robot in robots for x in robot.initial])
    notes = list(model.notes)
    for k in model.touching():
        pair = model.pair(k, 0.0)
        if unit.spec.name < pair.second.partition("/")[0] or "/" not in pair.second:
            notes.append(f"{pair.first} and {pair.second} overlap at the start: move one of them")
    unit.servo.set_guard(CollisionGuard(model, unit.servo.smoother, [_neighbour(other) for other in others]))
    return notes


def _neighbour(unit: GuardedArm) -> Neighbour:
    """Return the function that returns where an arm is, and where it ends if it stops now."""

    def stop() -> tuple[Sequence[float], Sequence[float]]:
        servo = unit.servo
        if servo.active:
            q = servo.report.q_set
            return q, servo.smoother.stop_end() if q is servo.smoother.q else q
        q = unit.reading.q if unit.reading is not None else unit.spec.initial
        return q, q

    return stop


def _same_place(one: RobotSpec, other: RobotSpec) -> bool:
    apart, _ = Pose(one.base_position, one.base_orientation).distance(Pose(other.base_position, other.base_orientation))
    return apart < _SAME_PLACE
