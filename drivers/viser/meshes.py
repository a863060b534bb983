"""Visuals as GLB files in memory, the format that a browser displays without further work.

Colours are baked into the vertices: a texture that is a palette, as arms often have one, would otherwise be sent once
for each of a mesh's materials. Only few large triangles, whose corners cannot show the texture, keep it.

viser's own view of URDFs (``ViserUrdf``) does not replace this: it ignores the units of Collada files, refuses a URDF
with a capsule, skips missing meshes silently, sends large meshes and textures unchanged, and moves no world's bodies.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.kinematics.urdf import UrdfVisual

__all__ = ["visual_glb"]

Array = NDArray[np.float64]

_HEAVY = 60_000
"""Greatest number of triangles of a mesh that is sent unchanged."""
_CELLS = 150
"""Grid cells along the longest side of a heavier mesh."""
_COARSE = 200
"""Only a piece with fewer triangles may keep its texture,"""
_WIDE = 0.05
"""and only where they span more than this share of it, on average."""
_PIXELS = 512
"""Largest side of a texture that is kept, pixels."""
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
    """(V, 3) from 0 to 1, sRGB."""


def visual_glb(visual: UrdfVisual) -> bytes:
    """Return the shape of a visual, in its own frame, as a GLB file. Raises ValueError where it cannot be drawn."""
    import trimesh

    parts = _mesh(visual) if visual.shape == "mesh" else [_to_trimesh(_primitive(visual))]
    scene: Any = trimesh.Scene(parts)
    data: bytes = scene.export(file_type="glb", include_normals=True)
    return data


def _to_trimesh(part: _Part) -> Any:
    """Return a part as a trimesh mesh. The vertex colours of a GLB are linear, not sRGB."""
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


def _primitive(visual: UrdfVisual) -> _Part:
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
        raise ValueError(f"unknown shape {visual.shape!r}")
    colors = np.tile((visual.rgba or _GREY)[:3], (len(mesh.vertices), 1))
    return _faceted(np.array(mesh.vertices), np.array(mesh.faces), colors)


def _mesh(visual: UrdfVisual) -> list[Any]:
    """Return the parts of a mesh file: those that keep a texture, and one with all others."""
    import trimesh

    if not Path(visual.file).is_file():
        raise ValueError(f"there is no file {visual.file}")
    try:
        loaded = trimesh.load(visual.file, process=False)
        metres = trimesh.units.unit_conversion(loaded.units or "meters", "meters")
        textured, parts = [], []
        for matrix, piece in _pieces(loaded):
            whole = np.diag([*(metres * np.array(visual.size)), 1.0]) @ matrix
            if _needs_texture(piece):
                textured.append(_textured(piece, whole))
            elif len(piece.faces):
                parts.append(_part(piece, whole, visual.rgba))
    except Exception as error:  # parsers raise anything on a bad file
        raise ValueError(f"{visual.file}: {type(error).__name__}: {error}") from None
    if not textured and not parts:
        raise ValueError(f"{visual.file} has no triangles")
    return textured + ([_to_trimesh(_decimated(_joined(parts)))] if parts else [])


def _pieces(loaded: Any) -> Iterator[tuple[Array, Any]]:
    """Yield (pose matrix, mesh) for each piece of a file; each material is one piece."""
    import trimesh

    if isinstance(loaded, trimesh.Trimesh):
        yield np.eye(4), loaded
    elif isinstance(loaded, trimesh.Scene):
        for node in loaded.graph.nodes_geometry:
            matrix, name = loaded.graph[node]
            if isinstance(loaded.geometry[name], trimesh.Trimesh):
                yield matrix, loaded.geometry[name]


def _part(piece: Any, matrix: Array, rgba: tuple[float, ...] | None) -> _Part:
    """Return one piece, moved and coloured."""
    points, faces = _moved(piece, matrix)
    colors = _colors(piece, rgba)
    # trimesh computes missing normals only with scipy; those of the file are in its cache.
    normals = np.asarray(piece.vertex_normals, float) if "vertex_normals" in piece._cache else None
    if normals is None or not np.isfinite(normals).all():
        return _faceted(points, faces, colors)
    return _Part(points, faces, _unit(normals @ np.linalg.inv(matrix[:3, :3])), colors)


def _moved(piece: Any, matrix: Array) -> tuple[Array, NDArray[np.int64]]:
    """Return points and faces of a piece; faces are reversed where the matrix mirrors, to keep the outside outside."""
    faces = np.asarray(piece.faces)
    points: Array = np.asarray(piece.vertices, float) @ matrix[:3, :3].T + matrix[:3, 3]
    return points, faces[:, ::-1] if np.linalg.det(matrix[:3, :3]) < 0 else faces


def _colors(piece: Any, rgba: tuple[float, ...] | None) -> Array:
    """Return the colours (V, 3). A URDF's colour replaces that of a material and tints a texture; white keeps both."""
    count, visual = len(piece.vertices), piece.visual
    tint = np.ones(3) if rgba is None else np.asarray(rgba[:3], float)
    texture = _texture(piece)
    if texture is not None:
        return _sampled(np.asarray(texture.convert("RGB")), np.asarray(visual.uv, float)) * tint
    if visual.kind in ("vertex", "face"):
        return np.asarray(visual.vertex_colors, float)[:, :3] / 255 * tint
    material = getattr(visual, "material", None)
    # A material without entries is trimesh's placeholder for a missing file.
    if np.all(tint == 1) and material is not None and getattr(material, "kwargs", True):
        tint = np.asarray(material.main_color[:3], float) / 255
    return np.tile(tint, (count, 1))


def _texture(piece: Any) -> Any | None:
    material = getattr(piece.visual, "material", None)
    image = getattr(material, "image", None) or getattr(material, "baseColorTexture", None)
    return image if getattr(piece.visual, "uv", None) is not None else None


def _needs_texture(piece: Any) -> bool:
    if _texture(piece) is None or not 0 < len(piece.faces) < _COARSE:
        return False
    return float(np.ptp(np.asarray(piece.visual.uv)[piece.faces], axis=1).max(axis=1).mean()) > _WIDE


def _textured(piece: Any, matrix: Array) -> Any:
    """Return a piece that keeps its texture as a trimesh mesh."""
    import trimesh

    texture = _texture(piece).convert("RGB")  # type: ignore[union-attr]
    texture.thumbnail((_PIXELS, _PIXELS))
    points, faces = _moved(piece, matrix)
    flat = _faceted(points, faces, np.zeros_like(points))
    visuals: Any = trimesh.visual
    material = visuals.material.PBRMaterial(baseColorTexture=texture, metallicFactor=0.0, roughnessFactor=0.8)
    visual = visuals.TextureVisuals(np.asarray(piece.visual.uv)[faces.reshape(-1)], material=material)
    return trimesh.Trimesh(flat.points, flat.faces, vertex_normals=flat.normals, visual=visual, process=False)


def _sampled(texture: NDArray[np.uint8], uv: Array) -> Array:
    height, width, _ = texture.shape
    column = (np.mod(uv[:, 0], 1.0) * width).astype(int) % width
    row = ((1.0 - np.mod(uv[:, 1], 1.0)) * height).astype(int) % height
    colors: Array = texture[row, column] / 255.0
    return colors


def _faceted(points: Array, faces: NDArray[np.int64], colors: Array) -> _Part:
    """Give each triangle its own corners and its own normal."""
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


def _decimated(part: _Part) -> _Part:
    """Join all vertices in one cell of a grid, where a mesh is heavy."""
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
