"""Mass, friction and damping of links, and contacts between bodies."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from typing import Any

from hal.errors import CommandError, NotSupported

from .engine import Body, PyBulletClient

__all__ = [
    "bounding_box",
    "deepest_overlap",
    "find_contacts",
    "forget_contacts",
    "read_dynamics",
    "write_dynamics",
]

# Name here -> name of PyBullet's argument, place in getDynamicsInfo.
_SCALARS = {
    "mass": ("mass", 0),
    "lateral_friction": ("lateralFriction", 1),
    "restitution": ("restitution", 5),
    "rolling_friction": ("rollingFriction", 6),
    "spinning_friction": ("spinningFriction", 7),
    "contact_damping": ("contactDamping", 8),
    "contact_stiffness": ("contactStiffness", 9),
}
_CONTACT = ("contact_stiffness", "contact_damping")
_DAMPING = ("linear_damping", "angular_damping")
_NAMES = (*_SCALARS, "inertia", *_DAMPING)
_HARD = 1e9
"""Stiffness of a rigid contact, N/m."""
_DEFAULT_ERP = 0.2
"""Share of a contact's depth that PyBullet takes away per step where no stiffness is set."""
FAR = 1000.0
"""Distance from the origin where bodies touch nothing, m."""


def read_dynamics(client: PyBulletClient, body: Body, link: int) -> dict[str, Any]:
    """Return the dynamics of a link.

    ``mass`` kg; ``inertia`` (3,) kg m2 about the principal axes; ``lateral_friction``, ``rolling_friction``,
    ``spinning_friction`` and ``restitution``, without units; ``contact_stiffness`` N/m and ``contact_damping`` Ns/m,
    None where contacts are as hard as the solver can make them; ``linear_damping`` and ``angular_damping`` 1/s, of the
    whole body (PyBullet does not report these two: they are the values that were set last).
    """
    info = client.getDynamicsInfo(body.id, link)
    values: dict[str, Any] = {name: float(info[place]) for name, (_, place) in _SCALARS.items()}
    values["inertia"] = [float(value) for value in info[2]]
    if values["contact_stiffness"] < 0.0 or link in body.hardened:
        values.update(dict.fromkeys(_CONTACT))
    values.update(zip(_DAMPING, body.damping, strict=True))
    return values


def write_dynamics(
    client: PyBulletClient, body: Body, link: int, values: Mapping[str, Any], dt: float
) -> dict[str, Any]:
    """Set some of the values of :func:`read_dynamics` and check that PyBullet took them.

    A new mass scales the inertia with it unless an inertia is given (PyBullet alone would replace the URDF's inertia
    by that of the collision shape).

    Args:
        client: The world.
        body: The body.
        link: Index of the link.
        values: New values by name.
        dt: The physics step, s.

    Returns:
        The previous values, to be passed here to restore them.

    Raises:
        CommandError: An unknown name, an impossible number, or a mass that would make a fixed body movable or the
            reverse. Nothing was set.
        NotSupported: PyBullet did not take a value.
    """
    wanted = _checked(body, link, values)
    before = read_dynamics(client, body, link)
    if "mass" in wanted:
        if (wanted["mass"] > 0.0) != (before["mass"] > 0.0):
            raise CommandError(f"the mass of {body.name!r} cannot change between 0 (fixed) and more")
        scale = wanted["mass"] / before["mass"] if before["mass"] > 0.0 else 0.0
        wanted.setdefault("inertia", [value * scale for value in before["inertia"]])
    if any(name in wanted for name in _CONTACT):  # PyBullet takes the two only together
        for name in _CONTACT:
            wanted.setdefault(name, before[name])
        if (wanted["contact_stiffness"] is None) != (wanted["contact_damping"] is None):
            raise CommandError("contact_stiffness and contact_damping are set together, or both None")
    _apply(client, body, link, wanted, before, dt)

    after = read_dynamics(client, body, link)
    for name, value in wanted.items():
        if not _same(after[name], value):
            raise NotSupported(f"PyBullet did not take {name} = {value} for {body.name!r}: it holds {after[name]}")
    return {name: before[name] for name in wanted}


def _checked(body: Body, link: int, values: Mapping[str, Any]) -> dict[str, Any]:
    wanted: dict[str, Any] = {}
    for name, value in values.items():
        if name not in _NAMES:
            raise CommandError(f"unknown property {name!r} of a link; properties: {', '.join(_NAMES)}")
        if value is None and name in _CONTACT:
            wanted[name] = None
            continue
        try:
            numbers = [float(item) for item in value] if name == "inertia" else [float(value)]
        except (TypeError, ValueError):
            raise CommandError(f"{name} of {body.name!r} must be a number, not {value!r}") from None
        if (name == "inertia" and len(numbers) != 3) or not all(math.isfinite(x) and x >= 0.0 for x in numbers):
            raise CommandError(f"{name} of {body.name!r} must be finite and at least 0, not {value!r}")
        wanted[name] = numbers if name == "inertia" else numbers[0]
    return wanted


def _apply(
    client: PyBulletClient, body: Body, link: int, wanted: dict[str, Any], before: dict[str, Any], dt: float
) -> None:
    arguments = {_SCALARS[n][0]: v for n, v in wanted.items() if n in _SCALARS and n not in _CONTACT}
    if "inertia" in wanted:
        arguments["localInertiaDiagonal"] = wanted["inertia"]
    for name, argument in zip(_DAMPING, ("linearDamping", "angularDamping"), strict=True):
        if name in wanted:
            arguments[argument] = wanted[name]
    if arguments:
        client.changeDynamics(body.id, link, **arguments)
    body.damping = (wanted.get(_DAMPING[0], body.damping[0]), wanted.get(_DAMPING[1], body.damping[1]))

    if _CONTACT[0] not in wanted:
        return
    stiffness, damping = wanted["contact_stiffness"], wanted["contact_damping"]
    if stiffness is not None:
        client.changeDynamics(body.id, link, contactStiffness=stiffness, contactDamping=damping)
        body.hardened.discard(link)
    elif before["contact_stiffness"] is not None:
        # PyBullet cannot forget a stiffness. A contact's error reduction is dt k / (dt k + d) and its softness
        # 1 / (dt k + d), so a huge k with this d is the solver's own hard contact.
        damping = dt * _HARD * (1.0 / _DEFAULT_ERP - 1.0)
        client.changeDynamics(body.id, link, contactStiffness=_HARD, contactDamping=damping)
        body.hardened.add(link)


def _same(a: Any, b: Any) -> bool:
    if isinstance(a, list):
        return all(_same(x, y) for x, y in zip(a, b, strict=True))
    if a is None or b is None:
        return a is b
    return math.isclose(a, b, rel_tol=1e-9, abs_tol=1e-12)


# --- contacts -------------------------------------------------------------------------------------------------------


def find_contacts(
    client: PyBulletClient, bodies: Iterable[Body], a: Body | None, b: Body | None
) -> list[dict[str, Any]]:
    """Return the contacts of the last step, as :meth:`.world.PyBulletWorld.contacts` does; None stands for any body."""
    chosen = {key: body.id for key, body in (("bodyA", a), ("bodyB", b)) if body is not None}
    by_id = {body.id: body for body in bodies}
    found = []
    for contact in client.getContactPoints(**chosen):
        one, other = by_id[contact[1]], by_id[contact[2]]
        found.append(
            {
                "a": one.name,
                "b": other.name,
                "link_a": one.link_names[contact[3]],
                "link_b": other.link_names[contact[4]],
                "position": list(contact[6]),
                "normal": list(contact[7]),
                "distance": contact[8],
                "force": contact[9],
            }
        )
    return found


def deepest_overlap(client: PyBulletClient, a: Body, b: Body) -> tuple[float, str, str]:
    """Return how deep two bodies overlap, m, 0 where they are apart, and by which link of each."""
    points = client.getClosestPoints(a.id, b.id, distance=0.0)
    if not points:
        return 0.0, "", ""
    deepest = min(points, key=lambda point: point[8])
    return max(0.0, -deepest[8]), a.link_names[deepest[3]], b.link_names[deepest[4]]


def bounding_box(client: PyBulletClient, body: Body) -> tuple[list[float], list[float]]:
    """Return the lower and upper corner (3,) m of the box along the world's axes around all links of a body."""
    corners = [client.getAABB(body.id, link) for link in body.links.values()]
    lower = [min(corner[0][axis] for corner in corners) for axis in range(3)]
    upper = [max(corner[1][axis] for corner in corners) for axis in range(3)]
    return lower, upper


def forget_contacts(client: PyBulletClient, bodies: Iterable[Body]) -> None:
    """Move bodies far away and back, so that the solver forgets their contacts.

    The solver starts from the forces of the previous step, and a lasting contact may keep the friction and the
    stiffness of its first step. Without these, the steps after a reset repeat those after the start bit for bit, and
    new dynamics act at once.
    """
    taken = []
    for place, body in enumerate(bodies, start=1):
        if body.moves:
            taken.append((body.id, client.getBasePositionAndOrientation(body.id), client.getBaseVelocity(body.id)))
            client.resetBasePositionAndOrientation(body.id, (FAR * place, 0.0, FAR), (0.0, 0.0, 0.0, 1.0))
    client.performCollisionDetection()
    for number, pose, velocity in taken:
        client.resetBasePositionAndOrientation(number, *pose)
        client.resetBaseVelocity(number, *velocity)
