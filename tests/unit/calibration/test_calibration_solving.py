"""From views to the camera's pose, against poses that are known: exact, noisy, wrong and hopeless ones."""

from __future__ import annotations

import os
from dataclasses import replace

import numpy as np
import pytest
from calibration_kit import BOARD, CAMERA, LENS, K, Z, degrees, poses, views

from hal.calibration import CalibrationFailed, Eye, View, solve
from hal.calibration.report import difference_lines, report_lines
from hal.calibration.rotations import exponential, inverse
from hal.geometry import Pose

EYES: tuple[Eye, ...] = ("in-hand", "to-hand")
SEEDS = range(5 if os.environ.get("HAL_SOAK") == "1" else 2)


@pytest.mark.parametrize("eye", EYES)
def test_perfect_views_give_the_camera_exactly(eye: Eye) -> None:
    found = solve(views(eye, poses(8)), eye)
    distance, angle = found.camera.distance(CAMERA)
    assert distance < 1e-8
    assert angle < 1e-7
    assert max(found.rms()) < 1e-5
    assert found.warnings == ()


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("seed", SEEDS)
@pytest.mark.parametrize("lens", [(0.0,) * 5, LENS])
def test_noisy_corners_are_averaged_and_the_doubt_is_honest(eye: Eye, seed: int, lens: tuple[float, ...]) -> None:
    found = solve(views(eye, poses(20, seed), noise_px=0.3, lens=lens, seed=seed), eye)
    distance, angle = found.camera.distance(CAMERA)
    assert distance < 1e-3
    assert degrees(angle) < 0.1
    assert distance < 5.0 * found.doubt.position
    assert angle < 5.0 * found.doubt.rotation
    assert found.doubt.position < 1e-3, "and it does not cry wolf"
    assert 0.25 < found.rms()[0] < 0.55, "two coordinates of 0.3 px each"


def test_a_k_that_is_a_little_wrong_costs_little() -> None:
    wrong = K + np.array([[1.5, 0.0, 2.0], [0.0, 1.5, -2.0], [0.0, 0.0, 0.0]])
    found = solve(views("in-hand", poses(20), noise_px=0.3, believed=wrong), "in-hand")
    distance, angle = found.camera.distance(CAMERA)
    assert distance < 4e-3
    assert degrees(angle) < 0.4


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("seed", SEEDS)
def test_an_arm_that_is_off_by_half_a_millimetre_is_no_reason_to_be_off_by_two(eye: Eye, seed: int) -> None:
    found = solve(views(eye, poses(20, seed), noise_px=0.2, arm=5e-4, seed=seed), eye)
    distance, angle = found.camera.distance(CAMERA)
    assert 2e-4 <= found.arm <= 2e-3, "it is found out how far the arm is off"
    assert distance < 2e-3
    assert degrees(angle) < 0.3
    assert distance < 5.0 * found.doubt.position
    assert found.doubt.position < 3e-3


@pytest.mark.parametrize("eye", EYES)
def test_views_during_which_something_moved_are_left_out_and_named(eye: Eye) -> None:
    taken = views(eye, poses(15), noise_px=0.2)
    push = Pose.from_matrix(exponential(np.array([0.02, 0.0, 0.01, 0.0, 0.03, 0.0])))
    for k in (3, 11):
        taken[k] = replace(taken[k], T_world_link=taken[k].T_world_link @ push)
    found = solve(taken, eye)
    assert [one.name for one in found.residuals if not one.used] == ["view 3", "view 11"]
    assert any("view 3, view 11" in text for text in found.warnings)
    assert found.doubtful == (), "the others fit each other"
    distance, angle = found.camera.distance(CAMERA)
    assert distance < 1e-3
    assert degrees(angle) < 0.1


def test_a_pose_of_the_board_that_was_mistaken_does_no_harm() -> None:
    """A flat board looks nearly the same from two sides; its corners say all the same."""
    taken = views("in-hand", poses(12), noise_px=0.1)
    flip = Pose.from_matrix(exponential(np.array([0.0, 0.0, 0.0, 0.0, 0.9, 0.0])))
    for k in (0, 5):
        sighting = taken[k].sighting
        taken[k] = replace(taken[k], sighting=replace(sighting, T_camera_board=sighting.T_camera_board @ flip))
    found = solve(taken, "in-hand")
    assert found.camera.distance(CAMERA)[0] < 1e-3
    assert len(found.used) == 12


def test_single_corners_that_are_far_off_count_little() -> None:
    taken = views("in-hand", poses(15), noise_px=0.1)
    chance = np.random.default_rng(5)
    for view in taken:
        view.sighting.pixels[chance.integers(24)] += 3.0
    assert solve(taken, "in-hand").camera.distance(CAMERA)[0] < 1e-3


@pytest.mark.parametrize(("share", "word"), [(1.02, "larger"), (0.98, "smaller")])
def test_a_board_that_was_printed_at_another_size_is_told(share: float, word: str) -> None:
    found = solve(views("in-hand", poses(20), noise_px=0.1, real_board=BOARD.measured(share * 0.035)), "in-hand")
    (warning,) = found.warnings
    assert f"2.0 % {word}" in warning
    assert "--square" in warning
    assert "or the camera's K" in warning
    assert found.doubtful == (warning,)


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("share", [0.9, 1.1])
def test_a_k_or_a_board_that_is_wrong_by_a_tenth_is_refused(eye: Eye, share: float) -> None:
    wrong = K * [[share], [share], [1.0]]
    with pytest.raises(CalibrationFailed, match="or the camera's K"):
        solve(views(eye, poses(15, 3), noise_px=0.2, arm=2e-4, believed=wrong), eye)
    with pytest.raises(CalibrationFailed, match="--square"):
        solve(views(eye, poses(15, 3), noise_px=0.2, real_board=BOARD.measured(share * 0.035)), eye)


def moved(eye: Eye, after: int, metres: float) -> list[View]:
    """15 views; after so many of them somebody pushed the board."""
    taken = views(eye, poses(15, 3), noise_px=0.2, arm=2e-4)
    push = Pose.from_matrix(Z @ exponential(np.array([metres, 0.0, 0.0, 0.0, 0.0, 0.0])) @ inverse(Z))
    for k in range(after, 15):
        link = taken[k].T_world_link
        # the same pictures as before, of a board that is elsewhere: so the arm is, too
        at = push.inverse() @ link if eye == "in-hand" else link @ push
        taken[k] = replace(taken[k], T_world_link=at)
    return taken


@pytest.mark.parametrize("eye", EYES)
@pytest.mark.parametrize("after", [7, 10])
def test_a_board_that_moved_in_the_middle_is_refused(eye: Eye, after: int) -> None:
    with pytest.raises(CalibrationFailed, match=r"off by [3-6]\.\d px.*did the board"):
        solve(moved(eye, after, 0.008), eye)


@pytest.mark.parametrize("eye", EYES)
def test_one_that_moved_half_as_far_makes_the_answer_doubtful(eye: Eye) -> None:
    found = solve(moved(eye, 7, 0.0045), eye)
    assert any("did the board" in text for text in found.doubtful)
    assert set(found.doubtful) <= set(found.warnings)


@pytest.mark.parametrize("eye", EYES)
def test_the_answer_is_the_colour_sensors_whichever_took_the_pictures(eye: Eye) -> None:
    stereo = Pose([0.015, 0.001, -0.002], [0.0, 0.01, 0.0, 1.0])
    taken = [replace(view, T_color_eye=stereo) for view in views(eye, poses(8))]
    distance, angle = (solve(taken, eye).camera @ stereo).distance(CAMERA)
    assert distance < 1e-8
    assert angle < 1e-7


@pytest.mark.parametrize(
    ("turns", "text"),
    [
        ((0.6, 0.0, 0.0), "about every other one"),
        ((0.0, 0.0, 0.8), "about every other one"),
        ((0.01, 0.01, 0.01), "too little"),
    ],
)
@pytest.mark.parametrize("eye", EYES)
def test_views_that_could_not_tell_are_refused(eye: Eye, turns: tuple[float, float, float], text: str) -> None:
    with pytest.raises(CalibrationFailed, match=text):
        solve(views(eye, poses(15, turns=turns), noise_px=0.1), eye)


def test_too_few_views_are_refused() -> None:
    with pytest.raises(CalibrationFailed, match="at least 6 views, better 15, and there are 5"):
        solve(views("in-hand", poses(5)), "in-hand")


def test_views_of_another_arm_are_refused() -> None:
    """The poses of the arm belong to other pictures."""
    taken, others = views("in-hand", poses(12)), views("in-hand", poses(12, seed=9))
    mixed = [replace(a, T_world_link=b.T_world_link) for a, b in zip(taken, others, strict=True)]
    with pytest.raises(CalibrationFailed, match="right arm and link"):
        solve(mixed, "in-hand")


def test_a_camera_that_is_not_where_it_was_said_to_be_fixed_is_refused() -> None:
    with pytest.raises(CalibrationFailed):
        solve(views("in-hand", poses(12), noise_px=0.1), "to-hand")


def test_too_many_bad_views_are_refused() -> None:
    taken = views("in-hand", poses(12), noise_px=0.1)
    chance = np.random.default_rng(2)
    for k in (0, 2, 5, 8, 10):
        push = Pose.from_matrix(exponential(0.02 * chance.normal(size=6)))
        taken[k] = replace(taken[k], T_world_link=taken[k].T_world_link @ push)
    with pytest.raises(CalibrationFailed, match="do not fit"):
        solve(taken, "in-hand")


def test_the_report_has_units_and_every_view() -> None:
    found = solve(views("to-hand", poses(8), noise_px=0.2), "to-hand")
    lines = report_lines(found)
    assert len(lines) == 1 + 8 + 2
    for line in lines[1:10]:
        assert "px" in line
        assert "mm" in line
        assert "deg" in line
    moved = Pose([0.01, 0.0, 0.0]) @ found.camera
    assert "by 10.00 mm and 0.000 degrees" in difference_lines(moved, found.camera, "the world")[-1]
