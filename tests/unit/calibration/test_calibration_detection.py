"""Detection of the board in drawn images: accuracy of the corners, and reasons to reject an image."""

from __future__ import annotations

import importlib
import sys
from functools import cache

import numpy as np
import pytest
from calibration_kit import BOARD, CAMERA, LENS, K, X, Z, picture, pixels_of
from numpy.typing import NDArray

from hal.calibration import CalibrationFailed, NoView, View, load_board, solve
from hal.calibration.collecting import plan_views
from hal.calibration.detection import Detector
from hal.calibration.solving import inverse, motion
from hal.errors import DriverMissing
from hal.geometry import Pose

cv2 = pytest.importorskip("cv2", reason="pip install opencv-python-headless")
NO_LENS = (0.0,) * 5


def facing(distance: float = 0.45, tilt: float = 0.35, turn: float = 0.3) -> NDArray[np.float64]:
    pose = motion(np.array([0.0, 0.0, 0.0, tilt, -0.2, turn]))
    pose[:3, 3] = np.array([0.0, 0.0, distance]) - pose[:3, :3] @ BOARD.centre
    return pose


@cache
def sharp(lens: tuple[float, ...] = NO_LENS) -> NDArray[np.uint8]:
    """Return a picture of the facing board, which the tests share: drawing it takes most of a test."""
    return picture(facing(), cv2, lens, finer=3)


@pytest.mark.parametrize("lens", [NO_LENS, LENS])
def test_corners_and_pose_are_found(lens: tuple[float, ...]) -> None:
    pose = facing()
    found = Detector(BOARD).find(sharp(lens), K, lens)
    assert np.array_equal(found.points, BOARD.corners)
    assert np.abs(found.pixels - pixels_of(pose)).max() < 0.12
    assert found.error_px < 0.08
    distance, angle = found.T_camera_board.distance(Pose.from_matrix(pose))
    assert distance < 1e-3
    assert angle < 5e-3


def test_a_colour_image_of_a_part_of_the_board_is_enough() -> None:
    pose = facing()
    grey = sharp().copy()
    grey[:, :260] = 120
    found = Detector(BOARD).find(np.repeat(grey[:, :, None], 3, axis=2), K, NO_LENS)
    assert 8 <= len(found.points) < 24
    assert found.T_camera_board.distance(Pose.from_matrix(pose))[0] < 2e-3


def test_misidentified_corners_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    pose, detector = facing(), Detector(BOARD)
    find = detector._refine_corners

    def mistaken(*given: object) -> NDArray[np.float64]:
        pixels = find(*given)
        pixels[[3, 9]] = pixels[[9, 3]]
        pixels[20] += 6.0
        return pixels

    monkeypatch.setattr(detector, "_refine_corners", mistaken)
    found = detector.find(sharp(), K, NO_LENS)
    assert len(found.points) == 21
    assert found.T_camera_board.distance(Pose.from_matrix(pose))[0] < 1e-3


def test_unusable_images_are_refused_with_a_code() -> None:
    detector = Detector(BOARD)

    def reason(grey: NDArray[np.uint8], lens: tuple[float, ...] = NO_LENS) -> str:
        with pytest.raises(NoView) as caught:
            detector.find(grey, K, lens)
        return caught.value.code

    assert reason(np.full((480, 640), 120, np.uint8)) == "no_board"
    assert reason(cv2.GaussianBlur(sharp(), (0, 0), 2.0)) == "blurred"
    corner = sharp().copy()
    corner[:, :370] = 120
    assert reason(corner) == "too_few_corners"
    assert reason(picture(facing(0.3, 0.0, 0.0), cv2, (-0.8, 0.5, 0.0, 0.0, 0.0), finer=2)) == "not_flat"


def test_the_built_in_board_is_the_one_of_these_tests() -> None:
    assert load_board() == BOARD


def test_a_missing_library_is_a_missing_driver(monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("cv2", "scipy.optimize"):
        monkeypatch.setitem(sys.modules, name, None)
    monkeypatch.delitem(sys.modules, "hal.calibration.solving")
    with pytest.raises(DriverMissing):
        Detector(BOARD)
    with pytest.raises(DriverMissing):
        importlib.import_module("hal.calibration.solving")


def test_an_opencv_that_is_too_old_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(cv2.aruco, "CharucoDetector")
    with pytest.raises(DriverMissing):
        load_board()


def test_planned_views_show_the_whole_board_from_all_sides() -> None:
    first = Pose.from_matrix(facing(0.6))
    places = plan_views(BOARD, K, (640, 480), first, 60)
    normals, distances = [], []
    for place in places:
        pixels = pixels_of(place.matrix())
        assert (pixels > 0).all()
        assert (pixels < [640, 480]).all()
        assert np.linalg.norm(pixels[1] - pixels[0]) > 8.0
        normals.append(place.matrix()[:3, 2])
        distances.append(place.transform(BOARD.centre)[2])
    assert min(n[2] for n in normals) > 0.7, "none from so flat that markers vanish"
    assert np.ptp(np.array(normals)[:, :2], axis=0).min() > 0.8, "tilted to all sides"
    assert max(distances) > 1.2 * min(distances)
    assert [p.position.tolist() for p in places] == [
        p.position.tolist() for p in plan_views(BOARD, K, (640, 480), first, 60)
    ]


@pytest.mark.slow
def test_drawn_images_lead_to_the_camera() -> None:
    """Everything but an arm: images drawn through a lens, detected, solved."""
    detector, taken = Detector(BOARD), []
    for k, place in enumerate(plan_views(BOARD, K, (640, 480), Pose.from_matrix(facing(0.5)), 8)):
        link = Z @ inverse(place.matrix()) @ inverse(X)
        grey = picture(place.matrix(), cv2, LENS, finer=2)
        taken.append(View(f"view {k}", Pose.from_matrix(link), detector.find(grey, K, LENS)))
    distance, angle = solve(taken, "in-hand").camera.distance(CAMERA)
    assert distance < 1e-3
    assert angle < 2e-3
    with pytest.raises(CalibrationFailed):
        solve(taken[:4], "in-hand")
