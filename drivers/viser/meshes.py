"""Visuals as GLB files in memory, the format that a browser displays without further work.

The triangles and their colours are those of the pictures of simulated cameras (:mod:`hal.drivers.scene.meshes`), from
the same cache: heavy meshes with fewer triangles, and textures that are palettes as colours of the vertices.

viser's own view of URDFs (``ViserUrdf``) does not replace this: it ignores the units of Collada files, refuses a URDF
with a capsule, skips missing meshes silently, sends large meshes and textures unchanged, and moves no world's bodies.
"""

from __future__ import annotations

import warnings
from collections.abc import Iterable
from typing import Any

import numpy as np

from hal.drivers.scene.meshes import MeshLibrary
from hal.drivers.scene.shapes import Mesh, Visual, parts_of

_PIXELS = 512
"""Largest side of a texture, pixels."""


def visuals_glb(visuals: Iterable[Visual], notes: list[str]) -> bytes:
    """Return the visual shapes of one link, in the link's frame, as a GLB file; empty if there is nothing to draw.

    Args:
        visuals: The shapes.
        notes: Gets a line for each that cannot be drawn.
    """
    import trimesh

    with warnings.catch_warnings(record=True) as troubles:
        warnings.simplefilter("always")
        parts = parts_of(0, tuple(visuals), MeshLibrary().load)
    notes += [str(trouble.message) for trouble in troubles]
    scene: Any = trimesh.Scene([_convert_mesh(part.mesh) for part in parts if not part.coarse])
    data: bytes = scene.export(file_type="glb", include_normals=True) if parts else b""
    return data


def _convert_mesh(mesh: Mesh) -> Any:
    """Return a mesh as one of trimesh. The vertex colours of a GLB are linear, not sRGB."""
    import trimesh
    from PIL import Image

    looks: Any = trimesh.visual
    if mesh.texture is not None:
        texture = Image.fromarray(mesh.texture)
        texture.thumbnail((_PIXELS, _PIXELS))
        material = looks.material.PBRMaterial(baseColorTexture=texture, metallicFactor=0.0, roughnessFactor=0.8)
        look = looks.TextureVisuals(mesh.uv, material=material)
    else:
        colors = mesh.colors / 255.0
        linear = np.where(colors <= 0.04045, colors / 12.92, ((colors + 0.055) / 1.055) ** 2.4)
        linear[:, 3] = 1.0
        look = looks.ColorVisuals(vertex_colors=np.round(255 * linear).astype(np.uint8))
    return trimesh.Trimesh(mesh.positions, mesh.faces, vertex_normals=mesh.normals, visual=look, process=False)
