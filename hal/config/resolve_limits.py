"""An arm's limits: the model's, filled in from the URDF, tightened where the arm is real, and by the rig."""

from __future__ import annotations

import math
from collections.abc import Sequence
from contextlib import suppress
from pathlib import Path

from ..specs import Floats, LimitsSpec
from .files import Problems
from .models import LimitsModel, RobotModel
from .rigfile import LimitsConfig, RobotConfig
from .schema import Quantity, Unknown
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
MOST_REAL = {
    "velocity": Quantity("rad/s", 0.0, 15.0, above=True),
    "acceleration": Quantity("rad/s2", 0.0, 100.0, above=True),
    "jerk": Quantity("rad/s3", 0.0, 20000.0, above=True),
    "torque": Quantity("Nm", 0.0, 1000.0, above=True),
}
"""What no file can loosen on a real arm, wherever a limit is from. The fastest joints of arms on a bench reach about
12 rad/s; a Panda's jerk limit is 10000 rad/s3."""
MOST_REAL_TCP_SPEED = Quantity("m/s", 0.0, 1.5, above=True)
"""Below the 1.7 m/s at which a Panda stops by itself; 0.25 m/s is ISO 10218's reduced speed."""
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
    urdf: UrdfModel | None,
    file: Path,
    config: RobotConfig,
    source: str,
    key: str,
    real: bool,
    problems: Problems,
) -> LimitsSpec:
    """The limits that the servo keeps. Numbers that nobody knows are NaN, which is neither too large nor too small.

    They are noted as missing here, or what keeps them from being known was noted before. ``real``: the model's
    ``real_limits`` count. Raises Unknown where the number of joints is not known.
    """
    with suppress(Unknown):
        for name in ("acceleration", "jerk"):
            if getattr(model.limits, name, ()) is None:
                text = f"is missing: {UNITS[name]}, one number for each joint or one for all; a URDF does not hold it"
                problems.add(file, f"limits.{name}", text)
    limits = {name: _of_model(model, urdf, name, file, problems) for name in UNITS}
    _check_order(limits, model.joints, file, "limits", problems)
    own = dict(limits)  # looked at in simulation, too, so that mistakes are found there
    with suppress(Unknown):
        _tighten(own, model.real_limits, model.joints, file, "real_limits", problems, _LOOSER_THAN_OWN)
    if real:
        limits = own
    with suppress(Unknown):
        rule = None if getattr(config.limits, "allow_looser_limits", True) else _LOOSER_THAN_MODEL
        _tighten(limits, config.limits, model.joints, source, key, problems, rule)
    if real:
        given = getattr(config, "limits", LimitsConfig()).model_fields_set
        for name, most in MOST_REAL.items():
            fast = [value for value in limits[name] or () if value > most.most]
            if fast:
                text = f"must be {most} for every joint of a real arm, not {max(fast):g}"
                if name in given:
                    problems.add(source, f"{key}.{name}", text)
                else:
                    problems.add(file, f"limits.{name}", text)
    return LimitsSpec(**limits)  # type: ignore[arg-type]  # None only for torque, which may be


_LOOSER_THAN_OWN = "{value:g} is looser than limits.{name}, {limit:g}, for joint {joint!r}", ""
_LOOSER_THAN_MODEL = (
    "{value:g} is looser than the model's {limit:g} for joint {joint!r}",
    "; only allow_looser_limits: true beside it permits that",
)
"""What is said of each number that is too loose, and after them."""


def _tighten(
    limits: dict[str, Floats | None],
    changes: LimitsModel | LimitsConfig,
    joints: Sequence[str],
    file: Path | str,
    key: str,
    problems: Problems,
    rule: tuple[str, str] | None,
) -> None:
    """Put ``changes`` in place of those of ``limits``, in place; where there is a ``rule``, looser ones are noted."""
    for name, unit in UNITS.items():
        changed: Floats | None = getattr(changes, name, None)
        if changed is None:
            continue
        values = spread(changed, len(joints), file, f"{key}.{name}", unit, problems, one_for_all=True)
        if values is None:
            continue
        if rule is not None:
            _check_tighter(values, limits[name], joints, name, file, f"{key}.{name}", problems, rule)
        limits[name] = values
    if not {"lower", "upper"}.isdisjoint(changes.model_fields_set):
        _check_order(limits, joints, file, key, problems)


def _check_tighter(
    values: Floats,
    limits: Floats | None,
    joints: Sequence[str],
    name: str,
    file: Path | str,
    key: str,
    problems: Problems,
    rule: tuple[str, str],
) -> None:
    each, after = rule
    looser = [
        each.format(value=value, limit=limit, joint=joint, name=name)
        for value, limit, joint in zip(values, limits or values, joints, strict=True)
        if (value < limit if name == "lower" else value > limit)
    ]
    if looser:
        problems.add(file, key, f"{'; '.join(looser)} ({UNITS[name]}){after}")


def _check_order(
    limits: dict[str, Floats | None], joints: Sequence[str], file: Path | str, key: str, problems: Problems
) -> None:
    """Lower below upper. Where they are not, nobody knows what is between them, so they are NaN afterwards."""
    lower, upper = list(limits["lower"] or ()), list(limits["upper"] or ())
    empty: list[str] = []
    for k, joint in enumerate(joints):
        if lower[k] >= upper[k]:
            empty.append(f"joint {joint!r} has {lower[k]:g} and {upper[k]:g}")
            lower[k] = upper[k] = math.nan
    if empty:
        problems.add(file, key, f"lower must be below upper: {'; '.join(empty)}")
    limits["lower"], limits["upper"] = tuple(lower), tuple(upper)


def _of_model(model: RobotModel, urdf: UrdfModel | None, name: str, file: Path, problems: Problems) -> Floats | None:
    n = len(model.joints)
    unknown = (math.nan,) * n
    with suppress(Unknown):
        own: Floats | None = getattr(model.limits, name)
        if own is not None:
            return spread(own, n, file, f"limits.{name}", UNITS[name], problems, one_for_all=True) or unknown
        if urdf is not None and name not in ("acceleration", "jerk"):
            return _from_urdf(model, urdf, name, file, problems)
    return unknown


def _from_urdf(model: RobotModel, urdf: UrdfModel, name: str, file: Path, problems: Problems) -> Floats | None:
    joints = [urdf.joints.get(joint) for joint in model.joints]
    if name == "torque":
        efforts = [joint.effort for joint in joints if joint is not None and joint.effort and joint.effort > 0.0]
        # An effort of 0 stands in many files for "unknown".
        return tuple(efforts) if len(efforts) == len(joints) else None
    values: list[float] = []
    lacking: list[str] = []
    for joint in joints:
        value: float | None = getattr(joint, name, None)
        if joint is None or not joint.movable:  # noted where joints are looked up
            value = math.nan
        elif value is None and joint.kind == "continuous" and name in ("lower", "upper"):
            value = math.copysign(ENDLESS, -1.0 if name == "lower" else 1.0)
        elif value is None or (name == "velocity" and value <= 0.0):
            lacking.append(joint.name)
            value = math.nan
        values.append(value)
    if lacking:
        text = f"is missing ({UNITS[name]}), and {urdf.path.name} gives none for {', '.join(map(repr, lacking))}"
        problems.add(file, f"limits.{name}", text)
    return tuple(values)
