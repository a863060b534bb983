"""The pictures of every stream, by number: made once for each mode, and known to the last bit."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .figures import Mode, Stream
from .number import draw_number
from .scene import PHASES, Scene

__all__ = ["DEPTH_UNIT", "Pictures"]

DEPTH_UNIT = 0.001
"""m, as a D435 comes."""


class Pictures:
    """What the streams show in picture 1, 2, 3 ...: one of a few prepared pictures with the number drawn into it."""

    def __init__(self, streams: dict[str, Stream], pattern: str, seed: int) -> None:
        self._streams = streams
        self._scene = Scene(seed) if pattern == "scene" else None
        self._seed = seed
        self._prepared: dict[tuple[str, tuple[int, int], str], list[NDArray[Any]]] = {}

    def prepare(self, name: str, mode: Mode) -> list[NDArray[Any]]:
        """All phases in a mode: arrays to draw numbers into, the same ones every time. Some 50 ms for the first."""
        key = (name, (mode.width, mode.height), mode.format)
        if key not in self._prepared:
            self._prepared[key] = [self._make(name, mode, phase) for phase in range(PHASES)]
        return self._prepared[key]

    def expected(self, name: str, mode: Mode, number: int) -> NDArray[Any]:
        """Exactly what is sent as that number, a copy: (H, W) uint16 for ``z16``, ``yuyv`` and ``uyvy``, uint8
        for ``y8``; (H, W, 3 or 4) uint8 for the others."""
        picture: NDArray[Any] = self.prepare(name, mode)[number % PHASES].copy()
        draw_number(picture, mode.format, number)
        return picture

    def truth(self, name: str, mode: Mode, number: int) -> NDArray[np.float64]:
        """Depth (H, W) in that sensor's view, m, from the scene's geometry and not rounded; 0 for nothing."""
        assert self._scene is not None, "only a scene has a truth"
        stream = self._streams[name]
        lens = stream.lens_at(mode.width, mode.height)
        return self._scene.look(lens, mode.width, mode.height, stream.pose, number % PHASES)[0]

    def _make(self, name: str, mode: Mode, phase: int) -> NDArray[Any]:
        if self._scene is None:
            depth, colors = _gradients(mode.width, mode.height, phase + PHASES * self._seed)
            gray = colors[..., 0] ^ np.uint8(0x5A if name == "infrared_right" else 0)
        else:
            stream = self._streams[name]
            lens = stream.lens_at(mode.width, mode.height)
            metres, colors = self._scene.look(lens, mode.width, mode.height, stream.pose, phase)
            depth = np.round(metres / DEPTH_UNIT).astype(np.uint16)
            gray = colors.mean(axis=2).astype(np.uint8)
        if mode.format == "z16":
            return depth
        return gray if mode.format == "y8" else _packed(colors, mode.format)


def _gradients(width: int, height: int, shift: int) -> tuple[NDArray[np.uint16], NDArray[np.uint8]]:
    """Depth from 0.5 to 1.5 m with a strip of none on its left, and colours; other pictures for every shift."""
    x, y = np.arange(width), np.arange(height)[:, None]
    depth = (500 + (x + 2 * y + 37 * shift) % 1000).astype(np.uint16)
    depth[:, : width // 40] = 0
    colors = np.empty((height, width, 3), np.uint8)
    colors[..., 0] = (x + y + 29 * shift) % 256
    colors[..., 1] = (x + 17 * shift) % 256
    colors[..., 2] = (2 * y + 11 * shift) % 256
    return depth, colors


def _packed(colors: NDArray[np.uint8], format: str) -> NDArray[Any]:
    """RGB (H, W, 3) in another format."""
    if format == "rgb8":
        return colors
    if format == "bgr8":
        return np.ascontiguousarray(colors[..., ::-1])
    if format in ("rgba8", "bgra8"):
        order = (0, 1, 2) if format == "rgba8" else (2, 1, 0)
        opaque = np.full((*colors.shape[:2], 1), 255, np.uint8)
        return np.ascontiguousarray(np.concatenate([colors[..., order], opaque], axis=2))
    packed = _yuyv(colors.astype(np.float32))
    return packed if format == "yuyv" else packed.byteswap()


def _yuyv(rgb: NDArray[np.float32]) -> NDArray[np.uint16]:
    """Two pixels share a colour: brightness in the low bytes, blue and red in the high ones (BT.601, video range)."""
    y = rgb @ np.array([65.481, 128.553, 24.966]) / 255.0 + 16.0
    pairs = (rgb[:, 0::2] + rgb[:, 1::2]) / 2.0
    u = pairs @ np.array([-37.797, -74.203, 112.0]) / 255.0 + 128.0
    v = pairs @ np.array([112.0, -93.786, -18.214]) / 255.0 + 128.0
    packed: NDArray[np.uint16] = np.round(y).astype(np.uint16)
    packed[:, 0::2] |= np.round(u).astype(np.uint16) << 8
    packed[:, 1::2] |= np.round(v).astype(np.uint16) << 8
    return packed
