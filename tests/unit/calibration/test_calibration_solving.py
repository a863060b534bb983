"""From synthetic views to the camera's pose: exact, noisy, inconsistent and insufficient ones."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from calibration_kit import BOARD, CAMERA, LENS, K, Z, degrees, poses, views

from hal.apps.calibrate import difference_lines, report_lines
from hal.calibration import CalibrationFailed, Eye, View, solve
from hal.calibration.solving import inverse, motion
from hal.geometry import Pose

EYES: tuple[Eye, ...] = ("in-hand", "to-hand")
SEEDS = range(5 if os.environ.get("HAL_SOAK") == "1" else 1)


def refused(views: list[View], eye: Eye) -> str:
    """Code of the error that the views end in."""
    with pytest.raises(CalibrationFailed) as caught:
        solve(views, eye)
    return caught.value.code


@pytest.mark.parametrize("eye", EYES)
def test_perfect_views_give_the_camera_exactly(eye: Eye) -> None:
    found = solve(views(eye, poses(8)), eye)
    assert found.camera.distance(CAMERA) == pytest.approx((0.0, 0.0), abs=1e-8)
    assert max(found.rms()) < 1e-5
    assert found.warnings == ()


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("lens", [(0.0,) * 5, LENS])
def test_noise_is_averaged_and_the_uncertainty_covers_the_error(eye: Eye, seed: int, lens: tuple[float, ...]) -> None:
    found = solve(views(eye, poses(20, seed), noise_px=0.3, lens=lens, seed=seed), eye)
    distance, angle = found.camera.distance(CAMERA)
    assert distance < 1e-3
    assert degrees(angle) < 0.1
    assert distance < 5.0 * found.uncertainty.position
    assert angle < 5.0 * found.uncertainty.rotation
    assert found.uncertainty.position < 1e-3
    assert 0.25 < found.rms()[0] < 0.55, "two coordinates of 0.3 px each"


def test_a_slightly_wrong_K_has_a_small_effect() -> None:
    wrong = K + np.array([[1.5, 0.0, 2.0], [0.0, 1.5, -2.0], [0.0, 0.0, 0.0]])
    found = solve(views("in-hand", poses(14), noise_px=0.3, believed=wrong), "in-hand")
    distance, angle = found.camera.distance(CAMERA)
    assert distance < 4e-3
    assert degrees(angle) < 0.4


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("seed", SEEDS)
def test_an_error_of_the_arm_is_estimated_and_hardly_affects_the_result(eye: Eye, seed: int) -> None:
    found = solve(views(eye, poses(20, seed), noise_px=0.2, arm=5e-4, seed=seed), eye)
    distance, angle = found.camera.distance(CAMERA)
    assert 2e-4 <= found.arm_error <= 2e-3
    assert distance < 2e-3
    assert degrees(angle) < 0.3
    assert distance < 5.0 * found.uncertainty.position
    assert found.uncertainty.position < 3e-3


@pytest.mark.parametrize("eye", EYES)
def test_views_with_a_motion_are_left_out_and_named(eye: Eye) -> None:
    taken = views(eye, poses(15), noise_px=0.2)
    push = Pose.from_matrix(motion(np.array([0.02, 0.0, 0.01, 0.0, 0.03, 0.0])))
    for k in (3, 11):
        taken[k] = replace(taken[k], T_world_link=taken[k].T_world_link @ push)
    found = solve(taken, eye)
    assert [one.name for one in found.residuals if not one.used] == ["view 3", "view 11"]
    assert any("view 3, view 11" in text for text in found.warnings)
    assert found.doubts == (), "the others fit each other"
    distance, angle = found.camera.distance(CAMERA)
    assert distance < 1e-3
    assert degrees(angle) < 0.1


def test_an_ambiguous_pose_of_the_board_does_not_affect_the_result() -> None:
    taken = views("in-hand", poses(12), noise_px=0.1)
    flip = Pose.from_matrix(motion(np.array([0.0, 0.0, 0.0, 0.0, 0.9, 0.0])))
    for k in (0, 5):
        detection = taken[k].detection
        taken[k] = replace(taken[k], detection=replace(detection, T_camera_board=detection.T_camera_board @ flip))
    found = solve(taken, "in-hand")
    assert found.camera.distance(CAMERA)[0] < 1e-3
    assert len(found.used) == 12


def test_outlying_corners_have_little_weight() -> None:
    taken = views("in-hand", poses(15), noise_px=0.1)
    chance = np.random.default_rng(5)
    for view in taken:
        view.detection.pixels[chance.integers(24)] += 3.0
    assert solve(taken, "in-hand").camera.distance(CAMERA)[0] < 1e-3


@pytest.mark.parametrize("share", [1.02, 0.98])
def test_a_board_of_another_size_gives_a_warning(share: float) -> None:
    found = solve(views("in-hand", poses(14), noise_px=0.1, real_board=BOARD.resize(share * 0.035)), "in-hand")
    assert found.uncertainty.scale == pytest.approx(share - 1.0, abs=1e-3)
    assert (len(found.warnings), found.doubts) == (1, found.warnings)


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("share", [0.9, pytest.param(1.1, marks=pytest.mark.slow)])
def test_a_K_or_a_board_wrong_by_a_tenth_is_refused(eye: Eye, share: float) -> None:
    wrong = K * [[share], [share], [1.0]]
    assert refused(views(eye, poses(15, 3), noise_px=0.2, arm=2e-4, believed=wrong), eye) == "wrong_size"
    board = BOARD.resize(share * 0.035)
    assert refused(views(eye, poses(15, 3), noise_px=0.2, real_board=board), eye) == "wrong_size"


def moved(eye: Eye, after: int, metres: float) -> list[View]:
    """15 views; after ``after`` of them the board moved by ``metres``."""
    taken = views(eye, poses(15, 3), noise_px=0.2, arm=2e-4)
    push = Pose.from_matrix(Z @ motion(np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.0])) @ inverse(Z))
    for k in range(after, 15):
        link = taken[k].T_world_link
        # equivalent: the same images with the arm elsewhere
        at = push.inverse() @ link if eye == "in-hand" else link @ push
        taken[k] = replace(taken[k], T_world_link=at)
    return taken


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("after", [7, 10])
def test_a_board_that_moved_during_the_collection_is_refused(eye: Eye, after: int) -> None:
    assert refused(moved(eye, after, 0.008), eye) == "bad_fit"


@pytest.mark.parametrize("eye", EYES)
def test_a_board_that_moved_half_as_far_gives_a_warning(eye: Eye) -> None:
    found = solve(moved(eye, 7, 0.0045), eye)
    assert found.rms()[0] > found.focal / 300.0
    assert found.doubts
    assert set(found.doubts) <= set(found.warnings)


@pytest.mark.parametrize("eye", EYES)
def test_the_result_is_the_colour_sensor_whichever_sensor_took_the_images(eye: Eye) -> None:
    stereo = Pose([0.015, 0.001, -0.002], [0.0, 0.01, 0.0, 1.0])
    taken = [replace(view, T_color_eye=stereo) for view in views(eye, poses(8))]
    assert (solve(taken, eye).camera @ stereo).distance(CAMERA) == pytest.approx((0.0, 0.0), abs=1e-7)


@pytest.mark.parametrize("eye", EYES)
def test_too_few_views_and_too_little_rotation_are_refused(eye: Eye) -> None:
    assert refused(views(eye, poses(5)), eye) == "too_few_views"
    for turns in ((0.6, 0.0, 0.0), (0.0, 0.0, 0.8)):
        assert refused(views(eye, poses(15, turns=turns), noise_px=0.1), eye) == "one_rotation_axis"
    assert refused(views(eye, poses(15, turns=(0.01,) * 3), noise_px=0.1), eye) == "too_little_rotation"


def test_views_of_another_arm_are_refused() -> None:
    taken, others = views("in-hand", poses(12)), views("in-hand", poses(12, seed=9))
    mixed = [replace(a, T_world_link=b.T_world_link) for a, b in zip(taken, others, strict=True)]
    assert refused(mixed, "in-hand") == "views_disagree"


def test_the_wrong_eye_is_refused() -> None:
    assert refused(views("in-hand", poses(12), noise_px=0.1), "to-hand") in ("views_disagree", "bad_fit")


def test_too_many_bad_views_are_refused() -> None:
    taken = views("in-hand", poses(12), noise_px=0.1)
    chance = np.random.default_rng(2)
    for k in (0, 2, 5, 8, 10):
        push = Pose.from_matrix(motion(0.02 * chance.normal(size=6)))
        taken[k] = replace(taken[k], T_world_link=taken[k].T_world_link @ push)
    assert refused(taken, "in-hand") in ("views_disagree", "bad_fit")


def test_the_report_has_units_and_every_view() -> None:
    found = solve(views("to-hand", poses(8), noise_px=0.2), "to-hand")
    lines = report_lines(found)
    assert len(lines) == 1 + 8 + 2
    for line in lines[1:10]:
        assert "px" in line
        assert "mm" in line
        assert "deg" in line
    moved = Pose([0.01, 0.0, 0.0]) @ found.camera
    assert "10.00 mm and 0.000 degrees" in difference_lines(moved, found.camera, "the world")[-1]
