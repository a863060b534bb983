"""Mass and friction of links, contacts between bodies, and the space that bodies take."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .engine import Body
from .loading import STIFF_CONTACT, contact_dimensions

__all__ = ["bounding_box", "deepest_overlap", "find_contacts", "read_dynamics", "write_dynamics"]

Array = NDArray[np.float64]

_CONTACT = ("lateral_friction", "rolling_friction", "spinning_friction", "contact_stiffness", "contact_damping")


def read_dynamics(model: Any, body: Body, link: int) -> dict[str, Any]:
    """Return those of :data:`~hal.drivers.scene.values.DYNAMICS` that MuJoCo has."""
    number = body.ids[link]
    values: dict[str, Any] = {name: getattr(body.contacts[link], name) for name in _CONTACT}
    values["mass"] = float(model.body_mass[number])
    values["inertia"] = model.body_inertia[number].tolist()
    return values


def write_dynamics(mujoco: Any, spec: Any, model: Any, body: Body, link: int, values: Mapping[str, Any]) -> None:
    """Set some of the values of :func:`read_dynamics`, in the model and in what it is compiled from.

    MuJoCo's stiffness is per mass: ``contact_stiffness`` and ``contact_damping`` are divided by that of the link.

    Args:
        mujoco: The module.
        spec: The ``mujoco.MjSpec``.
        model: The model that was compiled from it.
        body: The body.
        link: Number of the link.
        values: New values by name.
    """
    number, contact = body.ids[link], body.contacts[link]
    node = spec.body(body.mujoco_name(list(body.links)[link]))
    if "mass" in values or "inertia" in values:
        node.mass = model.body_mass[number] = values.get("mass", model.body_mass[number])
        inertia = values.get("inertia", model.body_inertia[number].tolist())
        node.inertia = model.body_inertia[number] = inertia
        mujoco.mj_setConst(model, mujoco.MjData(model))
    for name in _CONTACT:
        if name in values:
            setattr(contact, name, values[name])
    mass = float(model.body_mass[number]) or 1.0
    solref = STIFF_CONTACT
    if contact.contact_stiffness is not None and contact.contact_damping is not None:
        solref = (-contact.contact_stiffness / mass, -contact.contact_damping / mass)
    friction = (contact.lateral_friction, contact.spinning_friction, contact.rolling_friction)
    for k, geom in enumerate(body.shapes[link]):
        model.geom_friction[geom], model.geom_solref[geom] = friction, solref
        model.geom_condim[geom] = contact_dimensions(contact)
        shape = spec.geom(f"{node.name}/{k}")
        shape.friction, shape.solref, shape.condim = friction, solref, contact_dimensions(contact)


# --- contacts --------------------------------------------------------------------------------------------------------


def find_contacts(
    mujoco: Any, model: Any, data: Any, bodies: Iterable[Body], a: Body | None, b: Body | None
) -> list[dict[str, Any]]:
    """Return the contacts of the last step, as :meth:`.SimulatedWorld.contacts` does; None stands for any body."""
    owners = {number: (body, link) for body in bodies for number, link in zip(body.ids, body.links, strict=True)}
    found, force = [], np.zeros(6)
    for number in range(data.ncon):
        contact = data.contact[number]
        if contact.efc_address < 0:
            continue
        one, other = (owners[int(model.geom_bodyid[geom])] for geom in contact.geom)
        normal = -contact.frame[:3]  # MuJoCo's points from the first shape to the second one
        if (a is not None and other[0] is a) or (a is None and b is not None and one[0] is b):
            one, other, normal = other, one, -normal
        if (a is not None and one[0] is not a) or (b is not None and other[0] is not b):
            continue
        mujoco.mj_contactForce(model, data, number, force)
        found.append(
            {
                "a": one[0].name,
                "b": other[0].name,
                "link_a": one[1],
                "link_b": other[1],
                "position": (contact.pos - 0.5 * contact.dist * normal).tolist(),
                "normal": normal.tolist(),
                "distance": float(contact.dist),
                "force": float(force[0]),
            }
        )
    return found


def deepest_overlap(mujoco: Any, model: Any, data: Any, a: Body, b: Body) -> tuple[float, str, str]:
    """Return how deep two bodies overlap, m, 0 where they are apart, and by which link of each."""
    deepest: tuple[float, str, str] = (0.0, "", "")
    for link_a, shapes_a in zip(a.links, a.shapes, strict=True):
        for link_b, shapes_b in zip(b.links, b.shapes, strict=True):
            for one in shapes_a:
                for other in shapes_b:
                    apart = np.linalg.norm(data.geom_xpos[one] - data.geom_xpos[other])
                    if apart < model.geom_rbound[one] + model.geom_rbound[other]:
                        depth = -mujoco.mj_geomDistance(model, data, one, other, 0.001, None)
                        deepest = max(deepest, (depth, link_a, link_b))
    return deepest


FAR = 1e3
"""Half extents of a plane, m."""


def bounding_box(mujoco: Any, model: Any, data: Any, body: Body) -> tuple[list[float], list[float]]:
    """Return the lower and upper corner (3,) m of the box along the world's axes around all links of a body."""
    boxes = [_box_of(mujoco, model, data, shape) for shapes in body.shapes for shape in shapes]
    if not boxes:
        place = data.xpos[body.ids[0]].tolist()
        return place, list(place)
    lower, upper = (np.array(corners) for corners in zip(*boxes, strict=True))
    return lower.min(axis=0).tolist(), upper.max(axis=0).tolist()


def _box_of(mujoco: Any, model: Any, data: Any, shape: int) -> tuple[Array, Array]:
    kinds = mujoco.mjtGeom
    kind, size, centre = model.geom_type[shape], model.geom_size[shape], data.geom_xpos[shape]
    turn = data.geom_xmat[shape].reshape(3, 3)
    if kind == kinds.mjGEOM_PLANE:
        return centre - FAR, centre + FAR * (1.0 - turn[:, 2])
    if kind == kinds.mjGEOM_MESH:
        mesh = model.geom_dataid[shape]
        first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
        points = model.mesh_vert[first : first + count] @ turn.T + centre
        return points.min(axis=0), points.max(axis=0)
    if kind == kinds.mjGEOM_SPHERE:
        half = np.full(3, size[0])
    elif kind == kinds.mjGEOM_CAPSULE:
        half = np.abs(turn[:, 2]) * size[1] + size[0]
    elif kind == kinds.mjGEOM_CYLINDER:
        half = np.abs(turn[:, 2]) * size[1] + size[0] * np.sqrt(np.maximum(0.0, 1.0 - turn[:, 2] ** 2))
    else:
        half = np.abs(turn) @ size
    return centre - half, centre + half
