"""Mass, friction and damping of links, and contacts between bodies."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

from hal.drivers.scene.engine import AppliedForce, RayFound
from hal.drivers.scene.values import BOUNCE
from hal.geometry import compose

from .engine import Body, PyBulletClient

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
_HARD = 1e9
"""Stiffness of a rigid contact, N/m."""
_DEFAULT_ERP = 0.2
"""Share of a contact's depth that PyBullet takes away per step where no stiffness is set."""
_ANY = 1e18
"""Distance up to which PyBullet by default takes bodies that approach each other for a contact, m."""
FAR = 1000.0
"""Distance from the origin where bodies touch nothing, m."""


def read_dynamics(client: PyBulletClient, body: Body, link: int) -> dict[str, Any]:
    """Return the dynamics of a link, :data:`~hal.drivers.scene.values.DYNAMICS`.

    PyBullet does not report ``linear_damping`` and ``angular_damping``: they are the values that were set last.
    """
    info = client.getDynamicsInfo(body.id, link)
    values: dict[str, Any] = {name: float(info[place]) for name, (_, place) in _SCALARS.items()}
    values["inertia"] = [float(value) for value in info[2]]
    if link in body.fingers:
        mass, moments = body.fingers[link][0]
        values |= {"mass": mass, "inertia": list(moments)}
    if values["contact_stiffness"] < 0.0 or link in body.hardened:
        values.update(dict.fromkeys(_CONTACT))
    values.update(zip(_DAMPING, body.damping, strict=True))
    return values


def write_dynamics(
    client: PyBulletClient, body: Body, link: int, wanted: Mapping[str, Any], before: Mapping[str, Any], dt: float
) -> None:
    """Set some of the values of :func:`read_dynamics`, which were ``before``, at a physics step of ``dt`` s.

    A new mass needs an inertia beside it: PyBullet alone would replace the URDF's by that of the collision shape. It
    takes contact_stiffness and contact_damping only together.
    """
    arguments = {_SCALARS[n][0]: v for n, v in wanted.items() if n in _SCALARS and n not in _CONTACT}
    if "inertia" in wanted:
        arguments["localInertiaDiagonal"] = wanted["inertia"]
    for name, argument in zip(_DAMPING, ("linearDamping", "angularDamping"), strict=True):
        if name in wanted:
            arguments[argument] = wanted[name]
    if arguments:
        client.changeDynamics(body.id, link, **arguments)
        body.edits += 1
        if link in body.fingers and not {"mass", "inertia"}.isdisjoint(wanted):
            new = wanted.get("mass", before["mass"]), tuple(wanted.get("inertia", before["inertia"]))
            body.fingers[link] = new, body.fingers[link][1]
            body.weigh_fingers(client, body.handling)
    body.damping = (wanted.get(_DAMPING[0], body.damping[0]), wanted.get(_DAMPING[1], body.damping[1]))

    if not {*_CONTACT, "restitution"}.isdisjoint(wanted):
        _write_contact(client, body, link, {**before, **wanted}, dt)


def _write_contact(client: PyBulletClient, body: Body, link: int, values: Mapping[str, Any], dt: float) -> None:
    """Set how contacts give way and bounce.

    PyBullet cannot forget a stiffness. A contact's error reduction is dt k / (dt k + d) and its softness
    1 / (dt k + d), so a huge k with this d is the solver's own hard contact.

    A contact that bounces must begin when bodies touch, and be hard with a small error reduction: PyBullet adds to the
    speed after it what takes the depth away, and subtracts what closes a gap before it, up to a third of the height.
    """
    stiffness, bounces = values["contact_stiffness"], values["restitution"] > 0.0
    if stiffness is not None:
        client.changeDynamics(body.id, link, contactStiffness=stiffness, contactDamping=values["contact_damping"])
        body.hardened.discard(link)
    elif bounces or client.getDynamicsInfo(body.id, link)[9] >= 0.0:
        reduction = 2.0 * BOUNCE if bounces else _DEFAULT_ERP  # between two that bounce, a quarter of it remains
        damping = dt * _HARD * (1.0 / reduction - 1.0)
        client.changeDynamics(body.id, link, contactStiffness=_HARD, contactDamping=damping)
        body.hardened.add(link)
    begin = 0.0 if bounces and stiffness is None else _ANY
    client.changeDynamics(body.id, link, contactProcessingThreshold=begin)


# --- contacts -------------------------------------------------------------------------------------------------------


def find_contacts(
    client: PyBulletClient, bodies: Iterable[Body], a: Body | None, b: Body | None
) -> list[dict[str, Any]]:
    """Return the contacts of the last step, as :meth:`.SimulatedWorld.contacts` does; None stands for any body."""
    chosen = {key: body.id for key, body in (("bodyA", a), ("bodyB", b)) if body is not None}
    by_id = {body.id: body for body in bodies}
    found = []
    for contact in client.getContactPoints(**chosen):
        one, other = by_id[contact[1]], by_id[contact[2]]
        found.append(
            {
                "a": one.name,
                "b": other.name,
                "link_a": one.link_name(contact[3]),
                "link_b": other.link_name(contact[4]),
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
    skip_a, skip_b = a.ignored_by(b), b.ignored_by(a)
    points = [point for point in points if point[3] not in skip_a and point[4] not in skip_b]
    if not points:
        return 0.0, "", ""
    deepest = min(points, key=lambda point: point[8])
    return max(0.0, -deepest[8]), a.link_name(deepest[3]), b.link_name(deepest[4])


def distance(client: PyBulletClient, a: Body, links_a: Sequence[int], b: Body, links_b: Sequence[int]) -> float | None:
    """Return the smallest distance between links of two bodies, m; None if one side has no collision shape."""
    found = [
        point[8]
        for one, other in itertools.product(links_a, links_b)
        for point in client.getClosestPoints(a.id, b.id, distance=FAR, linkIndexA=one, linkIndexB=other)
    ]
    return min(found, default=None)


def cast_ray(
    client: PyBulletClient, bodies: Iterable[Body], start: Sequence[float], end: Sequence[float]
) -> RayFound | None:
    number, link, _, position, normal = client.rayTest(start, end)[0]
    body = next((body for body in bodies if body.id == number), None)
    return None if body is None else RayFound(body, link, position, normal)


def apply_force(client: PyBulletClient, force: AppliedForce[Body]) -> None:
    number, link = force.body.id, force.link
    if force.point is not None:
        state = None if link == -1 else client.getLinkState(number, link)
        frame = force.body.base_pose(client) if state is None else (state[4], state[5])
        place = compose(frame, (tuple(force.point), (0.0, 0.0, 0.0, 1.0)))[0]
    elif link == -1:
        place = client.getBasePositionAndOrientation(number)[0]
    else:
        place = client.getLinkState(number, link)[0]
    client.applyExternalForce(number, link, force.force, place, client.WORLD_FRAME)


def bounding_box(client: PyBulletClient, body: Body) -> tuple[list[float], list[float]]:
    """Return the lower and upper corner (3,) m of the box along the world's axes around all links of a body."""
    solid = [link for link in body.links.values() if client.getCollisionShapeData(body.id, link)]
    corners = [client.getAABB(body.id, link) for link in solid or body.links.values()]
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
