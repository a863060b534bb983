"""Contacts of links: their friction and stiffness, what touches what, and the space that bodies take."""

from __future__ import annotations

import itertools
from collections.abc import Collection, Iterable, Iterator, Sequence, Set
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.drivers.scene.engine import RayFound
from hal.drivers.scene.values import BOUNCE

from .engine import Body, LinkContact

Array = NDArray[np.float64]

USUAL_FRICTION = 0.5
"""Friction of a link whose file or record does not give another one."""
HARD_CONTACT = (0.02, 1.0)
"""Time constant, s, and damping ratio of contacts without a stiffness: MuJoCo's own."""
HARD_IMPEDANCE = (0.95, 0.99, 0.001, 0.5, 2.0)
"""How much of a contact's ideal force acts: little of it is lost, so that fingers do not sink into what they hold."""
PAD_IMPEDANCE = (0.99, 0.999, 0.001, 0.5, 2.0)
"""The same between a gripper's pad and what it holds."""
BOUNCING_IMPEDANCE = (0.999, 0.999, 0.001, 0.5, 2.0)
"""The same of a contact with restitution."""
CARRIED = 5
"""Group of the shapes of objects that are attached to an arm, which rays pass through."""
REACH = 1e4
"""Largest distance between two bodies that is computed, m."""
SOFTEST = 0.02
"""Least ratio of the force that acts to that which is lost, for contacts with a stiffness."""


class ContactParameters(NamedTuple):
    """MuJoCo's parameters of a shape's contacts."""

    friction: tuple[float, float, float]
    condim: int
    solref: tuple[float, float]
    solimp: tuple[float, float, float, float, float]
    priority: int
    solmix: float = 1.0


def contact_parameters(contact: LinkContact, mass: float, h: float) -> ContactParameters:
    """Return the parameters of the shapes of a link with this mass, kg; ``h`` is MuJoCo's step, s.

    In a contact MuJoCo uses the greater friction of the two, not their product as this project means it: half of each
    (:data:`USUAL_FRICTION`) makes both the same where at least one of the two has the usual friction, and neither less.
    :func:`friction_pairs` gives all others.

    A contact in MuJoCo has a stiffness per mass, and loses a share of its force that acts like more mass. The share
    is chosen so that a spring of this stiffness is stable at this step.
    """
    friction = (USUAL_FRICTION * contact.lateral_friction, contact.spinning_friction, contact.rolling_friction)
    condim = 6 if contact.rolling_friction > 0.0 else 4 if contact.spinning_friction > 0.0 else 3
    stiffness, damping = contact.contact_stiffness, contact.contact_damping
    if stiffness is None or damping is None:
        if contact.pad:
            return ContactParameters(friction, condim, (2.0 * h, 1.0), PAD_IMPEDANCE, 0, 1e3)
        return ContactParameters(friction, condim, HARD_CONTACT, HARD_IMPEDANCE, 0)
    mass = mass or 1.0
    ratio = max(SOFTEST, 2.0 * (stiffness * h + damping) * h / mass)
    share = ratio / (1.0 + ratio)
    solref = (-stiffness * (1.0 - share) / mass, -damping * (1.0 - share) / mass)
    return ContactParameters(friction, condim, solref, (share, share, 0.001, 0.5, 2.0), 1)


def add_pairs(spec: Any, bodies: Collection[Body]) -> None:
    """Add to a ``mujoco.MjSpec`` the pairs of shapes of :func:`friction_pairs`, in place of those from before.

    MuJoCo has no restitution. But a contact's damping times the step is the share of the speed that it takes in a step,
    so that (1 + e) / h, without a spring that adds to it, sends bodies back with e times their speed.
    """
    for pair in spec.pairs:
        spec.delete(pair)
    h = spec.option.timestep
    for a, k, b, m, friction, bounce in friction_pairs(bodies):
        one, other = spec.geom(f"{a.link_path(k)}/0"), spec.geom(f"{b.link_path(m)}/0")
        first = max((one, other), key=lambda shape: (shape.priority, shape.solmix))
        spin, roll = (max(one.friction[place], other.friction[place]) for place in (1, 2))
        solref, solimp = first.solref, first.solimp
        if bounce > 0.0:
            solref, solimp = (-BOUNCE / h**2, -(1.0 + bounce) / h), BOUNCING_IMPEDANCE
        for first_shape, second_shape in itertools.product(range(a.solids[k]), range(b.solids[m])):
            spec.add_pair(
                geomname1=f"{a.link_path(k)}/{first_shape}",
                geomname2=f"{b.link_path(m)}/{second_shape}",
                friction=(friction, friction, spin, roll, roll),
                condim=max(one.condim, other.condim),
                solref=solref,
                solimp=solimp,
                solreffriction=HARD_CONTACT if bounce > 0.0 else (0.0, 0.0),
            )


def friction_pairs(bodies: Collection[Body]) -> Iterator[tuple[Body, int, Body, int, float, float]]:
    """Yield the links (body and number of each) whose contacts are not MuJoCo's own, with friction and restitution."""
    for a, k, b, m in _solid_pairs(bodies):
        pair = one, other = a.contacts[k], b.contacts[m]
        friction = one.lateral_friction * other.lateral_friction
        soft = [link for link in pair if link.contact_stiffness is not None]
        bounce = 0.0 if soft else one.restitution * other.restitution
        used = max(link.lateral_friction for link in (soft if len(soft) == 1 else pair))
        if abs(USUAL_FRICTION * used - friction) > 1e-9 or bounce > 0.0:
            yield a, k, b, m, friction, bounce


def _solid_pairs(bodies: Collection[Body]) -> Iterator[tuple[Body, int, Body, int]]:
    """Yield the links (body and number of each) of different bodies that may touch."""
    for a, b in itertools.combinations(bodies, 2):
        if a.carried or b.carried or not (a.floating or a.movable or b.floating or b.movable):
            continue
        skip_a, skip_b = a.ignored_by(b), b.ignored_by(a)
        for k, m in itertools.product(range(len(a.contacts)), range(len(b.contacts))):
            if a.solids[k] and b.solids[m] and k not in skip_a and m not in skip_b:
                yield a, k, b, m


def find_contacts(
    mujoco: Any,
    model: Any,
    data: Any,
    bodies: Iterable[Body],
    a: Body | None,
    b: Body | None,
    *,
    only: Set[int] | None = None,
    without: Set[int] = frozenset(),
) -> list[dict[str, Any]]:
    """Return the contacts of the last step, as :meth:`.SimulatedWorld.contacts` does; None stands for any body.

    ``only`` are MuJoCo's numbers of the links that have the contacts, ``without`` those of links that have none.
    """
    owners = {number: (body, link) for body in bodies for number, link in zip(body.ids, body.links, strict=True)}
    found, force = [], np.zeros(6)
    for number in range(data.ncon):
        contact = data.contact[number]
        if contact.efc_address < 0:
            continue
        ends = [int(model.geom_bodyid[geom]) for geom in contact.geom]
        if not without.isdisjoint(ends) or (only is not None and only.isdisjoint(ends)):
            continue
        one, other = (owners[end] for end in ends)
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
    solid_a, solid_b = (
        [(link, one.shapes[k]) for link, k in one.links.items() if k not in one.ignored_by(other)]
        for one, other in ((a, b), (b, a))
    )
    for link_a, shapes_a in solid_a:
        for link_b, shapes_b in solid_b:
            for one in shapes_a:
                for other in shapes_b:
                    apart = np.linalg.norm(data.geom_xpos[one] - data.geom_xpos[other])
                    if apart < model.geom_rbound[one] + model.geom_rbound[other]:
                        depth = -mujoco.mj_geomDistance(model, data, one, other, 0.001, None)
                        deepest = max(deepest, (depth, link_a, link_b))
    return deepest


def distance(mujoco: Any, model: Any, data: Any, a: Sequence[int], b: Sequence[int]) -> float | None:
    """Return the smallest distance between two groups of shapes, m, negative if they overlap; None without shapes."""
    pairs = []
    for one, other in itertools.product(a, b):
        rounds = model.geom_rbound[one], model.geom_rbound[other]  # 0 for a plane
        apart = np.linalg.norm(data.geom_xpos[one] - data.geom_xpos[other]) - sum(rounds)
        pairs.append((float(apart) if min(rounds) > 0.0 else -np.inf, one, other))
    least = np.inf
    for bound, one, other in sorted(pairs):
        if bound > least:
            break
        least = min(least, mujoco.mj_geomDistance(model, data, one, other, REACH, None))
    return float(least) if pairs else None


def cast_ray(
    mujoco: Any, model: Any, data: Any, bodies: Iterable[Body], start: Sequence[float], end: Sequence[float]
) -> RayFound | None:
    here, along = np.array(start, float), np.subtract(end, start)
    geom, normal = np.full((1, 1), -1, np.int32), np.zeros((3, 1))
    groups = np.array([[one] for one in (1, 1, 1, 1, 1, 0)], np.uint8)  # without CARRIED
    share = mujoco.mj_ray(model, data, here, along, groups, True, -1, geom, normal)
    if not 0.0 <= share <= 1.0:
        return None
    number = int(model.geom_bodyid[geom[0, 0]])
    body = next(body for body in bodies if number in body.ids)
    return RayFound(body, body.ids.index(number), (here + share * along).tolist(), normal[:, 0].tolist())


FAR = 1e30
"""Half extents of a plane, m: those of PyBullet, by which a reset of the scene knows a plane."""


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
