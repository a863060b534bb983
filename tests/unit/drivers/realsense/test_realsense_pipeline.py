"""Conversion of the library's intrinsics and extrinsics."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

rs = pytest.importorskip("pyrealsense2", reason="needs pyrealsense2: pip install 'robot-hal[realsense]'")

from hal.drivers.realsense.pipeline import convert_extrinsics, convert_intrinsics  # noqa: E402

D455 = [-0.0567, 0.0669, 0.0004, -0.0006, -0.0212]
"""Distortion of a D455's colour sensor, roughly."""


def intrinsics(model: Any, coefficients: list[float]) -> Any:
    made = rs.intrinsics()
    made.width, made.height, made.fx, made.fy, made.ppx, made.ppy = 1280, 720, 640.0, 641.0, 636.5, 363.25
    made.model, made.coeffs = model, coefficients
    return made


def projected(rays: np.ndarray, K: np.ndarray, distortion: np.ndarray) -> np.ndarray:
    """OpenCV's documented formula."""
    x, y = rays[:, 0] / rays[:, 2], rays[:, 1] / rays[:, 2]
    k1, k2, p1, p2, k3 = distortion
    r2 = x * x + y * y
    radial = 1 + k1 * r2 + k2 * r2**2 + k3 * r2**3
    u = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
    v = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
    return np.stack([K[0, 0] * u + K[0, 2], K[1, 1] * v + K[1, 2]], axis=1)


PIXELS = [[u, v] for u in (0.0, 17.0, 300.5, 636.5, 900.0, 1279.0) for v in (0.0, 100.0, 363.25, 719.0)]


@pytest.mark.parametrize(
    ("model", "coefficients", "bound"),
    [
        ("none", [0.0] * 5, 1e-3),
        ("brown_conrady", [0.0] * 5, 1e-3),
        ("brown_conrady", [0.03, -0.02, 0.001, -0.0005, 0.004], 2e-2),
        ("inverse_brown_conrady", [0.0] * 5, 1e-3),
        ("inverse_brown_conrady", D455, 0.05),
    ],
)
def test_the_librarys_rays_project_to_the_same_pixels_with_opencv(model, coefficients, bound):
    camera = intrinsics(getattr(rs.distortion, model), coefficients)
    lens = convert_intrinsics(camera)
    rays = np.array([rs.rs2_deproject_pixel_to_point(camera, pixel, 1.3) for pixel in PIXELS])
    misses = np.hypot(*(projected(rays, lens.K, lens.distortion) - PIXELS).T)
    assert misses.max() <= bound
    assert lens.residual <= bound
    assert (lens.distortion == 0.0).all() == (not any(coefficients))


def test_a_model_that_the_library_only_projects() -> None:
    camera = intrinsics(rs.distortion.modified_brown_conrady, D455)
    lens = convert_intrinsics(camera)
    rays = np.array([[x, y, 1.0] for x in (-0.9, -0.4, 0.0, 0.3, 0.9) for y in (-0.5, 0.0, 0.2, 0.5)])
    pixels = np.array([rs.rs2_project_point_to_pixel(camera, ray.tolist()) for ray in rays])
    assert np.hypot(*(projected(rays, lens.K, lens.distortion) - pixels).T).max() <= 0.05
    straight = np.hypot(*(projected(rays, lens.K, np.zeros(5)) - pixels).T)
    assert straight.max() > 5.0, "the distortion matters"


def test_pixel_zero_is_the_centre_of_the_first_pixel() -> None:
    """A point on the optical axis is seen at the principal point, and no half pixel is added."""
    camera = intrinsics(rs.distortion.none, [0.0] * 5)
    assert rs.rs2_project_point_to_pixel(camera, [0.0, 0.0, 1.0]) == pytest.approx([636.5, 363.25])
    assert convert_intrinsics(camera).K[0, 2] == 636.5


def test_extrinsics_become_the_pose_of_the_first_in_the_second() -> None:
    made = rs.extrinsics()
    made.rotation = [0.0, 1.0, 0.0, -1.0, 0.0, 0.0, 0.0, 0.0, 1.0]
    made.translation = [0.1, 0.2, 0.3]
    point = [1.0, 2.0, 3.0]
    assert np.allclose(convert_extrinsics(made).transform(point), rs.rs2_transform_point_to_point(made, point))
