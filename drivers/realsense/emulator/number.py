"""The number of a picture, drawn into it: 24 squares in the middle of its upper edge, the highest bit left."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

import numpy as np
from numpy.typing import NDArray

__all__ = ["BITS", "INK", "draw_number", "read_number"]

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
"""Values of a 0 and a 1, by format; of a depth picture in its units."""


def _square(height: int, width: int) -> float:
    """Edge of one square, pixels: all of them fit into the middle square of the picture, which a crop leaves."""
    return min(height, width) / 30.0


def strip_height(height: int, width: int) -> int:
    """How many of the upper rows have squares in them."""
    return max(1, round(_square(height, width)))


def draw_number(picture: NDArray[Any], format: str, number: int) -> None:
    """Draw ``number`` into a picture (H, W) or (H, W, channels) of that format; every square in full."""
    height, width = picture.shape[:2]
    edge = _square(height, width)
    columns = np.arange(width)
    bits = np.floor((columns - width / 2.0) / edge + BITS / 2.0).astype(int)
    inside = (bits >= 0) & (bits < BITS)
    on = (number >> (BITS - 1 - bits[inside])) & 1
    ink = np.array(INK[format], picture.dtype)
    first = int(columns[inside][0])
    picture[: strip_height(height, width), first : first + len(on)] = ink[on]


def read_number(picture: NDArray[Any], format: str | None = None) -> int:
    """The number in a picture, as it was drawn, or in a scaled centre crop which kept the picture's upper edge.

    ``format`` is needed for packed colour (``yuyv``, ``uyvy``) only; depth may be raw or in metres. Raises ValueError
    where there is none.
    """
    plane = picture if picture.ndim == 2 else picture[..., 0]
    height, width = plane.shape
    edge = _square(height, width)
    columns = np.floor(width / 2.0 + (np.arange(BITS) - BITS / 2.0 + 0.5) * edge).astype(int)
    values = plane[int(edge / 2.0), columns].astype(float)
    low, high = map(float, INK[format]) if format in ("yuyv", "uyvy") else _LEVELS[plane.dtype.str[1:]]
    bits = values > (low + high) / 2.0
    if np.any(np.abs(values - np.where(bits, high, low)) > 0.1 * (high - low)):
        raise ValueError("there is no number in this picture")
    return int(sum(int(bit) << (BITS - 1 - k) for k, bit in enumerate(bits)))


_LEVELS = {"u1": (0.0, 255.0), "u2": (600.0, 1000.0), "f4": (0.6, 1.0)}
