"""Light, shadows and background of drawn pictures: what is drawn beside the bodies of a scene.

The first light casts shadows, by a shadow map: the depths of all that is drawn, as seen from the light. It is drawn
once for each state of the world, whatever the number of cameras, from shapes with few triangles, because OpenGL without
a graphics card needs time for each of them.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BACKGROUND = (0.72, 0.76, 0.80)
"""Colour of the background."""
_SIDE = 512
"""Side of the shadow map, texels."""
_WIDEST = 2.0
"""Greatest radius of the space in which shadows are drawn, m: its texels are 8 mm large."""
_CELLS = 6
"""Size of the details of a part that its shadow has, as a share of the part's radius: one of so many."""
_STEP = 0.25
"""The space of the shadows grows and moves in steps of this size, m, so that their edges stand still."""
_LARGE = 2.0
"""Parts with a greater radius, such as floors, cast no shadow, m."""
_OFFSET = 1.5
"""Distance from a surface, texels, at which its shadow is looked up, so that it casts none onto itself."""


@dataclass(frozen=True)
class Light:
    """A light that is infinitely far away."""

    direction: tuple[float, float, float] = (-0.35, 0.45, 0.82)
    """(3,) towards the light, in the world; of any length."""
    color: tuple[float, float, float] = (1.0, 1.0, 1.0)
    """(3,) red, green and blue; 1 for that of the default light."""


@dataclass(frozen=True)
class Look:
    """How a scene looks, apart from its bodies."""

    lights: tuple[Light, ...] = (Light(),)
    """The first one casts shadows. The others are soft, as from a large window: they also light what is turned away
    from them, half as much at a right angle."""
    ambient: float = 1.0
    """Light from everywhere, as a factor of the default."""
    background: tuple[float, ...] = BACKGROUND
    """(3,) red, green, blue, 0..1."""
    backdrop: str = ""
    """Texture of the background, which the colour tints; empty for none."""
    shadows: bool = True
    exposure: Mapping[str, float] = field(default_factory=dict)
    """Factor on the brightness of a camera's pictures, by its name."""


class ShadowMap:
    """The depths of a scene as seen from a light."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self._texture = context.depth_texture((_SIDE, _SIDE))
        self._texture.compare_func = "<="
        self._texture.repeat_x = self._texture.repeat_y = False
        self._target = context.framebuffer(depth_attachment=self._texture)
        self._program = context.program(vertex_shader=_SHADOW_VERTEX, fragment_shader="#version 330\nvoid main() {}\n")
        self._shown: tuple[Any, ...] = ()
        self._to_light = np.eye(4)
        self.offset = 0.0
        """Distance from a surface at which its shadow is looked up, m."""

    def draw(
        self, key: tuple[Any, ...], direction: Array, casters: Iterable[Any], frames: Array, balls: Array
    ) -> Array:
        """Draw the depths, unless they are those of ``key``; return the matrix (4, 4) from the world to the map, 0..1.

        Args:
            key: What the depths depend on.
            direction: (3,) unit vector towards the light, in the world.
            casters: What is drawn of the scene, see :class:`.renderer.GLRenderer`.
            frames: Their poses (N, 4, 4) in the world.
            balls: (N, 5) centre, 1 and radius of a ball around each, in its own frame, m.
        """
        if key == self._shown:
            return self._to_light
        centres = np.einsum("nij,nj->ni", frames[:, :3], balls[:, :4])
        to_clip = self._fit(direction, centres, balls[:, 4])
        matrices = np.ascontiguousarray((to_clip @ frames).transpose(0, 2, 1), np.float32)
        self._target.clear(depth=1.0)
        self._target.use()
        self._context.enable_only(self._context.DEPTH_TEST)
        for drawable, matrix, radius in zip(casters, matrices, balls[:, 4], strict=True):
            if radius <= _LARGE:
                self._program["to_clip"].write(matrix)
                self._array(drawable).render()
        half = np.diag([0.5, 0.5, 0.5, 1.0])
        half[:3, 3] = 0.5
        self._to_light, self._shown = half @ to_clip, key
        return self._to_light

    def _fit(self, direction: Array, centres: Array, radii: Array) -> Array:
        """Return the projection (4, 4) from the world to clip space that has all casters in it."""
        cast = radii <= _LARGE
        low, high = np.zeros(3), np.zeros(3)
        if cast.any():
            low, high = (centres - radii[:, None])[cast].min(axis=0), (centres + radii[:, None])[cast].max(axis=0)
        low, high = np.floor(low / _STEP) * _STEP, np.ceil(high / _STEP) * _STEP
        middle, radius = (low + high) / 2.0, float(np.clip(np.linalg.norm(high - low) / 2.0, _STEP, _WIDEST))
        self.offset = _OFFSET * 2.0 * radius / _SIDE
        z = -direction
        x = np.cross(z, np.eye(3)[int(np.argmin(np.abs(z)))])
        x /= np.linalg.norm(x)
        matrix = np.eye(4)
        matrix[:3, :3] = np.stack([x, np.cross(z, x), z]) / radius
        matrix[:3, 3] = -matrix[:3, :3] @ middle
        matrix[2] /= 2.0  # casters outside of the space, towards the light, cast their shadows into it
        matrix[2, 3] = -matrix[2, :3] @ middle
        return matrix

    def _array(self, drawable: Any) -> Any:
        known = drawable.arrays.get("shadow")
        if known is None:
            mesh = drawable.part.mesh
            points = _coarsen(mesh.positions, mesh.faces, drawable.part.radius / _CELLS)
            if not len(points):  # a rod, or what is so flat that it has no cell of its own
                points = np.ascontiguousarray(mesh.positions[mesh.faces], np.float32)
            buffer = self._context.buffer(points.tobytes())
            content = [(buffer, "3f4", "position")]
            known = drawable.arrays["shadow"] = self._context.vertex_array(self._program, content)
            drawable.buffers.append(buffer)
        return known

    def use(self, place: int) -> None:
        """Make the map the texture of this number."""
        self._texture.use(place)


def _coarsen(positions: NDArray[np.float32], faces: NDArray[np.uint32], cell: float) -> NDArray[np.float32]:
    """Return the corners (F, 3, 3) of the triangles that are left when all corners within a cell, m, become one."""
    _, place = np.unique(np.floor(positions / cell).astype(np.int64), axis=0, return_inverse=True)
    place = place.reshape(-1)
    counts = np.bincount(place)
    middle = np.stack([np.bincount(place, positions[:, k]) / counts for k in range(3)], axis=1)
    corners = place[faces]
    left = (corners != np.roll(corners, 1, axis=1)).all(axis=1)
    ordered = np.sort(corners[left], axis=1)
    _, first = np.unique(ordered, axis=0, return_index=True)
    result: NDArray[np.float32] = middle[corners[left][first]].astype(np.float32)
    return result


_SHADOW_VERTEX = """#version 330
uniform mat4 to_clip;
in vec3 position;
void main() { gl_Position = to_clip * vec4(position, 1.0); }
"""


class Backdrop:
    """A picture around the scene, infinitely far away."""

    def __init__(self, context: Any) -> None:
        self._context = context
        self._program = context.program(vertex_shader=_BACKDROP_VERTEX, fragment_shader=_BACKDROP_FRAGMENT)
        self._array = context.vertex_array(self._program, [])

    def draw(self, target: Any, texture: Any, rays: Array, tint: Array, grey: bool) -> None:
        """Draw it where nothing else was drawn.

        Args:
            target: The framebuffer of one layer, with the depths of what was drawn.
            texture: The picture.
            rays: (3, 3) from the position in the picture (-1..1, -1..1, 1) to the direction in the world.
            tint: (3,) factors on red, green and blue.
            grey: Whether only the luminance is drawn.
        """
        target.use()
        self._context.enable_only(self._context.DEPTH_TEST)
        self._program["rays"].write(np.ascontiguousarray(rays.T, np.float32))
        self._program["tint"].value = tuple(tint.tolist())
        self._program["grey"].value = grey
        texture.use(0)
        self._array.render(self._context.TRIANGLES, vertices=3)


_BACKDROP_VERTEX = """#version 330
uniform mat3 rays;
out vec3 ray;
void main() {
    vec2 at = vec2(gl_VertexID == 1 ? 3.0 : -1.0, gl_VertexID == 2 ? 3.0 : -1.0);
    ray = rays * vec3(at, 1.0);
    gl_Position = vec4(at, 0.99999, 1.0);
}
"""

_BACKDROP_FRAGMENT = """#version 330
uniform sampler2D picture;
uniform vec3 tint;
uniform bool grey;
in vec3 ray;
out vec4 color;
void main() {
    vec3 far = abs(ray);  // on a cube around the camera
    vec2 at = far.x > max(far.y, far.z) ? ray.yz / ray.x : far.y > far.z ? ray.xz / ray.y : ray.xy / ray.z;
    vec3 seen = textureLod(picture, at, 0.0).rgb * tint;
    color = grey ? vec4(dot(seen, vec3(0.299, 0.587, 0.114))) : vec4(seen, 1.0);
}
"""
