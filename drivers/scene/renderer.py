"""Drawing: the interface of a renderer, and the one that draws with OpenGL.

OpenGL draws without a window, on a graphics card or, with Mesa's llvmpipe, without one. Nothing here depends on a
physics engine: what is drawn is a :class:`.drawn.DrawnWorld`.
"""

from __future__ import annotations

import ctypes
import os
import sys
import threading
from abc import ABC, abstractmethod
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import DTypeLike, NDArray

from hal.errors import DriverMissing
from hal.geometry import Pose
from hal.specs import CameraSpec

from .drawn import DrawnWorld
from .lighting import Backdrop, Light, Look, ShadowMap
from .meshes import MeshLibrary
from .shapes import DrawnPart, Visual, parts_of
from .textures import load_texture

Array = NDArray[np.float64]

LUMINANCE = (0.299, 0.587, 0.114)
"""Weights of red, green and blue (ITU-R BT.601)."""
_NEAR, _FAR = 0.01, 100.0
"""Range of what is drawn, m. A camera's own range only blanks its depth."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Options of ``mallopt``, of glibc's malloc.h."""
_REMEDY = "apt install libegl1 libgl1-mesa-dri"
_TEXTURES = 64
"""Number of textures that are kept although nothing shows them."""
_COARSE_PIXELS = 6.0
"""A link is drawn coarsely where the omitted details are smaller than so many pixels: a whole arm in a picture of
256 x 256 from 1 m on, in one of 640 x 480 from 2.5 m on."""


class RenderedImages(NamedTuple):
    """One picture of the world; None for streams that the camera does not have. Upright, aligned pixel by pixel."""

    color: NDArray[np.uint8] | None
    """(H, W, 3) RGB."""
    depth: NDArray[np.float32] | None
    """(H, W) m along the optical axis; 0 where nothing is within the camera's range."""
    infrared: NDArray[np.uint8] | None
    """(H, W): the luminance."""
    segmentation: NDArray[np.int32] | None
    """(H, W) ``index`` of the body, -1 for the background."""


class Renderer(ABC):
    """Draws the present state of one world. Calls may come from any thread, one at a time."""

    description: str
    """The renderer in one line, for a banner."""

    @abstractmethod
    def render(self, camera: CameraSpec, T_world_camera: Pose) -> RenderedImages:
        """Draw a picture with the pinhole model ``camera.K``, without distortion.

        Args:
            camera: Its K, size, range and streams; only what it streams is computed.
            T_world_camera: Pose of the optical frame (x right, y down, z forward).
        """

    def close(self) -> None:  # noqa: B027  # not every renderer holds something
        """Release the graphics memory. Idempotent."""


class _Drawable(NamedTuple):
    """A part on the graphics card."""

    part: DrawnPart
    vertices: Any
    indices: Any
    layout: tuple[str, ...]
    texture: Any
    arrays: dict[tuple[str, ...], Any]
    """Its vertex array for each program."""


class _Program(NamedTuple):
    """A program for a set of streams and a kind of light, with its uniforms; None for those that it does not have."""

    key: tuple[str, ...]
    program: Any
    to_clip: Any
    model_view: Any
    body: Any


class _Body(NamedTuple):
    visuals: tuple[Visual, ...]
    """The visual shapes that it was built from; when they change, it is built again."""
    number: int
    """Its value in segmentation images."""
    drawables: tuple[_Drawable, ...]


class GLRenderer(Renderer):
    """Draws with moderngl on EGL; meshes come from a library with the user's cache.

    The shader writes depth in metres, so it is as exact as a float and needs no conversion. The picture is drawn with
    its first row first, so nothing is flipped either. Raises DriverMissing if moderngl, EGL or a graphics driver is
    missing; names the command that installs it.
    """

    def __init__(self, scene: DrawnWorld) -> None:
        self._scene = scene
        self._library = MeshLibrary()
        self._lock = threading.Lock()
        self._context = create_context()
        self.description = f"OpenGL on {self._context.info['GL_RENDERER']}"
        self._light_block = self._context.buffer(reserve=16 * _LIGHT_ROWS)
        self._context.__exit__(None, None, None)  # current in no thread, so that any thread may draw
        self._bodies: dict[int, _Body] = {}
        self._revision: int | None = None
        self._drawables: list[_Drawable] = []
        self._links: list[tuple[int, int]] = []
        self._link_of: NDArray[np.int64] = np.empty(0, int)
        self._balls: Array = np.empty((0, 5))
        self._coarse: NDArray[np.bool_] = np.empty(0, bool)
        self._cells: Array = np.empty(0)
        """Size of the details that the coarse parts of each link leave out, m; infinite where it has none."""
        self._textures: dict[int, tuple[Any, Any]] = {}
        self._targets: dict[tuple[int, int, tuple[str, ...]], _Target] = {}
        self._programs: dict[tuple[str, ...], _Program] = {}
        self._shadows: ShadowMap | None = None
        self._cast: int | None = None
        """Revision of the parts that cast shadows."""
        self._backdrop: Backdrop | None = None

    def render(self, camera: CameraSpec, T_world_camera: Pose) -> RenderedImages:
        with self._lock, self._context:
            if self._revision != self._scene.revision:
                self._build()
            return self._draw(camera, T_world_camera)

    def close(self) -> None:
        with self._lock:
            if self._context is not None:
                with self._context:
                    for body in self._bodies.values():
                        _release(body)
                    self._context.finish()
                self._context.release()
                self._context = None

    def _build(self) -> None:
        """Bring the graphics card's meshes up to date with the world's bodies."""
        present: dict[int, _Body] = {}
        for body in self._scene.bodies.values():
            visuals = self._scene.visuals(body.id)
            known = self._bodies.pop(body.id, None)
            if known and known.visuals == visuals:
                present[body.id] = known._replace(number=body.index)
                continue
            _release(known)
            parts = parts_of(body.id, visuals, self._library.load)
            present[body.id] = _Body(visuals, body.index, tuple(self._upload(part) for part in parts))
        for gone in self._bodies.values():
            _release(gone)
        self._bodies = present
        self._drop_textures()
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

    def _drop_textures(self) -> None:
        """Release what nothing shows any more, where there are many: each episode may bring others from files."""
        used = {id(drawable.texture) for body in self._bodies.values() for drawable in body.drawables}
        for key in list(self._textures) if len(self._textures) > _TEXTURES else ():
            texture, _ = self._textures[key]
            if id(texture) not in used:
                texture.release()
                del self._textures[key]

    def _upload(self, part: DrawnPart) -> _Drawable:
        mesh = part.mesh
        columns: list[NDArray[Any]] = [mesh.positions, mesh.normals, mesh.colors]
        layout: tuple[str, ...] = ("3f4 3f4 4f1", "position", "normal", "color")
        texture = None
        if mesh.texture is not None and mesh.uv is not None:
            columns.append(mesh.uv)
            layout = ("3f4 3f4 4f1 2f4", "position", "normal", "color", "uv")
            texture = self._texture(mesh.texture, repeated=mesh.repeated)
        rows = np.concatenate([np.ascontiguousarray(c).view(np.uint8).reshape(len(c), -1) for c in columns], axis=1)
        vertices = self._context.buffer(rows.tobytes())
        indices = self._context.buffer(np.ascontiguousarray(mesh.faces, np.uint32).tobytes())
        return _Drawable(part, vertices, indices, layout, texture, {})

    def _texture(self, image: NDArray[np.uint8], repeated: bool) -> Any:
        if id(image) not in self._textures:
            height, width = image.shape[:2]
            texture = self._context.texture((width, height), 3, image[::-1].tobytes(), alignment=1)
            texture.build_mipmaps()
            if repeated:  # these cover most of a picture: sharper edges are nearly free, smooth ones take a fifth more
                texture.filter = self._context.NEAREST_MIPMAP_NEAREST, self._context.NEAREST
            self._textures[id(image)] = (texture, image)  # the image is kept, so that its id stays its own
        return self._textures[id(image)][0]

    def _draw(self, camera: CameraSpec, T_world_camera: Pose) -> RenderedImages:
        look = self._scene.look
        streams = tuple(name for name in _OUTPUTS if name in camera.streams)
        target = self._target(camera.width, camera.height, streams)
        T_camera_world: Any = np.linalg.inv(T_world_camera.matrix())
        frames: Array = self._scene.link_frames(self._links)
        model_view = (T_camera_world @ frames)[self._link_of]
        to_clip, planes = _lens(camera.width, camera.height, camera.K)
        # Large distances are multiplied here in double precision, not in the shader.
        transforms = np.stack([to_clip @ model_view, model_view], axis=1)
        packed = np.ascontiguousarray(transforms.transpose(0, 1, 3, 2), np.float32).reshape(-1, 32)

        exposure = look.exposure.get(camera.name, 1.0)
        variant = self._light(look, streams, camera, frames, T_camera_world, exposure)
        plain, textured = (self._program(streams, kind) for kind in (variant, (*variant, "textured")))
        target.clear(np.clip(exposure * np.array(look.background), 0.0, 1.0))
        for number in self._visible(camera.K[0][0], planes, model_view):
            drawable = self._drawables[number]
            program = plain
            if drawable.texture is not None:
                program = textured
                drawable.texture.use(0)
            matrices = packed[number]
            program.to_clip.write(matrices[:16])
            if program.model_view is not None:
                program.model_view.write(matrices[16:])
            if program.body is not None:
                program.body.value = float(self._bodies[drawable.part.body].number)
            self._context.enable_only(
                self._context.DEPTH_TEST | (self._context.CULL_FACE if drawable.part.mesh.closed else 0)
            )
            self._array(drawable, program).render()
        if look.backdrop:
            self._draw_backdrop(look, target, to_clip[:2, :3], T_world_camera, exposure)
        return target.read()

    def _light(
        self,
        look: Look,
        streams: tuple[str, ...],
        camera: CameraSpec,
        frames: Array,
        T_camera_world: Array,
        gain: float,
    ) -> tuple[str, ...]:
        """Draw the shadow map and write everything that does not differ between parts; return the kind of programs."""
        key, *fills = look.lights or (Light(color=(0.0, 0.0, 0.0)),)
        to_camera = T_camera_world[:3, :3]
        values = np.zeros((_LIGHT_ROWS, 4))  # the rows of the block Light
        values[7] = *(to_camera @ _unit(key.direction)), look.ambient
        values[8] = *key.color, gain
        values[9, :3] = to_camera[:, 2]
        values[11, :2] = camera.depth_min, camera.depth_max
        variant: tuple[str, ...] = ()
        if fills:
            variant = ("fill",)
            # Half from everywhere, half by the side that a surface has towards the light; and the ambient light, too.
            colors = 0.5 * _KEY * np.array([light.color for light in fills])
            directions = np.array([to_camera @ _unit(light.direction) for light in fills])
            low, high = 0.5 * look.ambient * np.array(_AMBIENT)
            values[0:3, :3] = (colors.T @ directions + np.outer(high - low, to_camera[:, 2])).T
            values[10, :3] = colors.sum(axis=0) + low + high
        if look.shadows and {"color", "infrared"} & set(streams):
            variant += ("shadows",)
            to_light = self._draw_shadows(_unit(key.direction), frames) @ np.linalg.inv(T_camera_world)
            assert self._shadows is not None
            self._shadows.use(1)
            values[3:7, :3] = to_light[:3].T
            values[9, 3] = self._shadows.offset
        self._light_block.write(values.astype(np.float32))
        self._light_block.bind_to_uniform_block(0)
        return variant

    def _draw_shadows(self, direction: Array, frames: Array) -> Array:
        """Return the matrix (4, 4) from the world to the shadow map, which shows the present state of the world."""
        if self._shadows is None:
            self._shadows = ShadowMap(self._context)
        if self._cast != self._revision:
            # Of a link that has coarse parts, these cast the shadow.
            cast = np.flatnonzero(self._coarse | np.isinf(self._cells)[self._link_of])
            self._shadows.load([self._drawables[number].part for number in cast], self._link_of[cast])
            self._cast = self._revision
        return self._shadows.draw(direction, frames)

    def _draw_backdrop(self, look: Look, target: _Target, lens: Array, pose: Pose, gain: float) -> None:
        if self._backdrop is None:
            self._backdrop = Backdrop(self._context)
        inverse = np.linalg.inv(np.vstack([lens, [0.0, 0.0, 1.0]]))
        rays = pose.matrix()[:3, :3] @ inverse
        texture = self._texture(load_texture(look.backdrop), repeated=True)
        for name, layer in target.layers():
            self._backdrop.draw(layer, texture, rays, gain * np.array(look.background), name == "infrared")

    def _visible(self, focal: float, planes: Array, model_view: Array) -> list[int]:
        """Return the drawables that the picture may show, nearest first, so that hidden pixels are not shaded."""
        centres = np.einsum("nij,nj->ni", model_view[:, :3], self._balls[:, :4])
        radii = self._balls[:, 4]
        inside = (centres @ planes.T >= -radii[:, None]).all(axis=1) & (centres[:, 2] + radii > _NEAR)
        # The nearest point of each link selects its coarse parts or the others.
        nearest = np.full(len(self._links), np.inf)
        np.minimum.at(nearest, self._link_of, centres[:, 2] - radii)
        coarse = self._cells * focal <= _COARSE_PIXELS * nearest
        numbers = np.flatnonzero(inside & (self._coarse == coarse[self._link_of]))
        # By their farthest points: a floor is behind what stands on it, although it begins before it.
        order: list[int] = numbers[np.argsort(centres[numbers, 2] + radii[numbers])].tolist()
        return order

    def _target(self, width: int, height: int, streams: tuple[str, ...]) -> _Target:
        key = (width, height, streams)
        if key not in self._targets:
            self._targets[key] = _Target(self._context, width, height, streams)
        return self._targets[key]

    def _program(self, streams: tuple[str, ...], kind: tuple[str, ...]) -> _Program:
        key = (*streams, *kind)
        if key not in self._programs:
            defines = "".join(f"#define {name.upper()}\n" for name in key)
            outputs = "".join(
                f"layout(location = {place}) out {_OUTPUTS[name].type} out_{name};\n"
                for place, name in enumerate(streams)
            )
            program = self._context.program(
                vertex_shader=f"#version 330\n{defines}{_LIGHT}{_VERTEX}",
                fragment_shader=f"#version 330\n{defines}{outputs}{_LIGHT}{_FRAGMENT}",
            )
            if "Light" in program:
                program["Light"].binding = 0
            if "shadow_map" in program:
                program["shadow_map"].value = 1
            uniforms = (program.get(name, None) for name in ("model_view_projection", "model_view", "body"))
            self._programs[key] = _Program(key, program, *uniforms)
        return self._programs[key]

    def _array(self, drawable: _Drawable, program: _Program) -> Any:
        if program.key not in drawable.arrays:
            content = [(drawable.vertices, *drawable.layout)]
            drawable.arrays[program.key] = self._context.vertex_array(
                program.program, content, index_buffer=drawable.indices, skip_errors=True
            )
        return drawable.arrays[program.key]


def _unit(direction: Any) -> Array:
    vector = np.asarray(direction, float)
    result: Array = vector / np.linalg.norm(vector)
    return result


def _release(body: _Body | None) -> None:
    for drawable in body.drawables if body else ():
        for array in drawable.arrays.values():
            array.release()
        drawable.vertices.release()
        drawable.indices.release()


# --- where OpenGL draws to --------------------------------------------------------------------------------------------


def create_context() -> Any:
    """Return an OpenGL context, current in the calling thread; raises DriverMissing, which names the remedy."""
    try:
        import moderngl
    except ImportError as error:
        raise DriverMissing(f"{error}; pip install moderngl") from error
    options: dict[str, Any] = {"standalone": True, "backend": "egl"}
    try:
        _keep_freed_memory()
        with _limit_threads():
            context: Any = moderngl.create_context(require=330, **options)
    except Exception as error:  # glcontext raises bare Exceptions
        raise DriverMissing(f"{error}; {_REMEDY}") from error
    context.front_face = "cw"  # the picture is drawn upside down, which turns every triangle over
    return context


def _keep_freed_memory() -> None:
    """Let the C library keep up to 64 MiB of freed memory, which each picture needs again.

    By default, glibc returns more than a few of a picture's buffers to the system, which must clear all of their pages
    for the next picture: a fifth of the processor time.
    """
    mallopt = getattr(ctypes.CDLL(None), "mallopt", None) if sys.platform == "linux" else None
    if mallopt is not None:
        mallopt(_M_TRIM_THRESHOLD, 64 << 20)
        mallopt(_M_MMAP_THRESHOLD, 32 << 20)


@contextmanager
def _limit_threads() -> Iterator[None]:
    """Limit Mesa's software renderer, while it starts, to one thread; more would compete with the servo's process."""
    name = "LP_NUM_THREADS"
    before = os.environ.get(name)
    os.environ.setdefault(name, "1")
    try:
        yield
    finally:
        if before is None:
            del os.environ[name]


class _Target:
    """Framebuffers for pictures of one size and one set of streams."""

    def __init__(self, context: Any, width: int, height: int, streams: tuple[str, ...]) -> None:
        self._streams = streams
        self._shape = (height, width)
        depth = context.depth_renderbuffer((width, height))
        layers = [context.texture((width, height), _OUTPUTS[s].components, dtype=_OUTPUTS[s].dtype) for s in streams]
        self._all = context.framebuffer(layers, depth)
        self._open: Any = self._all.color_mask
        one, none = (True,) * 4, (False,) * 4
        masks: Any = [[one if other == name else none for other in streams] for name in streams]
        self._masks = dict(zip(streams, masks if len(streams) > 1 else [one], strict=True))
        self._lit = {
            name: context.framebuffer([layer], depth)
            for name, layer in zip(streams, layers, strict=True)
            if name in ("color", "infrared")
        }

    def clear(self, background: Array) -> None:
        """Clear all layers, and draw into them from now on; ``background`` (3,) is that of light, 0..1."""
        grey = float(background @ np.array(LUMINANCE))
        colors = {"color": (*background.tolist(), 1.0), "infrared": (grey,) * 4}
        self._all.use()
        for name, mask in self._masks.items():  # a clear fills all layers of a framebuffer with one colour
            self._all.color_mask = mask
            self._all.clear(*colors.get(name, _OUTPUTS[name].background), depth=1.0)
        self._all.color_mask = self._open

    def layers(self) -> Iterator[tuple[str, Any]]:
        """Yield the framebuffer of each layer that shows light, with the depths of what was drawn."""
        yield from self._lit.items()

    def read(self) -> RenderedImages:
        found: dict[str, NDArray[Any]] = {}
        for place, name in enumerate(self._streams):
            output = _OUTPUTS[name]
            image = np.empty((*self._shape, 3) if name == "color" else self._shape, output.array)
            self._all.read_into(
                image,
                components=image.shape[2] if image.ndim == 3 else 1,
                attachment=place,
                alignment=1,
                dtype=output.dtype,
            )
            found[name] = image
        segmentation = found.get("segmentation")
        return RenderedImages(
            found.get("color"),
            found.get("depth"),
            found.get("infrared"),
            None if segmentation is None else segmentation.astype(np.int32),
        )


@lru_cache(maxsize=64)
def _lens(width: int, height: int, K: tuple[tuple[float, ...], ...]) -> tuple[Array, Array]:
    """Return a pinhole camera's projection (4, 4) and the sides of what it sees.

    The projection is from the camera's frame to clip space, with the rows of the picture upwards: the centre of pixel
    (u, v) lies at ((u + 0.5) 2 / W - 1, (v + 0.5) 2 / H - 1). The sides (4, 3) are planes through the camera, as unit
    vectors that point inwards.
    """
    rows = np.array(K)
    matrix = np.zeros((4, 4))
    matrix[0, :3] = (rows[0] + [0, 0, 0.5]) * 2 / width - [0, 0, 1]
    matrix[1, :3] = (rows[1] + [0, 0, 0.5]) * 2 / height - [0, 0, 1]
    matrix[2, 2:] = (_FAR + _NEAR) / (_FAR - _NEAR), -2 * _FAR * _NEAR / (_FAR - _NEAR)
    matrix[3, 2] = 1
    right, lower = width - 0.5, height - 0.5
    corners = np.array([[-0.5, -0.5, 1], [right, -0.5, 1], [right, lower, 1], [-0.5, lower, 1]])
    rays = corners @ np.linalg.inv(rows).T
    planes = np.cross(rays, np.roll(rays, -1, axis=0))
    return matrix, planes / np.linalg.norm(planes, axis=1, keepdims=True)


# --- shaders: one source, of which each set of streams compiles what it needs -----------------------------------------


class _Output(NamedTuple):
    type: str
    components: int
    dtype: str
    array: DTypeLike
    background: tuple[float, float, float, float]


_OUTPUTS = {
    "color": _Output("vec4", 4, "f1", np.uint8, (0.0, 0.0, 0.0, 1.0)),
    "depth": _Output("float", 1, "f4", np.float32, (0.0, 0.0, 0.0, 0.0)),
    "infrared": _Output("float", 1, "f1", np.uint8, (0.0, 0.0, 0.0, 0.0)),
    # A float holds every whole number below 2^24; an integer layer cannot be cleared to -1 through moderngl.
    "segmentation": _Output("float", 1, "f4", np.float32, (-1.0, -1.0, -1.0, -1.0)),
}
"""How each stream is drawn; their order is that of the layers. The background of light is that of the scene's look."""

_KEY = 0.36
"""Share of the light that comes from the first light."""
_AMBIENT = (0.34, 0.32, 0.31), (0.52, 0.54, 0.57)
"""Light from everywhere on what faces downwards, and upwards."""

_LIGHT = """
layout(std140) uniform Light {
    mat3 fill_by_side;
    mat4x3 to_light;
    vec3 key_light;
    float ambience;
    vec3 key_color;
    float exposure;
    vec3 up;
    float offset;
    vec3 fill;
    vec2 range;
};
"""
"""What does not differ between parts."""
_LIGHT_ROWS = 12
"""Length of that block, in rows of four floats."""

_VERTEX = """
#if defined(COLOR) || defined(INFRARED)
#define LIT
#endif
uniform mat4 model_view_projection;
in vec3 position;
#ifdef LIT
uniform mat4 model_view;
in vec3 normal;
in vec4 color;
out vec3 to_eye;
out vec3 facing;
out vec3 paint;
#ifdef TEXTURED
in vec2 uv;
out vec2 place;
#endif
#ifdef SHADOWS
out vec3 in_light;
#endif
#endif
void main() {
    gl_Position = model_view_projection * vec4(position, 1.0);
#ifdef LIT
    to_eye = -(model_view * vec4(position, 1.0)).xyz;
    facing = mat3(model_view) * normal;
    paint = color.rgb;
#ifdef TEXTURED
    place = uv;
#endif
#ifdef SHADOWS
    in_light = to_light * vec4(offset * facing - to_eye, 1.0);
#endif
#endif
}
"""

_FRAGMENT = (
    f"""
#define KEY {_KEY}
#define LOW vec3{_AMBIENT[0]}
#define HIGH vec3{_AMBIENT[1]}
"""
    + """
#if defined(COLOR) || defined(INFRARED)
#define LIT
#endif
#ifdef LIT
#ifdef SHADOWS
uniform sampler2DShadow shadow_map;
in vec3 in_light;
#endif
in vec3 to_eye;
in vec3 facing;
in vec3 paint;
#ifdef TEXTURED
uniform sampler2D picture;
in vec2 place;
#endif
#endif
#ifdef SEGMENTATION
uniform float body;
#endif
void main() {
#ifdef LIT
    vec3 n = normalize(facing) * (gl_FrontFacing ? 1.0 : -1.0);
    vec3 eye = normalize(to_eye);
    vec3 base = paint;
#ifdef TEXTURED
    base *= texture(picture, place).rgb;
#endif
    float side = max(dot(n, key_light), 0.0);
    float head = 0.12 * max(dot(n, eye), 0.0);
    // The 24th power of the cosine between n and the middle of key_light and eye, without a root or a logarithm.
    float gloss = max(dot(n, key_light + eye), 0.0);
    gloss *= gloss / max(2.0 + 2.0 * dot(key_light, eye), 1e-6);
    gloss *= gloss;
    gloss *= gloss;
    gloss *= 0.05 * gloss * gloss;
    float lit = 1.0;
#ifdef SHADOWS
    if (side > 0.0 && all(lessThan(abs(in_light - 0.5), vec3(0.5))))
        lit = texture(shadow_map, in_light);
#endif
#ifdef FILL
    vec3 around = fill + fill_by_side * n + ambience * head;
#else
    vec3 around = ambience * (mix(LOW, HIGH, 0.5 + 0.5 * dot(n, up)) + head);
#endif
    vec3 light = around + lit * KEY * side * key_color;
    vec3 seen = exposure * (base * light + lit * gloss * key_color);
#endif
#ifdef COLOR
    out_color = vec4(seen, 1.0);
#endif
#ifdef INFRARED
    out_infrared = dot(seen, vec3(0.299, 0.587, 0.114));
#endif
#ifdef DEPTH
    float z = 1.0 / gl_FragCoord.w;
    out_depth = z >= range.x && z <= range.y ? z : 0.0;
#endif
#ifdef SEGMENTATION
    out_segmentation = body;
#endif
}
"""
)
