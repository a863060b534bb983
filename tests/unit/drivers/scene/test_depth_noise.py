"""The noise of simulated depth, against the formulas that it is made by and the geometry of two imagers."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from errors_kit import raises_problems

from hal.config import load
from hal.drivers.scene.camera import SimulatedCamera
from hal.drivers.scene.depth_noise import DepthNoise, depth_noise
from hal.specs import CameraSpec

FB = 384.0 * 0.05
"""Focal length, pixels, x baseline, m, of a D435 at 640x480: depth x disparity."""


def camera(model: str = "realsense_d435", noise: Any = True, **keys: Any) -> CameraSpec:
    eye = {
        "model": model,
        "look_at": {"target": [0, 0, 0], "distance": 1.0},
        "align": "depth",
        "simulated": {"depth_noise": noise},
        **keys,
    }
    (spec,) = load({"cameras": {"eye": eye}}).resolve().cameras
    return spec


def made(spec: CameraSpec) -> DepthNoise:
    noise = depth_noise(spec)
    assert noise is not None
    return noise


def wall(spec: CameraSpec, z: float) -> np.ndarray:
    return np.full((spec.height, spec.width), z, np.float32)


def errors(spec: CameraSpec, z: float, frames: int = 6) -> np.ndarray:
    """(frames, H, W) m, in the middle of a wall."""
    noise = made(spec)
    middle = (slice(40, -40), slice(120, -40))
    return np.stack([noise(wall(spec, z), number)[middle] for number in range(frames)]) - z


@pytest.mark.parametrize("z", [0.5, 1.0, 2.0, 4.0])
def test_the_error_of_a_wall_is_that_of_the_formula(z: float) -> None:
    found = errors(camera(), z)
    rms = 0.08 * z**2 / FB
    assert found.std() == pytest.approx(rms, rel=0.06)
    assert abs(found.mean()) < 0.05 * rms + 0.0001
    assert (np.abs(found) < 6 * rms + 0.002).all(), "nothing is missing in the middle of a wall"


def test_it_is_that_of_the_mode_and_of_the_model() -> None:
    wide = camera(capture={"width": 1280, "height": 720, "rate_hz": 30})
    assert errors(wide, 2.0, 2).std() == pytest.approx(0.08 * 4 / (640 * 0.05), rel=0.08)
    assert errors(camera("realsense_d455"), 2.0).std() == pytest.approx(0.08 * 4 / (384 * 0.095), rel=0.08)
    assert errors(camera(noise={"subpixel": 0.03}), 2.0).std() == pytest.approx(0.03 * 4 / FB, rel=0.1)


def test_a_smaller_picture_has_the_errors_of_the_captured_one() -> None:
    small = camera(output={"width": 320, "height": 240})
    found = np.stack([made(small)(wall(small, 2.0), n) for n in range(8)])[:, 20:-20, 60:-20] - 2.0
    assert found.std() == pytest.approx(0.08 * 4 / FB, rel=0.06)


@pytest.mark.parametrize("patch", [1.0, 4.0, 9.0])
def test_errors_are_correlated_over_a_patch(patch: float) -> None:
    spec = camera(noise={"patch": patch, "step": 0})
    found = errors(spec, 2.0, 8)
    assert found.std() == pytest.approx(0.08 * 4 / FB, rel=0.08), "whatever the patch"

    def alike(step: int) -> float:
        return float(np.corrcoef(found[:, :, :-step].ravel(), found[:, :, step:].ravel())[0, 1])

    if patch == 1.0:
        assert abs(alike(1)) < 0.05
    else:
        assert alike(1) > 0.7
        assert abs(alike(int(2 * patch) + 1)) < 0.1
    frames = np.corrcoef(found[0].ravel(), found[1].ravel())[0, 1]
    assert abs(frames) < 0.1, "each frame is its own"


def test_depth_comes_in_steps_of_disparity_and_in_whole_units() -> None:
    spec = camera()
    depth = made(spec)(wall(spec, 3.0), 1)
    assert np.allclose(depth * 1000, np.rint(depth * 1000), atol=1e-3)
    disparity = FB / np.unique(depth[depth > 0])
    steps = disparity * 32
    assert np.abs(steps - np.rint(steps)).max() < 0.2  # a millimetre at 3 m is 0.07 of a step
    assert SimulatedCamera(spec).info.depth_scale == 0.001
    assert SimulatedCamera(camera(noise=False)).info.depth_scale is None


class TestShadow:
    """A board before a wall. Disparities are whole numbers, so that every edge is where a pixel ends."""

    NEAR, FAR = FB / 24, FB / 12

    def hidden(self, spec: CameraSpec, left: int, right: int) -> set[int]:
        """Columns without depth, of a row with the board in it."""
        depth = wall(spec, self.FAR)
        depth[100:300, left:right] = self.NEAR
        seen = made(spec)(depth, 0)
        assert (seen[90] == 0).sum() == (seen[350] == 0).sum(), "above and below the board all is as without it"
        return set(np.flatnonzero(seen[200] == 0).tolist())

    def test_is_left_of_the_board_and_left_of_the_picture(self) -> None:
        hidden = self.hidden(camera(), 300, 400)
        band, shadow = set(range(12)), set(range(288, 300))
        assert band <= hidden, "the right imager does not see as far to the left"
        assert len(hidden ^ (band | shadow)) <= 2
        assert not hidden & set(range(300, 640)), "nothing on the board, and nothing right of it"

    def test_of_a_thin_thing_is_as_wide_as_the_thing(self) -> None:
        hidden = self.hidden(camera(), 300, 304) - set(range(13))
        assert hidden
        assert hidden <= set(range(287, 294)), "where the right imager has it before the wall"

    def test_of_two_imagers_with_the_view_between_them(self) -> None:
        """The D455's colour sensor lies between its imagers, so that each of them hides something else."""
        spec = camera("realsense_d455", align="color")
        board, back = 384 * 0.095 / 24, 384 * 0.095 / 12
        depth = wall(spec, back)
        depth[100:300, 300:400] = board
        seen = made(spec)(depth, 0)[200] == 0
        parallax = 384 * (1 / board - 1 / back)
        assert seen[260:300].sum() == pytest.approx(parallax * 0.036, abs=2)  # whole pixels
        assert seen[400:440].sum() == pytest.approx(parallax * 0.059, abs=2)
        assert not seen[300:400].any()

    def test_can_be_left_out(self) -> None:
        assert not self.hidden(camera(noise={"shadow": False}), 300, 400)


def test_outside_the_range_there_is_nothing() -> None:
    spec = camera()
    depth = wall(spec, 9.9)
    depth[:100] = 0.0
    depth[100:200] = spec.depth_min
    seen = made(spec)(depth, 0)
    assert not seen[:100].any()
    measured = seen[seen > 0]
    assert measured.size
    assert measured.min() >= spec.depth_min
    assert measured.max() <= spec.depth_max


def test_noise_depends_on_seed_frame_and_camera() -> None:
    spec = camera()

    def picture(spec: CameraSpec, number: int) -> bytes:
        return made(spec)(wall(spec, 1.5), number).tobytes()

    first = picture(spec, 1)
    assert picture(spec, 1) == first
    others = [picture(spec, 2), picture(replace(spec, name="other"), 1), picture(camera(noise={"seed": 5}), 1)]
    assert first not in others
    assert len(set(others)) == 3


def test_lidar_noise_grows_with_the_distance() -> None:
    spec = camera("realsense_l515")
    noise = made(spec)
    for z, sigma in ((1.0, 0.0025), (5.0, 0.009), (8.0, 0.0025 + 7 * 0.013 / 8)):
        found = noise(wall(spec, z), 0) - z
        assert found.std() == pytest.approx(sigma, rel=0.03)
        assert abs(found.mean()) < 1e-4
    depth = wall(spec, 2.0)
    depth[100:300, 300:400] = 1.0
    seen = noise(depth, 1)
    assert seen.all(), "it has no shadow"
    assert np.allclose(seen / 0.00025, np.rint(seen / 0.00025), atol=0.02)


def test_no_noise_by_default() -> None:
    for spec in (camera(noise=False), camera(simulated={}), camera(streams=["color"], align="color")):
        assert depth_noise(spec) is None
    with raises_problems("unknown_key"):
        depth_noise(replace(camera(), options={**camera().options, "depth_noise": {"subpixl": 1}}))
