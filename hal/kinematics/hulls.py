"""Convex hulls of mesh files, which collide in their place, and the mass of a solid of their form."""

from __future__ import annotations

import itertools
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .mesh_files import check_mesh

Array = NDArray[np.float64]

FORMATS = (".obj", ".stl", ".dae")
"""Ends of the names of mesh files whose hulls can collide."""
MOST = 1000
"""Number of points up to which a hull is exact."""
DIRECTIONS = 1024
"""Directions in which the outermost points of a larger mesh are taken."""
EXACT = 1e-3
"""How far a point may then be outside of the hull, as a share of the mesh's size."""
ROUNDS = 2
"""Most often that points which are farther outside are added."""
FLAT = 1e-6
"""Least thickness of a hull, as a share of its size."""


@dataclass(frozen=True, eq=False)
class Hull:
    """A convex hull."""

    points: Array
    """(n, 3) corners, m."""
    faces: NDArray[np.intp]
    """(m, 3) indices of corners, counter-clockwise from outside."""

    @property
    def volume(self) -> float:
        """Its volume, m3."""
        a, b, c = (self.points[self.faces[:, k]] - self.points[0] for k in range(3))
        return float(np.einsum("fi,fi->", a, np.cross(b, c)) / 6.0)


class Solid(NamedTuple):
    """How a mass of 1 kg is spread."""

    centre: Array
    """(3,) centre of mass, m."""
    moments: Array
    """(3,) principal moments of inertia, m2."""
    axes: Array
    """(3, 3) their axes, as columns, right-handed."""


def mesh_hulls(file: str | Path, scale: float = 1.0, *, parts: bool = False) -> tuple[Hull, ...]:
    """Return the convex hulls of a mesh file.

    Args:
        file: An OBJ, STL or Collada file. Its surface need not be closed.
        scale: Factor on all lengths.
        parts: One hull for each part (see :func:`mesh_parts`); False for one around everything.

    Raises:
        ValueError: It cannot be read, has another format, or a part of it is flat; the message does not name it.
        OSError: It cannot be opened.
    """
    state = Path(file).stat()
    return _mesh_hulls(Path(file), state.st_mtime_ns, state.st_size, scale, parts)


@lru_cache(maxsize=64)
def _mesh_hulls(file: Path, changed_ns: int, size: int, scale: float, parts: bool) -> tuple[Hull, ...]:
    if file.suffix.lower() not in FORMATS:
        raise ValueError(f"is none of {', '.join(FORMATS)}; convert it, for example with trimesh")
    check_mesh(file)
    found = mesh_parts(file)
    if not parts:
        found = [np.concatenate(found)]
    return tuple(convex_hull(scale * points) for points in found)


_GROUP = re.compile(rb"^[ \t]*[og][ \t][^\n]*$", re.MULTILINE)
_VERTEX = re.compile(rb"^[ \t]*v[ \t]+(\S+)[ \t]+(\S+)[ \t]+(\S+)", re.MULTILINE)
_FACE = re.compile(rb"^[ \t]*f[ \t]+([^\r\n]*)", re.MULTILINE)


def mesh_parts(file: Path) -> list[Array]:
    """Return the points (n, 3) of each part of a mesh file, m.

    The parts of an OBJ file are its objects and groups, as in PyBullet; those of other files are the pieces of surface
    that are connected.

    Raises:
        ValueError: It cannot be read, or has no faces.
    """
    if file.suffix.lower() == ".obj":
        data = file.read_bytes()
        vertices = np.array(_VERTEX.findall(data)).astype(float).reshape(-1, 3)
        parts = []
        for part in _GROUP.split(data):
            corners = [word.split(b"/")[0] for face in _FACE.findall(part) for word in face.split()]
            if corners:
                indices = np.array(corners).astype(int)
                parts.append(vertices[np.unique(np.where(indices > 0, indices - 1, indices))])
        if not parts and not len(vertices):
            raise ValueError("has no vertices")
        return parts or [vertices]
    import trimesh  # 0.3 s

    try:
        loaded: Any = trimesh.load(str(file), process=False)
        metres = float(trimesh.units.unit_conversion(loaded.units or "meters", "meters"))
        meshes: Any = loaded.dump() if isinstance(loaded, trimesh.Scene) else [loaded]
        found = [(np.asarray(one.vertices, float) * metres, np.asarray(one.faces)) for one in meshes]
    except Exception as error:  # whatever the reader of that format raises
        raise ValueError(f"cannot be read: {error}") from None
    parts = [part for points, faces in found if len(faces) for part in _pieces(points, faces)]
    if not parts:
        raise ValueError("has no faces")
    return parts


def _pieces(points: Array, faces: NDArray[np.intp]) -> list[Array]:
    """Return the points of each piece of surface that is connected; points at the same place are one."""
    places, point = np.unique(points, axis=0, return_inverse=True)
    faces = point.reshape(-1)[faces]
    piece = np.arange(len(places))
    while True:
        least = piece[faces].min(axis=1)
        joined = piece.copy()
        np.minimum.at(joined, piece[faces].reshape(-1), np.repeat(least, 3))  # the piece's own name, too
        np.minimum.at(joined, faces.reshape(-1), np.repeat(least, 3))
        joined = joined[joined]
        if np.array_equal(joined, piece):
            break
        piece = joined
    used = np.unique(faces)
    return [places[used[piece[used] == name]] for name in np.unique(piece[used])]


def convex_hull(points: Array) -> Hull:
    """Return the convex hull of points (n, 3); that of many points lacks corners that hardly stick out.

    Raises:
        ValueError: They are in one plane.
    """
    points = np.unique(points, axis=0)
    extent = float(np.linalg.norm(np.ptp(points, axis=0))) if len(points) else 0.0
    spread = np.linalg.svd(points - points.mean(axis=0), full_matrices=False)[1] if len(points) > 3 else np.zeros(3)
    if spread[2] <= FLAT * max(spread[0], 1e-9):
        raise ValueError("is flat, and has no hull; use a thin box")
    if len(points) <= MOST:
        return exact_hull(points)
    chosen = np.unique(np.concatenate([(part @ points.T).argmax(axis=1) for part in np.array_split(_sphere(), 16)]))
    hull = exact_hull(points[chosen])
    for _ in range(ROUNDS):
        outside = _find_outside(points, hull, EXACT * extent)
        if not len(outside):
            break
        chosen = np.union1d(chosen, outside)
        hull = exact_hull(points[chosen])
    return hull


def _sphere() -> Array:
    """Return directions (n, 3) that are spread evenly (a Fibonacci lattice)."""
    k = np.arange(DIRECTIONS) + 0.5
    z, turn = 1.0 - 2.0 * k / DIRECTIONS, np.pi * (1.0 + 5.0**0.5) * k
    radius = np.sqrt(1.0 - z * z)
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), z], axis=1)


def _find_outside(points: Array, hull: Hull, tolerance: float) -> NDArray[np.intp]:
    """Return the point that is the farthest outside of each face, if it is farther than ``tolerance``."""
    corners = hull.points[hull.faces]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    areas = np.linalg.norm(normals, axis=1)
    normals = normals[areas > 0.0] / areas[areas > 0.0, None]
    offsets = np.einsum("fi,fi->f", normals, corners[areas > 0.0, 0])
    found = []
    for normal, offset in zip(np.array_split(normals, 64), np.array_split(offsets, 64), strict=True):
        if len(normal):
            height = normal @ points.T
            highest = height.argmax(axis=1)
            found.append(highest[height[np.arange(len(normal)), highest] - offset > tolerance])
    return np.unique(np.concatenate(found))


def exact_hull(points: Array) -> Hull:
    """Return the convex hull of points (n, 3) with all its corners. Raises ValueError if it cannot be made."""
    import coal  # with pinocchio

    middle, size = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    rows = coal.StdVec_Vec3s()
    rows.extend(list((points - middle) / size))  # qhull's own tolerances are absolute
    for command in ("Qt", "QJ"):  # the second one, if a corner of the first has more neighbours than coal counts
        try:
            made = coal.Convex.convexHull(rows, True, command)
            break
        except (RuntimeError, ValueError) as error:
            reason = str(error).strip().splitlines()[-1]
    else:
        raise ValueError(f"has no hull: {reason}")
    corners = np.array(made.points()).reshape(-1, 3)
    triangles = (made.polygons(k) for k in range(made.num_polygons))
    faces = np.array([(one[0], one[1], one[2]) for one in triangles], np.intp)
    a, b, c = (corners[faces[:, k]] for k in range(3))
    inwards = np.einsum("fi,fi->f", np.cross(b - a, c - a), a - corners.mean(axis=0)) < 0.0
    faces[inwards] = faces[inwards][:, ::-1]
    return Hull(corners * size + middle, faces)


def uniform_solid(hulls: Iterable[Hull]) -> Solid:
    """Return the mass properties of hulls of one density; where they overlap, it counts twice.

    The moments are the exact integrals over the tetrahedra between the origin and each face.
    """
    volume, first, second = 0.0, np.zeros(3), np.zeros((3, 3))
    hulls = tuple(hulls)
    origin = hulls[0].points.mean(axis=0)
    for hull in hulls:
        a, b, c = (hull.points[hull.faces[:, k]] - origin for k in range(3))
        volumes = np.einsum("fi,fi->f", a, np.cross(b, c)) / 6.0
        total = a + b + c
        volume += volumes.sum()
        first += volumes @ total / 4.0
        second += sum(np.einsum("f,fi,fj->ij", volumes, one, one) for one in (a, b, c, total)) / 20.0
    centre = first / volume
    spread = second / volume - np.outer(centre, centre)
    moments, axes = principal_axes(np.trace(spread) * np.eye(3) - spread)
    return Solid(centre + origin, moments, axes)


def principal_axes(inertia: Array) -> tuple[Array, Array]:
    """Return the principal moments (3,) of an inertia (3, 3), and their axes as columns (3, 3), right-handed.

    They are in the order of the axes nearest to theirs, so the moments of a diagonal matrix are its diagonal.
    """
    moments, axes = np.linalg.eigh(inertia)
    orders: Sequence[Sequence[int]] = list(itertools.permutations(range(3)))
    order = list(max(orders, key=lambda order: float(np.abs(np.diag(axes[:, list(order)])).sum())))
    axes = axes[:, order]
    return moments[order], axes if np.linalg.det(axes) > 0.0 else axes * np.array([1.0, 1.0, -1.0])
