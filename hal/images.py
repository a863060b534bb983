"""Camera matrices, lens distortion, and the crop and scaling of images; needs nothing but NumPy.

Conventions are OpenCV's: the centre of the upper left pixel is (0, 0), so an image of width w reaches from -1/2 to
w - 1/2, and distortion is the five coefficients (k1, k2, p1, p2, k3) of Brown and Conrady.
"""

from __future__ import annotations

import math
from functools import lru_cache
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]

_ROUNDS = 100
_EXACT = 1e-10
"""Largest error of an inverted distortion, in units of the focal length."""
_DIVERGED = 100.0
"""Error from which the iteration does not return, in the same units."""


class Crop(NamedTuple):
    """A rectangle of an image, pixels."""

    x: int
    y: int
    width: int
    height: int


class Intrinsics(NamedTuple):
    """Focal lengths and principal point, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float

    def crop_and_scale(self, crop: Crop, width: int, height: int) -> Intrinsics:
        """Return the intrinsics of the image that is cut out and scaled to ``width`` x ``height``."""
        sx, sy = width / crop.width, height / crop.height
        return Intrinsics(
            self.fx * sx,
            self.fy * sy,
            (self.cx - crop.x + 0.5) * sx - 0.5,
            (self.cy - crop.y + 0.5) * sy - 0.5,
        )

    def matrix(self) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
        """Return the camera matrix K (3, 3)."""
        return (self.fx, 0.0, self.cx), (0.0, self.fy, self.cy), (0.0, 0.0, 1.0)


def centre_crop(width: int, height: int, out_width: int, out_height: int) -> Crop:
    """Return the largest centred part of an image that has the output's aspect ratio, to the nearest pixel."""
    if width * out_height > height * out_width:
        cut_width, cut_height = max(1, round(height * out_width / out_height)), height
    else:
        cut_width, cut_height = width, max(1, round(width * out_height / out_width))
    return Crop((width - cut_width) // 2, (height - cut_height) // 2, cut_width, cut_height)


def from_field_of_view(
    width: int,
    height: int,
    horizontal_deg: float | None,
    vertical_deg: float | None,
    sensor: tuple[int, int] | None = None,
) -> Intrinsics:
    """Return the intrinsics of a camera with the given field of view and the principal point in the middle.

    Args:
        width: Width of the mode, pixels.
        height: Height of the mode, pixels.
        horizontal_deg: Angle from edge to edge, degrees; None for square pixels.
        vertical_deg: Likewise; one of the two angles is needed.
        sensor: Size in pixels of the image that the angles belong to, of which a mode of another aspect ratio is the
            largest centred part; None for the mode itself.
    """
    full_width, full_height = sensor or (width, height)
    fx = full_width / 2 / math.tan(math.radians(horizontal_deg) / 2) if horizontal_deg is not None else None
    fy = full_height / 2 / math.tan(math.radians(vertical_deg) / 2) if vertical_deg is not None else None
    if fx is None and fy is None:
        raise ValueError("horizontal_deg or vertical_deg is needed")
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    assert fx is not None
    assert fy is not None
    scale = max(width / full_width, height / full_height)  # pixels of the mode per pixel of the sensor
    return Intrinsics(fx * scale, fy * scale, (width - 1) / 2, (height - 1) / 2)


def distort_points(points: ArrayLike, distortion: ArrayLike) -> Array:
    """Apply lens distortion.

    Args:
        points: (n, 2) x/z and y/z of an ideal camera.
        distortion: (5,)

    Returns:
        (n, 2) x/z and y/z at which the lens shows them.
    """
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


def undistort_pixels(pixels: ArrayLike, K: Array, distortion: ArrayLike) -> Array:
    """Return where a camera with the same ``K`` and no distortion would see ``pixels``.

    The fixed-point iteration of OpenCV's ``undistortPoints``, which however neither reports divergence nor has the same
    signature in OpenCV 4 and 5.

    Args:
        pixels: (n, 2)
        K: (3, 3)
        distortion: (5,)

    Returns:
        (n, 2) pixels.

    Raises:
        ValueError: The iteration diverges: the coefficients are invalid at these pixels.
    """
    seen = np.column_stack([np.asarray(pixels, float), np.ones(len(np.asarray(pixels)))]) @ np.linalg.inv(K).T
    target = seen[:, :2] / seen[:, 2:]
    points = target.copy()
    if np.any(distortion):
        for _ in range(_ROUNDS):
            error = target - distort_points(points, distortion)
            points += error
            if not _EXACT <= np.abs(error).max() < _DIVERGED:
                break
        if not np.abs(error).max() < _EXACT:
            raise ValueError("the distortion has no inverse at these pixels; check the camera's coefficients")
    ideal: Array = np.column_stack([points, np.ones(len(points))]) @ K[:2].T
    return ideal


def depth_to_points(depth: NDArray[np.float32], K: Array, distortion: ArrayLike) -> NDArray[np.float32]:
    """Return the point that each pixel of a depth image shows.

    Args:
        depth: (H, W) distance along the optical axis, m; 0 where nothing was measured.
        K: (3, 3)
        distortion: (5,)

    Returns:
        (H, W, 3) in the camera's axes (x right, y down, z forward), m; 0 where nothing was measured.
    """
    rays = _rays(depth.shape, tuple(K.ravel().tolist()), tuple(np.asarray(distortion, float).tolist()))
    points: NDArray[np.float32] = depth[..., None] * rays
    return points


@lru_cache(maxsize=8)
def _rays(shape: tuple[int, int], matrix: tuple[float, ...], distortion: tuple[float, ...]) -> NDArray[np.float32]:
    """Return x/z, y/z and 1 (H, W, 3) of what each pixel shows."""
    K, (height, width) = np.array(matrix).reshape(3, 3), shape
    pixels = np.dstack(np.meshgrid(np.arange(width), np.arange(height))).reshape(-1, 2)
    ideal = undistort_pixels(pixels, K, distortion)
    rays = np.column_stack([ideal, np.ones(len(ideal))]) @ np.linalg.inv(K).T
    image: NDArray[np.float32] = rays.reshape(height, width, 3).astype(np.float32)
    return image


class Cropping:
    """Crops images of one size to the output's aspect ratio, centred, and scales them to the output's size.

    Colour and infrared are averaged over the area of each new pixel. Depth is taken from the nearest pixel, because a
    mean over an edge is a distance at which there is nothing. :meth:`matrix` does the same to the camera matrix, so
    real and simulated cameras agree.
    """

    def __init__(self, width: int, height: int, out_width: int, out_height: int) -> None:
        self.crop = centre_crop(width, height, out_width, out_height)
        self.size = (out_width, out_height)
        self.is_identity = (width, height) == self.size
        self._cuts_only = (self.crop.width, self.crop.height) == self.size
        x, y = self.crop.x, self.crop.y
        self._part = (slice(y, y + self.crop.height), slice(x, x + self.crop.width))
        columns = ((np.arange(out_width) + 0.5) * self.crop.width / out_width).astype(np.intp) + x
        rows = ((np.arange(out_height) + 0.5) * self.crop.height / out_height).astype(np.intp) + y
        self._nearest = np.ix_(rows, columns)

    def matrix(self, K: Array) -> Array:
        """Return the camera matrix (3, 3) of the output, for ``K`` (3, 3) of the input."""
        before = Intrinsics(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        return np.array(before.crop_and_scale(self.crop, *self.size).matrix())

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Crop and scale an image (H, W, 3) or (H, W); always returns a new array."""
        if self._cuts_only:
            return np.array(image[self._part])
        from PIL import Image

        x, y, width, height = self.crop
        picture = Image.fromarray(image)
        scaled = picture.resize(self.size, Image.Resampling.BOX, box=(x, y, x + width, y + height))
        result: NDArray[np.uint8] = np.asarray(scaled, np.uint8).copy()
        return result

    def depth(self, image: NDArray[Any]) -> NDArray[Any]:
        """Crop and scale an image (H, W) of any type, by nearest pixels; always returns a new array."""
        return image[self._part].copy() if self._cuts_only else np.ascontiguousarray(image[self._nearest])
