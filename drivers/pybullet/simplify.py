"""Fewer triangles where a file has far more than a picture can show.

Drawing without a graphics card costs time per triangle, and the meshes of an arm are tessellated to a tenth of a
millimetre.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from .shapes import Mesh

__all__ = ["coarsened", "simplified"]

_HEAVY = 3000
"""Triangles up to which a mesh is drawn as it is."""
_EDGES = 4.0
"""Size of a cell, in mean edges of the mesh."""
_SHARE = 1 / 50
"""Greatest size of a cell, as a share of the mesh's diagonal."""
_COARSE_HEAVY = 600
_COARSE_SHARE = 1 / 25
"""The same two for small pictures."""


def simplified(mesh: Mesh) -> Mesh:
    """Return a heavy mesh with fewer triangles, with no visible difference in a large picture; others as they are."""
    if len(mesh.faces) <= _HEAVY:
        return mesh
    points = mesh.positions.astype(float)
    corners = points[mesh.faces]
    double_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    mean_edge = np.sqrt(double_area.sum() * 2 / np.sqrt(3) / len(mesh.faces))  # as if all were equilateral
    return _clustered(mesh, min(_EDGES * mean_edge, _SHARE * float(np.linalg.norm(np.ptp(points, axis=0)))))


def coarsened(mesh: Mesh) -> Mesh:
    """Return a heavy mesh with a third of the triangles of :func:`simplified`, for small pictures; others as they are.

    ``cell`` of the result says how small: see :class:`.shapes.Mesh`.
    """
    if len(mesh.faces) <= _COARSE_HEAVY:
        return mesh
    return _clustered(mesh, _COARSE_SHARE * float(np.linalg.norm(np.ptp(mesh.positions.astype(float), axis=0))))


def _clustered(mesh: Mesh, cell: float) -> Mesh:
    """Make the vertices of one colour in each cell of a grid one.

    The one that stays is that of them which is nearest to the planes of all their triangles (quadrics: Garland and
    Heckbert, 1997; clustering: Lindstrom, 2000), so corners, sharp edges and flat faces stay in place; a curved
    surface moves by about the square of a cell over eight times its radius. Triangles keep the colours of their
    corners; normals want to be computed again.
    """
    if cell <= 0:
        return mesh
    points = mesh.positions.astype(float)
    corners = points[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    double_area = np.linalg.norm(across, axis=1)
    grid = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    _, paint = np.unique(mesh.colors, axis=0, return_inverse=True)
    keys = np.stack([grid @ np.array([1, 1 << 20, 1 << 40]), paint.reshape(-1)], axis=1)
    _, cluster = np.unique(keys, axis=0, return_inverse=True)
    cluster = cluster.reshape(-1)
    chosen = _nearest_to_planes(points, corners, across, double_area, cluster[mesh.faces], cluster)

    faces = cluster[mesh.faces]
    solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    first = np.argmin(faces, axis=1)[:, None]
    turned = np.take_along_axis(faces, (first + np.arange(3)) % 3, axis=1)  # the same triangle, written one way
    solid[solid] = _first_of_each(turned[solid])
    each = mesh.faces[solid].reshape(-1)
    return replace(
        mesh,
        positions=mesh.positions[chosen[faces[solid].reshape(-1)]],
        normals=mesh.normals[each],
        colors=mesh.colors[each],
        uv=None if mesh.uv is None else mesh.uv[each],
        faces=np.arange(len(each), dtype=np.uint32).reshape(-1, 3),
        cell=cell,
    )


def _nearest_to_planes(
    points: NDArray[np.float64],
    corners: NDArray[np.float64],
    across: NDArray[np.float64],
    double_area: NDArray[np.float64],
    face_clusters: NDArray[np.int64],
    cluster: NDArray[np.int64],
) -> NDArray[np.int64]:
    """For each cluster, the vertex of it with the least sum of squared distances to its triangles' planes."""
    unit = across / np.where(double_area == 0, 1, double_area)[:, None]
    planes = np.concatenate([unit, -np.einsum("fi,fi->f", unit, corners[:, 0])[:, None]], axis=1)
    quadrics = np.einsum("f,fi,fj->fij", double_area, planes, planes).reshape(-1, 16)
    count = cluster.max() + 1
    total = np.stack([np.bincount(face_clusters.reshape(-1), np.repeat(q, 3), count) for q in quadrics.T], axis=1)
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    cost = np.einsum("vi,vij,vj->v", homogeneous, total.reshape(-1, 4, 4)[cluster], homogeneous)
    order = np.lexsort((cost, cluster))
    starts = np.flatnonzero(np.diff(cluster[order], prepend=-1))
    chosen: NDArray[np.int64] = order[starts]
    return chosen


def _first_of_each(faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    _, first = np.unique(faces, axis=0, return_index=True)
    keep = np.zeros(len(faces), bool)
    keep[first] = True
    return keep
