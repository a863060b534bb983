"""Inertias that no body of a link's mass and size can have, which are common in URDF files, and what to do then."""

from __future__ import annotations

from collections.abc import Container

from .body import Body
from .library import Client
from .values import listed

__all__ = ["mend_inertias"]


def mend_inertias(client: Client, body: Body, massless: Container[str]) -> list[str]:
    """Give links whose inertia cannot be that of their shape.

    The mass of a link lies inside the box around its collision shape. All of it in the corners would have three times
    the inertia of an even box, which is what PyBullet gives a shape, and nothing has more. Placeholders such as
    0.1 kg m2 for a finger of 0.1 kg break this by orders of magnitude; a wrist with them needs more torque than it
    has to keep its own acceleration limits. Links without a shape, or with a possible inertia, keep the file's.

    Args:
        massless: links of which the file says nothing; they are mended without a word.

    Returns:
        Warnings for a person.
    """
    mended = []
    for name, link in body.links.items():
        mass, _, given = client.getDynamicsInfo(body.id, link)[:3]
        if mass <= 0.0:
            if any(given):
                client.changeDynamics(body.id, link, localInertiaDiagonal=(0.0, 0.0, 0.0))
                mended.append(name)
            continue
        if not client.getCollisionShapeData(body.id, link):
            continue
        client.changeDynamics(body.id, link, mass=mass)  # PyBullet then computes the inertia of the shape
        of_shape = client.getDynamicsInfo(body.id, link)[2]
        if all(value <= 3.0 * greatest for value, greatest in zip(sorted(given), sorted(of_shape), strict=True)):
            client.changeDynamics(body.id, link, localInertiaDiagonal=given)
        else:
            mended.append(name)
    wrong = [name for name in mended if name not in massless]
    if not wrong:
        return []
    return [f"{body.name}: inertia computed from the collision shapes, the URDF's is impossible: {listed(wrong)}"]
