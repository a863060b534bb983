"""Textures: pictures that cover a body or the background, from files or made here.

Those that are made here are grey, to be tinted by a colour, repeat without a seam, and are always the same.
"""

from __future__ import annotations

from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

_SIDE = 128
"""Side of a texture that is made here, pixels."""


@lru_cache(maxsize=256)
def load_texture(name: str) -> NDArray[np.uint8]:
    """Return a texture (H, W, 3), RGB: one of :data:`hal.randomization.TEXTURES`, or a file of a picture."""
    made = _MADE.get(name)
    if made is not None:
        grey = np.round(255.0 * np.clip(made(), 0.0, 1.0)).astype(np.uint8)
        return np.repeat(grey[:, :, None], 3, axis=2)
    from PIL import Image

    with Image.open(Path(name)) as picture:
        return np.asarray(picture.convert("RGB"), np.uint8)


def _grid() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return row and column of each pixel, 0..1."""
    row, column = np.mgrid[0:_SIDE, 0:_SIDE] / _SIDE
    return row, column


def _smooth_noise(cells: int, seed: int) -> NDArray[np.float64]:
    values = np.random.default_rng(seed).random((cells, cells))
    at = np.arange(_SIDE) * cells / _SIDE
    low, share = at.astype(int), at % 1.0
    share = share * share * (3.0 - 2.0 * share)
    rows = values[low] * (1.0 - share)[:, None] + values[(low + 1) % cells] * share[:, None]
    smooth: NDArray[np.float64] = rows[:, low] * (1.0 - share) + rows[:, (low + 1) % cells] * share
    return smooth


def _cloudy() -> NDArray[np.float64]:
    return sum((_smooth_noise(2 ** (k + 2), k) * 0.5**k for k in range(5)), np.zeros((_SIDE, _SIDE))) / 1.9375


def _checker() -> NDArray[np.float64]:
    row, column = _grid()
    return np.where((row < 0.5) == (column < 0.5), 1.0, 0.35)


def _stripes() -> NDArray[np.float64]:
    return np.where(_grid()[1] < 0.5, 1.0, 0.45)


def _gradient() -> NDArray[np.float64]:
    return 0.65 + 0.35 * np.cos(2.0 * np.pi * _grid()[0])


def _noise() -> NDArray[np.float64]:
    return np.random.default_rng(7).uniform(0.35, 1.0, (_SIDE, _SIDE))


def _marble() -> NDArray[np.float64]:
    row, column = _grid()
    veins = np.abs(np.sin(np.pi * (4.0 * column + 2.0 * row + 3.0 * _cloudy())))
    return 0.45 + 0.55 * np.sqrt(veins)


def _wood() -> NDArray[np.float64]:
    row, _ = _grid()
    fibres = _smooth_noise(64, 11)[:, :1] * np.ones((1, _SIDE))
    rings = np.sin(2.0 * np.pi * (6.0 * row + 0.6 * _smooth_noise(4, 12)))
    return 0.72 + 0.16 * rings + 0.12 * fibres


_MADE = {
    "checker": _checker,
    "gradient": _gradient,
    "marble": _marble,
    "noise": _noise,
    "stripes": _stripes,
    "wood": _wood,
}
