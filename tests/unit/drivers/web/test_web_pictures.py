"""How the pictures of cameras look on the pages, and when a page may be sent one."""

from __future__ import annotations

import io

import numpy as np
import pytest
from PIL import Image
from web_kit import camera, frame

from hal.drivers.web.pictures import PictureCredit, compress, smoothed


def pixels(jpeg: bytes) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(jpeg))).astype(int)


def test_depth_is_bright_where_it_is_near_and_black_where_nothing_was_measured() -> None:
    spec = camera("depth", 64, 16, "depth")  # 0.2 to 2.2 m
    depth = frame(spec, 0.0)
    for k, value in enumerate((0.0, 0.2, 1.2, 2.2, 9.0, float("nan"), float("inf"), -1.0)):
        depth.depth[:, 8 * k : 8 * k + 8] = value
    row = pixels(compress(depth, spec))[8, 4::8]
    assert np.abs(row - [0, 255, 147, 40, 40, 0, 40, 0]).max() <= 2


def test_infrared_is_grey() -> None:
    spec = camera("ir", 32, 16, "infrared")
    image = pixels(compress(frame(spec, 90), spec))
    assert image.shape == (16, 32)
    assert np.abs(image - 90).max() <= 2


def test_colours_are_not_swapped() -> None:
    spec = camera("color", 32, 16)
    red = frame(spec, 0)
    red.color[:, :, 0] = 250
    assert np.abs(pixels(compress(red, spec)) - [250, 0, 0]).max() <= 4


def test_a_page_gets_the_newest_picture_once_it_has_drawn_the_last() -> None:
    newest = {"a": 0, "b": 3}
    credit = PictureCredit()
    assert list(credit.due(newest.__getitem__)) == []
    credit.watch(("a", "b"))
    assert list(credit.due(newest.__getitem__)) == ["b"]
    credit.spend("b", 3)
    newest["b"] = 5
    assert list(credit.due(newest.__getitem__)) == []
    credit.watch(("b",))
    assert list(credit.due(newest.__getitem__)) == [], "asking again for the same gives no credit"
    credit.give_back("b")
    credit.give_back("b")
    credit.give_back("a")
    assert list(credit.due(newest.__getitem__)) == ["b"]
    credit.spend("b", 5)
    credit.give_back("b")
    assert list(credit.due(newest.__getitem__)) == [], "it has the newest one"


def test_a_small_picture_has_no_staircases_and_no_lone_pixels_and_is_not_changed_itself() -> None:
    """A steep edge as it is drawn with one sample a pixel, and a glint."""
    row, column = np.mgrid[:60, :80]
    picture = np.where((row > 0.3 * column + 10)[:, :, None], 200, 60).astype(np.uint8).repeat(3, axis=2)
    picture[5, 60] = 255
    before = picture.copy()
    found = smoothed(picture)
    assert (picture == before).all(), "what others get of this frame stays as it is"
    steps = np.unique(found[:, 20:60, 0])
    assert len(steps) > 6, "an edge passes through values in between"
    assert steps.min() >= 60
    assert steps.max() <= 200
    assert found[5, 60].max() < 100, "a lone pixel becomes like those around it"
    far = abs(row - 0.3 * column - 10) > 8
    far[3:8, 58:63] = False
    assert (found[far] == picture[far]).all(), "surfaces stay as they are"


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (3, 3), (48, 64)])
def test_any_size_and_any_noise_can_be_smoothed(shape: tuple[int, int]) -> None:
    noise = np.random.default_rng(1).integers(0, 256, (*shape, 3), np.uint8)
    found = smoothed(noise)
    assert (found.shape, found.dtype) == (noise.shape, noise.dtype)
