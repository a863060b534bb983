"""Build arms and objects of a rig into a MuJoCo model, and correct what their URDF files leave out or get wrong.

Only what physics needs is built: links, joints, masses and collision shapes.
"""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.drivers.scene.gripper import FingerTravel
from hal.drivers.scene.records import (
    check_names,
    followers_of,
    hulls_of,
    joint_drives,
    mimics_of,
    pad_links,
    primitive_size,
)
from hal.drivers.scene.urdf_files import checked_urdf, has_free_base, massless, mesh_points
from hal.drivers.scene.values import listed
from hal.errors import ConfigError, Problem
from hal.geometry import Pose, quaternion_to_matrix
from hal.kinematics.hulls import Hull, principal_axes, uniform_solid
from hal.kinematics.urdf import TURNING, UrdfJoint, UrdfLink, UrdfModel, parse_xml
from hal.specs import BodySpec, RobotSpec

from .contacts import CARRIED, contact_parameters
from .engine import Body, LinkContact, load_mujoco, wxyz

Array = NDArray[np.float64]

FINGER_INERTIA = 1.0
"""Inertia of the drive of each finger, kg, at the fingertip: it is in no URDF, and a finger of 30 g alone could not
press steadily."""
ROUGH = 1.15
"""A link may have so many times the greatest inertia that fits its collision shapes, which are rough."""
UNSTOPPABLE, STRONGEST = 1e5, 1e9
"""Inertia, kg m2, and greatest torque, Nm, of the joints of an arm that mirrors a real one."""
LEAST_MASS, LEAST_INERTIA = 1e-3, 1e-7
"""Least mass, kg, and moment of inertia, kg m2, of a link that moves: MuJoCo takes none without."""
COUPLING = (0.01, 1.0)
"""Time constant, s, and damping ratio of the constraint between joints that move together."""
STIFF = (0.99, 0.999)
"""Impedance of the couplings that carry the whole force of a finger, at no distance and far from it."""
STIFF_FRICTION = (0.9999, 0.9999, 0.001, 0.5, 2.0)
"""How much of a joint's friction acts: what it holds creeps by less than 10 um/s."""
MOST_CORNERS = 400
"""Most corners of the hull of a mesh: MuJoCo finds contacts at neighbouring corners only, so that an object with very
close ones rocks."""
UNBOUNDED = 1e-6
"""What is added to the range of a joint, rad or m: a joint that rests at its limit needs no force to stay there."""


@dataclass
class Shape:
    """One collision shape, in the frame of its link."""

    kind: str
    size: tuple[float, ...]
    """Half extents of a box; radius; radius and half the length, m."""
    pose: Pose
    points: Array | None = None
    """Vertices (n, 3) of a mesh, m: its convex hull collides."""

    def corners(self) -> Array:
        """Return points (n, 3) in the frame of the link that the shape is within."""
        if self.points is not None:
            points = self.points
        else:
            half = {
                "box": self.size,
                "sphere": self.size * 3,
                "cylinder": (self.size[0], self.size[0], self.size[-1]),
                "capsule": (self.size[0], self.size[0], self.size[0] + self.size[-1]),
            }[self.kind]
            points = np.array(list(itertools.product(*((-one, one) for one in half))))
        corners: Array = points @ quaternion_to_matrix(self.pose.orientation).T + self.pose.position
        return corners


@dataclass
class Inertial:
    mass: float
    """kg"""
    moments: Array
    """(3,) kg m2, about the principal axes."""
    pose: Pose
    """Centre of mass and principal axes, in the frame of the link."""


@dataclass
class LinkPlan:
    """One link of a body, before it is built."""

    name: str
    joint: UrdfJoint | None
    """The joint that carries it; None for the base."""
    parent: int
    shapes: list[Shape]
    inertial: Inertial | None


@dataclass
class BodyPlan:
    """All that is needed to build one body."""

    body: Body
    links: list[LinkPlan]
    """From the base outwards."""
    limits: dict[str, tuple[float, float] | None] = field(default_factory=dict)
    """Range of each joint that moves, rad or m."""
    mimics: list[tuple[str, str, float, float]] = field(default_factory=list)
    """Follower, leader, multiplier and offset."""
    fingers: dict[str, float] = field(default_factory=dict)
    """Inertia of the drive of each finger, kg or kg m2, by its joint."""
    unstoppable: tuple[str, ...] = ()
    """Joints that nothing holds back."""
    warnings: list[str] = field(default_factory=list)


# --- records ---------------------------------------------------------------------------------------------------------


def plan_object(spec: BodySpec) -> BodyPlan:
    """Return the plan of an object.

    Raises ConfigError if its file is missing or broken, MuJoCo cannot take it, or a size that its shape needs is
    missing.
    """
    if spec.shape != "urdf":
        hulls = hulls_of(spec) if spec.shape == "mesh" else ()
        shapes = [Shape("mesh", (), Pose(), hull.points) for hull in hulls] or [_primitive(spec)]
        free = has_free_base(spec, None)
        inertial = None
        if free:
            inertial = _solid(spec.mass, hulls) if hulls else _uniform(spec.mass, shapes[0])
        body = Body(
            name=spec.name,
            spec=spec,
            links={"base": 0},
            joints={},
            movable=(),
            floating=free,
            base=(tuple(spec.position), tuple(spec.orientation)),
            contacts=[LinkContact()],
            solids=[len(shapes) if spec.collision else 0],
        )
        return BodyPlan(body, [LinkPlan("base", None, -1, shapes if spec.collision else [], inertial)])
    key = f"objects.{spec.name}.urdf"
    if spec.urdf is None:
        raise ConfigError([Problem("objects", key, "is missing, and the shape is urdf", "missing_key")])
    urdf = checked_urdf(spec.urdf, key)
    plan = _plan_urdf(spec, urdf, key, spec.scale)
    body = plan.body
    body.floating = has_free_base(spec, urdf)
    if body.floating and plan.links[0].inertial is None:  # a frame that other links are fixed to
        alone = len(plan.links) == 1
        plan.links[0].inertial = Inertial(1.0 if alone else LEAST_MASS, np.full(3, LEAST_INERTIA), Pose())
    body.home = dict.fromkeys(body.movable, 0.0)
    body.base = (tuple(spec.position), tuple(spec.orientation))
    if made_up := massless(urdf):
        plan.warnings.append(f"{spec.name}: no <inertial> in {listed(made_up)}; 1 kg is used for each")
    return plan


def plan_robot(spec: RobotSpec, *, mirrored: bool = False) -> BodyPlan:
    """Return the plan of an arm, with its base fixed in the world. Raises ConfigError, as :func:`plan_object`.

    One that is ``mirrored`` mirrors a real arm: nothing in the world stops its joints, and its fingers have their grip
    force.
    """
    key = f"robots.{spec.name}.urdf"
    urdf = checked_urdf(spec.urdf, key)
    plan = _plan_urdf(spec, urdf, key, 1.0)
    body = plan.body
    moving = {name: joint for name, joint in urdf.joints.items() if joint.movable}
    check_names(spec, moving, body.links)
    limits = {name: (joint.effort or 0.0, joint.velocity or 0.0) for name, joint in moving.items()}
    drives = joint_drives(spec, limits, urdf)
    plan.warnings += drives.warnings
    for name in moving:
        number = body.joints[name]
        body.home[number], body.efforts[number] = drives.home[name], drives.efforts[name]
        body.speeds[number] = drives.speeds[name]
        if moving[name].damping:
            body.damping[number] = moving[name].damping
    body.followers = followers_of(spec, urdf)
    for name, friction in pad_links(spec, urdf).items():
        contact = body.contacts[body.links[name]]
        contact.pad = True
        if friction:
            contact.lateral_friction, contact.spinning_friction = friction
    if spec.gripper:
        middle = spec.gripper.width_max / 2.0
        levers = FingerTravel(spec.gripper).speeds(1.0, middle)
        plan.fingers = {
            name: FINGER_INERTIA * (0.5 / lever) ** 2 for name, lever in zip(spec.gripper.joints, levers, strict=True)
        }
        plan.fingers |= {one.joint: plan.fingers[one.of] * one.multiplier**2 for one in body.followers}
    if mirrored:
        plan.unstoppable = spec.joints
        for name in moving:
            if name not in (one.joint for one in body.followers):
                body.efforts[body.joints[name]] = STRONGEST
        if spec.gripper:
            efforts = FingerTravel(spec.gripper).efforts(spec.gripper.force, middle)
            body.efforts |= {body.joints[name]: e for name, e in zip(spec.gripper.joints, efforts, strict=True)}
    root = Pose(spec.base_position, spec.base_orientation)
    if spec.kinematics.base_link:
        root = root @ urdf.poses({})[spec.kinematics.base_link].inverse()
    body.base = (tuple(root.position.tolist()), tuple(root.orientation.tolist()))
    return plan


def _plan_urdf(spec: BodySpec | RobotSpec, urdf: UrdfModel, key: str, scale: float) -> BodyPlan:
    for joint in urdf.joints.values():
        if not joint.movable and joint.kind != "fixed":
            message = f"joint {joint.name!r} is neither fixed, revolute, continuous nor prismatic"
            raise ConfigError([Problem(str(urdf.path), key, message, "wrong_joint")])
    elements = {element.get("name", ""): element for element in parse_xml(urdf.path).findall("link")}
    order = (urdf.root, *(joint.child for joint in urdf.outwards))
    number = {name: k for k, name in enumerate(order)}
    carried_by = {joint.child: joint for joint in urdf.joints.values()}
    pads = pad_links(spec, urdf)
    links: list[LinkPlan] = []
    fixed: list[str] = []
    problems: list[Problem] = []
    for name in order:
        link, found = urdf.links[name], carried_by.get(name)
        try:
            shapes = list(_shapes(link, scale, name in pads))
        except ValueError as error:
            text = f"MuJoCo cannot load link {name!r}: {error}"
            problems.append(Problem(str(urdf.path), key, text, "bad_mesh"))
            continue
        least = LEAST_INERTIA if found is None or found.movable else 0.0
        inertial, wrong = _inertial(elements[name], link, shapes, scale, least)
        if wrong:
            fixed.append(name)
        links.append(LinkPlan(name, found, number[found.parent] if found else -1, shapes, inertial))
    if problems:
        raise ConfigError(problems)
    joints = {name: k for k, name in enumerate(urdf.joints)}
    moving = [joint for joint in urdf.joints.values() if joint.movable]
    plan = BodyPlan(
        Body(
            name=spec.name,
            spec=spec,
            links=number,
            joints=joints,
            movable=tuple(joints[joint.name] for joint in moving),
            floating=False,
            contacts=[_contact(elements[name]) for name in order],
            urdf=urdf,
            solids=[len(link.shapes) for link in links],
        ),
        links,
        limits={joint.name: _range(joint, scale) for joint in moving},
        mimics=[(one.joint, one.of, one.multiplier, one.offset) for one in mimics_of(spec, urdf)],
    )
    if fixed:
        text = "inertia computed from the collision shapes, the URDF's is impossible"
        plan.warnings.append(f"{spec.name}: {text}: {listed(fixed)}")
    if scale != 1.0:
        for made in links:
            if made.joint is not None:
                made.joint = _scale_joint(made.joint, scale)
    return plan


def _scale_joint(joint: UrdfJoint, scale: float) -> UrdfJoint:
    return replace(joint, origin=Pose(joint.origin.position * scale, joint.origin.orientation))


def _range(joint: UrdfJoint, scale: float) -> tuple[float, float] | None:
    if joint.lower is None or joint.upper is None or joint.lower >= joint.upper:
        return None
    size = 1.0 if joint.kind in TURNING else scale
    return size * joint.lower - UNBOUNDED, size * joint.upper + UNBOUNDED


def _contact(link: ElementTree.Element) -> LinkContact:
    """Return the frictions in a link's ``<contact>``, a custom element of PyBullet's."""
    given: dict[str, Any] = {}
    for name in ("lateral_friction", "rolling_friction", "spinning_friction"):
        element = link.find(f"contact/{name}")
        if element is not None and element.get("value"):
            given[name] = float(element.get("value", "0"))
    return LinkContact(**given)


# --- shapes ----------------------------------------------------------------------------------------------------------


def _primitive(spec: BodySpec) -> Shape:
    size = primitive_size(spec)
    if spec.shape in ("cylinder", "capsule"):
        size = (size[0], size[1] / 2.0)
    elif spec.shape == "plane":  # infinite in contacts
        size = (0.0, 0.0, 1.0)
    return Shape(spec.shape, size, Pose())


def _shapes(link: UrdfLink, scale: float, sliced: bool) -> Iterator[Shape]:
    """Yield the collision shapes of a link; raises ValueError if a mesh has no hull."""
    for shape in link.collisions:
        pose = Pose(shape.pose.position * scale, shape.pose.orientation)
        if shape.shape == "mesh":
            for points in mesh_points(shape, sliced=sliced):
                yield Shape("mesh", (), pose, points * scale)
        elif shape.shape == "box":
            yield Shape("box", tuple(side / 2.0 * scale for side in shape.size), pose)
        elif shape.shape == "sphere":
            yield Shape("sphere", (shape.size[0] * scale,), pose)
        else:
            radius, length = shape.size
            yield Shape(shape.shape, (radius * scale, length / 2.0 * scale), pose)


# --- masses ----------------------------------------------------------------------------------------------------------


def _uniform(mass: float, shape: Shape) -> Inertial:
    if shape.kind == "box":
        return Inertial(mass, mass * _box_inertia(shape.corners()), shape.pose)
    r, half = shape.size[0], shape.size[-1] if len(shape.size) == 2 else 0.0
    ends = 0.0 if shape.kind == "cylinder" else 4.0 * r / (4.0 * r + 6.0 * half)  # share of the mass in the caps
    across = (1.0 - ends) * (r * r / 4.0 + half * half / 3.0) + ends * (0.4 * r * r + half * half + 0.75 * half * r)
    along = (1.0 - ends) * r * r / 2.0 + ends * 0.4 * r * r
    return Inertial(mass, mass * np.array([across, across, along]), shape.pose)


def _solid(mass: float, hulls: Sequence[Hull]) -> Inertial:
    solid = uniform_solid(hulls)
    return Inertial(mass, mass * solid.moments, Pose.from_matrix(_frame(solid.axes, solid.centre)))


def _box_inertia(corners: Array) -> Array:
    """Return the moments (3,) of the box of 1 kg around points, m2."""
    squares = np.square(corners.max(axis=0) - corners.min(axis=0))
    moments: Array = (squares.sum() - squares) / 12.0
    return moments


def _inertial(
    element: ElementTree.Element, link: UrdfLink, shapes: list[Shape], scale: float, least: float
) -> tuple[Inertial | None, bool]:
    """Return the mass of a link, and whether its inertia is not the file's, which is impossible.

    No moment of inertia is less than ``least``, kg m2.

    The mass of a link lies inside the box around its collision shapes. If all of it were in the corners, the inertia
    would be three times that of a uniform box; no body has more. Placeholders such as 0.1 kg m2 for a finger of 0.1 kg
    break this bound by orders of magnitude. Links without a shape, or with a possible inertia, keep the file's.
    """
    corners = np.vstack([shape.corners() for shape in shapes]) if shapes else None
    given = element.find("inertial")
    if given is None:
        if not link.has_shapes:
            return None, False
        of_shapes = _box_inertia(corners) if corners is not None else np.full(3, 1e-3)
        middle = (corners.max(axis=0) + corners.min(axis=0)) / 2.0 if corners is not None else np.zeros(3)
        return Inertial(1.0, of_shapes, Pose(middle)), False
    mass_of, inertia = given.find("mass"), given.find("inertia")
    mass = float(mass_of.get("value", "0")) if mass_of is not None else 0.0
    values = {name: float(inertia.get(name, "0")) if inertia is not None else 0.0 for name in _MOMENTS}
    if mass <= 0.0:
        return None, any(values.values())
    place = link.inertial or Pose()
    xx, yy, zz, xy, xz, yz = values.values()
    moments, axes = principal_axes(np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]]) * scale**2)
    pose = Pose(place.position * scale, place.orientation) @ Pose.from_matrix(_frame(axes))
    wrong = False
    if corners is not None:
        most = 3.0 * mass * _box_inertia(corners)
        wrong = bool((np.sort(moments) > ROUGH * np.sort(most)).any()) or bool((moments <= 0.0).all())
        if wrong:
            moments, pose = most / 3.0, Pose(pose.position)
    moments = np.maximum(moments, least)
    excess = moments.max() - (moments.sum() - moments.max())  # MuJoCo refuses a moment above the sum of the others
    if excess > 0.0:
        moments = moments + np.where(moments == moments.max(), 0.0, 0.5 * excess * (1.0 + 1e-6))
    return Inertial(mass, moments, pose), wrong


_MOMENTS = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")


def _frame(axes: Array, position: Array | float = 0.0) -> Array:
    matrix = np.eye(4)
    matrix[:3, :3], matrix[:3, 3] = axes, position
    return matrix


# --- building --------------------------------------------------------------------------------------------------------


def build(model: Any, plan: BodyPlan) -> None:
    """Add a body to a ``mujoco.MjSpec``. Links, joints and shapes of one body do not collide with each other."""
    mujoco = load_mujoco()
    body = plan.body
    made: list[Any] = []
    for number, link in enumerate(plan.links):
        if link.joint is None:
            position, orientation = body.base
            node = model.worldbody.add_body(name=body.mujoco_name(link.name), pos=position, quat=wxyz(orientation))
            if body.floating:
                node.add_freejoint(name=body.mujoco_name())
        else:
            origin = link.joint.origin
            node = made[link.parent].add_body(
                name=body.mujoco_name(link.name), pos=origin.position, quat=wxyz(origin.orientation)
            )
            if link.joint.movable:
                _add_joint(mujoco, node, plan, link.joint)
        made.append(node)
        inertial = link.inertial
        if inertial is None and link.joint is not None and link.joint.movable:
            inertial = Inertial(LEAST_MASS, np.full(3, LEAST_INERTIA), Pose())
        node.explicitinertial = True
        if inertial is not None:
            node.mass, node.inertia = inertial.mass, inertial.moments
            node.ipos, node.iquat = inertial.pose.position, wxyz(inertial.pose.orientation)
        for k, shape in enumerate(link.shapes):
            _add_shape(mujoco, model, node, body, number, f"{body.mujoco_name(link.name)}/{k}", shape)
    names = [body.mujoco_name(link.name) for link in plan.links]
    for first, second in itertools.combinations((names[k] for k, link in enumerate(plan.links) if link.shapes), 2):
        model.add_exclude(bodyname1=first, bodyname2=second, name=f"{first}|{second}")  # as in PyBullet
    followers = {one.joint for one in body.followers}
    for follower, leader, multiplier, offset in plan.mimics:
        coupling = model.add_equality(
            name=f"{body.mujoco_name(follower)}|mimic",
            type=mujoco.mjtEq.mjEQ_JOINT,
            objtype=mujoco.mjtObj.mjOBJ_JOINT,
            name1=body.mujoco_name(follower),
            name2=body.mujoco_name(leader),
            solref=COUPLING,
        )
        coupling.data[:2] = offset, multiplier
        if follower in followers:
            coupling.solimp[:2] = STIFF


def take_out(model: Any, plan: BodyPlan) -> None:
    body = plan.body
    root = model.body(body.mujoco_name(plan.links[0].name))
    prefix = body.mujoco_name()
    for one in (*model.excludes, *model.equalities):
        if one.name.startswith(prefix):
            model.delete(one)
    model.delete(root)
    for mesh in model.meshes:
        if mesh.name.startswith(prefix):
            model.delete(mesh)


def _add_joint(mujoco: Any, node: Any, plan: BodyPlan, joint: UrdfJoint) -> None:
    turn = joint.origin.inverse().orientation
    axis = Pose((0.0, 0.0, 0.0), turn).matrix()[:3, :3] @ np.array(joint.axis)  # in the child's frame
    kind = mujoco.mjtJoint.mjJNT_HINGE if joint.kind in TURNING else mujoco.mjtJoint.mjJNT_SLIDE
    made = node.add_joint(name=plan.body.mujoco_name(joint.name), type=kind, axis=axis)
    limits = plan.limits[joint.name]
    made.limited = limits is not None
    if limits is not None:
        made.range = limits
    if joint.name in plan.fingers:
        made.armature = plan.fingers[joint.name]
    elif joint.name in plan.unstoppable:
        made.armature = UNSTOPPABLE
    if not plan.body.is_robot:
        linear_only = (joint.damping, 0.0, 0.0)  # since MuJoCo 4, with terms of higher order
        made.damping = linear_only if np.ndim(made.damping) else joint.damping
        made.frictionloss, made.solimp_friction = joint.friction, STIFF_FRICTION


_KINDS: Mapping[str, str] = {
    "box": "mjGEOM_BOX",
    "sphere": "mjGEOM_SPHERE",
    "cylinder": "mjGEOM_CYLINDER",
    "capsule": "mjGEOM_CAPSULE",
    "plane": "mjGEOM_PLANE",
    "mesh": "mjGEOM_MESH",
}


def _add_shape(mujoco: Any, model: Any, node: Any, body: Body, link: int, name: str, shape: Shape) -> None:
    values: dict[str, Any] = {
        "name": name,
        "type": getattr(mujoco.mjtGeom, _KINDS[shape.kind]),
        "pos": shape.pose.position,
        "quat": wxyz(shape.pose.orientation),
        "mass": 0.0,
        **contact_parameters(body.contacts[link], node.mass, model.option.timestep)._asdict(),
    }
    if body.carried:
        values |= {"contype": 0, "conaffinity": 0, "group": CARRIED}
    if shape.points is not None:
        mesh = model.add_mesh(name=name)
        mesh.uservert = shape.points.ravel().tolist()
        if body.urdf is None:
            mesh.maxhullvert = MOST_CORNERS
        values["meshname"] = name
    else:
        values["size"] = (*shape.size, 0.0, 0.0)[:3]
    node.add_geom(**values)
