"""What touches what, and how to make the solver forget it."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from .body import Body
from .library import Client

__all__ = ["bounding_box", "deepest_overlap", "find_contacts", "forget_contacts"]

FAR = 1000.0
"""m: where nothing touches anything."""


def find_contacts(client: Client, bodies: Iterable[Body], a: Body | None, b: Body | None) -> list[dict[str, Any]]:
    """Contacts of the last step, as :meth:`.world.World.contacts` gives them."""
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


def deepest_overlap(client: Client, a: Body, b: Body) -> tuple[float, str, str]:
    """How deep two bodies are in each other as they stand, m, and by which links; 0 where they are apart."""
    points = client.getClosestPoints(a.id, b.id, distance=0.0)
    if not points:
        return 0.0, "", ""
    deepest = min(points, key=lambda point: point[8])
    return max(0.0, -deepest[8]), a.link_names[deepest[3]], b.link_names[deepest[4]]


def bounding_box(client: Client, body: Body) -> tuple[list[float], list[float]]:
    """Lower and upper corner (3,) m of the box along the world's axes that holds all links of a body."""
    corners = [client.getAABB(body.id, link) for link in body.links.values()]
    lower = [min(corner[0][axis] for corner in corners) for axis in range(3)]
    upper = [max(corner[1][axis] for corner in corners) for axis in range(3)]
    return lower, upper


def forget_contacts(client: Client, bodies: Iterable[Body]) -> None:
    """Take bodies out of reach of everything and put them back, so that the solver forgets what pressed where.

    It starts from the forces of the step before, and a lasting contact may keep the friction and the stiffness of its
    first step. With these gone, what follows a reset is bit for bit what follows the start, and new dynamics act at
    once.
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
