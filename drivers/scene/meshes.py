"""Mesh files as triangles, with fewer triangles where a file has far more than a picture can show.

Parsing meshes takes much longer than reading them back (``python -m benchmarks render``): parsed meshes are kept in
the user's cache folder. A cache that is missing, broken or not writable only costs that time. Without a graphics card,
drawing costs time per triangle, and the meshes of an arm have far more triangles than a picture can show.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import os
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hal.kinematics.mesh_files import cache_folder, write_whole

from .shapes import Mesh, joined, unit

_FORMAT = 8
"""Version of the cache files; increase it whenever the records or the parsing change."""
_BESIDE = {".mtl", ".png", ".jpg", ".jpeg", ".bmp", ".tga"}
"""Files in a mesh's folder that may decide its colours."""
_PACKAGE = {".3mf": "lxml networkx", ".stp": "cascadio", ".step": "cascadio"}
"""Packages that trimesh needs for a format."""
_COARSE_SAVES = 0.7
"""Share of the triangles above which a coarse mesh is not worth its memory."""
_CREASE = float(np.cos(np.radians(35)))
"""An edge is sharp where its faces turn by more than this."""
_FIELDS = tuple(field.name for field in fields(Mesh) if field.name not in ("coarse", "repeated"))
_CLOSED_SHARE = 0.9
"""Share of edges with a face on either side above which a mesh counts as the surface of a solid."""
_HEAVY = 3000
"""Number of triangles up to which a mesh is drawn unchanged."""
_EDGES = 4.0
"""Size of a cell, in mean edges of the mesh."""
_SHARE = 1 / 50
"""Greatest size of a cell, as a share of the mesh's diagonal."""
_COARSE_HEAVY = 600
_COARSE_SHARE = 1 / 25
"""The same two limits for small pictures."""


class MeshLibrary:
    """Meshes by file, from memory, from the cache folder or parsed, in this order."""

    def __init__(self, folder: Path | None = None, parser: Callable[[str], list[Mesh]] | None = None) -> None:
        self._folder = cache_folder("meshes") if folder is None else folder
        self._parser = parser or parse
        self._known: dict[str, list[Mesh]] = {}

    def load(self, path: str) -> list[Mesh]:
        """Return the meshes in a file, one per texture; none, with a warning, when the file cannot be read."""
        if path not in self._known:
            self._known[path] = self._load(path)
        return self._known[path]

    def _load(self, path: str) -> list[Mesh]:
        try:
            cached = self._folder / f"{_key(path)}.npz"
        except OSError as error:
            warnings.warn(f"{path}: {error.strerror}; it is not drawn", stacklevel=2)
            return []
        # A cache file that is missing, cut short or from elsewhere: parse again.
        with contextlib.suppress(OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            return _read(cached)
        try:
            meshes = self._parser(path)
        except Exception as error:  # a parser raises whatever it likes on a bad file
            package = _PACKAGE.get(Path(path).suffix.lower())
            remedy = f"; its format needs: pip install {package}" if package else ""
            warnings.warn(f"{path}: {type(error).__name__}: {error}; it is not drawn{remedy}", stacklevel=2)
            return []
        with contextlib.suppress(OSError):
            _write(cached, meshes)
        return meshes


def _key(path: str) -> str:
    """Return a name that changes whenever the mesh, or a material or picture in its folder, does."""
    file = Path(path)
    state = file.stat()
    beside = max(
        (entry.stat().st_mtime_ns for entry in os.scandir(file.parent) if Path(entry.name).suffix.lower() in _BESIDE),
        default=0,
    )
    text = f"{_FORMAT} {file.resolve()} {state.st_mtime_ns} {state.st_size} {beside}"
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _write(path: Path, meshes: list[Mesh]) -> None:
    arrays: dict[str, Any] = {"count": np.array(len(meshes))}
    for index, mesh in enumerate(meshes):
        for name, level in ((f"{index}", mesh), (f"{index}.coarse", mesh.coarse)):
            for field in _FIELDS if level is not None else ():
                value = getattr(level, field)
                if value is not None:
                    arrays[f"{name}.{field}"] = np.asarray(value)
    data = io.BytesIO()
    np.savez(data, **arrays)
    write_whole(path, data.getvalue())


def _read(path: Path) -> list[Mesh]:
    with np.load(path, allow_pickle=False) as archive:
        return [_read_mesh(archive, f"{index}") for index in range(int(archive["count"]))]


def _read_mesh(archive: Any, name: str) -> Mesh:
    values: dict[str, Any] = {f: archive[f"{name}.{f}"] for f in _FIELDS if f"{name}.{f}" in archive}
    for field, kind in (("material", bool), ("closed", bool), ("cell", float)):
        values[field] = kind(values[field])
    coarse = _read_mesh(archive, f"{name}.coarse") if f"{name}.coarse.faces" in archive else None
    mesh = Mesh(**values, coarse=coarse)
    if len(mesh.faces) and mesh.faces.max() >= len(mesh.positions):
        raise ValueError("a face without a vertex")
    return mesh


# --- mesh files -------------------------------------------------------------------------------------------------------


def parse(path: str) -> list[Mesh]:
    """Parse a mesh file of any format that trimesh reads. Raises ValueError if it has no triangles.

    Returns one mesh per texture, in m, with the colours of the file's materials.
    """
    import trimesh  # half a second, and not needed when everything is in the cache

    loaded = trimesh.load(path, process=False)
    metres = np.diag([trimesh.units.unit_conversion(loaded.units or "meters", "meters")] * 3 + [1.0])
    meshes: dict[Any, list[Mesh]] = {}
    for matrix, part in _parts(loaded) if isinstance(loaded, trimesh.Scene) else [(np.eye(4), loaded)]:
        if isinstance(part, trimesh.Trimesh) and len(part.faces):
            mesh = _part(part).moved(metres @ matrix)
            look = None if mesh.texture is None else (mesh.texture.shape, mesh.texture.tobytes())
            meshes.setdefault((look, mesh.material), []).append(mesh)
    if not meshes:
        raise ValueError("no triangles")
    whole = [joined(group) for group in meshes.values()]
    return [_add_levels(mesh) for mesh in whole]


def _add_levels(whole: Mesh) -> Mesh:
    """Return a mesh for large pictures, with a coarse one for small pictures where that saves much."""
    fine, coarse = (
        _weld(whole if mesh is whole else _add_normals(mesh)) for mesh in (simplify_mesh(whole), coarsen_mesh(whole))
    )
    return replace(fine, coarse=coarse) if len(coarse.faces) < _COARSE_SAVES * len(fine.faces) else fine


def _parts(scene: Any) -> Iterator[tuple[NDArray[np.float64], Any]]:
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        yield matrix, scene.geometry[name]


def _part(part: Any) -> Mesh:
    """Return one part of a file, which has one material, perhaps with a texture."""
    positions = np.asarray(part.vertices, np.float32)
    faces = np.asarray(part.faces, np.uint32)
    colors = np.full((len(positions), 4), 255, np.uint8)
    # trimesh computes missing normals only with scipy; those of the file are in its cache.
    normals = (
        np.asarray(part.vertex_normals, np.float32) if "vertex_normals" in part._cache else np.empty((0, 3), np.float32)
    )
    mesh = Mesh(positions, normals, colors, faces)
    visual = part.visual
    material = getattr(visual, "material", None)
    if not getattr(material, "kwargs", True):
        material = None  # trimesh's substitute for a missing material file
    uv = getattr(visual, "uv", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if visual.kind == "vertex":
        mesh = replace(mesh, colors=np.asarray(visual.vertex_colors, np.uint8))
    elif image is not None and uv is not None:
        texture = np.asarray(image.convert("RGB"), np.uint8)
        mesh = _paint_vertices(replace(mesh, uv=np.asarray(uv, np.float32), texture=texture, material=False))
    elif material is not None:
        colors[:] = np.asarray(material.main_color, np.uint8)
    return _add_normals(mesh) if not len(normals) or _is_faceted(mesh) else mesh


def _is_faceted(mesh: Mesh) -> bool:
    """Return whether each triangle has its own normal: three vertices per triangle, and a faceted look."""
    normals = mesh.normals[mesh.faces]
    return bool(np.mean(np.ptp(normals, axis=1).max(axis=1) < 1e-3) > 0.9)


def _add_normals(mesh: Mesh) -> Mesh:
    """Return the mesh with computed normals: smooth, except over edges sharper than the crease angle."""
    corners = mesh.positions.astype(float)[mesh.faces]
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])  # as long as twice the area
    facing = unit(across)
    _, point = np.unique(_rows(mesh.positions), return_inverse=True)
    point = point.reshape(-1)[mesh.faces].reshape(-1)  # of each corner; three corners a face
    mine, other = _pairs(point)
    alike = np.einsum("ni,ni->n", facing[mine // 3], facing[other // 3]) > _CREASE
    normals = np.stack([np.bincount(mine[alike], across[other[alike] // 3, k], len(point)) for k in range(3)], axis=1)
    flat = np.repeat(facing, 3, axis=0)
    lost = np.linalg.norm(normals, axis=1) == 0
    normals[lost] = flat[lost]
    each = mesh.faces.reshape(-1)
    return replace(
        mesh,
        positions=mesh.positions[each],
        normals=unit(normals).astype(np.float32),
        colors=mesh.colors[each],
        uv=None if mesh.uv is None else mesh.uv[each],
        faces=np.arange(len(each), dtype=np.uint32).reshape(-1, 3),
    )


def _pairs(point: NDArray[np.int64]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Return all pairs of corners at the same point, including each with itself."""
    order = np.argsort(point, kind="stable")
    starts = np.flatnonzero(np.diff(point[order], prepend=-1))
    sizes = np.diff(starts, append=len(point))
    start, size = np.repeat(starts, sizes), np.repeat(sizes, sizes)  # of each corner's group
    mine = np.repeat(np.arange(len(point)), size)
    step = np.arange(len(mine)) - np.repeat(np.cumsum(size) - size, size)
    return order[mine], order[start[mine] + step]


def _paint_vertices(mesh: Mesh) -> Mesh:
    """Replace the texture by vertex colours where both look the same: fewer vertices, draws and samples.

    They do where the texture is a palette, or where triangles are finer than its details: there the colour inside a
    triangle is the interpolation of its corners.
    """
    assert mesh.uv is not None
    assert mesh.texture is not None
    corners = mesh.uv[mesh.faces]
    weights = np.array([(a, b, 4 - a - b) for a in range(5) for b in range(5 - a)]) / 4
    inside = _sample(mesh.texture, np.einsum("wc,fci->fwi", weights, corners)).astype(float)
    blend = np.einsum("wc,fci->fwi", weights, _sample(mesh.texture, corners).astype(float))
    agree = (np.abs(inside - blend).max(axis=(1, 2)) <= 16) & (np.ptp(corners, axis=1).max(axis=1) < 1)
    if agree.mean() < 0.9:
        return mesh
    vertex = np.concatenate([_sample(mesh.texture, mesh.uv), np.full((len(mesh.uv), 1), 255, np.uint8)], axis=1)
    return replace(mesh, colors=vertex, uv=None, texture=None)


def _sample(texture: NDArray[np.uint8], uv: NDArray[np.float32]) -> NDArray[np.uint8]:
    height, width = texture.shape[:2]
    column = np.floor(np.mod(uv[..., 0], 1.0) * width).astype(int) % width
    row = np.floor((1 - np.mod(uv[..., 1], 1.0)) * height).astype(int) % height
    colors: NDArray[np.uint8] = texture[row, column]
    return colors


def _weld(mesh: Mesh) -> Mesh:
    """Merge equal vertices: the renderer's work is per vertex, and files often repeat them for every triangle."""
    columns = [mesh.positions, np.round(mesh.normals * 50), mesh.colors.astype(np.float32)]
    if mesh.uv is not None:
        columns.append(mesh.uv)
    _, first, inverse = np.unique(_rows(*columns), return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[mesh.faces]
    # In the order of their use: a software renderer caches the vertices that it used last.
    used, order = np.unique(faces, return_index=True)
    used = used[np.argsort(order)]
    place = np.empty(len(first), np.uint32)
    place[used] = np.arange(len(used), dtype=np.uint32)
    first = first[used]
    return replace(
        mesh,
        positions=mesh.positions[first],
        normals=mesh.normals[first],
        colors=mesh.colors[first],
        uv=None if mesh.uv is None else mesh.uv[first],
        faces=place[faces],
        closed=_is_closed(mesh),
    )


def _rows(*columns: NDArray[Any]) -> NDArray[Any]:
    """Return each row as one item, to compare whole rows."""
    table = np.ascontiguousarray(np.concatenate(columns, axis=1, dtype=np.float32) + 0)  # + 0: no negative zero
    return table.view([("", f"V{table.shape[1] * 4}")]).reshape(-1)


def _is_closed(mesh: Mesh) -> bool:
    """Return whether the mesh encloses a volume, with its faces turned outwards."""
    _, corner = np.unique(_rows(mesh.positions), return_inverse=True)
    faces = corner.reshape(-1)[mesh.faces].astype(np.int64)
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there, back = edges[:, 0] * len(corner) + edges[:, 1], edges[:, 1] * len(corner) + edges[:, 0]
    points = mesh.positions.astype(float)[mesh.faces]
    volume = np.einsum("ij,ij->i", points[:, 0], np.cross(points[:, 1], points[:, 2])).sum()
    return bool(np.isin(there, back).mean() >= _CLOSED_SHARE and volume > 0)


# --- fewer triangles --------------------------------------------------------------------------------------------------


def simplify_mesh(mesh: Mesh) -> Mesh:
    """Return a heavy mesh with fewer triangles, with no visible difference in a large picture; others as they are."""
    if len(mesh.faces) <= _HEAVY:
        return mesh
    points = mesh.positions.astype(float)
    corners = points[mesh.faces]
    double_area = np.linalg.norm(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]), axis=1)
    mean_edge = np.sqrt(double_area.sum() * 2 / np.sqrt(3) / len(mesh.faces))  # as if all were equilateral
    return _cluster(mesh, min(_EDGES * mean_edge, _SHARE * float(np.linalg.norm(np.ptp(points, axis=0)))))


def coarsen_mesh(mesh: Mesh) -> Mesh:
    """Return a heavy mesh with a third of the triangles of :func:`simplify_mesh`, for small pictures; others unchanged.

    ``cell`` of the result is the size of the omitted details: see :class:`.scene.Mesh`.
    """
    if len(mesh.faces) <= _COARSE_HEAVY:
        return mesh
    return _cluster(mesh, _COARSE_SHARE * float(np.linalg.norm(np.ptp(mesh.positions.astype(float), axis=0))))


def _cluster(mesh: Mesh, cell: float) -> Mesh:
    """Merge the vertices of one colour in each cell of a grid.

    The one that is kept is the nearest to the planes of all their triangles (quadrics: Garland and Heckbert, 1997;
    clustering: Lindstrom, 2000), so corners, sharp edges and flat faces stay in place; a curved surface moves by about
    the square of a cell over eight times its radius. Triangles keep the colours of their corners; normals must be
    computed again.
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
    """Return the vertex of each cluster with the least sum of squared distances to its triangles' planes."""
    unit = across / np.where(double_area == 0, 1, double_area)[:, None]
    planes = np.concatenate([unit, -np.einsum("fi,fi->f", unit, corners[:, 0])[:, None]], axis=1)
    quadrics = np.einsum("f,fi,fj->fij", double_area, planes, planes).reshape(-1, 16)
    count = cluster.max() + 1
    total = np.stack([np.bincount(face_clusters.reshape(-1), np.repeat(q, 3), count) for q in quadrics.T], axis=1)
    homogeneous = np.concatenate([points, np.ones((len(points), 1))], axis=1)
    cost = np.einsum("vi,vij,vj->v", homogeneous, total.reshape(-1, 4, 4)[cluster], homogeneous)
    order = np.lexsort((cost, cluster))
    starts = np.flatnonzero(np.diff(cluster[order], prepend=-1))
    return order[starts]


def _first_of_each(faces: NDArray[np.int64]) -> NDArray[np.bool_]:
    _, first = np.unique(faces, axis=0, return_index=True)
    keep = np.zeros(len(faces), bool)
    keep[first] = True
    return keep
