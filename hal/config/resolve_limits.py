"""An arm's limits: the model's, filled in from the URDF, tightened by the rig."""

from __future__ import annotations

import math
from pathlib import Path

from ..specs import Floats, LimitsSpec
from .files import Problems
from .models import RobotModel
from .rigfile import RobotConfig
from .urdf import UrdfModel

__all__ = ["resolve_limits", "spread"]

UNITS = {
    "lower": "rad",
    "upper": "rad",
    "velocity": "rad/s",
    "acceleration": "rad/s2",
    "jerk": "rad/s3",
    "torque": "Nm",
}
ENDLESS = 1e4
"""rad; the limit of a joint that turns without end."""


def spread(
    values: Floats, n: int, file: Path | str, key: str, unit: str, problems: Problems, *, one_for_all: bool = False
) -> Floats | None:
    """``values`` with one number for each of ``n`` joints; None, and a problem noted, for another count."""
    if one_for_all and len(values) == 1:
        return values * n
    if len(values) != n:
        problems.add(file, key, f"must have {n} numbers ({unit}), one for each joint, not {len(values)}")
        return None
    return values


def resolve_limits(
    model: RobotModel,
    urdf: UrdfModel,
    file: Path,
    config: RobotConfig,
    source: str,
    key: str,
    problems: Problems,
) -> LimitsSpec | None:
    """The limits that the servo keeps; None, and problems noted, where they are not whole."""
    n, found = len(model.joints), len(problems.found)
    limits: dict[str, Floats | None] = {}
    for name, unit in UNITS.items():
        own: Floats | None = getattr(model.limits, name)
        if own is not None:
            limits[name] = spread(own, n, file, f"limits.{name}", unit, problems, one_for_all=True)
        else:
            limits[name] = _from_urdf(model, urdf, name, file, problems)
    if len(problems.found) > found:
        return None
    for name in UNITS:
        changed: Floats | None = getattr(config.limits, name)
        if changed is None:
            continue
        values = spread(changed, n, source, f"{key}.{name}", UNITS[name], problems, one_for_all=True)
        if values is not None:
            _check_tighter(values, limits[name], model, name, config.limits.allow_looser_limits, source, key, problems)
            limits[name] = values
    changed_keys = config.limits.model_fields_set
    for name in ("velocity", "acceleration", "jerk", "torque"):
        place, where = (source, f"{key}.{name}") if name in changed_keys else (file, f"limits.{name}")
        if any(value <= 0.0 for value in limits[name] or ()):
            problems.add(place, where, f"must be above 0 ({UNITS[name]}) for every joint")
    lower, upper, joints = limits["lower"] or (), limits["upper"] or (), model.joints
    for low, high, joint in zip(lower, upper, joints, strict=False):
        if low >= high:
            place, where = (source, key) if changed_keys & {"lower", "upper"} else (file, "limits")
            problems.add(place, where, f"lower must be below upper: joint {joint!r} has {low:g} and {high:g}")
    if len(problems.found) > found:
        return None
    return LimitsSpec(**limits)  # type: ignore[arg-type]  # None only for torque, which may be


def _from_urdf(model: RobotModel, urdf: UrdfModel, name: str, file: Path, problems: Problems) -> Floats | None:
    unit = UNITS[name]
    if name in ("acceleration", "jerk"):
        text = f"is missing: {unit}, one number for each joint or one for all; a URDF does not hold it"
        problems.add(file, f"limits.{name}", text)
        return None
    joints = [urdf.joints[joint] for joint in model.joints]
    if name == "torque":
        efforts = [joint.effort for joint in joints]
        # An effort of 0 stands in many files for "unknown".
        return tuple(effort for effort in efforts if effort) if all(efforts) else None
    values: list[float] = []
    for joint in joints:
        value: float | None = getattr(joint, name)
        if value is None and joint.kind == "continuous" and name in ("lower", "upper"):
            value = math.copysign(ENDLESS, -1.0 if name == "lower" else 1.0)
        if value is None or (name == "velocity" and value <= 0.0):
            text = f"is missing ({unit}), and {urdf.path.name} gives none for joint {joint.name!r}"
            problems.add(file, f"limits.{name}", text)
            return None
        values.append(value)
    return tuple(values)


def _check_tighter(
    values: Floats,
    limits: Floats | None,
    model: RobotModel,
    name: str,
    allowed: bool,
    source: str,
    key: str,
    problems: Problems,
) -> None:
    if allowed or limits is None:
        return
    looser = [
        f"{value:g} is looser than the model's {limit:g} for joint {joint!r}"
        for value, limit, joint in zip(values, limits, model.joints, strict=True)
        if (value < limit if name == "lower" else value > limit)
    ]
    if looser:
        text = f"{'; '.join(looser)} ({UNITS[name]}); only allow_looser_limits: true beside it permits that"
        problems.add(source, f"{key}.{name}", text)
