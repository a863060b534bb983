"""Light, shadows and background of drawn pictures: what is drawn beside the bodies of a scene.

The first light casts shadows, by a shadow map: the depths of all that is drawn, as seen from the light. It is drawn
once for each state of the world, whatever the number of cameras, from shapes with few triangles, because OpenGL without
a graphics card needs time for each of them.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
        self._array: Any = None
        self._buffers: list[Any] = []
        self._shown: tuple[Any, ...] = ()
        self._to_light = np.eye(4)
        self.offset = 0.0
        """Distance from a surface at which its shadow is looked up, m."""

    def load(self, parts: Sequence[Any], links: NDArray[np.int64]) -> None:
        """Take what casts shadows, each a :class:`.shapes.DrawnPart`, and the numbers (N,) of their links."""
        small = [number for number, part in enumerate(parts) if part.radius <= _LARGE]
        outlines = [parts[number].outline for number in small]
        sizes = [len(points) for points, _ in outlines]
        self._links = np.asarray(links, int)[small]
        self._balls = np.array([[*parts[n].centre, 1.0, parts[n].radius] for n in small]).reshape(-1, 5)
        self._part_of = np.repeat(np.arange(len(small)), sizes)
        self._points = np.ones((sum(sizes), 4), np.float32)
        for item in (self._array, *self._buffers) if self._buffers else ():
            item.release()
        self._array, self._buffers, self._shown = None, [], ()
        if small:
            self._points[:, :3] = np.concatenate([points for points, _ in outlines])
            starts = np.cumsum([0, *sizes[:-1]])
            faces = np.concatenate([faces + start for (_, faces), start in zip(outlines, starts, strict=True)])
            vertices = self._context.buffer(reserve=12 * len(self._points), dynamic=True)
            indices = self._context.buffer(faces.astype(np.uint32).tobytes())
            self._buffers = [vertices, indices]
            self._array = self._context.vertex_array(self._program, [(vertices, "3f4", "position")], indices)

    def draw(self, direction: Array, frames: Array) -> Array:
        """Draw the depths, unless they are those that were drawn last; return the matrix (4, 4), world to map, 0..1.

        ``direction`` (3,) is a unit vector towards the light, ``frames`` the poses (N, 4, 4) of all links, in the
        world.
        """
        key = direction.tobytes(), frames.tobytes()
        if key == self._shown:
            return self._to_light
        frames = frames[self._links]
        to_clip = self._fit(direction, np.einsum("nij,nj->ni", frames[:, :3], self._balls[:, :4]), self._balls[:, 4])
        self._target.clear(depth=1.0)
        if self._array is not None:  # in one call, with points that are placed here: there are few of them
            matrices = (to_clip @ frames)[:, :3].astype(np.float32)
            placed = np.einsum("nij,nj->ni", matrices[self._part_of], self._points)
            self._buffers[0].write(np.ascontiguousarray(placed))
            self._target.use()
            self._context.enable_only(self._context.DEPTH_TEST | self._context.CULL_FACE)
            self._array.render()
        half = np.diag([0.5, 0.5, 0.5, 1.0])
        half[:3, 3] = 0.5
        self._to_light, self._shown = half @ to_clip, key
        return self._to_light

    def _fit(self, direction: Array, centres: Array, radii: Array) -> Array:
        """Return the projection (4, 4) from the world to clip space that has all casters in it."""
        low, high = np.zeros(3), np.zeros(3)
        if len(radii):
            low, high = (centres - radii[:, None]).min(axis=0), (centres + radii[:, None]).max(axis=0)
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

    def use(self, place: int) -> None:
        self._texture.use(place)


_SHADOW_VERTEX = """#version 330
in vec3 position;
void main() { gl_Position = vec4(position, 1.0); }
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
