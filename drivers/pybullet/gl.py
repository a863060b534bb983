"""The renderer for everyday use: OpenGL without a window, on a graphics card or (Mesa's llvmpipe) without one."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.geometry import Pose
from hal.specs import CameraSpec

from .gl_target import NEAR, Target, create_context, projection
from .meshes import MeshLibrary
from .rendering import Images, Renderer
from .scene import Part, Scene, link_frames, parts_of
from .shaders import FRAGMENT, OUTPUTS, VERTEX

__all__ = ["GLRenderer"]

Array = NDArray[np.float64]

_KEY_LIGHT = np.array([-0.35, 0.45, 0.82])
"""Direction towards the light, in the world."""


_COARSE_PIXELS = 6.0
"""A link is drawn coarsely where what is left out is smaller than so many pixels: a whole arm in a picture of 256 x 256
from 1 m on, in one of 640 x 480 from 2.5 m on."""


class _Drawable(NamedTuple):
    """A part on the graphics card."""

    part: Part
    vertices: Any
    indices: Any
    layout: tuple[str, ...]
    texture: Any
    arrays: dict[tuple[str, ...], Any]
    """Its vertex array for each set of streams."""


class _Body(NamedTuple):
    shapes: tuple[Any, ...]
    """What PyBullet said of it: when that changes, the body is built again."""
    number: int
    """In segmentation images."""
    drawables: tuple[_Drawable, ...]


class GLRenderer(Renderer):
    """moderngl on EGL.

    Depth is written in metres by the shader, so it is as exact as a float and needs no conversion. The picture is
    drawn with its first row first, so nothing is flipped either.

    Raises:
        DriverMissing: moderngl or EGL is missing, or there is no graphics driver; names the command that mends it.
    """

    def __init__(self, scene: Scene, library: MeshLibrary | None = None) -> None:
        self._scene = scene
        self._library = library or MeshLibrary()
        self._lock = threading.Lock()
        self._context = create_context()
        self.description = f"OpenGL on {self._context.info['GL_RENDERER']}"
        self._context.__exit__(None, None, None)  # current in no thread, so that any thread may draw
        self._bodies: dict[int, _Body] = {}
        self._revision: int | None = None
        self._drawables: list[_Drawable] = []
        self._links: list[tuple[int, int]] = []
        self._link_of: NDArray[np.int64] = np.empty(0, int)
        self._balls: Array = np.empty((0, 5))
        self._coarse: NDArray[np.bool_] = np.empty(0, bool)
        self._cells: Array = np.empty(0)
        """Of each link, the size of what its coarse parts leave out, m; infinite where it has none."""
        self._textures: dict[int, tuple[Any, Any]] = {}
        self._targets: dict[tuple[int, int, tuple[str, ...]], Target] = {}
        self._programs: dict[tuple[str, ...], Any] = {}

    def render(self, camera: CameraSpec, T_world_camera: Pose) -> Images:
        with self._lock, self._context:
            if self._revision != self._scene.revision:
                self._build()
            return self._draw(camera, T_world_camera)

    def close(self) -> None:
        with self._lock:
            if self._context is not None:
                self._context.release()
                self._context = None

    # --- what there is to draw ---------------------------------------------------------------------------------

    def _build(self) -> None:
        """Bring the graphics card's meshes up to date with the world's bodies."""
        client = self._scene.client
        present: dict[int, _Body] = {}
        for body in self._scene.bodies.values():
            shapes = tuple(client.getVisualShapeData(body.id))
            known = self._bodies.pop(body.id, None)
            if known and known.shapes == shapes:
                present[body.id] = known._replace(number=body.index)
                continue
            _release(known)
            parts = parts_of(client, shapes, self._library)
            present[body.id] = _Body(shapes, body.index, tuple(self._upload(part) for part in parts))
        for gone in self._bodies.values():
            _release(gone)
        self._bodies = present
        self._drawables = [drawable for body in present.values() for drawable in body.drawables]
        parts = [drawable.part for drawable in self._drawables]
        places = [(part.body, part.link) for part in parts]
        self._links = list(dict.fromkeys(places))
        self._link_of = np.array([self._links.index(place) for place in places], int)
        self._balls = np.array([[*part.centre, 1.0, part.radius] for part in parts]).reshape(-1, 5)
        self._coarse = np.array([part.coarse for part in parts], bool)
        self._cells = np.full(len(self._links), np.inf)
        for link, cell in zip(self._link_of[self._coarse], (p.mesh.cell for p in parts if p.coarse), strict=True):
            self._cells[link] = cell if np.isinf(self._cells[link]) else max(cell, self._cells[link])
        self._revision = self._scene.revision

    def _upload(self, part: Part) -> _Drawable:
        mesh = part.mesh
        columns: list[NDArray[Any]] = [mesh.positions, mesh.normals, mesh.colors]
        layout: tuple[str, ...] = ("3f4 3f4 4f1", "position", "normal", "color")
        texture = None
        if mesh.texture is not None and mesh.uv is not None:
            columns.append(mesh.uv)
            layout = ("3f4 3f4 4f1 2f4", "position", "normal", "color", "uv")
            texture = self._texture(mesh.texture)
        rows = np.concatenate([np.ascontiguousarray(c).view(np.uint8).reshape(len(c), -1) for c in columns], axis=1)
        vertices = self._context.buffer(rows.tobytes())
        indices = self._context.buffer(np.ascontiguousarray(mesh.faces, np.uint32).tobytes())
        return _Drawable(part, vertices, indices, layout, texture, {})

    def _texture(self, image: NDArray[np.uint8]) -> Any:
        if id(image) not in self._textures:
            height, width = image.shape[:2]
            texture = self._context.texture((width, height), 3, image[::-1].tobytes(), alignment=1)
            texture.build_mipmaps()
            self._textures[id(image)] = (texture, image)  # the image is kept, so that its id stays its own
        return self._textures[id(image)][0]

    # --- drawing -----------------------------------------------------------------------------------------------

    def _draw(self, camera: CameraSpec, T_world_camera: Pose) -> Images:
        streams = tuple(name for name in OUTPUTS if name in camera.streams)
        target = self._target(camera.width, camera.height, streams)
        T_camera_world = np.linalg.inv(T_world_camera.matrix())
        frames = link_frames(self._scene.client, self._links)
        model_view = (T_camera_world @ frames)[self._link_of]
        to_clip = projection(camera)
        # Everything that is as large as a world is multiplied here in double precision, not in the shader.
        transforms = np.stack([to_clip @ model_view, model_view], axis=1)
        packed = np.ascontiguousarray(transforms.transpose(0, 1, 3, 2), np.float32).reshape(-1, 32)

        target.clear()
        for key, value in (
            ("key_light", T_camera_world[:3, :3] @ (_KEY_LIGHT / np.linalg.norm(_KEY_LIGHT))),
            ("up", T_camera_world[:3, 2]),
            ("range", (camera.depth_min, camera.depth_max)),
        ):
            self._set(streams, key, value)
        for number in self._visible(camera, model_view):
            drawable = self._drawables[number]
            program = self._program(streams, drawable.texture is not None)
            matrices = packed[number]
            program["model_view_projection"].write(matrices[:16])
            if "model_view" in program:
                program["model_view"].write(matrices[16:])
            if "body" in program:
                program["body"].value = float(self._bodies[drawable.part.body].number)
            if drawable.texture is not None:
                drawable.texture.use(0)
            self._context.enable_only(
                self._context.DEPTH_TEST | (self._context.CULL_FACE if drawable.part.mesh.closed else 0)
            )
            self._array(drawable, streams, program).render()
        return target.read()

    def _set(self, streams: tuple[str, ...], key: str, value: Any) -> None:
        for textured in (False, True):
            program = self._program(streams, textured)
            if key in program:
                program[key].value = tuple(float(v) for v in value)

    def _visible(self, camera: CameraSpec, model_view: Array) -> Iterator[int]:
        """The drawables that the picture may show, nearest first, so that hidden pixels are not shaded."""
        centres = np.einsum("nij,nj->ni", model_view[:, :3], self._balls[:, :4])
        radii = self._balls[:, 4]
        K = np.array(camera.K)
        corners = np.array([[-0.5, -0.5, 1], [camera.width - 0.5, -0.5, 1], [-0.5, camera.height - 0.5, 1]])
        corners = np.concatenate([corners, [[camera.width - 0.5, camera.height - 0.5, 1]]])
        rays = corners @ np.linalg.inv(K).T  # upper left, upper right, lower left, lower right
        planes = np.cross(rays[[0, 1, 3, 2]], rays[[1, 3, 2, 0]])  # look inwards
        planes /= np.linalg.norm(planes, axis=1, keepdims=True)
        inside = (centres @ planes.T >= -radii[:, None]).all(axis=1) & (centres[:, 2] + radii > NEAR)
        # Of each link, the coarse parts or the others, by its nearest point.
        nearest = np.full(len(self._links), np.inf)
        np.minimum.at(nearest, self._link_of, centres[:, 2] - radii)
        coarse = self._cells * K[0, 0] <= _COARSE_PIXELS * nearest
        numbers = np.flatnonzero(inside & (self._coarse == coarse[self._link_of]))
        return iter(numbers[np.argsort(centres[numbers, 2] - radii[numbers])].tolist())

    def _target(self, width: int, height: int, streams: tuple[str, ...]) -> Target:
        key = (width, height, streams)
        if key not in self._targets:
            self._targets[key] = Target(self._context, width, height, streams)
        return self._targets[key]

    def _program(self, streams: tuple[str, ...], textured: bool) -> Any:
        key = (*streams, "textured") if textured else streams
        if key not in self._programs:
            defines = "".join(f"#define {name.upper()}\n" for name in key)
            outputs = "".join(
                f"layout(location = {place}) out {OUTPUTS[name].type} out_{name};\n"
                for place, name in enumerate(streams)
            )
            self._programs[key] = self._context.program(
                vertex_shader=f"#version 330\n{defines}{VERTEX}",
                fragment_shader=f"#version 330\n{defines}{outputs}{FRAGMENT}",
            )
        return self._programs[key]

    def _array(self, drawable: _Drawable, streams: tuple[str, ...], program: Any) -> Any:
        if streams not in drawable.arrays:
            content = [(drawable.vertices, *drawable.layout)]
            drawable.arrays[streams] = self._context.vertex_array(
                program, content, index_buffer=drawable.indices, skip_errors=True
            )
        return drawable.arrays[streams]


def _release(body: _Body | None) -> None:
    for drawable in body.drawables if body else ():
        for array in drawable.arrays.values():
            array.release()
        drawable.vertices.release()
        drawable.indices.release()
