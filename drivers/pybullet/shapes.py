"""Triangle meshes as the renderer wants them, and the primitive shapes among them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["Mesh", "box", "capsule", "cylinder", "joined", "plane", "sphere", "unit"]

Points = NDArray[np.float32]

_SEGMENTS = 48
"""Of a circle. A chord then leaves the circle by 0.2 % of its radius."""
_PLANE_HALF = 50.0
"""Half the side of the square that stands for an infinite plane, m."""


@dataclass(frozen=True, eq=False)
class Mesh:
    """Triangles in one texture. Outward faces are counter-clockwise."""

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
    material: bool = True
    """The colours come from the file's materials, which a colour from the URDF replaces; a texture it tints."""
    closed: bool = True
    """A solid's surface: faces that look away are hidden anyway and need not be drawn."""
    cell: float = 0.0
    """Details smaller than this were left out, m; 0 where none were."""
    coarse: Mesh | None = None
    """The same with fewer triangles, for pictures in which ``coarse.cell`` is small; None where that saves little."""

    def scaled(self, scale: tuple[float, float, float] | NDArray[np.float64]) -> Mesh:
        """Stretched along the axes; a mirroring keeps the outside outside."""
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

    def moved(self, matrix: NDArray[np.float64]) -> Mesh:
        """In the frame in which ``matrix`` (4, 4) gives the pose of this mesh's own frame; it may scale and mirror."""
        linear, translation = matrix[:3, :3], matrix[:3, 3]
        faces = self.faces[:, ::-1] if np.linalg.det(linear) < 0 else self.faces
        return replace(
            self,
            positions=(self.positions @ linear.T + translation).astype(np.float32),
            normals=unit(self.normals @ np.linalg.inv(linear)).astype(np.float32),
            faces=np.ascontiguousarray(faces),
        )

    def tinted(self, rgba: tuple[float, ...]) -> Mesh:
        """In the colour that the URDF gives; white leaves the file's own colours."""
        tint = np.asarray(rgba, float)
        if np.all(tint == 1):
            return self
        base = np.full(len(self.colors) * 4, 255.0).reshape(-1, 4) if self.material else self.colors.astype(float)
        return replace(self, colors=np.clip(base * tint + 0.5, 0, 255).astype(np.uint8))


def joined(meshes: Sequence[Mesh]) -> Mesh:
    """Several meshes of one texture as one."""
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


def box(half_extents: tuple[float, float, float]) -> Mesh:
    """A box around the origin; half its sides in m."""
    positions: list[NDArray[np.float64]] = []
    normals: list[NDArray[np.float64]] = []
    faces: list[list[int]] = []
    for axis in range(3):
        for side in (1.0, -1.0):
            normal, across = side * np.eye(3)[axis], np.eye(3)[axis - 1]
            along = np.cross(normal, across)
            first = len(positions)
            positions += [normal + a * across + b * along for a, b in ((-1, -1), (1, -1), (1, 1), (-1, 1))]
            normals += [normal] * 4
            faces += [[first, first + 1, first + 2], [first, first + 2, first + 3]]
    return _mesh(np.array(positions) * np.asarray(half_extents), np.array(normals), np.array(faces))


def sphere(radius: float) -> Mesh:
    """A sphere around the origin; radius in m."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, _SEGMENTS // 2 + 1)
    ring = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return _revolved(radius * ring, ring)


def cylinder(radius: float, length: float) -> Mesh:
    """A cylinder along z, centred at the origin; m."""
    h = length / 2
    profile = [(0, -h), (radius, -h), (radius, -h), (radius, h), (radius, h), (0, h)]
    normals = [(0, -1), (0, -1), (1, 0), (1, 0), (0, 1), (0, 1)]
    return _revolved(np.array(profile, float), np.array(normals, float))


def capsule(radius: float, length: float) -> Mesh:
    """A cylinder of ``length`` along z with a half sphere on either end; m."""
    angle = np.linspace(0, np.pi / 2, _SEGMENTS // 4 + 1)
    cap = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    upper = radius * cap + (0, length / 2)
    mirror = np.array([1, -1])
    return _revolved(np.concatenate([(upper * mirror)[::-1], upper]), np.concatenate([(cap * mirror)[::-1], cap]))


def plane() -> Mesh:
    """A large square in z = 0 that looks up."""
    h = _PLANE_HALF
    positions = np.array([[-h, -h, 0], [h, -h, 0], [h, h, 0], [-h, h, 0]])
    return _mesh(positions, np.tile([0.0, 0, 1], (4, 1)), np.array([[0, 1, 2], [0, 2, 3]]), closed=False)


def _revolved(profile: NDArray[np.float64], normals: NDArray[np.float64]) -> Mesh:
    """The surface that a profile (P, 2) of radius and height, from bottom to top, leaves around z."""
    angle = np.linspace(0, 2 * np.pi, _SEGMENTS + 1)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=1)

    def around(points: NDArray[np.float64]) -> NDArray[np.float64]:
        ring = points[:, None, :1] * circle[None]
        height = np.broadcast_to(points[:, None, 1:], (*ring.shape[:2], 1))
        rows: NDArray[np.float64] = np.concatenate([ring, height], axis=2).reshape(-1, 3)
        return rows

    row = _SEGMENTS + 1
    lower = (np.arange(len(profile) - 1)[:, None] * row + np.arange(_SEGMENTS)).reshape(-1)
    quads = np.stack([lower, lower + 1, lower + row + 1, lower, lower + row + 1, lower + row], axis=1)
    positions, faces = around(profile), quads.reshape(-1, 3)
    corners = positions[faces]
    area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    return _mesh(positions, around(normals), faces[area > 1e-9 * area.max()])


def _mesh(
    positions: NDArray[np.float64], normals: NDArray[np.float64], faces: NDArray[np.int64], closed: bool = True
) -> Mesh:
    white = np.full((len(positions), 4), 255, np.uint8)
    return Mesh(positions.astype(np.float32), normals.astype(np.float32), white, faces.astype(np.uint32), closed=closed)


def unit(vectors: NDArray[Any]) -> NDArray[Any]:
    """Vectors (N, 3) at length 1; a zero stays zero."""
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    result: NDArray[Any] = vectors / np.where(lengths == 0, 1, lengths)
    return result
