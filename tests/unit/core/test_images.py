"""Crop, scaling and lens distortion of images, and the points that depth images show."""

from __future__ import annotations

import numpy as np
import pytest
from errors_kit import raises_code

from hal.errors import CommandError, NotSupported
from hal.geometry import Pose
from hal.images import Cropping, distort_points, undistort_pixels
from hal.types import Frame, Stamp

SIZES = [((640, 480), (256, 256)), ((848, 480), (640, 480)), ((640, 480), (640, 480)), ((640, 480), (1280, 960))]


def ramp(width: int, height: int) -> np.ndarray:
    """An image whose pixels hold their own column (red) and row (green), scaled to 255."""
    image = np.zeros((height, width, 3), np.uint8)
    image[..., 0] = np.round(np.linspace(0, 255, width))
    image[..., 1] = np.round(np.linspace(0, 255, height))[:, None]
    return image


@pytest.mark.parametrize(("size", "output"), SIZES)
def test_the_camera_matrix_follows_the_image(size: tuple[int, int], output: tuple[int, int]) -> None:
    (width, height), (out_width, out_height) = size, output
    K = np.array([[0.9 * width, 0, (width - 1) / 2 + 3], [0, 0.9 * width, (height - 1) / 2 - 2], [0, 0, 1]])
    cropping = Cropping(width, height, out_width, out_height)
    image, K_out = ramp(width, height), cropping.matrix(K)
    out = cropping.color(image)
    assert out.shape == (out_height, out_width, 3)
    assert out.dtype == np.uint8
    scale = out_width / cropping.crop.width
    for u, v in ((0.1, 0.2), (-0.2, 0.15), (0.0, 0.0)):  # rays, as x/z and y/z
        at = K @ (u, v, 1.0)
        there = np.round(K_out @ (u, v, 1.0)).astype(int)
        column, row = (there[:2] - K_out[:2, 2]) / K_out[[0, 1], [0, 1]] * K[[0, 1], [0, 1]] + K[:2, 2]
        assert np.hypot(column - at[0], row - at[1]) <= 0.8 / scale, "rounding to the nearest new pixel"
        assert out[there[1], there[0], 0] == pytest.approx(column * 255 / (width - 1), abs=1.5)
        assert out[there[1], there[0], 1] == pytest.approx(row * 255 / (height - 1), abs=1.5)


@pytest.mark.parametrize(("size", "output"), SIZES)
def test_depth_is_not_averaged(size: tuple[int, int], output: tuple[int, int]) -> None:
    depth = np.ones((size[1], size[0]), np.float32)
    depth[:, ::2] = 3.0
    out = Cropping(*size, *output).depth(depth)
    assert out.shape == (output[1], output[0])
    assert set(np.unique(out)) <= {1.0, 3.0}


def test_outputs_do_not_share_memory_with_the_input() -> None:
    image = ramp(64, 48)
    for output in ((64, 48), (32, 32)):
        out = Cropping(64, 48, *output).color(image)
        assert not np.shares_memory(out, image)
        out[:] = 0
    assert image.any()


LENS = (0.12, -0.25, 0.001, -0.0008, 0.05)
K = np.array([[614.0, 0.0, 319.5], [0.0, 612.0, 240.5], [0.0, 0.0, 1.0]])


def test_distortion_agrees_with_opencv_and_its_inverse_undoes_it() -> None:
    cv2 = pytest.importorskip("cv2", reason="pip install opencv-python-headless")
    points = np.random.default_rng(0).uniform(-0.5, 0.5, (50, 2))
    rays = np.column_stack([points, np.ones(50)])
    ours = np.column_stack([distort_points(points, LENS), np.ones(50)]) @ K[:2].T
    theirs = cv2.projectPoints(rays, np.zeros(3), np.zeros(3), K, np.array(LENS))[0]
    assert np.abs(ours - theirs.reshape(-1, 2)).max() < 1e-9
    assert np.abs(undistort_pixels(ours, K, LENS) - rays @ K[:2].T).max() < 1e-6


def test_a_distortion_without_an_inverse_is_an_error() -> None:
    with pytest.raises(ValueError, match="distortion"):
        undistort_pixels([[5000.0, 4000.0]], K, (-2.0, 3.0, 0.0, 0.0, -1.0))


# Points.


def frame_of(depth: np.ndarray | None, pose: Pose | None = None, distortion: tuple[float, ...] = (0.0,) * 5) -> Frame:
    K = np.array([[100.0, 0.0, 2.0], [0.0, 120.0, 1.0], [0.0, 0.0, 1.0]])
    return Frame(Stamp(0.0, 0.0, 0), None, depth, None, None, K, np.array(distortion), pose)


def test_points_are_what_each_pixel_shows_in_the_frame_that_was_chosen() -> None:
    depth = np.zeros((3, 5), np.float32)
    depth[1, 2], depth[2, 4] = 0.5, 2.0
    pose = Pose.from_rpy((1.0, 2.0, 3.0), (np.pi, 0.0, 0.0))  # it looks down
    frame = frame_of(depth, pose)
    seen = [[0.0, 0.0, 0.5], [0.04, 2.0 / 120.0, 2.0]]
    assert frame.points() == pytest.approx(np.array(seen))
    assert frame.points(depth > 1.0) == pytest.approx(np.array(seen[1:]))
    assert frame.points(frame="world") == pytest.approx(np.array([[1.0, 2.0, 2.5], [1.04, 2.0 - 2.0 / 120.0, 1.0]]))
    base = Pose((1.0, 2.0, 0.0), (0.0, 0.0, np.sqrt(0.5), np.sqrt(0.5)))
    assert frame.points(frame=base)[1] == pytest.approx([-2.0 / 120.0, -0.04, 1.0], abs=1e-6)
    image = frame.point_image(base)
    assert (image.shape, image.dtype) == ((3, 5, 3), np.float32)
    assert not image[0].any()


def test_the_lens_distortion_is_taken_out_of_points() -> None:
    distortion = (0.3, -0.1, 0.01, -0.02, 0.05)
    points = frame_of(np.full((30, 40), 2.0, np.float32), distortion=distortion).points()
    K, ideal = frame_of(None).K, points[:, :2] / points[:, 2:]
    pixels = distort_points(ideal, distortion) @ K[:2, :2].T + K[:2, 2]
    there = np.dstack(np.meshgrid(np.arange(40), np.arange(30))).reshape(-1, 2)
    assert pixels == pytest.approx(there, abs=1e-4)


def test_points_that_cannot_be_computed_are_refused_by_name() -> None:
    depth = np.ones((3, 5), np.float32)
    with raises_code(NotSupported, "no_depth"):
        frame_of(None).points()
    with raises_code(NotSupported, "no_camera_pose"):
        frame_of(depth).points(frame="world")
    with raises_code(CommandError, "bad_mask"):
        frame_of(depth).points(np.ones((5, 3), bool))
    with raises_code(CommandError, "unknown_frame"):
        frame_of(depth).points(frame="arm")  # type: ignore[arg-type]  # the mistake
