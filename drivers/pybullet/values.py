"""What comes from outside, checked; and poses as they travel."""

from __future__ import annotations

import difflib
import math
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hal.errors import CommandError
from hal.specs import BodySpec, RobotSpec, from_json

from .body import Body
from .transforms import Transform

__all__ = ["body_spec", "joint_positions", "nearest", "numbers", "pose_json", "transform"]


def numbers(name: str, values: Any, size: int | None = None) -> list[float]:
    """``values`` as ``size`` finite floats; CommandError when they are not that."""
    try:
        floats = [float(value) for value in values]
    except (TypeError, ValueError):
        raise CommandError(f"{name} must be {size or 'some'} numbers, not {values!r}") from None
    if size is not None and len(floats) != size:
        raise CommandError(f"{name} must be {size} numbers, not {len(floats)}")
    if not all(map(math.isfinite, floats)):
        raise CommandError(f"{name} holds a number that is not finite: {floats}")
    return floats


def transform(pose: object) -> Transform:
    """A pose from outside: ``{"position": (3,), "orientation": (4,) xyzw}``, the orientation optional."""
    if not isinstance(pose, Mapping) or not set(pose) <= {"position", "orientation"} or "position" not in pose:
        raise CommandError(f"a pose is {{'position': [x, y, z], 'orientation': [x, y, z, w]}}, not {pose!r}")
    position = numbers("position", pose["position"], 3)
    orientation = numbers("orientation", pose.get("orientation", (0.0, 0.0, 0.0, 1.0)), 4)
    norm = math.hypot(*orientation)
    if norm < 1e-9:
        raise CommandError("orientation must not be zero")
    return tuple(position), tuple(value / norm for value in orientation)


def pose_json(pose: Transform) -> dict[str, list[float]]:
    """A pose as it travels."""
    return {"position": list(pose[0]), "orientation": list(pose[1])}


def body_spec(data: Mapping[str, Any]) -> BodySpec:
    """The record of an object, from its JSON."""
    try:
        return from_json(BodySpec, dict(data))
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise CommandError(f"that is no body: {error}") from None


def joint_positions(body: Body, q: Sequence[float]) -> dict[int, float]:
    """Joint index -> position, for the ``q`` of a reset: an arm's joints, its fingers after them or not, or all
    movable joints of an object."""
    values = numbers("q", q)
    joints, fingers = list(body.movable), []
    if isinstance(body.spec, RobotSpec):
        joints = [body.joints[name] for name in body.spec.joints]
        fingers = [body.joints[name] for name in body.spec.gripper.joints] if body.spec.gripper else []
    if len(values) == len(joints) + len(fingers):
        joints += fingers
    if len(values) != len(joints):
        raise CommandError(f"q of {body.name!r} must be {len(joints)} numbers, not {len(values)}")
    return dict(zip(joints, values, strict=True))


def nearest(name: str, names: Iterable[str]) -> str:
    """The end of a sentence that says what there is, and what was probably meant."""
    known = list(names)
    close = difflib.get_close_matches(name, known, n=1)
    hint = f"; did you mean {close[0]!r}?" if close else "."
    return f"{hint} There are: {', '.join(known)}" if known else "; there is none"


def listed(names: Sequence[str], most: int = 3) -> str:
    """Names for a message: the first ones, and how many more there are."""
    more = len(names) - most
    return ", ".join(names) if more <= 0 else f"{', '.join(names[:most])} and {more} more"
