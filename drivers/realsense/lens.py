"""A lens as librealsense describes it, into the camera matrix and the distortion that OpenCV knows.

The library's pixel (0, 0) is the centre of the upper left pixel, as it is here (its wiki, "Projection in RealSense SDK
2.0"; ``src/proc/align.cpp`` takes x - 0.5 for the left edge of pixel x), so nothing is shifted.

Its ``brown_conrady`` is OpenCV's model. The colour sensors of the D400 say ``inverse_brown_conrady``, others say
``modified_brown_conrady``: close to it and not the same, and what the library makes of the former has changed between
its versions. So OpenCV's five numbers are fitted to what the library itself makes of a grid of pixels or rays; they
enter linearly, so that is one linear problem.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import pyrealsense2 as rs
from numpy.typing import NDArray

from hal.geometry import Pose

__all__ = ["Lens", "lens_of", "pose_of"]

Array = NDArray[np.float64]
_GRID = 25
"""Pixels of the fit along each edge."""


class Lens(NamedTuple):
    """How one stream sees."""

    K: Array
    """(3, 3), pixels."""
    distortion: Array
    """(5,) in OpenCV's order."""
    residual: float
    """By how much the fitted model misses the library's, at worst, pixels; 0 where nothing was fitted."""


def lens_of(intrinsics: Any) -> Lens:
    """Of ``rs2::intrinsics``."""
    K = np.array(
        [[intrinsics.fx, 0.0, intrinsics.ppx], [0.0, intrinsics.fy, intrinsics.ppy], [0.0, 0.0, 1.0]], np.float64
    )
    coefficients = np.array(intrinsics.coeffs, np.float64)
    if intrinsics.model == rs.distortion.none or not coefficients.any():
        return Lens(K, np.zeros(5), 0.0)
    if intrinsics.model == rs.distortion.brown_conrady:
        return Lens(K, coefficients, 0.0)
    return _fitted(intrinsics, K)


def _fitted(intrinsics: Any, K: Array) -> Lens:
    columns = np.linspace(0.0, intrinsics.width - 1.0, _GRID)
    rows = np.linspace(0.0, intrinsics.height - 1.0, _GRID)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    focal = K[[0, 1], [0, 1]]
    if intrinsics.model == rs.distortion.inverse_brown_conrady:
        rays = np.array([rs.rs2_deproject_pixel_to_point(intrinsics, pixel.tolist(), 1.0) for pixel in pixels])
    else:  # the library takes these from rays to pixels only
        rays = np.column_stack([(pixels - K[:2, 2]) / focal, np.ones(len(pixels))])
        pixels = np.array([rs.rs2_project_point_to_pixel(intrinsics, ray.tolist()) for ray in rays])
    x, y = rays[:, 0], rays[:, 1]
    shift = (pixels - K[:2, 2]) / focal - rays[:, :2]
    r2 = x * x + y * y
    radial, tangential = r2[:, None] ** (1, 2, 3), 2.0 * x * y
    along_x = np.column_stack([x * radial[:, 0], x * radial[:, 1], tangential, r2 + 2.0 * x * x, x * radial[:, 2]])
    along_y = np.column_stack([y * radial[:, 0], y * radial[:, 1], r2 + 2.0 * y * y, tangential, y * radial[:, 2]])
    system = np.concatenate([along_x * focal[0], along_y * focal[1]])  # in pixels, which is what shall be small
    wanted = np.concatenate([shift[:, 0] * focal[0], shift[:, 1] * focal[1]])
    distortion, *_ = np.linalg.lstsq(system, wanted, rcond=None)
    misses = (system @ distortion - wanted).reshape(2, -1)
    return Lens(K, distortion, float(np.hypot(*misses).max()))


def pose_of(extrinsics: Any) -> Pose:
    """``rs2::extrinsics`` that take points of one stream to another: the first one's pose in the second one's frame."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(extrinsics.rotation, np.float64).reshape(3, 3).T  # its columns stand one after the other
    matrix[:3, 3] = extrinsics.translation
    return Pose.from_matrix(matrix)
