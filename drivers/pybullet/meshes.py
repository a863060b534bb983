"""Mesh files as triangles, parsed once: what was parsed is kept in the user's cache folder.

Parsing the meshes of one arm takes a second or two, reading them back some milliseconds. A cache that is missing,
broken or not writable costs only that time.
"""

from __future__ import annotations

import contextlib
import hashlib
import os
import tempfile
import warnings
import zipfile
from collections.abc import Callable, Iterator
from dataclasses import fields, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from .shapes import Mesh, joined, unit
from .simplify import coarsened, simplified

__all__ = ["MeshLibrary", "cache_folder", "parse"]

_FORMAT = 8
"""Raised whenever the records or the parsing change, so that old cache files are not read."""
_BESIDE = {".mtl", ".png", ".jpg", ".jpeg", ".bmp", ".tga"}
"""Files in a mesh's folder that may decide its colours."""
_PACKAGE = {".3mf": "lxml networkx", ".stp": "cascadio", ".step": "cascadio"}
"""Formats for which trimesh wants one more package."""
_COARSE_SAVES = 0.7
"""A coarse mesh with a greater share of the triangles is not worth its memory."""
_CREASE = float(np.cos(np.radians(35)))
"""An edge is sharp where its faces turn by more than this."""
_FIELDS = tuple(field.name for field in fields(Mesh) if field.name != "coarse")
_CLOSED_SHARE = 0.9
"""Share of edges with a face on either side from which on a mesh counts as the surface of a solid."""


def cache_folder() -> Path:
    """``$XDG_CACHE_HOME/robot-hal/meshes``, by default under ``~/.cache``."""
    root = os.environ.get("XDG_CACHE_HOME") or os.path.join(os.path.expanduser("~"), ".cache")
    return Path(root) / "robot-hal" / "meshes"


class MeshLibrary:
    """Meshes by file, from memory, from the cache folder or parsed, in this order."""

    def __init__(self, folder: Path | None = None, parser: Callable[[str], list[Mesh]] | None = None) -> None:
        self._folder = cache_folder() if folder is None else folder
        self._parser = parser or parse
        self._known: dict[str, list[Mesh]] = {}

    def load(self, path: str) -> list[Mesh]:
        """The meshes in a file, one per texture. Empty, with a warning, when the file cannot be read."""
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


def parse(path: str) -> list[Mesh]:
    """The meshes in a file, one per texture, with the colours of its materials."""
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
    return [_with_levels(mesh) for mesh in whole]


def _with_levels(whole: Mesh) -> Mesh:
    """Return a mesh as it is drawn in large pictures, and with it, where that saves much, as in small ones."""
    fine, coarse = (
        _welded(whole if mesh is whole else _shaded(mesh)) for mesh in (simplified(whole), coarsened(whole))
    )
    return replace(fine, coarse=coarse) if len(coarse.faces) < _COARSE_SAVES * len(fine.faces) else fine


def _parts(scene: Any) -> Iterator[tuple[NDArray[np.float64], Any]]:
    for node in scene.graph.nodes_geometry:
        matrix, name = scene.graph[node]
        yield matrix, scene.geometry[name]


def _part(part: Any) -> Mesh:
    """One part of a file: one material, perhaps with a texture."""
    positions = np.asarray(part.vertices, np.float32)
    faces = np.asarray(part.faces, np.uint32)
    colors = np.full((len(positions), 4), 255, np.uint8)
    # trimesh computes missing normals only with scipy; those that the file brought are in its cache.
    normals = (
        np.asarray(part.vertex_normals, np.float32) if "vertex_normals" in part._cache else np.empty((0, 3), np.float32)
    )
    mesh = Mesh(positions, normals, colors, faces)
    visual = part.visual
    material = getattr(visual, "material", None)
    if not getattr(material, "kwargs", True):
        material = None  # trimesh's stand-in for a material file that is not there
    uv = getattr(visual, "uv", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    if visual.kind == "vertex":
        mesh = replace(mesh, colors=np.asarray(visual.vertex_colors, np.uint8))
    elif image is not None and uv is not None:
        texture = np.asarray(image.convert("RGB"), np.uint8)
        mesh = _painted(replace(mesh, uv=np.asarray(uv, np.float32), texture=texture, material=False))
    elif material is not None:
        colors[:] = np.asarray(material.main_color, np.uint8)
    return _shaded(mesh) if not len(normals) or _faceted(mesh) else mesh


def _faceted(mesh: Mesh) -> bool:
    """Did the file give each triangle its own normal? That is three vertices a triangle, and looks worse."""
    normals = mesh.normals[mesh.faces]
    return bool(np.mean(np.ptp(normals, axis=1).max(axis=1) < 1e-3) > 0.9)


def _shaded(mesh: Mesh) -> Mesh:
    """With normals of its own: smooth over the surface, but not over edges sharper than the crease angle."""
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
    """All pairs of corners at one point, each with itself too."""
    order = np.argsort(point, kind="stable")
    starts = np.flatnonzero(np.diff(point[order], prepend=-1))
    sizes = np.diff(starts, append=len(point))
    start, size = np.repeat(starts, sizes), np.repeat(sizes, sizes)  # of each corner's group
    mine = np.repeat(np.arange(len(point)), size)
    step = np.arange(len(mine)) - np.repeat(np.cumsum(size) - size, size)
    return order[mine], order[start[mine] + step]


def _painted(mesh: Mesh) -> Mesh:
    """The texture turned into vertex colours where those say the same: fewer vertices, draws and samples.

    They do where a texture is a palette, or finer triangles than its detail: there the colour in a triangle is what
    its corners interpolate to.
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


def _welded(mesh: Mesh) -> Mesh:
    """Equal vertices made one: the renderer's work is per vertex, and files often repeat them for every triangle."""
    columns = [mesh.positions, np.round(mesh.normals * 50), mesh.colors.astype(np.float32)]
    if mesh.uv is not None:
        columns.append(mesh.uv)
    _, first, inverse = np.unique(_rows(*columns), return_index=True, return_inverse=True)
    faces = inverse.reshape(-1)[mesh.faces]
    # In the order of their use: a software renderer remembers the vertices that it met last.
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
        closed=_closed(mesh),
    )


def _rows(*columns: NDArray[Any]) -> NDArray[Any]:
    """Each row as one item, to compare rows whole."""
    table = np.ascontiguousarray(np.concatenate(columns, axis=1, dtype=np.float32) + 0)  # + 0: no negative zero
    return table.view([("", f"V{table.shape[1] * 4}")]).reshape(-1)


def _closed(mesh: Mesh) -> bool:
    """Does the mesh enclose a volume, with its faces turned outwards?"""
    _, corner = np.unique(_rows(mesh.positions), return_inverse=True)
    faces = corner.reshape(-1)[mesh.faces].astype(np.int64)
    edges = faces[:, [[0, 1], [1, 2], [2, 0]]].reshape(-1, 2)
    there, back = edges[:, 0] * len(corner) + edges[:, 1], edges[:, 1] * len(corner) + edges[:, 0]
    points = mesh.positions.astype(float)[mesh.faces]
    volume = np.einsum("ij,ij->i", points[:, 0], np.cross(points[:, 1], points[:, 2])).sum()
    return bool(np.isin(there, back).mean() >= _CLOSED_SHARE and volume > 0)


def _key(path: str) -> str:
    """Changes whenever the mesh, or a material or picture in its folder, does."""
    file = Path(path)
    state = file.stat()
    beside = max(
        (entry.stat().st_mtime_ns for entry in os.scandir(file.parent) if Path(entry.name).suffix.lower() in _BESIDE),
        default=0,
    )
    text = f"{_FORMAT} {file.resolve()} {state.st_mtime_ns} {state.st_size} {beside}"
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def _write(path: Path, meshes: list[Mesh]) -> None:
    """Into a temporary file first, so that nobody ever reads half a file."""
    arrays: dict[str, Any] = {"count": np.array(len(meshes))}
    for index, mesh in enumerate(meshes):
        for name, level in ((f"{index}", mesh), (f"{index}.coarse", mesh.coarse)):
            for field in _FIELDS if level is not None else ():
                value = getattr(level, field)
                if value is not None:
                    arrays[f"{name}.{field}"] = np.asarray(value)
    path.parent.mkdir(parents=True, exist_ok=True)
    handle, temporary = tempfile.mkstemp(dir=path.parent, suffix=".tmp")
    try:
        with os.fdopen(handle, "wb") as file:
            np.savez(file, **arrays)
        os.replace(temporary, path)
    except BaseException:
        os.unlink(temporary)
        raise


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
