"""Intrinsics from synthetic corners of a board, with a known lens and noise."""

from __future__ import annotations

from contextlib import suppress
from typing import Any

import numpy as np
import pytest

pytest.importorskip("cv2", reason="needs OpenCV: pip install 'robot-hal[calibration]'")

from calibration_kit import BOARD, SIZE, WEBCAM, K, hold, pixels_of

from hal.calibration import CalibrationFailed, LensViews, NoView
from hal.config.files import parse_yaml
from hal.config.rigfile import IntrinsicsConfig
from hal.images import distort_points

BLANK = np.zeros((SIZE[1], SIZE[0]), np.uint8)


class Corners:
    """Stands for a detector; the corners of the next image are known."""

    def __init__(self, seen: list[Any], noise_px: float) -> None:
        self.chance, self.noise, self.seen = np.random.default_rng(2), noise_px, iter(seen)

    def find_corners(self, picture: Any) -> tuple[Any, Any]:
        pixels = pixels_of(next(self.seen), WEBCAM)
        return BOARD.corners, pixels + self.noise * self.chance.normal(size=pixels.shape)


def collect(seen: list[Any], noise_px: float = 0.1) -> LensViews:
    views = LensViews(Corners(seen, noise_px))  # type: ignore[arg-type]
    for _ in seen:
        with suppress(NoView):  # as in an earlier image
            views.add(BLANK)
    return views


def test_the_lens_is_found_within_its_uncertainty() -> None:
    found = collect(hold(25)).solve()
    values = found.K[[0, 1, 0, 1], [0, 1, 2, 2]]
    assert (np.abs(values - K[[0, 1, 0, 1], [0, 1, 2, 2]]) < 4.0 * found.std).all()
    assert found.std.max() < 3.0
    rays = np.dstack(np.meshgrid(np.linspace(-0.45, 0.45, 9), np.linspace(-0.35, 0.35, 7))).reshape(-1, 2)
    seen, true = (
        distort_points(rays, lens) @ k[:2, :2].T + k[:2, 2] for lens, k in ((found.distortion, found.K), (WEBCAM, K))
    )
    assert np.abs(seen - true).max() < 2.5
    assert found.error_px == pytest.approx(0.1 * 2**0.5, rel=0.15)
    assert not found.doubts
    entry = IntrinsicsConfig.model_validate(parse_yaml(found.entry()))
    assert (entry.width, entry.height) == SIZE
    assert entry.cx == pytest.approx(found.K[0, 2], abs=1e-3)


@pytest.mark.parametrize(("how", "word"), [({"tilt": 0.03}, "focal"), ({"aside": 0.01}, "distortion")])
def test_a_board_that_is_not_moved_enough_gives_a_doubtful_result(how: dict[str, float], word: str) -> None:
    doubts = collect(hold(25, **how)).solve().doubts
    assert [text for text in doubts if word in text]


def test_views_that_do_not_determine_a_camera_are_refused() -> None:
    views = collect(hold(1) * 5)
    assert len(views) == 1
    for wrong, code in ((views, "too_few_views"), (collect(hold(25), noise_px=2.0), "misfit")):
        with pytest.raises(CalibrationFailed) as caught:
            wrong.solve()
        assert caught.value.code == code
