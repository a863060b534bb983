"""Read and check URDF files: links, joints, shapes and limits as plain records, without a physics engine.

Everything that crashes a library, or makes it fail with an error of its own, is checked first: the tree, every number
and the mesh files. Prefixes that the file does not declare (``drake:``, ``xacro:``) are accepted, as other readers of
URDF do.
"""

from __future__ import annotations

import math
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from types import MappingProxyType
from xml.parsers import expat

from ..geometry import Pose, apply_rotation, rotate
from .mesh_files import check_mesh, is_installed, mesh_file

TURNING = ("revolute", "continuous")
"""Joints that turn about an axis, rad."""
MOVABLE = (*TURNING, "prismatic")
"""Joints about or along one axis."""
ROUNDING = 1e-12
"""How far below 0 a moment of inertia may be, kg m2: programs that write URDF files round."""


@dataclass(frozen=True)
class UrdfVisual:
    """One shape of a link, drawn or touched, with its pose in the frame of the link."""

    pose: Pose
    shape: str
    """``mesh``, ``box``, ``sphere``, ``cylinder`` or ``capsule``."""
    size: tuple[float, ...]
    """Scale of a mesh along x, y, z; sides of a box; radius; radius and length; m."""
    rgba: tuple[float, ...] | None = None
    """None for the colours of the mesh file."""
    file: str = ""
    """Path of a mesh, which may not exist."""


@dataclass(frozen=True)
class UrdfLink:
    """A link."""

    name: str
    inertial: Pose | None
    """Pose of the centre of mass; None where the link has no ``<inertial>``."""
    has_shapes: bool
    """Whether it has a visual or a collision shape."""
    visuals: tuple[UrdfVisual, ...]
    collisions: tuple[UrdfVisual, ...] = ()
    """Its collision shapes; they have no colour."""
    mass: float | None = None
    """kg; None where the link has no ``<inertial>``."""


@dataclass(frozen=True)
class UrdfMimic:
    """A joint that follows another: ``q[joint] = multiplier * q[of] + offset``."""

    joint: str
    of: str
    multiplier: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class UrdfJoint:
    """A joint. Limits are None where the URDF does not give them; an effort of 0 means unknown."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Pose
    """Pose of the child in the parent's frame, at zero."""
    axis: tuple[float, ...]
    """(3,) unit vector along the parent's axes."""
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    effort: float | None = None
    mimic: UrdfMimic | None = None
    damping: float = 0.0
    """Force or torque against a speed, Ns/m or Nm s/rad."""
    friction: float = 0.0
    """Force or torque of dry friction, N or Nm."""

    @property
    def movable(self) -> bool:
        """Whether the joint has one axis that can be driven."""
        return self.kind in MOVABLE

    def placement(self, values: Mapping[str, float]) -> tuple[list[float], list[float]]:
        """Return position (3,) and quaternion (4,) of the child in the parent's frame.

        Args:
            values: Joint -> position, rad or m; absent joints are at 0. A joint with a mimic follows its leader.
        """
        position, orientation = self.origin.position.tolist(), self.origin.orientation.tolist()
        if self.mimic is None:
            value = values.get(self.name, 0.0)
        else:
            value = self.mimic.multiplier * values.get(self.mimic.of, 0.0) + self.mimic.offset
        along = [value * part for part in self.axis]
        if self.kind in TURNING:
            orientation = apply_rotation(orientation, along)
        elif self.kind == "prismatic":
            position = [a + b for a, b in zip(position, along, strict=True)]
        return position, orientation


@dataclass(frozen=True)
class UrdfModel:
    """Links and joints of a URDF, which are a tree."""

    path: Path
    links: Mapping[str, UrdfLink]
    joints: Mapping[str, UrdfJoint]
    """In the order of the file."""

    @property
    def root(self) -> str:
        """The link that is no joint's child."""
        children = {joint.child for joint in self.joints.values()}
        return next(link for link in self.links if link not in children)

    @property
    def mimics(self) -> tuple[UrdfMimic, ...]:
        """The joints that follow others."""
        return tuple(joint.mimic for joint in self.joints.values() if joint.mimic is not None)

    @cached_property
    def outwards(self) -> tuple[UrdfJoint, ...]:
        """The joints from the root outwards: a parent comes before its children."""
        placed, ordered, waiting = {self.root}, list[UrdfJoint](), list(self.joints.values())
        while waiting:
            ready = [joint for joint in waiting if joint.parent in placed]
            ordered += ready
            waiting = [joint for joint in waiting if joint.parent not in placed]
            placed |= {joint.child for joint in ready}
        return tuple(ordered)

    def above(self, link: str) -> Iterator[UrdfJoint]:
        """Yield the joints between a link and the root, nearest first."""
        by_child = {joint.child: joint for joint in self.joints.values()}
        while link in by_child:
            yield by_child[link]
            link = by_child[link].parent

    def poses(self, values: Mapping[str, float]) -> dict[str, Pose]:
        """Return the pose of each link in the root's frame; ``values`` are as in :meth:`UrdfJoint.placement`."""
        found = {self.root: Pose()}
        for joint in self.outwards:
            found[joint.child] = found[joint.parent] @ Pose(*joint.placement(values))
        return found

    def find_massless(self) -> list[str]:
        """Return the links that move and have shapes, but no ``<inertial>``: simulators make up a mass for them."""
        return [
            name
            for name, link in self.links.items()
            if link.inertial is None and link.has_shapes and any(joint.kind != "fixed" for joint in self.above(name))
        ]


def read_urdf(path: Path, *, meshes: bool = True) -> UrdfModel:
    """Read and check a URDF.

    Args:
        path: The file.
        meshes: Whether to check the mesh files that it names, too.

    Raises:
        ValueError: It, or a mesh that it names, is wrong; the message does not name ``path``.
        OSError: It cannot be read.
    """
    data, folder = path.read_bytes(), path.resolve().parent
    model, files = _read(data, path, folder)
    if any(mesh_file(name, folder) != file for name, file in files.items()):  # they were moved since
        _read.cache_clear()
        model, files = _read(data, path, folder)
    if meshes:
        for name, file in files.items():
            _check_mesh(name, file)
    return model


@lru_cache(maxsize=16)  # opening a rig reads its arms several times
def _read(data: bytes, path: Path, folder: Path) -> tuple[UrdfModel, dict[str, Path]]:
    """Return a model, and the file of each mesh that it names."""
    robot = _parse(data)
    if robot.tag != "robot":
        raise ValueError(f"is not a URDF: its root element is <{robot.tag}>, not <robot>")
    links = {_name(element): element for element in robot.findall("link")}
    if not links:
        raise ValueError("has no links")
    joints = {}
    for element in robot.findall("joint"):
        name = _name(element)
        joints[name] = element
        for link in _ends(element):
            if link not in links:
                raise ValueError(f"joint {name!r} refers to link {link!r}, which does not exist")
        _check_kind(element)
    for kind, names in (("link", links), ("joint", joints)):
        if len(names) < len(robot.findall(kind)):
            raise ValueError(f"has two {kind}s of one name")
    for element in (*links.values(), *joints.values()):
        _check_numbers(element)
    found = {name: _joint(element) for name, element in joints.items()}
    _check_tree(links, found)
    colors = _named_colors(robot)
    meshes = dict.fromkeys(mesh.get("filename", "") for mesh in robot.iter("mesh"))
    files = {name: mesh_file(name, folder) for name in meshes}
    drawn = {name: _link(element, colors, files) for name, element in links.items()}
    return UrdfModel(path, MappingProxyType(drawn), MappingProxyType(found)), files


def parse_xml(path: Path | str) -> ElementTree.Element:
    """Parse an XML file without resolving namespaces: prefixes need no declaration and stay in the tags.

    Raises:
        ValueError: It is not valid XML.
        OSError: It cannot be read.
    """
    return _parse(Path(path).read_bytes())


def _parse(data: bytes) -> ElementTree.Element:
    builder = ElementTree.TreeBuilder()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartElementHandler = builder.start
    parser.EndElementHandler = builder.end
    parser.CharacterDataHandler = builder.data
    try:
        parser.Parse(data.lstrip(), True)  # a blank line before the declaration is common, though no XML
        return builder.close()
    except (expat.ExpatError, LookupError, ValueError) as error:  # LookupError: an encoding that Python lacks
        raise ValueError(f"is not valid XML, so not a URDF: {error}") from None


def _name(element: ElementTree.Element) -> str:
    name = element.get("name")
    if not name:
        raise ValueError(f"a <{element.tag}> has no name")
    return name


def _ends(joint: ElementTree.Element) -> tuple[str, str]:
    parent, child = joint.find("parent"), joint.find("child")
    if parent is None or child is None:
        raise ValueError(f"joint {joint.get('name')!r} has no parent or no child")
    return parent.get("link", ""), child.get("link", "")


def _check_kind(joint: ElementTree.Element) -> None:
    kind, kinds = joint.get("type", ""), (*MOVABLE, "fixed", "floating", "planar")
    if kind not in kinds:
        raise ValueError(f"joint {joint.get('name')!r} has type {kind!r}; types: {', '.join(kinds)}")


def _check_tree(links: Mapping[str, object], joints: Mapping[str, UrdfJoint]) -> None:
    """Check that every link but one, the root, is the child of one joint, and that all of them lead to the root."""
    parents: dict[str, UrdfJoint] = {}
    for joint in joints.values():
        if joint.child in parents:
            other = parents[joint.child].name
            raise ValueError(f"link {joint.child!r} is the child of two joints, {other!r} and {joint.name!r}")
        parents[joint.child] = joint
    roots = [link for link in links if link not in parents]
    if len(roots) > 1:
        names = ", ".join(map(repr, roots[:6])) + (" ..." if len(roots) > 6 else "")
        raise ValueError(f"is not one tree: {names} are no joint's child, and only the root may be none")
    for link in links:
        place, steps = link, 0
        while place in parents and steps <= len(links):
            place, steps = parents[place].parent, steps + 1
        if place in parents:
            raise ValueError(f"link {link!r} is its own ancestor, through joint {parents[link].name!r}")


# Attributes that hold numbers: how many, and the least that each may be.
_NUMBERS = {
    "origin": {"xyz": (3, -math.inf), "rpy": (3, -math.inf)},
    "axis": {"xyz": (3, -math.inf)},
    "limit": {"lower": (1, -math.inf), "upper": (1, -math.inf), "effort": (1, 0.0), "velocity": (1, 0.0)},
    "dynamics": {"damping": (1, 0.0), "friction": (1, 0.0)},
    "mimic": {"multiplier": (1, -math.inf), "offset": (1, -math.inf)},
    "mass": {"value": (1, 0.0)},
    "inertia": dict.fromkeys(("ixx", "iyy", "izz"), (1, -ROUNDING))
    | dict.fromkeys(("ixy", "ixz", "iyz"), (1, -math.inf)),
    "mesh": {"scale": (3, -math.inf)},
    "box": {"size": (3, 0.0)},
    "cylinder": {"radius": (1, 0.0), "length": (1, 0.0)},
    "capsule": {"radius": (1, 0.0), "length": (1, 0.0)},
    "sphere": {"radius": (1, 0.0)},
    "color": {"rgba": (4, 0.0)},
}


def _check_numbers(owner: ElementTree.Element) -> None:
    """Check every number in a link or a joint."""
    place = f"{owner.tag} {owner.get('name')!r}: <"
    for element in owner.iter():
        for attribute, (count, least) in _NUMBERS.get(element.tag, {}).items():
            text = element.get(attribute)
            if text is None:
                continue
            try:
                values = [float(word) for word in text.split()]
            except ValueError:
                raise ValueError(f"{place}{element.tag} {attribute}={text!r}> is not a number") from None
            if len(values) != count and not (attribute == "scale" and len(values) > count):  # the rest is not used
                raise ValueError(f"{place}{element.tag} {attribute}={text!r}> must be {count} number(s)")
            if not all(math.isfinite(value) and value >= least for value in values):
                must = "finite" if least == -math.inf else "finite and not negative"
                raise ValueError(f"{place}{element.tag} {attribute}={text!r}> must be {must}")
            if element.tag == "axis" and owner.get("type") in MOVABLE and math.hypot(*values) < 1e-6:
                raise ValueError(f"{place}axis xyz={text!r}> is not a direction")


def _check_mesh(name: str, file: Path) -> None:
    """Check a mesh file if it exists; a driver that needs a missing one reports it.

    Meshes of installed packages are trusted, as their code is: checking them would take up to a second.
    """
    try:
        if file.is_file() and not is_installed(file):
            check_mesh(file)
    except ValueError as error:
        raise ValueError(f"mesh {name}: {error}") from None
    except OSError as error:
        raise ValueError(f"mesh {name} cannot be read: {error}") from None


# Records of elements whose numbers have been checked.


def _floats(element: ElementTree.Element | None, attribute: str, default: tuple[float, ...]) -> tuple[float, ...]:
    text = element.get(attribute) if element is not None else None
    return default if text is None else tuple(float(word) for word in text.split())


def _origin(owner: ElementTree.Element) -> Pose:
    origin, zero = owner.find("origin"), (0.0, 0.0, 0.0)
    return Pose() if origin is None else Pose.from_rpy(_floats(origin, "xyz", zero), _floats(origin, "rpy", zero))


def _joint(element: ElementTree.Element) -> UrdfJoint:
    name, kind = element.get("name", ""), element.get("type", "")
    parent, child = _ends(element)
    origin, limit, mimic = _origin(element), element.find("limit"), element.find("mimic")
    dynamics = element.find("dynamics")
    axis = _floats(element.find("axis"), "xyz", (1.0, 0.0, 0.0))
    length = math.hypot(*axis) or 1.0

    def number(attribute: str) -> float | None:
        return next(iter(_floats(limit, attribute, ())), None)

    # A URDF's lower and upper limits are 0 where they are left out of a <limit> (the specification says so).
    default = 0.0 if limit is not None else None
    lower, upper = number("lower"), number("upper")
    bounded = kind != "continuous"
    return UrdfJoint(
        name=name,
        kind=kind,
        parent=parent,
        child=child,
        origin=origin,
        axis=tuple(rotate(origin.orientation.tolist(), [part / length for part in axis])),
        lower=(lower if lower is not None else default) if bounded else None,
        upper=(upper if upper is not None else default) if bounded else None,
        velocity=number("velocity"),
        effort=number("effort"),
        mimic=None
        if mimic is None
        else UrdfMimic(
            name,
            mimic.get("joint", ""),
            float(mimic.get("multiplier", 1.0)),
            float(mimic.get("offset", 0.0)),
        ),
        damping=_floats(dynamics, "damping", (0.0,))[0],
        friction=_floats(dynamics, "friction", (0.0,))[0],
    )


_Colors = Mapping[str, tuple[float, ...]]


def _named_colors(robot: ElementTree.Element) -> _Colors:
    """Return the colours of all materials, which may be defined after their first use; wrong ones are left out."""
    colors: dict[str, tuple[float, ...]] = {}
    for material in robot.iter("material"):
        try:
            rgba = _floats(material.find("color"), "rgba", ())
        except ValueError:
            continue
        if len(rgba) == 4:
            colors.setdefault(material.get("name", ""), rgba)
    return colors


def _link(element: ElementTree.Element, colors: _Colors, files: Mapping[str, Path]) -> UrdfLink:
    inertial = element.find("inertial")
    visuals, collisions = (
        tuple(shape for shape in (_shape(one, colors, files) for one in element.findall(kind)) if shape is not None)
        for kind in ("visual", "collision")
    )
    return UrdfLink(
        name=element.get("name", ""),
        inertial=_origin(inertial) if inertial is not None else None,
        has_shapes=element.find("visual") is not None or element.find("collision") is not None,
        visuals=visuals,
        collisions=collisions,
        mass=None if inertial is None else next(iter(_floats(inertial.find("mass"), "value", (0.0,)))),
    )


def _first_existing(geometry: ElementTree.Element, files: Mapping[str, Path]) -> ElementTree.Element | None:
    """Return the first shape in a ``<geometry>`` that is no mesh, or whose file exists; else the first, if it has one.

    Several shapes are alternatives. That is an addition to URDF: other readers take the first.
    """
    shapes = list(geometry)
    found = (one for one in shapes if one.tag != "mesh" or files[one.get("filename", "")].is_file())
    return next(found, next(iter(shapes), None))


def _shape(element: ElementTree.Element, colors: _Colors, files: Mapping[str, Path]) -> UrdfVisual | None:
    material, geometry = element.find("material"), element.find("geometry")
    rgba = colors.get(material.get("name", "")) if material is not None else None
    if material is not None and (own := material.find("color")) is not None:
        rgba = _floats(own, "rgba", (1.0, 1.0, 1.0, 1.0))
    shape = _first_existing(geometry, files) if geometry is not None else None
    if shape is None:
        return None
    pose = _origin(element)
    if shape.tag == "mesh":
        file = str(files[shape.get("filename", "")])
        return UrdfVisual(pose, "mesh", _floats(shape, "scale", (1.0, 1.0, 1.0))[:3], rgba, file)
    if shape.tag == "box":
        return UrdfVisual(pose, "box", _floats(shape, "size", (0.0, 0.0, 0.0)), rgba)
    if shape.tag in ("sphere", "cylinder", "capsule"):
        length = () if shape.tag == "sphere" else _floats(shape, "length", (0.0,))
        return UrdfVisual(pose, shape.tag, _floats(shape, "radius", (0.0,)) + length, rgba)
    return None
