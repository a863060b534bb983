"""The joints of a body of a simulated world: their ranges, and positions that they are placed at."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence

from hal.errors import CommandError, DeviceNotFound, suggest
from hal.kinematics.urdf import TURNING
from hal.specs import BodySpec, RobotSpec
from hal.world import BodyJoint

from .engine import SimulatedBody
from .values import numbers

TOLERANCE = 1e-6
"""How far a position may be outside of its joint's range, rad or m."""


def movable_joints(body: SimulatedBody) -> dict[str, BodyJoint]:
    found: dict[str, BodyJoint] = {}
    scale = body.spec.scale if isinstance(body.spec, BodySpec) else 1.0
    for name, joint in body.urdf.joints.items() if body.urdf is not None else ():
        if not joint.movable:
            continue
        size = 1.0 if joint.kind in TURNING else scale
        lower = upper = None
        if joint.lower is not None and joint.upper is not None and joint.lower < joint.upper:
            lower, upper = size * joint.lower, size * joint.upper
        leader = None if joint.mimic is None else joint.mimic.of
        found[name] = BodyJoint(joint.kind, lower, upper, joint.damping, joint.friction, leader)
    return found


def joints_to_place(body: SimulatedBody, positions: Mapping[str, float]) -> dict[int, float]:
    """Return joint number -> position, rad or m, for some joints of an object, and for those that follow them.

    Raises DeviceNotFound, which lists the joints, and CommandError for a position out of range, for what is no number,
    and for a joint that follows another one.
    """
    joints = movable_joints(body)
    if not isinstance(positions, Mapping):
        raise CommandError(f"the positions of joints are {{name: rad or m}}, not {positions!r}")
    placed: dict[int, float] = {}
    for name, given in positions.items():
        if name not in joints:
            message = f"{body.name!r} has no joint {name!r} that moves{suggest(name, joints)}"
            raise DeviceNotFound(message, code="unknown_joint")
        (value,), joint = numbers(f"the position of {name!r}", [given]), joints[name]
        if joint.follows is not None:
            raise CommandError(f"joint {name!r} follows {joint.follows!r}: place that", code="joint_follows")
        least = -math.inf if joint.lower is None else joint.lower
        most = math.inf if joint.upper is None else joint.upper
        if not least - TOLERANCE <= value <= most + TOLERANCE:
            message = f"{value:g} is outside of the range of {name!r}: {least:g} to {most:g}"
            raise CommandError(message, code="out_of_range")
        placed[body.joints[name]] = value
    for mimic in body.urdf.mimics if body.urdf is not None else ():
        if body.joints.get(mimic.of) in placed:
            placed[body.joints[mimic.joint]] = mimic.multiplier * placed[body.joints[mimic.of]] + mimic.offset
    return placed


def reset_positions(body: SimulatedBody, q: Sequence[float]) -> dict[int, float]:
    """Return joint number -> position for the ``q`` of a reset.

    ``q`` has an arm's joints, optionally its fingers after them; for an object, all its movable joints. Raises
    CommandError.
    """
    values = numbers("q", q)
    joints, fingers = list(body.movable), []
    if isinstance(body.spec, RobotSpec):
        joints = [body.joints[name] for name in body.spec.joints]
        fingers = [body.joints[name] for name in body.spec.gripper.joints] if body.spec.gripper else []
    if len(values) == len(joints) + len(fingers):
        joints += fingers
    if len(values) != len(joints):
        raise CommandError(f"q of {body.name!r} must be {len(joints)} numbers, not {len(values)}", code="wrong_size")
    return dict(zip(joints, values, strict=True))
