"""Shapes to draw: triangle meshes, primitive shapes, and the visual shapes of the bodies of a scene."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.geometry import Pose

from .textures import load_texture

Array = NDArray[np.float64]
Points = NDArray[np.float32]

_SEGMENTS, _COARSE_SEGMENTS = 48, 16
"""Segments of a circle, and of that of a sphere or capsule that is small in the picture. A chord leaves the circle by
0.2 % of its radius, or by 1.9 %."""
_TEXTURE = 0.25
"""Side of a texture that covers a body, m."""
_CELLS = 6
"""Size of the details of a part that its shadow has, as a share of the part's radius: one of so many."""


class Visual(NamedTuple):
    link: int
    """Number of the link in its body; 0 is the base."""
    kind: str
    """``mesh``, ``box``, ``sphere``, ``cylinder`` or ``capsule``."""
    size: tuple[float, ...]
    """Scale (3,) of a mesh; sides (3,) of a box; radius of a sphere; radius and length of a cylinder or capsule; m."""
    file: str
    """Path of a mesh."""
    position: tuple[float, ...]
    """(3,) m in the frame of the link (not of its centre of mass)."""
    orientation: tuple[float, ...]
    """(4,) xyzw."""
    rgba: tuple[float, ...]
    texture: str = ""
    """Picture that covers it instead of its own, see :mod:`.textures`; empty for none."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles with one texture. Outward faces are counter-clockwise."""

    positions: Points
    """(V, 3) m."""
    normals: Points
    """(V, 3) unit vectors."""
    colors: NDArray[np.uint8]
    """(V, 4) RGBA; multiplied with the texture where there is one."""
    faces: NDArray[np.uint32]
    """(F, 3) indices of vertices."""
    uv: Points | None = None
    """(V, 2) texture coordinates, (0, 0) at the lower left."""
    texture: NDArray[np.uint8] | None = None
    """(H, W, 3) RGB, first row at the top."""
    repeated: bool = False
    """Whether the texture is a pattern that covers the mesh again and again."""
    material: bool = True
    """Whether the colours come from the file's materials, which a colour from the URDF replaces; a texture it tints."""
    closed: bool = True
    """Whether this is the surface of a solid: faces that point away are hidden anyway and need not be drawn."""
    cell: float = 0.0
    """Size of the largest details that were left out, m; 0 where none were."""
    coarse: Mesh | None = None
    """The same with fewer triangles, for pictures in which ``coarse.cell`` is small; None where that saves little."""

    def scaled(self, scale: tuple[float, ...] | NDArray[np.float64]) -> Mesh:
        """Return the mesh stretched along the axes by ``scale`` (3,); mirroring keeps faces turned outwards."""
        factors = np.asarray(scale, np.float32)
        if np.all(factors == 1):
            return self
        with np.errstate(divide="ignore"):
            inverse = np.where(factors == 0, 0, 1 / factors)
        faces = self.faces[:, ::-1] if np.prod(factors) < 0 else self.faces
        return replace(
            self,
            positions=(self.positions * factors).astype(np.float32),
            normals=unit(self.normals * inverse).astype(np.float32),
            faces=np.ascontiguousarray(faces),
            cell=self.cell * float(np.abs(factors).max()),
        )

    def moved(self, matrix: Array) -> Mesh:
        """Return the mesh in the frame in which ``matrix`` (4, 4), which may scale and mirror, gives its pose."""
        linear, translation = matrix[:3, :3], matrix[:3, 3]
        faces = self.faces[:, ::-1] if np.linalg.det(linear) < 0 else self.faces
        return replace(
            self,
            positions=(self.positions @ linear.T + translation).astype(np.float32),
            normals=unit(self.normals @ np.linalg.inv(linear)).astype(np.float32),
            faces=np.ascontiguousarray(faces),
        )

    def covered(self, texture: NDArray[np.uint8], side: float) -> Mesh:
        """Return the mesh, covered with a picture (H, W, 3) RGB, ``side`` m wide, from six sides."""
        corners = self.positions[self.faces]
        across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
        axis = np.abs(across).argmax(axis=1)
        used = np.array([[1, 2], [0, 2], [0, 1]])[axis]
        uv = np.take_along_axis(corners, used[:, None, :].repeat(3, axis=1), axis=2).reshape(-1, 2) / side
        return replace(
            self,
            positions=corners.reshape(-1, 3),
            normals=self.normals[self.faces].reshape(-1, 3),
            colors=np.full((3 * len(self.faces), 4), 255, np.uint8),
            faces=np.arange(3 * len(self.faces), dtype=np.uint32).reshape(-1, 3),
            uv=uv.astype(np.float32),
            texture=texture,
            repeated=True,
        )

    def tinted(self, rgba: tuple[float, ...]) -> Mesh:
        """Return the mesh in the colour that the URDF gives; white leaves the file's own colours."""
        tint = np.asarray(rgba, float)
        if np.all(tint == 1):
            return self
        base = np.full(len(self.colors) * 4, 255.0).reshape(-1, 4) if self.material else self.colors.astype(float)
        return replace(self, colors=np.clip(base * tint + 0.5, 0, 255).astype(np.uint8))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    offsets = np.cumsum([0] + [len(m.positions) for m in meshes[:-1]])
    return replace(
        meshes[0],
        positions=np.concatenate([m.positions for m in meshes]),
        normals=np.concatenate([m.normals for m in meshes]),
        colors=np.concatenate([m.colors for m in meshes]),
        faces=np.concatenate([m.faces + np.uint32(k) for m, k in zip(meshes, offsets, strict=True)]),
        uv=None if meshes[0].uv is None else np.concatenate([m.uv for m in meshes if m.uv is not None]),
        cell=max(m.cell for m in meshes),
        coarse=None,
    )


def unit(vectors: NDArray[Any]) -> NDArray[Any]:
    """Return vectors (N, 3) at length 1; a zero vector stays zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return vectors / np.where(lengths == 0, 1, lengths)


# --- primitive shapes ------------------------------------------------------------------------------------------------
# trimesh.creation has them too, but importing trimesh takes longer than everything else that a renderer needs to start.


def box(half_extents: tuple[float, float, float]) -> Mesh:
    """Return a box around the origin; half its sides in m."""
    corners: list[Array] = []
    normals: list[Array] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for side in (1.0, -1.0):
            normal, across = side * np.eye(3)[axis], np.eye(3)[axis - 1]
            along = np.cross(normal, across)
            first = len(corners)
            corners += [normal + a * across + b * along for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            normals += [normal] * 4
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return _white(np.array(corners) * np.asarray(half_extents), np.array(normals), np.array(faces))


def sphere(radius: float) -> Mesh:
    """Return a sphere around the origin; radius in m."""
    return _in_two_levels(radius, lambda segments: _capsule(radius, 0.0, segments))


def cylinder(radius: float, length: float) -> Mesh:
    """Return a cylinder along z, centred at the origin; m."""
    h = length / 2
    profile = [(0, -h), (radius, -h), (radius, -h), (radius, h), (radius, h), (0, h)]
    normals = [(0, -1), (0, -1), (1, 0), (1, 0), (0, 1), (0, 1)]
    return _revolve(np.array(profile, float), np.array(normals, float))


def capsule(radius: float, length: float) -> Mesh:
    """Return a cylinder of ``length`` along z with a half sphere on either end; m."""
    return _in_two_levels(radius, lambda segments: _capsule(radius, length, segments))


def _capsule(radius: float, length: float, segments: int) -> Mesh:
    angle = np.linspace(0, np.pi / 2, segments // 4 + 1)
    cap = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    upper = radius * cap + (0, length / 2)
    mirror = np.array([1, -1])
    lower, below = (upper * mirror)[::-1], (cap * mirror)[::-1]
    if not length:  # one circle at the equator
        lower, below = lower[:-1], below[:-1]
    return _revolve(np.concatenate([lower, upper]), np.concatenate([below, cap]), segments)


def _in_two_levels(radius: float, make: Callable[[int], Mesh]) -> Mesh:
    coarse = replace(make(_COARSE_SEGMENTS), cell=2.0 * np.pi * radius / _COARSE_SEGMENTS)
    return replace(make(_SEGMENTS), coarse=coarse)


def _revolve(profile: Array, normals: Array, segments: int = _SEGMENTS) -> Mesh:
    """Return the surface of revolution around z of a profile (P, 2) of radius and height, from bottom to top."""
    angle = np.linspace(0, 2 * np.pi, segments + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def around(points: Array) -> Array:
        ring = points[:, None, :1] * circle[None]
        height = np.broadcast_to(points[:, None, 1:], (*ring.shape[:2], 1))
        return np.concatenate([ring, height], axis=2).reshape(-1, 3)

    row = segments + 1
    lower = (np.arange(len(profile) - 1)[:, None] * row + np.arange(segments)).reshape(-1)
    quads = np.stack([lower, lower + 1, lower + row + 1, lower, lower + row + 1, lower + row], axis=1)
    positions, faces = around(profile), quads.reshape(-1, 3)
    corners = positions[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return _white(positions, around(normals), faces[area > 1e-9 * area.max()])


def _white(positions: Array, normals: Array, faces: NDArray[np.int64]) -> Mesh:
    white = np.full((len(positions), 4), 255, np.uint8)
    return Mesh(positions.astype(np.float32), normals.astype(np.float32), white, faces.astype(np.uint32))


# --- parts of a body -------------------------------------------------------------------------------------------------


@dataclass(frozen=True, eq=False)
class DrawnPart:
    """What one draw call draws: the meshes of one link that share a texture, in the frame of the link.

    A link has parts for large pictures, and others for small ones if any of its meshes is heavy.
    """

    body: int
    """The body's id."""
    link: int
    """Number of the link in its body."""
    mesh: Mesh
    coarse: bool
    """Whether it is for pictures in which ``mesh.cell`` is small."""
    centre: Array
    """(3,) centre of a ball around the mesh, m."""
    radius: float
    """Radius of that ball, m."""

    @cached_property
    def outline(self) -> tuple[Points, NDArray[np.int64]]:
        """Points (P, 3), m, and triangles (F, 3) for its shadow, turned outwards: all points within a cell are one."""
        mesh = self.mesh
        cells = np.floor(mesh.positions / (self.radius / _CELLS)).astype(np.int64)
        _, place = np.unique(cells, axis=0, return_inverse=True)
        place = place.reshape(-1)
        counts = np.bincount(place)
        points = np.stack([np.bincount(place, mesh.positions[:, k]) / counts for k in range(3)], axis=1)
        faces = place[mesh.faces]
        faces = faces[(faces != np.roll(faces, 1, axis=1)).all(axis=1)]
        if not len(faces):  # a rod, or what is so flat that it has no cell of its own
            points, faces = mesh.positions.astype(float), mesh.faces.astype(np.int64)
        first = faces.argmin(axis=1)[:, None]
        faces = np.unique(np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1), axis=0)
        return points.astype(np.float32), faces if mesh.closed else np.concatenate([faces, faces[:, ::-1]])


def parts_of(body: int, visuals: Sequence[Visual], load_mesh: Callable[[str], Sequence[Mesh]]) -> list[DrawnPart]:
    """Return the parts of one body by its id; ``load_mesh`` returns the meshes in a file."""
    found: list[tuple[Visual, Array, Mesh]] = []
    for visual in visuals:
        if visual.rgba[3] != 0:
            frame = Pose(visual.position, visual.orientation).matrix()
            found += [(visual, frame, mesh) for mesh in _meshes_of(visual, load_mesh)]
    heavy = {visual.link for visual, _, mesh in found if mesh.coarse is not None}
    groups: dict[Any, list[Mesh]] = {}
    for visual, frame, mesh in found:
        for coarse in (False, True) if visual.link in heavy else (False,):
            drawn = mesh.coarse if coarse and mesh.coarse is not None else mesh
            if visual.texture:
                drawn = drawn.covered(load_texture(visual.texture), _TEXTURE)
            texture = None if drawn.texture is None else id(drawn.texture)
            key = (visual.link, coarse, texture, drawn.closed)
            groups.setdefault(key, []).append(drawn.tinted(visual.rgba).moved(frame))
    return [_part(body, link, coarse, joined(meshes)) for (link, coarse, *_), meshes in groups.items()]


def _meshes_of(visual: Visual, load_mesh: Callable[[str], Sequence[Mesh]]) -> list[Mesh]:
    size = visual.size
    if visual.kind == "mesh":
        return [
            replace(mesh.scaled(size), coarse=None if mesh.coarse is None else mesh.coarse.scaled(size))
            for mesh in load_mesh(visual.file)
        ]
    if visual.kind == "box":
        return [box((size[0] / 2, size[1] / 2, size[2] / 2))]
    if visual.kind == "sphere":
        return [sphere(size[0])]
    return [(cylinder if visual.kind == "cylinder" else capsule)(size[0], size[1])]


def _part(body: int, link: int, coarse: bool, mesh: Mesh) -> DrawnPart:
    low, high = mesh.positions.min(axis=0), mesh.positions.max(axis=0)
    centre = (low + high).astype(float) / 2
    return DrawnPart(body, link, mesh, coarse, centre, float(np.linalg.norm(mesh.positions - centre, axis=1).max()))
