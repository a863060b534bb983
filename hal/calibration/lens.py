"""Brown and Conrady's distortion, as OpenCV numbers it, and its inverse."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import NoView

__all__ = ["distorted", "ideal_pixels"]

Array = NDArray[np.float64]

_ROUNDS = 100
_EXACT = 1e-10
"""In units of the focal length: far below any corner's noise."""
_FAR = 100.0
"""Likewise: it will never come back."""


def distorted(points: ArrayLike, distortion: ArrayLike) -> Array:
    """Where a lens with ``distortion`` (k1, k2, p1, p2, k3) sees the normalised points (n, 2) of an ideal camera."""
    k1, k2, p1, p2, k3 = np.asarray(distortion, float)
    x, y = np.asarray(points, float).T
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.column_stack(
        [
            x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
            y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
        ]
    )


def ideal_pixels(pixels: ArrayLike, K: Array, distortion: ArrayLike) -> Array:
    """Where a camera of the same ``K`` without distortion would see ``pixels`` (n, 2).

    By iteration: the point whose distortion is the pixel. NoView where that has no end, which means that the lens's
    numbers are no good there.
    """
    seen = np.column_stack([np.asarray(pixels, float), np.ones(len(np.asarray(pixels)))]) @ np.linalg.inv(K).T
    target = seen[:, :2] / seen[:, 2:]
    points = target.copy()
    if np.any(distortion):
        for _ in range(_ROUNDS):
            error = target - distorted(points, distortion)
            points += error
            if not _EXACT <= np.abs(error).max() < _FAR:
                break
        if not np.abs(error).max() < _EXACT:
            raise NoView("the camera's distortion cannot be undone out there; are its numbers right?")
    seen_ideally: Array = np.column_stack([points, np.ones(len(points))]) @ K[:2].T
    return seen_ideally
