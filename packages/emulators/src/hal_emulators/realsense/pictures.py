"""Everything that an emulated camera shows: its streams and lenses, a scene, and images with their number drawn in.

All of it is known exactly, so what a driver makes of the images can be compared to the bit, and depth with the truth in
millimetres.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from hal.geometry import Pose, quaternion_to_matrix
from hal.specs import CameraSpec

Array = NDArray[np.float64]

# Streams, modes and lenses.

SIZES = ((1280, 720), (848, 480), (640, 480), (640, 360), (424, 240))
"""Sizes that every stream offers beside the one that the spec names."""
RATES = (6, 15, 30, 60)
COLOR_FORMATS = ("rgb8", "bgr8", "yuyv", "uyvy", "rgba8", "bgra8")
_PLACES = {"color": 0.0, "depth": 0.015, "infrared": 0.015, "infrared_right": 0.065}
"""Positions of a D435's sensors, roughly, m along x of colour: the infrared pair 50 mm apart, colour left of it."""


class PinholeLens(NamedTuple):
    """A pinhole without distortion, pixels; the centre of the upper left pixel is (0, 0)."""

    fx: float
    fy: float
    cx: float
    cy: float


class StreamMode(NamedTuple):
    width: int
    height: int
    rate: int
    """Hz"""
    format: str


class EmulatedStream(NamedTuple):
    """One stream of the camera, whether or not the spec selects it."""

    name: str
    mode: StreamMode
    """The mode that the spec names, or would."""
    lens: PinholeLens
    """In that mode."""
    pose: Pose
    """Pose of its sensor's optical frame in that of the colour sensor."""

    def modes(self) -> tuple[StreamMode, ...]:
        """Return all modes that it offers, its own first."""
        own = self.mode
        formats = COLOR_FORMATS if self.name == "color" else (own.format,)
        sizes = [(own.width, own.height), *(size for size in SIZES if size != (own.width, own.height))]
        rates = [own.rate, *(rate for rate in RATES if rate != own.rate)]
        found = (StreamMode(*size, rate, format) for size in sizes for rate in rates for format in formats)
        return tuple(sorted(found, key=lambda mode: mode != own))

    def lens_at(self, width: int, height: int) -> PinholeLens:
        """Return the lens in a mode of another size: the sensor's middle, as large as it fits, scaled."""
        own = self.mode
        if (width, height) == (own.width, own.height):
            return self.lens
        scale = _imager_scale(width, height) / _imager_scale(own.width, own.height)
        cx = (self.lens.cx - (own.width - 1) / 2.0) * scale + (width - 1) / 2.0
        cy = (self.lens.cy - (own.height - 1) / 2.0) * scale + (height - 1) / 2.0
        return PinholeLens(self.lens.fx * scale, self.lens.fy * scale, cx, cy)


def make_serial(spec: CameraSpec) -> str:
    """Return a serial number made from the camera's name: twelve digits."""
    return f"9{zlib.crc32(spec.name.encode()) % 10**11:011d}"


def make_title(spec: CameraSpec) -> str:
    """Return the camera's title, made from its model's name if that is one of Intel's."""
    maker, _, model = spec.model.partition("_")
    return f"Intel RealSense {model.upper() if maker == 'realsense' and model else 'D435'} (emulated)"


def make_streams(spec: CameraSpec) -> dict[str, EmulatedStream]:
    """Return depth, colour and both infrared streams; what the spec leaves out is roughly that of a D435."""
    found = {}
    for name, x in _PLACES.items():
        default = "rgb8" if name == "color" else "z16" if name == "depth" else "y8"
        sensor = spec.sensors.get(name)
        if sensor is None:
            width, height = spec.capture_width, spec.capture_height
            mode = StreamMode(width, height, round(spec.rate_hz), default)
            found[name] = EmulatedStream(name, mode, _nominal_lens(name, width, height), Pose((x, 0.0, 0.0)))
        else:
            (fx, _, cx), (_, fy, cy), _ = sensor.K
            mode = StreamMode(sensor.width, sensor.height, round(sensor.rate_hz), sensor.format or default)
            pose = Pose(sensor.position, sensor.orientation)
            found[name] = EmulatedStream(name, mode, PinholeLens(fx, fy, cx, cy), pose)
    return found


def _nominal_lens(name: str, width: int, height: int) -> PinholeLens:
    f = 1.275 * height if name == "color" else 640.0 * _imager_scale(width, height)
    return PinholeLens(f, f, (width - 1) / 2.0, (height - 1) / 2.0)


def _imager_scale(width: int, height: int) -> float:
    """Return the pixels of a mode for each pixel of the imager's 1280x800."""
    return max(width / 1280.0, height / 800.0)


# The number of a frame, drawn into its image: 24 squares in the middle of the upper edge, the highest bit left.

BITS = 24
"""Enough for six days at 30 Hz."""
INK: Mapping[str, tuple[Any, Any]] = MappingProxyType(
    {
        "rgb8": ((0, 0, 0), (255, 255, 255)),
        "bgr8": ((0, 0, 0), (255, 255, 255)),
        "rgba8": ((0, 0, 0, 255), (255, 255, 255, 255)),
        "bgra8": ((0, 0, 0, 255), (255, 255, 255, 255)),
        "yuyv": (0x8010, 0x80EB),  # video black and white, without colour
        "uyvy": (0x1080, 0xEB80),
        "y8": (0, 255),
        "z16": (600, 1000),
    }
)
"""Values of a 0 and a 1, by format; of a depth image in its units."""
_LEVELS = {"u1": (0.0, 255.0), "u2": (600.0, 1000.0), "f4": (0.6, 1.0)}
"""The same by type of array, for images that a driver has converted."""


def _square(height: int, width: int) -> float:
    """Return the edge of one square, pixels: all of them fit into the image's middle square, which a crop keeps."""
    return min(height, width) / 30.0


def strip_height(height: int, width: int) -> int:
    """Return how many of the upper rows the squares cover."""
    return max(1, round(_square(height, width)))


def draw_number(image: NDArray[Any], format: str, number: int) -> None:
    """Draw a number into an image (H, W) or (H, W, channels) of a format; every square is drawn in full."""
    height, width = image.shape[:2]
    edge = _square(height, width)
    columns = np.arange(width)
    bits = np.floor((columns - width / 2.0) / edge + BITS / 2.0).astype(int)
    inside = (bits >= 0) & (bits < BITS)
    on = (number >> (BITS - 1 - bits[inside])) & 1
    ink = np.array(INK[format], image.dtype)
    first = int(columns[inside][0])
    image[: strip_height(height, width), first : first + len(on)] = ink[on]


def read_number(image: NDArray[Any], format: str | None = None) -> int:
    """Return the number that is drawn into an image. Raises ValueError if there is none.

    The image is as it was sent, or a scaled centre crop that keeps its upper edge; depth raw or in metres. ``format``
    is needed for packed colour only (``yuyv``, ``uyvy``).
    """
    plane = image if image.ndim == 2 else image[..., 0]
    height, width = plane.shape
    edge = _square(height, width)
    columns = np.floor(width / 2.0 + (np.arange(BITS) - BITS / 2.0 + 0.5) * edge).astype(int)
    values = plane[int(edge / 2.0), columns].astype(float)
    low, high = map(float, INK[format]) if format in ("yuyv", "uyvy") else _LEVELS[plane.dtype.str[1:]]
    bits = values > (low + high) / 2.0
    if np.any(np.abs(values - np.where(bits, high, low)) > 0.1 * (high - low)):
        raise ValueError("there is no number in this image")
    return int(sum(int(bit) << (BITS - 1 - k) for k, bit in enumerate(bits)))


# The scene: a table with squares of 5 cm, and a box that moves on it.

PHASES = 8
"""Number of images after which everything but the drawn number repeats."""
STEP = 0.03
"""Distance that the box moves from one image to the next, m."""
_TILT = math.radians(45.0)  # of the colour sensor below the horizon
_HEIGHT = 0.6  # m above the table
_SQUARE = 0.05  # m
_WALL = 1.6  # m ahead of the camera, along the table; as high as the view
_BOX = (0.12, 0.09, 0.12)  # m along right, up and ahead
_DARK, _LIGHT, _BACK = (60, 52, 44), (176, 160, 140), (96, 112, 128)
_FACES = ((200, 60, 40), (235, 120, 60), (150, 40, 30))  # of the box: its sides, its top, front and back


class EmulatedScene:
    """A table and a box in any of the box's phases, seen from anywhere; ``seed`` moves and colours the box."""

    def __init__(self, seed: int = 0) -> None:
        random = np.random.default_rng(seed)
        self._x, self._ahead = random.uniform(-0.05, 0.05), 0.6 + random.uniform(-0.04, 0.08)
        self._turn = int(random.integers(3))  # permutes the box's colour channels
        # Rows: right, up and ahead on the table, along the axes of the colour sensor's frame (x right, y down).
        c, s = math.cos(_TILT), math.sin(_TILT)
        self._R = np.array([[1.0, 0.0, 0.0], [0.0, -c, -s], [0.0, -s, c]])

    def render(
        self, lens: PinholeLens, width: int, height: int, pose: Pose, phase: int
    ) -> tuple[Array, NDArray[np.uint8]]:
        """Return the scene as a sensor sees it.

        Args:
            lens: The sensor's lens.
            width: Of the image, pixels.
            height: Of the image, pixels.
            pose: The sensor's pose in the colour sensor's frame.
            phase: Phase of the box, 0 to ``PHASES`` - 1.

        Returns:
            Depth (H, W) along the optical axis, m, and colours (H, W, 3) RGB.
        """
        eye = self._R @ pose.position
        rays = self._rays(lens, width, height, pose)
        depth, colors = self._background(eye, rays)
        low, high = self._box(phase)
        rows, columns = self._extent(lens, width, height, pose, low, high)
        if rows.start < rows.stop and columns.start < columns.stop:
            self._draw_box(eye, rays[rows, columns], low, high, depth[rows, columns], colors[rows, columns])
        return depth, colors

    def _rays(self, lens: PinholeLens, width: int, height: int, pose: Pose) -> Array:
        """Return directions (H, W, 3) in the table's axes, 1 m of depth long."""
        local = np.ones((height, width, 3))
        local[..., 0] = (np.arange(width) - lens.cx) / lens.fx
        local[..., 1] = ((np.arange(height) - lens.cy) / lens.fy)[:, None]
        rays: Array = local @ (self._R @ quaternion_to_matrix(pose.orientation)).T
        return rays

    def _background(self, eye: Array, rays: Array) -> tuple[Array, NDArray[np.uint8]]:
        with np.errstate(divide="ignore"):
            table = (-_HEIGHT - eye[1]) / rays[..., 1]
            wall = (_WALL - eye[2]) / rays[..., 2]
        table[table <= 0.0] = np.inf
        wall[wall <= 0.0] = np.inf
        depth = np.minimum(table, wall)
        depth[~np.isfinite(depth)] = 0.0
        x, ahead = eye[0] + depth * rays[..., 0], eye[2] + depth * rays[..., 2]
        dark = (np.floor(x / _SQUARE) + np.floor(ahead / _SQUARE)).astype(int) % 2 == 0
        colors = np.where(dark[..., None], np.array(_DARK, np.uint8), np.array(_LIGHT, np.uint8))
        colors[wall < table] = _BACK
        return depth, colors

    def _box(self, phase: int) -> tuple[Array, Array]:
        """Return the box's lowest and highest corner, in the table's axes from the colour sensor."""
        middle = np.array([self._x + (phase - (PHASES - 1) / 2.0) * STEP, _BOX[1] / 2.0 - _HEIGHT, self._ahead])
        return middle - np.array(_BOX) / 2.0, middle + np.array(_BOX) / 2.0

    def _extent(
        self, lens: PinholeLens, width: int, height: int, pose: Pose, low: Array, high: Array
    ) -> tuple[slice, slice]:
        """Return rows and columns outside which the box cannot be seen."""
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T @ self._R
        x, y, z = pose.inverse().transform(corners).T
        z = np.maximum(z, 1e-3)
        u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
        return (
            slice(max(0, math.floor(v.min())), max(0, min(height, math.ceil(v.max()) + 1))),
            slice(max(0, math.floor(u.min())), max(0, min(width, math.ceil(u.max()) + 1))),
        )

    def _draw_box(
        self, eye: Array, rays: Array, low: Array, high: Array, depth: Array, colors: NDArray[np.uint8]
    ) -> None:
        """Draw the box: a ray hits it if it enters all three pairs of its planes before it leaves any of them."""
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (low - eye) / rays, (high - eye) / rays
        enters, leaves = np.fmin(one, other), np.fmax(one, other)
        face, hit = enters.argmax(axis=2), enters.max(axis=2)
        seen = (hit < leaves.min(axis=2)) & (hit > 0.0) & (hit < depth)
        depth[seen] = hit[seen]
        colors[seen] = np.roll(np.array(_FACES, np.uint8), self._turn, axis=1)[face[seen]]


# The images.

DEPTH_UNIT = 0.001
"""m, as a D435 is delivered."""


class EmulatedImages:
    """Images of every stream by frame number: one of a few prepared ones, with the number drawn into it.

    Each is made once for a mode, and known to the bit.
    """

    def __init__(self, streams: dict[str, EmulatedStream], pattern: str, seed: int) -> None:
        """Prepare nothing yet. The pattern is ``test`` (gradients) or ``scene``."""
        self._streams = streams
        self._scene = EmulatedScene(seed) if pattern == "scene" else None
        self._seed = seed
        self._prepared: dict[tuple[str, tuple[int, int], str], list[NDArray[Any]]] = {}

    def prepare(self, name: str, mode: StreamMode) -> list[NDArray[Any]]:
        """Return the images of all phases in a mode, always the same arrays, to draw numbers into.

        The first call for a mode draws them, which takes long.
        """
        key = (name, (mode.width, mode.height), mode.format)
        if key not in self._prepared:
            self._prepared[key] = [self._make(name, mode, phase) for phase in range(PHASES)]
        return self._prepared[key]

    def expected(self, name: str, mode: StreamMode, number: int) -> NDArray[Any]:
        """Return a copy of exactly what is sent as a frame number of a stream.

        Returns:
            (H, W) uint16 for ``z16``, ``yuyv`` and ``uyvy``, (H, W) uint8 for ``y8``, (H, W, 3 or 4) uint8 for others.
        """
        image: NDArray[Any] = self.prepare(name, mode)[number % PHASES].copy()
        draw_number(image, mode.format, number)
        return image

    def truth(self, name: str, mode: StreamMode, number: int) -> NDArray[np.float64]:
        """Return the depth (H, W) in a sensor's view, m, from the scene's geometry, not rounded; 0 for nothing."""
        assert self._scene is not None, "only the pattern `scene` has a truth"
        stream = self._streams[name]
        lens = stream.lens_at(mode.width, mode.height)
        return self._scene.render(lens, mode.width, mode.height, stream.pose, number % PHASES)[0]

    def _make(self, name: str, mode: StreamMode, phase: int) -> NDArray[Any]:
        if self._scene is None:
            depth, colors = _gradients(mode.width, mode.height, phase + PHASES * self._seed)
            gray = colors[..., 0] ^ np.uint8(0x5A if name == "infrared_right" else 0)
        else:
            stream = self._streams[name]
            lens = stream.lens_at(mode.width, mode.height)
            metres, colors = self._scene.render(lens, mode.width, mode.height, stream.pose, phase)
            depth = np.round(metres / DEPTH_UNIT).astype(np.uint16)
            gray = colors.mean(axis=2).astype(np.uint8)
        if mode.format == "z16":
            return depth
        return gray if mode.format == "y8" else _pack_colors(colors, mode.format)


def _gradients(width: int, height: int, shift: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Return depth from 0.5 to 1.5 m with a strip of none on its left, and colours; different for every shift."""
    x, y = np.arange(width), np.arange(height)[:, None]
    depth = (500 + (x + 2 * y + 37 * shift) % 1000).astype(np.uint16)
    depth[:, : width // 40] = 0
    colors = np.empty((height, width, 3), np.uint8)
    colors[..., 0] = (x + y + 29 * shift) % 256
    colors[..., 1] = (x + 17 * shift) % 256
    colors[..., 2] = (2 * y + 11 * shift) % 256
    return depth, colors


def _pack_colors(colors: NDArray[np.uint8], format: str) -> NDArray[Any]:
    """Convert RGB (H, W, 3) to another format."""
    if format == "rgb8":
        return colors
    if format == "bgr8":
        return np.ascontiguousarray(colors[..., ::-1])
    if format in ("rgba8", "bgra8"):
        order = (0, 1, 2) if format == "rgba8" else (2, 1, 0)
        opaque = np.full((*colors.shape[:2], 1), 255, np.uint8)
        return np.ascontiguousarray(np.concatenate([colors[..., order], opaque], axis=2))
    packed = _pack_yuyv(colors.astype(np.float32))
    return packed if format == "yuyv" else packed.byteswap()


def _pack_yuyv(rgb: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Convert to YUYV: two pixels share a colour, luma is in the low bytes (BT.601, video range)."""
    y = rgb @ np.array([65.481, 128.553, 24.966]) / 255.0 + 16.0
    pairs = (rgb[:, 0::2] + rgb[:, 1::2]) / 2.0
    u = pairs @ np.array([-37.797, -74.203, 112.0]) / 255.0 + 128.0
    v = pairs @ np.array([112.0, -93.786, -18.214]) / 255.0 + 128.0
    packed: NDArray[np.uint16] = np.round(y).astype(np.uint16)
    packed[:, 0::2] |= np.round(u).astype(np.uint16) << 8
    packed[:, 1::2] |= np.round(v).astype(np.uint16) << 8
    return packed
