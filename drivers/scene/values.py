"""Values that come from outside into a simulated world: how they are checked, and how they are named in messages."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

from hal.errors import CommandError
from hal.geometry import Transform
from hal.specs import BodySpec, from_json

SINKS = 1e-4
"""How deep a body sinks in by its weight with the stiffness that a message proposes, m."""
BOUNCE = 0.01
"""Share of its depth that a contact with restitution loses in a step: a greater one would add to the height."""
_CONTACT = ("contact_stiffness", "contact_damping")
DYNAMICS = (
    "mass",
    "lateral_friction",
    "restitution",
    "rolling_friction",
    "spinning_friction",
    "contact_damping",
    "contact_stiffness",
    "inertia",
    "linear_damping",
    "angular_damping",
)
"""Properties of a link.

``mass`` kg; ``inertia`` (3,) kg m2 about the principal axes; ``lateral_friction``, ``rolling_friction``,
``spinning_friction`` and ``restitution``, without units; ``contact_stiffness`` N/m and ``contact_damping`` Ns/m, None
where contacts are as hard as the solver can make them; ``linear_damping`` and ``angular_damping`` 1/s, of the whole
body.
"""


def numbers(name: str, values: Any, size: int | None = None) -> list[float]:
    """Return ``values`` as ``size`` finite floats; raises CommandError for anything else."""
    try:
        floats = [float(value) for value in values]
    except (TypeError, ValueError):
        raise CommandError(f"{name} must be {size or 'some'} numbers, not {values!r}") from None
    if size is not None and len(floats) != size:
        raise CommandError(f"{name} must be {size} numbers, not {len(floats)}", code="wrong_size")
    if not all(map(math.isfinite, floats)):
        raise CommandError(f"{name} holds a number that is not finite: {floats}", code="not_finite")
    return floats


def transform(pose: object) -> Transform:
    """Return the transform of a pose ``{"position": (3,), "orientation": (4,) xyzw}``; the orientation is optional.

    Raises CommandError if it is no such pose, or its orientation is zero.
    """
    if not isinstance(pose, Mapping) or not set(pose) <= {"position", "orientation"} or "position" not in pose:
        raise CommandError(f"a pose is {{'position': [x, y, z], 'orientation': [x, y, z, w]}}, not {pose!r}")
    position = numbers("position", pose["position"], 3)
    orientation = numbers("orientation", pose.get("orientation", (0.0, 0.0, 0.0, 1.0)), 4)
    norm = math.hypot(*orientation)
    if norm < 1e-9:
        raise CommandError("orientation must not be zero")
    return tuple(position), tuple(value / norm for value in orientation)


def pose_json(pose: Transform) -> dict[str, list[float]]:
    """Return a pose as JSON."""
    return {"position": list(pose[0]), "orientation": list(pose[1])}


def body_spec(data: Mapping[str, Any]) -> BodySpec:
    """Return the record of an object from its JSON; raises CommandError."""
    try:
        return from_json(BodySpec, dict(data))
    except (TypeError, ValueError, KeyError, IndexError) as error:
        raise CommandError(f"not the record of a body: {error}") from None


def check_body(spec: BodySpec) -> None:
    """Raise CommandError for an object with an impossible number, or with a name that engines cannot take."""
    if not spec.name or "/" in spec.name:
        raise CommandError(f"the name of a body has at least one character, and no '/': {spec.name!r}", code="bad_name")
    transform({"position": spec.position, "orientation": spec.orientation})
    sizes = {"half_extents": spec.half_extents, "radius": spec.radius, "length": spec.length, "scale": spec.scale}
    for name, size in sizes.items():
        if size is not None and min(numbers(name, size if name == "half_extents" else [size])) <= 0.0:
            raise CommandError(f"{name} of {spec.name!r} must be more than 0, not {size}")
    if numbers("mass", [spec.mass])[0] < 0.0:
        raise CommandError(f"mass of {spec.name!r} must be at least 0, not {spec.mass}")


def like(state: Any, own: Any) -> bool:
    """Return whether ``state``, from outside, is built as ``own``, of finite numbers.

    None stands for any part, and lists may be empty.
    """
    if isinstance(state, Mapping):
        if own is None:
            return all(like(part, None) for part in state.values())
        return isinstance(own, Mapping) and set(state) == set(own) and all(like(state[key], own[key]) for key in own)
    if isinstance(state, (list, tuple)):
        fits = own is None or (isinstance(own, (list, tuple)) and (not own or not state or len(own) == len(state)))
        return fits and all(like(part, None) for part in state)
    if isinstance(own, Mapping):
        return False
    return state is None or (isinstance(state, (int, float)) and math.isfinite(state))


def listed(names: Sequence[str]) -> str:
    """Return names for a message: the first three, and how many more there are."""
    more = len(names) - 3
    return ", ".join(names) if more <= 0 else f"{', '.join(names[:3])} and {more} more"


# --- dynamics --------------------------------------------------------------------------------------------------------


def dynamics_values(body: str, values: Mapping[str, Any]) -> dict[str, Any]:
    """Return new :data:`DYNAMICS` of a link of ``body`` as floats; raises CommandError for anything impossible."""
    wanted: dict[str, Any] = {}
    for name, value in values.items():
        if name not in DYNAMICS:
            raise CommandError(f"unknown property {name!r} of a link; properties: {', '.join(DYNAMICS)}")
        if value is None and name in _CONTACT:
            wanted[name] = None
            continue
        try:
            floats = [float(item) for item in value] if name == "inertia" else [float(value)]
        except (TypeError, ValueError):
            raise CommandError(f"{name} of {body!r} must be a number, not {value!r}") from None
        if (name == "inertia" and len(floats) != 3) or not all(math.isfinite(x) and x >= 0.0 for x in floats):
            raise CommandError(f"{name} of {body!r} must be finite and at least 0, not {value!r}")
        wanted[name] = floats if name == "inertia" else floats[0]
    return wanted


def completed_dynamics(body: str, wanted: Mapping[str, Any], before: Mapping[str, Any]) -> dict[str, Any]:
    """Return all properties that a change of some of them, as of :func:`dynamics_values`, sets.

    A new mass scales the inertia with it unless an inertia is given. The stiffness and the damping of contacts are set
    together: where only one is given, the other one stays. Raises CommandError for a mass that would make a fixed body
    movable or the reverse, and for contacts half hard and half soft.
    """
    wanted = dict(wanted)
    if "mass" in wanted:
        if (wanted["mass"] > 0.0) != (before["mass"] > 0.0):
            raise CommandError(f"the mass of {body!r} cannot change between 0 (fixed) and more")
        scale = wanted["mass"] / before["mass"] if before["mass"] > 0.0 else 0.0
        wanted.setdefault("inertia", [value * scale for value in before["inertia"]])
    if any(name in wanted for name in _CONTACT):
        for name in _CONTACT:
            wanted.setdefault(name, before[name])
        if (wanted["contact_stiffness"] is None) != (wanted["contact_damping"] is None):
            raise CommandError(_other_half(body, wanted, before["mass"]), code="contact_incomplete")
    return wanted


def _other_half(body: str, wanted: Mapping[str, Any], mass: float) -> str:
    """Return the message about a stiffness of contacts without a damping, or the reverse, with a value to add."""
    stiffness, mass = wanted["contact_stiffness"], mass or 1.0
    if stiffness is None:
        added = f"contact_stiffness={_round(mass * 9.81 / SINKS):g} (N/m; it then sinks in by {1e3 * SINKS:g} mm)"
    else:
        added = f"contact_damping={_round(2.0 * math.sqrt(stiffness * mass)):g} (Ns/m; it then does not bounce)"
    return f"contact_stiffness and contact_damping of {body!r} are set together, or both None: add {added}"


def _round(value: float) -> float:
    """Return a value with one digit that is not 0."""
    return float(f"{value:.0e}")


def same_value(a: Any, b: Any) -> bool:
    """Return whether two values of a property are the same number, list of numbers, or None."""
    if isinstance(a, list):
        return all(same_value(x, y) for x, y in zip(a, b, strict=True))
    if a is None or b is None:
        return a is b
    return math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12)
