"""The URDF files of a simulated world: how they are checked, and what is drawn where meshes are not installed."""

from __future__ import annotations

import itertools
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.errors import ConfigError, Problem
from hal.kinematics.hulls import exact_hull, mesh_parts
from hal.kinematics.mesh_files import PACKAGE, mesh_file, package_folder
from hal.kinematics.urdf import UrdfLink, UrdfModel, UrdfVisual, parse_xml, read_urdf
from hal.specs import BodySpec

HOLLOW, SLICES = 0.5, 10
"""Share of its hull that a finger's mesh must fill to collide as one hull, and how many slices it is cut into else."""


def checked_urdf(path: str, key: str) -> UrdfModel:
    """Read and check a URDF and its meshes. A visual mesh in a package that is not installed is no problem.

    Raises ConfigError with all problems of the file that the configuration's ``key`` names, and of its meshes.
    """
    try:
        model = read_urdf(Path(path))
    except OSError as error:
        raise ConfigError([Problem(path, key, f"cannot be read: {error.strerror}", "missing_file")]) from None
    except ValueError as error:
        raise ConfigError([Problem(path, key, str(error), "bad_urdf")]) from None
    folder = Path(path).resolve().parent
    missing = [
        _file_name(shapes[0])
        for shapes, drawn in _mesh_shapes(path)
        if not any(_exists(one, folder) for one in shapes) and not (drawn and _absent(_file_name(shapes[0])))
    ]
    if missing:
        raise ConfigError(
            [_missing(path, key, name) for name in {_absent(name) or name: name for name in missing}.values()]
        )
    return model


def _missing(path: str, key: str, mesh: str) -> Problem:
    """Return the problem of a mesh that does not exist, or of its package, which is not installed."""
    package = _absent(mesh)
    if not package:
        return Problem(path, key, f"names a mesh that does not exist: {mesh}", "missing_file")
    return Problem(path, key, f"its meshes are in {where_to_get(package)}", "missing_package")


def where_to_get(package: str) -> str:
    """Return the words about a package that is not installed: its name, and the command that installs it."""
    from hal.config.context import INSTALL

    command = INSTALL.get(package, f"pip install {package.replace('_', '-')}")
    return f"package {package!r}, which is not installed; {command}"


def absent_packages(path: str) -> tuple[str, ...]:
    """Return the packages that a URDF's visual meshes are in and that are not installed.

    Of several alternatives the last is a plain shape: if that is drawn, the package of the first is returned.
    """
    folder = Path(path).resolve().parent
    found = dict.fromkeys(
        _absent(_file_name(shapes[0]))
        for shapes, drawn in _mesh_shapes(path)
        if drawn and not any(_exists(one, folder) for one in shapes[:-1] or shapes)
    )
    return tuple(name for name in found if name)


def drawn_visuals(link: UrdfLink) -> tuple[UrdfVisual, ...]:
    """Return what is drawn of a link: its visual shapes; its collision shapes if it has none, or if meshes are missing.

    Collision shapes have the colour of the visual shape that they replace.
    """
    if not link.visuals:
        return link.collisions
    missing = [visual for visual in link.visuals if visual.shape == "mesh" and not Path(visual.file).is_file()]
    if not missing:
        return link.visuals
    rgba = missing[0].rgba
    if link.collisions:
        return tuple(UrdfVisual(shape.pose, shape.shape, shape.size, rgba, shape.file) for shape in link.collisions)
    return tuple(visual for visual in link.visuals if visual not in missing)


def has_free_base(spec: BodySpec, urdf: UrdfModel | None) -> bool:
    """Return whether physics moves the base of an object: it has a mass, and is neither fixed nor attached to an arm.

    The mass of a URDF is that of its root; a root without ``<inertial>`` has one unless its name is ``world``.
    """
    if spec.fixed or spec.shape == "plane" or spec.robot is not None:
        return False
    if urdf is None:
        return spec.mass > 0.0
    mass = urdf.links[urdf.root].mass
    return urdf.root != "world" if mass is None else mass > 0.0


def massless(urdf: UrdfModel) -> tuple[str, ...]:
    """Return the links that have shapes but no ``<inertial>``: engines make up a mass for them."""
    return tuple(link.name for link in urdf.links.values() if link.inertial is None and link.has_shapes)


def _mesh_shapes(path: str) -> Iterator[tuple[list[ElementTree.Element], bool]]:
    """Yield the alternatives of each shape whose first one is a mesh, and whether it is only drawn."""
    for link in parse_xml(path).iter("link"):
        for owner in link:
            shapes = [shape for geometry in owner.iter("geometry") for shape in geometry]
            if shapes and shapes[0].tag == "mesh":
                yield shapes, owner.tag == "visual"


def _exists(shape: ElementTree.Element, folder: Path) -> bool:
    return shape.tag != "mesh" or mesh_file(_file_name(shape), folder).is_file()


def _file_name(shape: ElementTree.Element) -> str:
    return shape.get("filename", "")


def _absent(name: str) -> str:
    """Return the package of a mesh if that package is not installed, else an empty text."""
    if not name.startswith(PACKAGE):
        return ""
    package = name.removeprefix(PACKAGE).partition("/")[0]
    return package if package_folder(package) is None else ""


def mesh_points(shape: UrdfVisual, *, sliced: bool = False) -> Iterator[NDArray[np.float64]]:
    """Yield the points (n, 3), m, of each part of a link's mesh that collides with a hull of its own.

    The parts of an OBJ are its objects and groups, as in PyBullet; others have one part. With ``sliced``, cut a part
    that fills less than half of its hull, as a bent finger does, across its longest side. Raises ValueError if the mesh
    cannot be read, or a part of it is flat.
    """
    file = Path(shape.file)
    scale = np.array(shape.size)
    for points in mesh_parts(file) if file.suffix.lower() == ".obj" else _solid_parts(file, sliced):
        points = np.unique(points * scale, axis=0)
        spread = np.linalg.svd(points - points.mean(axis=0), compute_uv=False) if len(points) > 3 else np.zeros(3)
        if spread[2] <= 1e-6 * max(spread[0], 1e-9):
            raise ValueError(f"mesh {file.name} is flat, and has no hull; use a thin box as its collision shape")
        yield points


def _solid_parts(file: Path, sliced: bool) -> list[NDArray[np.float64]]:
    import trimesh  # 0.3 s

    try:
        mesh: Any = trimesh.load(str(file), force="mesh")
        points = np.array(mesh.vertices, dtype=np.float64)
        if not sliced or mesh.volume >= HOLLOW * exact_hull(points).volume:
            return [points]
        edges = points[mesh.edges_unique]
    except Exception as error:  # whatever the reader of that format raises
        raise ValueError(f"mesh {file.name} cannot be read: {error}") from None
    axis = int(np.ptp(points, axis=0).argmax())
    planes = np.linspace(points[:, axis].min(), points[:, axis].max(), SLICES + 1)
    cuts = [_cut(edges, axis, plane) for plane in planes]
    within = [points[(points[:, axis] >= low) & (points[:, axis] <= high)] for low, high in itertools.pairwise(planes)]
    return [np.concatenate(part) for part in zip(within, cuts[:-1], cuts[1:], strict=True)]


def _cut(edges: NDArray[np.float64], axis: int, plane: float) -> NDArray[np.float64]:
    """Return where edges (n, 2, 3) pass a plane across an axis."""
    a, b = edges[:, 0], edges[:, 1]
    passing = (a[:, axis] - plane) * (b[:, axis] - plane) < 0.0
    a, way = a[passing], (b - a)[passing]
    return a + way * ((plane - a[:, axis]) / way[:, axis])[:, None]
