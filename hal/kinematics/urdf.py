"""A URDF read as plain XML: enough to check it and to fill in limits, without a physics engine.

Everything is checked that makes a library crash or fail with an error of its own: the tree, every number, meshes.
"""

from __future__ import annotations

import importlib.util
import math
import re
import struct
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from types import MappingProxyType

import numpy as np

__all__ = [
    "UrdfJoint",
    "UrdfModel",
    "check_mesh",
    "mesh_file",
    "near",
    "package_folder",
    "read_urdf",
]

# [packages.py] Files that URDFs name: where the folder of an installed Python package is, and which file a mesh's
# name means.

_PACKAGE = "package://"
_SCHEMES = (_PACKAGE, "model://", "file://")


def package_folder(package: str) -> Path | None:
    """Folder of an installed Python package, which is not imported; None where there is none of that name."""
    try:
        spec = importlib.util.find_spec(package)
    except (ImportError, ValueError):
        return None
    if spec is None:
        return None
    if spec.submodule_search_locations:
        return Path(next(iter(spec.submodule_search_locations)))
    return Path(spec.origin).parent if spec.origin else None


def mesh_file(name: str, folder: Path) -> Path:
    """The file that a URDF in ``folder`` calls ``name``; where it should be beside the URDF when it is nowhere.

    It may lie beside the URDF or above it (:func:`near`), or, as ``package://NAME/...``, in an installed package.
    """
    found = near(name, folder)
    if found is not None:
        return found
    plain = _plain(name)
    package, _, rest = plain.partition("/")
    if name.startswith(_PACKAGE) and package.isidentifier():
        root = package_folder(package)
        if root is not None and (root / rest).is_file():
            return root / rest
    return folder / plain


def near(name: str, folder: Path) -> Path | None:
    """The file in ``folder`` or in one above it, whatever package a URI names: where PyBullet looks."""
    plain = _plain(name)
    return next((place / plain for place in (folder, *folder.parents) if (place / plain).is_file()), None)


def _plain(name: str) -> str:
    for scheme in _SCHEMES:
        name = name.removeprefix(scheme)
    return name


# [meshes.py] Checks of mesh files, before a library reads them: some crash on an index that leads out of the
# file.

FARTHEST = 1e6
"""Largest coordinate of a vertex, in whatever unit the file has."""
_VERTEX = re.compile(rb"^[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
_FACE = re.compile(rb"^[ \t]*f[ \t]+([^\r\n]*)", re.MULTILINE)
# The numbers of a corner, POSITION/TEXTURE/NORMAL, each with the lines that it counts.
_CORNERS = (
    ("vertex", re.compile(rb"(?:^|\s)(-?\d+)"), re.compile(rb"^[ \t]*v[ \t]", re.MULTILINE)),
    ("texture", re.compile(rb"\d/(-?\d+)"), re.compile(rb"^[ \t]*vt[ \t]", re.MULTILINE)),
    ("normal", re.compile(rb"\d/-?\d*/(-?\d+)"), re.compile(rb"^[ \t]*vn[ \t]", re.MULTILINE)),
)


def check_mesh(path: Path) -> None:
    """Check an OBJ, STL or Collada file; files of other kinds are left to the libraries.

    Raises:
        ValueError: What is wrong in it.
        OSError: It cannot be read.
    """
    state = path.stat()
    _check(path, state.st_mtime_ns, state.st_size)


@lru_cache(maxsize=512)
def _check(path: Path, changed_ns: int, size: int) -> None:
    check = {".obj": _check_obj, ".stl": _check_stl, ".dae": _check_collada}.get(path.suffix.lower())
    if check is not None:
        check(path.read_bytes())


def _check_obj(data: bytes) -> None:
    _check_coordinates(np.array(_VERTEX.findall(data)))
    faces = b"\n".join(_FACE.findall(data))
    for kind, corner, line in _CORNERS:
        found = corner.findall(faces)
        _check_indices(found, len(line.findall(data)), kind, first=1)


def _check_stl(data: bytes) -> None:
    if len(data) >= 84:
        (count,) = struct.unpack_from("<I", data, 80)
        if len(data) == 84 + 50 * count:
            rows = np.frombuffer(data, np.dtype([("at", "<f4", 12), ("rest", "<u2")]), count, 84)
            _check_coordinates(rows["at"][:, 3:])
            return
    if not data.lstrip().startswith(b"solid"):
        raise ValueError("is cut off, or no STL: its size is not that of the triangles it announces")
    _check_coordinates(np.array(re.findall(rb"vertex\s+(\S+)\s+(\S+)\s+(\S+)", data)))


def _check_collada(data: bytes) -> None:
    try:
        root = ElementTree.fromstring(data)
    except (ElementTree.ParseError, LookupError, ValueError) as error:
        raise ValueError(f"is not valid XML: {error}") from None
    for element in root.iter():
        element.tag = str(element.tag).rpartition("}")[2]  # without its namespace
    counts: dict[str, int] = {}  # entries of each source, by its id; of <vertices>, those of the positions
    for source in root.iter("source"):
        accessor = source.find("technique_common/accessor")
        array = source.find("float_array")
        if accessor is None or array is None:
            continue
        values = np.array((array.text or "").split() or ["0"])
        _check_coordinates(values)
        stride = max(1, int(accessor.get("stride", "1")))
        counts[source.get("id", "")] = min(int(accessor.get("count", "0")), len(values) // stride)
    for vertices in root.iter("vertices"):
        positions = [one.get("source", "")[1:] for one in vertices.findall("input")]
        counts[vertices.get("id", "")] = min((counts.get(name, 0) for name in positions), default=0)
    for kind in ("triangles", "polylist", "polygons", "tristrips", "trifans", "lines"):
        for primitive in root.iter(kind):
            inputs = [(int(one.get("offset", "0")), one.get("source", "")[1:]) for one in primitive.findall("input")]
            width = 1 + max((offset for offset, _ in inputs), default=0)
            for part in primitive.findall("p"):
                indices = (part.text or "").split()
                for offset, name in inputs:
                    _check_indices([i.encode() for i in indices[offset::width]], counts.get(name, 0), name, first=0)


def _check_coordinates(values: np.ndarray) -> None:
    try:
        numbers = values.astype(float)
    except ValueError as error:
        raise ValueError(f"has a coordinate that is no number: {error}") from None
    if not (np.abs(numbers) <= FARTHEST).all():
        raise ValueError(f"has a coordinate that is not finite, or beyond {FARTHEST:g}")


def _check_indices(found: list[bytes], count: int, kind: str, *, first: int) -> None:
    """Indices count from ``first``; negative ones, where they are allowed, count back from the last entry."""
    if not found:
        return
    if max(map(len, found)) > 12:
        raise ValueError(f"has a {kind} index of {max(map(len, found))} digits")
    indices = np.array(found).astype(np.int64)
    least, most = -count if first else 0, count - 1 + first
    wrong = indices[(indices < least) | (indices > most) | ((indices == 0) & (first == 1))]
    if len(wrong):
        raise ValueError(f"has {kind} index {wrong[0]}, and {count} of that kind")


MOVABLE = ("revolute", "continuous", "prismatic")
"""Joints about or along one axis."""


@dataclass(frozen=True)
class UrdfJoint:
    """A joint. Limits are None where the URDF does not give them; an effort of 0 means unknown."""

    name: str
    kind: str
    parent: str
    child: str
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    effort: float | None = None

    @property
    def movable(self) -> bool:
        """One axis that can be driven."""
        return self.kind in MOVABLE


@dataclass(frozen=True)
class UrdfModel:
    """Links and joints of a URDF."""

    path: Path
    links: Mapping[str, bool]
    """Name -> does the link have an ``<inertial>``?"""
    joints: Mapping[str, UrdfJoint]

    def above(self, link: str) -> Iterator[UrdfJoint]:
        """The joints between a link and the root, nearest first."""
        by_child = {joint.child: joint for joint in self.joints.values()}
        seen: set[str] = set()
        while link in by_child and link not in seen:
            seen.add(link)
            yield by_child[link]
            link = by_child[link].parent

    def without_mass(self) -> list[str]:
        """Links that move and have no ``<inertial>``: simulators make up a mass for them."""
        return [
            name
            for name, has_mass in self.links.items()
            if not has_mass and any(joint.kind != "fixed" for joint in self.above(name))
        ]


def read_urdf(path: Path) -> UrdfModel:
    """Read and check a URDF.

    Raises:
        ValueError: What is wrong in it, or in a mesh that it names.
        OSError: It cannot be read.
    """
    try:
        root = ElementTree.parse(path).getroot()
    except (ElementTree.ParseError, LookupError, ValueError) as error:  # an encoding that Python lacks is the latter
        raise ValueError(f"is not valid XML, so not a URDF: {error}") from None
    if root.tag != "robot":
        raise ValueError(f"is not a URDF: its root element is <{root.tag}>, not <robot>")
    links = {_name(element): element.find("inertial") is not None for element in root.findall("link")}
    if not links:
        raise ValueError("has no links")
    joints = {}
    for element in root.findall("joint"):
        joint = _joint(element)
        joints[joint.name] = joint
        for link in (joint.parent, joint.child):
            if link not in links:
                raise ValueError(f"joint {joint.name!r} names link {link!r}, which is not there")
    for kind, names in (("link", links), ("joint", joints)):
        if len(names) < len(root.findall(kind)):
            raise ValueError(f"has two {kind}s of one name")
    _check_tree(links, joints)
    for element in (*root.findall("link"), *root.findall("joint")):
        _check_numbers(element)
    for name in dict.fromkeys(mesh.get("filename", "") for mesh in root.iter("mesh")):
        _check_mesh(name, path.resolve().parent)
    return UrdfModel(path, MappingProxyType(links), MappingProxyType(joints))


def _name(element: ElementTree.Element) -> str:
    name = element.get("name")
    if not name:
        raise ValueError(f"a <{element.tag}> has no name")
    return name


def _check_tree(links: Mapping[str, bool], joints: Mapping[str, UrdfJoint]) -> None:
    """Every link hangs on one joint, but for one, and all of them on that."""
    parents: dict[str, UrdfJoint] = {}
    for joint in joints.values():
        if joint.child in parents:
            other = parents[joint.child].name
            raise ValueError(f"link {joint.child!r} hangs on two joints, {other!r} and {joint.name!r}")
        parents[joint.child] = joint
    roots = [link for link in links if link not in parents]
    if len(roots) > 1:
        names = ", ".join(map(repr, roots[:6])) + (" ..." if len(roots) > 6 else "")
        raise ValueError(f"falls apart: {names} hang on no joint, and only the root may")
    for link in links:
        place, steps = link, 0
        while place in parents and steps <= len(links):
            place, steps = parents[place].parent, steps + 1
        if place in parents:
            raise ValueError(f"link {link!r} hangs on itself, through joint {parents[link].name!r}")


# Attributes that hold numbers: how many, and the least that each may be.
_NUMBERS = {
    "origin": {"xyz": (3, -math.inf), "rpy": (3, -math.inf)},
    "axis": {"xyz": (3, -math.inf)},
    "limit": {"lower": (1, -math.inf), "upper": (1, -math.inf), "effort": (1, 0.0), "velocity": (1, 0.0)},
    "dynamics": {"damping": (1, 0.0), "friction": (1, 0.0)},
    "mimic": {"multiplier": (1, -math.inf), "offset": (1, -math.inf)},
    "mass": {"value": (1, 0.0)},
    "inertia": dict.fromkeys(("ixx", "iyy", "izz"), (1, 0.0)) | dict.fromkeys(("ixy", "ixz", "iyz"), (1, -math.inf)),
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
                raise ValueError(f"{place}{element.tag} {attribute}={text!r}> is no number") from None
            if len(values) != count:
                raise ValueError(f"{place}{element.tag} {attribute}={text!r}> must be {count} number(s)")
            if not all(math.isfinite(value) and value >= least for value in values):
                must = "finite" if least < 0.0 else "finite and not negative"
                raise ValueError(f"{place}{element.tag} {attribute}={text!r}> must be {must}")
            if element.tag == "axis" and owner.get("type") in MOVABLE and math.hypot(*values) < 1e-6:
                raise ValueError(f"{place}axis xyz={text!r}> is no direction")


def _check_mesh(name: str, folder: Path) -> None:
    """Check a mesh that is there; a driver that needs one reports those that are not.

    Those of installed packages are trusted, as their code is: checking them would take up to a second.
    """
    try:
        file = mesh_file(name, folder)
        if file.is_file() and not any(part in ("site-packages", "dist-packages") for part in file.parts):
            check_mesh(file)
    except ValueError as error:
        raise ValueError(f"mesh {name}: {error}") from None
    except OSError as error:
        raise ValueError(f"mesh {name} cannot be read: {error}") from None


def _joint(element: ElementTree.Element) -> UrdfJoint:
    name = _name(element)
    parent, child, limit = element.find("parent"), element.find("child"), element.find("limit")
    if parent is None or child is None:
        raise ValueError(f"joint {name!r} lacks its parent or its child")

    def number(attribute: str) -> float | None:
        text = limit.get(attribute) if limit is not None else None
        try:
            return float(text) if text is not None else None
        except ValueError:
            raise ValueError(f"joint {name!r}: {attribute}={text!r} is no number") from None

    kind = element.get("type", "")
    if kind not in (*MOVABLE, "fixed", "floating", "planar"):
        raise ValueError(f"joint {name!r} has type {kind!r}; types: {', '.join(MOVABLE)}, fixed, floating, planar")
    bounded = kind != "continuous"
    # A URDF's lower and upper limits are 0 where they are left out of a <limit> (the specification says so).
    default = 0.0 if limit is not None else None
    lower, upper = number("lower"), number("upper")
    return UrdfJoint(
        name=name,
        kind=kind,
        parent=parent.get("link", ""),
        child=child.get("link", ""),
        lower=(lower if lower is not None else default) if bounded else None,
        upper=(upper if upper is not None else default) if bounded else None,
        velocity=number("velocity"),
        effort=number("effort"),
    )
