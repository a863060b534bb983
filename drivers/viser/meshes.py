"""What is drawn, as GLB files in memory: the format that a browser takes without further work.

Colours are baked into the vertices. A palette as a picture, as arms often have one, would else be sent once for each
of a mesh's materials; only few large triangles, whose corners cannot tell the picture, keep it.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from .urdf import Visual

__all__ = ["glb"]

Array = NDArray[np.float64]

_HEAVY = 60_000
"""Triangles up to which a mesh is sent as it is."""
_CELLS = 150
"""Cells along the longest side of a mesh that is heavier."""
_COARSE = 200
"""Only a piece with fewer triangles than this may keep its picture."""
_WIDE = 0.05
"""And only where they span more than this share of it, on average."""
_PIXELS = 512
"""A picture that is kept is made this small."""
_GREY = (0.7, 0.7, 0.7, 1.0)


class _Part(NamedTuple):
    """Triangles with a normal and a colour at each vertex."""

    points: Array
    """(V, 3) m."""
    faces: NDArray[np.int64]
    """(F, 3)."""
    normals: Array
    """(V, 3)."""
    colors: Array
    """(V, 3) from 0 to 1, as a screen shows them (sRGB)."""


def glb(visual: Visual) -> bytes:
    """The shape of a visual in its own frame. Raises ValueError with the reason why it cannot be drawn."""
    import trimesh

    parts = _mesh(visual) if visual.shape == "mesh" else [_built(_primitive(visual))]
    scene: Any = trimesh.Scene(parts)
    data: bytes = scene.export(file_type="glb", include_normals=True)
    return data


def _built(part: _Part) -> Any:
    """The part as trimesh knows it. A GLB's vertex colours are linear, not sRGB."""
    import trimesh

    linear = np.where(part.colors <= 0.04045, part.colors / 12.92, ((part.colors + 0.055) / 1.055) ** 2.4)
    rgba = np.concatenate([linear, np.ones((len(linear), 1))], axis=1)
    return trimesh.Trimesh(
        part.points,
        part.faces,
        vertex_normals=part.normals,
        vertex_colors=np.round(255 * rgba).astype(np.uint8),
        process=False,
    )


def _primitive(visual: Visual) -> _Part:
    from trimesh import creation

    size = visual.size
    if visual.shape == "box":
        mesh = creation.box(size)
    elif visual.shape == "sphere":
        mesh = creation.icosphere(3, size[0])
    elif visual.shape == "cylinder":
        mesh = creation.cylinder(size[0], size[1], sections=48)
    elif visual.shape == "capsule":
        mesh = creation.capsule(size[1], size[0], count=(32, 32))
        mesh.apply_translation(-mesh.bounds.mean(axis=0))
    else:
        raise ValueError(f"there is no shape {visual.shape!r}")
    colors = np.tile((visual.rgba or _GREY)[:3], (len(mesh.vertices), 1))
    return _faceted(np.array(mesh.vertices), np.array(mesh.faces), colors)


def _mesh(visual: Visual) -> list[Any]:
    """The parts of a mesh file: those that keep a picture, and one with all the others."""
    import trimesh

    if not Path(visual.file).is_file():
        raise ValueError(f"{visual.file} is not there")
    try:
        loaded = trimesh.load(visual.file, process=False)
        metres = trimesh.units.unit_conversion(loaded.units or "meters", "meters")
        pictured, parts = [], []
        for matrix, piece in _pieces(loaded):
            whole = np.diag([*(metres * np.array(visual.size)), 1.0]) @ matrix
            if _needs_picture(piece):
                pictured.append(_pictured(piece, whole))
            elif len(piece.faces):
                parts.append(_part(piece, whole, visual.rgba))
    except Exception as error:  # a parser raises whatever it likes on a bad file
        raise ValueError(f"{visual.file}: {type(error).__name__}: {error}") from None
    if not pictured and not parts:
        raise ValueError(f"{visual.file} has no triangles")
    return pictured + ([_built(_lighter(_joined(parts)))] if parts else [])


def _pieces(loaded: Any) -> Iterator[tuple[Array, Any]]:
    """What is in a file, a piece for each material, each with its pose."""
    import trimesh

    if isinstance(loaded, trimesh.Trimesh):
        yield np.eye(4), loaded
    elif isinstance(loaded, trimesh.Scene):
        for node in loaded.graph.nodes_geometry:
            matrix, name = loaded.graph[node]
            if isinstance(loaded.geometry[name], trimesh.Trimesh):
                yield matrix, loaded.geometry[name]


def _part(piece: Any, matrix: Array, rgba: tuple[float, ...] | None) -> _Part:
    """One piece, moved and coloured."""
    points, faces = _moved(piece, matrix)
    colors = _colors(piece, rgba)
    # trimesh computes missing normals only with scipy; those that the file brought are in its cache.
    normals = np.asarray(piece.vertex_normals, float) if "vertex_normals" in piece._cache else None
    if normals is None or not np.isfinite(normals).all():
        return _faceted(points, faces, colors)
    return _Part(points, faces, _unit(normals @ np.linalg.inv(matrix[:3, :3])), colors)


def _moved(piece: Any, matrix: Array) -> tuple[Array, NDArray[np.int64]]:
    """Points and faces of a piece, the latter turned where the matrix mirrors: the outside stays outside."""
    faces = np.asarray(piece.faces)
    points: Array = np.asarray(piece.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3]
    return points, faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces


def _colors(piece: Any, rgba: tuple[float, ...] | None) -> Array:
    """(V, 3). A colour of the URDF's replaces that of a material and tints a picture; white leaves both."""
    count, visual = len(piece.vertices), piece.visual
    tint = np.ones(3) if rgba is None else np.asarray(rgba[:3], float)
    picture = _picture(piece)
    if picture is not None:
        return _sampled(np.asarray(picture.convert("RGB")), np.asarray(visual.uv, float)) * tint
    if visual.kind in ("vertex", "face"):
        return np.asarray(visual.vertex_colors, float)[:, :3] / 255 * tint
    material = getattr(visual, "material", None)
    # A material without entries is trimesh's stand-in for a file that is not there.
    if np.all(tint == 1) and material is not None and getattr(material, "kwargs", True):
        tint = np.asarray(material.main_color[:3], float) / 255
    return np.tile(tint, (count, 1))


def _picture(piece: Any) -> Any | None:
    material = getattr(piece.visual, "material", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    return image if getattr(piece.visual, "uv", None) is not None else None


def _needs_picture(piece: Any) -> bool:
    if _picture(piece) is None or not 0 < len(piece.faces) < _COARSE:
        return False
    return float(np.ptp(np.asarray(piece.visual.uv)[piece.faces], axis=1).max(axis=1).mean()) > _WIDE


def _pictured(piece: Any, matrix: Array) -> Any:
    """A piece that keeps its picture, as trimesh knows it."""
    import trimesh

    picture = _picture(piece).convert("RGB")  # type: ignore[union-attr]
    picture.thumbnail((_PIXELS, _PIXELS))
    points, faces = _moved(piece, matrix)
    flat = _faceted(points, faces, np.zeros_like(points))
    visuals: Any = trimesh.visual
    material = visuals.material.PBRMaterial(baseColorTexture=picture, metallicFactor=0.0, roughnessFactor=0.8)
    visual = visuals.TextureVisuals(np.asarray(piece.visual.uv)[faces.reshape(-1)], material=material)
    return trimesh.Trimesh(flat.points, flat.faces, vertex_normals=flat.normals, visual=visual, process=False)


def _sampled(picture: NDArray[np.uint8], uv: Array) -> Array:
    height, width, _ = picture.shape
    column = (np.mod(uv[:, 0], 1.0) * width).astype(int) % width
    row = ((1.0 - np.mod(uv[:, 1], 1.0)) * height).astype(int) % height
    colors: Array = picture[row, column] / 255.0
    return colors


def _faceted(points: Array, faces: NDArray[np.int64], colors: Array) -> _Part:
    """Each triangle with corners and a normal of its own."""
    each = faces.reshape(-1)
    corners = points[each].reshape(-1, 3, 3)
    across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    return _Part(points[each], np.arange(len(each)).reshape(-1, 3), np.repeat(_unit(across), 3, axis=0), colors[each])


def _joined(parts: list[_Part]) -> _Part:
    starts = np.cumsum([0] + [len(part.points) for part in parts[:-1]])
    return _Part(
        np.concatenate([part.points for part in parts]),
        np.concatenate([part.faces + start for part, start in zip(parts, starts, strict=True)]),
        np.concatenate([part.normals for part in parts]),
        np.concatenate([part.colors for part in parts]),
    )


def _lighter(part: _Part) -> _Part:
    """A heavy mesh with all vertices in one cell of a grid made one; others as they are."""
    if len(part.faces) <= _HEAVY:
        return part
    low, extent = part.points.min(axis=0), np.ptp(part.points, axis=0).max()
    cells = ((part.points - low) * (_CELLS / max(extent, 1e-9))).astype(np.int64)
    _, cluster, sizes = np.unique(cells @ [1, 1 << 20, 1 << 40], return_inverse=True, return_counts=True)
    cluster = cluster.reshape(-1)

    def mean(values: Array) -> Array:
        return np.stack([np.bincount(cluster, column) for column in values.T], axis=1) / sizes[:, None]

    faces = cluster[part.faces]
    solid = (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    return _Part(mean(part.points), np.unique(faces[solid], axis=0), _unit(mean(part.normals)), mean(part.colors))


def _unit(vectors: Array) -> Array:
    lengths = np.linalg.norm(vectors, axis=1, keepdims=True)
    return np.asarray(vectors / np.where(lengths == 0, 1, lengths))
