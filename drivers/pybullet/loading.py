"""Load the arms and objects of a rig into PyBullet, and correct what their URDF files leave out or get wrong."""

from __future__ import annotations

import contextlib
import copy
import json
import math
import tempfile
import xml.etree.ElementTree as ElementTree
from collections.abc import Container, Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hal.drivers.scene.records import check_names, hulls_of, joint_drives, mimics_of, pad_links, primitive_size
from hal.drivers.scene.urdf_files import checked_urdf, has_free_base, massless, mesh_points
from hal.drivers.scene.values import listed
from hal.errors import ConfigError, Problem
from hal.geometry import Transform, compose, inverse
from hal.kinematics.hulls import Hull, convex_hull, uniform_solid
from hal.kinematics.mesh_files import cache_file, mesh_file, mesh_near, write_whole
from hal.kinematics.urdf import UrdfMimic, UrdfModel, UrdfVisual, parse_xml
from hal.specs import BodySpec, RobotSpec

from .engine import Body, Gear, PyBulletClient, silence_output
from .motors import PassiveJoints

MARGIN, THIN = 0.001, 0.2
"""Margin that PyBullet adds around hulls, m; and what is taken off a thin hull at most, as a share of its thickness."""
_TIGHT = 1
"""Version of the cached hulls; increase it whenever they change."""
SLIVER = 1e-6
"""Area of a face, as a share of the greatest, below which it is left out: its normal is a matter of chance."""
LEAST_MASS, LEAST_INERTIA = 1e-3, 1e-7
"""Mass, kg, and moment of inertia, kg m2, of a mere frame that a joint moves: Bullet takes none without."""
PAD_STIFFNESS, PAD_DAMPING = 2e5, 2e3
"""Of contacts of a gripper's pads, N/m and Ns/m: so hard that the width is that of what is held."""
FINGER_MASS = 0.1
"""Least mass of a finger that moves or holds something, kg: the solver lets one of 29 g press with no more than 26 N.
The drive that moves with it is in no URDF. Fingers at rest have their own mass, so that the arm's inertia is right."""


def load_object(client: PyBulletClient, spec: BodySpec) -> tuple[Body, list[str]]:
    """Load an object; return it with warnings for the user.

    Raises ConfigError if its file is missing or broken, or a size that its shape needs is missing.
    """
    key = f"objects.{spec.name}"
    if spec.shape == "mesh":
        return _describe(client, spec, _make_mesh(client, spec, key), key), []
    if spec.shape != "urdf":
        number = _make_shape(client, spec)
        body = _describe(client, spec, number, key)
        return body, []
    if spec.urdf is None:
        raise ConfigError([Problem("objects", f"{key}.urdf", "is missing, and the shape is urdf", "missing_key")])
    urdf = checked_urdf(spec.urdf, f"{key}.urdf")
    lacking = massless(urdf)
    number = _load_urdf(client, spec.urdf, f"{key}.urdf", fixed=spec.fixed or spec.robot is not None, scale=spec.scale)
    body = _describe(client, spec, number, f"{key}.urdf", urdf)
    _lighten_frames(client, body, urdf)
    _couple(client, body, mimics_of(spec, urdf))
    if body.movable:
        PassiveJoints(client, body).release()
    warnings = fix_inertias(client, body, lacking)
    if lacking:
        warnings.append(f"{spec.name}: no <inertial> in {listed(lacking)}; PyBullet takes 1 kg for each")
    return body, warnings


def load_robot(client: PyBulletClient, spec: RobotSpec) -> tuple[Body, list[str]]:
    """Load an arm, with its base fixed in the world.

    Takes, returns and raises the same as :func:`load_object`; a joint or link that the URDF lacks is a ConfigError too.
    """
    key = f"robots.{spec.name}"
    urdf = checked_urdf(spec.urdf, f"{key}.urdf")
    lacking = massless(urdf)
    pads = pad_links(spec, urdf)
    tight = {name: urdf.links[name].collisions for name in pads}
    number = _load_urdf(client, spec.urdf, f"{key}.urdf", fixed=True, scale=1.0, tight=tight)
    body = _describe(client, spec, number, f"{key}.urdf", urdf)
    _lighten_frames(client, body, urdf)
    moving = {name: joint for name, joint in body.joints.items() if joint in body.movable}
    check_names(spec, moving, body.links)

    warnings = fix_inertias(client, body, lacking)
    infos = {name: client.getJointInfo(number, joint) for name, joint in moving.items()}
    drives = joint_drives(spec, {name: (float(info[10]), float(info[11])) for name, info in infos.items()}, urdf)
    for name, joint in moving.items():
        body.home[joint], body.efforts[joint] = drives.home[name], drives.efforts[name]
        body.speeds[joint] = drives.speeds[name]
    arm = [moving[name] for name in spec.joints]
    for name, friction in pads.items():
        link = body.links[name]
        if friction:
            client.changeDynamics(number, link, lateralFriction=friction[0], spinningFriction=friction[1])
        client.changeDynamics(
            number, link, contactStiffness=PAD_STIFFNESS, contactDamping=PAD_DAMPING, frictionAnchor=True
        )
        mass, _, moments = client.getDynamicsInfo(number, link)[:3]
        if mass < FINGER_MASS and link in moving.values() and link not in arm:
            client.changeDynamics(number, link, mass=FINGER_MASS)
            body.fingers[link] = (mass, moments), (FINGER_MASS, client.getDynamicsInfo(number, link)[2])
    body.base = _root_pose(client, body, spec)
    _couple(client, body, mimics_of(spec, urdf))
    return body, warnings + drives.warnings


@contextmanager
def loadable_urdf(path: str, tight: Mapping[str, Sequence[UrdfVisual]] | None = None) -> Iterator[str]:
    """Yield the path of a URDF that PyBullet can load: a temporary copy where meshes are in packages.

    Meshes in a package that is not installed are left out, and with its last one the visual shape. ``tight`` has the
    collision shapes of links that get no margin: on a finger it would be an error of the width.
    """
    folder = Path(path).resolve().parent
    root = parse_xml(path)
    files = [element for tag in ("mesh", "texture") for element in root.iter(tag) if element.get("filename")]
    if not tight and all(mesh_near(element.get("filename", ""), folder) for element in files):
        yield path
        return
    for element in files:
        element.set("filename", str(mesh_file(element.get("filename", ""), folder)))
    for link in root.iter("link"):
        for owner in (*link.findall("visual"), *link.findall("collision")):
            for geometry in owner.findall("geometry"):
                shapes = [one for one in geometry if one.tag != "mesh" or Path(one.get("filename", "")).is_file()]
                if len(geometry) and not shapes:
                    link.remove(owner)
                geometry[:] = shapes[:1]
    with tempfile.TemporaryDirectory() as place:
        for link in root.iter("link"):
            _tighten(link, (tight or {}).get(link.get("name", ""), ()), Path(place))
        file = Path(place) / Path(path).name
        file.write_bytes(ElementTree.tostring(root, encoding="utf-8"))
        yield str(file)


def _tighten(link: ElementTree.Element, shapes: Sequence[UrdfVisual], place: Path) -> None:
    """Take PyBullet's margin off a link's cylinders, and off its meshes, which become hulls in files at ``place``."""
    for collision, shape in zip(link.findall("collision"), shapes, strict=bool(shapes)):
        for cylinder in collision.iter("cylinder"):  # in a URDF PyBullet makes a hull of it
            radius, length = shape.size
            margin = min(MARGIN, THIN * min(2.0 * radius, length))
            cylinder.attrib = {"radius": f"{radius - margin:.9g}", "length": f"{length - 2.0 * margin:.9g}"}
        if shape.shape != "mesh":
            continue
        link.remove(collision)
        for text in _tight_hulls(shape):
            file = place / f"{link.get('name')}_{len(link)}.obj"
            file.write_text(text)
            part = copy.deepcopy(collision)
            for mesh in part.iter("mesh"):
                mesh.attrib = {"filename": str(file)}
            link.append(part)


def _tight_hulls(shape: UrdfVisual) -> list[str]:
    """Return the OBJ files of a mesh's hulls, smaller by PyBullet's margin; from the user's cache if it has them.

    They take seconds for some arms. A cache that is missing, broken or not writable only costs that time.
    """
    cached = cache_file("hulls", Path(shape.file), _TIGHT, shape.size, suffix=".json")
    with contextlib.suppress(OSError, ValueError):
        found: list[str] = json.loads(cached.read_bytes())
        return found
    made = [_tighten_hull(convex_hull(points)) for points in mesh_points(shape, sliced=True)]
    with contextlib.suppress(OSError):
        write_whole(cached, json.dumps(made).encode())
    return made


def _tighten_hull(hull: Hull) -> str:
    """Return the OBJ file of a hull that is smaller by PyBullet's margin."""
    smaller = remove_margin(hull)
    lines = [f"v {x:.9g} {y:.9g} {z:.9g}\n" for x, y, z in smaller.points]
    return "".join(lines + [f"f {a} {b} {c}\n" for a, b, c in smaller.faces + 1])


def _load_urdf(
    client: PyBulletClient,
    path: str,
    key: str,
    *,
    fixed: bool,
    scale: float,
    tight: Mapping[str, Sequence[UrdfVisual]] | None = None,
) -> int:
    number = -1
    with loadable_urdf(path, tight) as file, silence_output() as captured:
        try:
            # Without the inertia of the file, PyBullet invents one from the collision shapes.
            flags = client.URDF_USE_INERTIA_FROM_FILE | client.URDF_IGNORE_VISUAL_SHAPES
            number = client.loadURDF(file, useFixedBase=fixed, globalScaling=scale, flags=flags)
        except client.error:
            pass  # reported below, with what PyBullet printed
        if number >= 0:
            try:
                client.getBasePositionAndOrientation(number)
            except client.error:  # PyBullet has no room for its state
                number = -1
    if number < 0:
        printed = " ".join(captured.text.split())
        raise ConfigError([Problem(path, key, f"PyBullet cannot load it. {printed}".strip(), "bad_urdf")])
    return number


def _make_shape(client: PyBulletClient, spec: BodySpec) -> int:
    size = primitive_size(spec)
    if spec.shape == "box":
        solid = {"shapeType": client.GEOM_BOX, "halfExtents": size}
    elif spec.shape == "sphere":
        solid = {"shapeType": client.GEOM_SPHERE, "radius": size[0]}
    elif spec.shape == "plane":
        solid = {"shapeType": client.GEOM_PLANE, "planeNormal": (0.0, 0.0, 1.0)}
    else:
        kind = client.GEOM_CYLINDER if spec.shape == "cylinder" else client.GEOM_CAPSULE
        solid = {"shapeType": kind, "radius": size[0], "height": size[1]}
    shape = client.createCollisionShape(**solid) if spec.collision else -1
    mass = spec.mass if has_free_base(spec, None) else 0.0
    number: int = client.createMultiBody(mass, shape)
    return number


def _make_mesh(client: PyBulletClient, spec: BodySpec, key: str) -> int:
    """Make an object of the shape ``mesh`` from the hulls that collide: PyBullet reads several only from a URDF."""
    hulls = hulls_of(spec)
    free = has_free_base(spec, None)
    with tempfile.TemporaryDirectory() as place:
        parts = []
        for k, hull in enumerate(hulls if spec.collision else ()):
            Path(place, f"{k}.obj").write_text(_tighten_hull(hull))
            parts.append(f'<collision><geometry><mesh filename="{k}.obj"/></geometry></collision>')
        if free:
            solid = uniform_solid(hulls)
            roll, pitch, yaw = _rpy(solid.axes)
            centre, (xx, yy, zz) = " ".join(map(repr, solid.centre.tolist())), (spec.mass * solid.moments).tolist()
            parts.append(
                f'<inertial><origin xyz="{centre}" rpy="{roll!r} {pitch!r} {yaw!r}"/><mass value="{spec.mass}"/>'
                f'<inertia ixx="{xx!r}" iyy="{yy!r}" izz="{zz!r}" ixy="0" ixz="0" iyz="0"/></inertial>'
            )
        else:
            nothing = '<inertia ixx="0" iyy="0" izz="0" ixy="0" ixz="0" iyz="0"/>'
            parts.append(f'<inertial><mass value="0"/>{nothing}</inertial>')
        file = Path(place) / "mesh.urdf"
        file.write_text(f'<robot name="it"><link name="base">{"".join(parts)}</link></robot>')
        return _load_urdf(client, str(file), f"{key}.mesh", fixed=not free, scale=1.0)


def _rpy(axes: NDArray[np.float64]) -> tuple[float, float, float]:
    """Return the angles of a URDF of a rotation matrix (3, 3), rad."""
    roll, yaw = math.atan2(axes[2, 1], axes[2, 2]), math.atan2(axes[1, 0], axes[0, 0])
    return roll, math.atan2(-axes[2, 0], math.hypot(axes[2, 1], axes[2, 2])), yaw


def remove_margin(hull: Hull) -> Hull:
    """Return a hull that is smaller by the margin that PyBullet adds around hulls; one that is thin keeps some.

    It is where all faces, moved inwards by the margin, leave room. Seen from a point inside, a plane at the distance d
    with the normal n is the point n / d of the dual space, and each face of the dual points' hull is a corner.
    """
    normals, _ = _planes(hull)
    middle = uniform_solid([hull]).centre
    heights = normals @ (hull.points - middle).T
    margin = min(MARGIN, THIN * float(np.ptp(heights, axis=1).min()))
    normals, distances = _planes(convex_hull(normals / (heights.max(axis=1) - margin)[:, None]))
    return convex_hull(middle + normals / distances[:, None])


def _planes(hull: Hull) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the normals (n, 3) of a hull's faces, and their distances (n,) from the origin; without slivers."""
    corners = hull.points[hull.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    wide = areas > SLIVER * areas.max()
    normals = normals[wide] / areas[wide, None]
    return normals, np.einsum("fi,fi->f", normals, corners[wide, 0])


def _describe(
    client: PyBulletClient, spec: BodySpec | RobotSpec, number: int, key: str, urdf: UrdfModel | None = None
) -> Body:
    """Return a body with its names, indices and frames as PyBullet loaded them."""
    links = {client.getBodyInfo(number)[0].decode() if urdf is not None else "base": -1}  # as in hal.drivers.scene
    joints: dict[str, int] = {}
    movable: set[int] = set()
    for joint in range(client.getNumJoints(number)):
        info = client.getJointInfo(number, joint)
        joints[info[1].decode()] = joint
        links[info[12].decode()] = joint
        if info[2] in (client.JOINT_REVOLUTE, client.JOINT_PRISMATIC):
            movable.add(joint)
        elif info[2] != client.JOINT_FIXED:
            message = f"joint {info[1].decode()!r} is neither fixed, revolute, continuous nor prismatic"
            raise ConfigError([Problem(str(spec.urdf), key, message, "wrong_joint")])
    client.changeDynamics(number, -1, linearDamping=0.0, angularDamping=0.0)  # there is no air
    dynamics = client.getDynamicsInfo(number, -1)
    base: Transform = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0))
    if isinstance(spec, BodySpec):
        base = (tuple(spec.position), tuple(spec.orientation))
    return Body(
        name=spec.name,
        id=number,
        spec=spec,
        links=links,
        joints=joints,
        movable=tuple(joints[name] for name in (urdf.joints if urdf is not None else ()) if joints[name] in movable),
        floating=isinstance(spec, BodySpec) and has_free_base(spec, urdf),
        inertial=(tuple(dynamics[3]), tuple(dynamics[4])),
        home=dict.fromkeys(movable, 0.0),
        base=base,
        urdf=urdf,
    )


def _root_pose(client: PyBulletClient, body: Body, spec: RobotSpec) -> Transform:
    """Return the pose of the URDF's root that puts the arm's base link where the rig has it."""
    link = body.links[spec.kinematics.base_link] if spec.kinematics.base_link else -1
    if link == -1:
        return (tuple(spec.base_position), tuple(spec.base_orientation))
    body.set_base_pose(client, ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0)))
    state = client.getLinkState(body.id, link, computeForwardKinematics=True)
    return compose((spec.base_position, spec.base_orientation), inverse((state[4], state[5])))


def _couple(client: PyBulletClient, body: Body, mimics: Sequence[UrdfMimic]) -> None:
    """Couple joints that have a ``<mimic>``, which PyBullet ignores."""
    for mimic in mimics:
        follower, leader = body.joints[mimic.joint], body.joints[mimic.of]
        effort = max(body.efforts.get(leader, 0.0), body.efforts.get(follower, 0.0), 100.0)
        body.gears.append(Gear(client, body.id, leader, follower, mimic.multiplier, effort))


def _lighten_frames(client: PyBulletClient, body: Body, urdf: UrdfModel) -> None:
    """Take the weight of 1 kg off links without ``<inertial>`` and shapes, which PyBullet gives to mere frames.

    The root is left as it is: whether an object moves depends on it.
    """
    for name, link in urdf.links.items():
        if link.inertial is None and not link.has_shapes and name != urdf.root:
            moved = body.links[name] in body.movable
            mass, moment = (LEAST_MASS, LEAST_INERTIA) if moved else (0.0, 0.0)
            client.changeDynamics(body.id, body.links[name], mass=mass, localInertiaDiagonal=(moment,) * 3)


def fix_inertias(client: PyBulletClient, body: Body, massless: Container[str]) -> list[str]:
    """Replace impossible inertias of links by those of their collision shapes; return warnings for the user.

    The mass of a link lies inside the box around its collision shape. If all of it were in the corners, the inertia
    would be three times that of a uniform box, which is what PyBullet computes for a shape; no body has more.
    Placeholders such as 0.1 kg m2 for a finger of 0.1 kg break this bound by orders of magnitude; a wrist with them
    needs more torque than it has to keep its own acceleration limits. Links without a shape, or with a possible
    inertia, keep the file's. For ``massless`` links, without an inertia in the file, no warning is given.
    """
    fixed_links = []
    for name, link in body.links.items():
        mass, _, given = client.getDynamicsInfo(body.id, link)[:3]
        if mass <= 0.0:
            if any(given):
                client.changeDynamics(body.id, link, localInertiaDiagonal=(0.0, 0.0, 0.0))
                fixed_links.append(name)
            continue
        if not client.getCollisionShapeData(body.id, link):
            continue
        client.changeDynamics(body.id, link, mass=mass)  # PyBullet then computes the inertia of the shape
        of_shape = client.getDynamicsInfo(body.id, link)[2]
        if all(value <= 3.0 * greatest for value, greatest in zip(sorted(given), sorted(of_shape), strict=True)):
            client.changeDynamics(body.id, link, localInertiaDiagonal=given)
        else:
            fixed_links.append(name)
    wrong = [name for name in fixed_links if name not in massless]
    if not wrong:
        return []
    return [f"{body.name}: inertia computed from the collision shapes, the URDF's is impossible: {listed(wrong)}"]
