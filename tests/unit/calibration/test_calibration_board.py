"""The printed board, the simulated one and the detected one are the same."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from errors_kit import raises_code
from PIL import Image

from hal.calibration import Board, load_board
from hal.calibration.board import PIXELS_PER_MM, board_page, print_board
from hal.calibration.detection import Detector
from hal.config.data_files import data_folder
from hal.errors import CommandError, ConfigError

pytest.importorskip("cv2", reason="pip install opencv-python-headless")
BOARD = load_board()
OBJECT = data_folder("config") / "objects" / "charuco_board"


def test_corners_are_numbered_as_opencv_does() -> None:
    assert np.allclose(BOARD.corners, BOARD.make_opencv().getChessboardCorners(), atol=1e-7)


def test_the_simulated_board_matches_its_file() -> None:
    drawn = np.asarray(Image.open(OBJECT / "board.png").convert("L"))
    assert np.array_equal(drawn, np.pad(BOARD.picture(4.0), 40, constant_values=255))
    width, height = (float(v) for v in re.findall(r'size="([\d.]+) ([\d.]+)', (OBJECT / "board.urdf").read_text())[0])
    assert (width, height) == pytest.approx((drawn.shape[1] / 4000, drawn.shape[0] / 4000))


@pytest.mark.parametrize("ending", ["png", "pdf"])
def test_a_page_is_to_scale(tmp_path: Path, ending: str) -> None:
    path = tmp_path / f"board.{ending}"
    width, height = print_board(BOARD, path)
    assert (width, height) == (0.297, 0.210), "A4"
    if ending == "pdf":
        box = re.search(rb"/MediaBox\s*\[\s*0\s+0\s+([\d.]+)\s+([\d.]+)", path.read_bytes())
        assert [float(v) / 72 * 0.0254 for v in box.groups()] == pytest.approx([width, height], rel=1e-4)
        return
    image = Image.open(path)
    assert image.info["dpi"] == pytest.approx((254.0, 254.0), rel=1e-4)
    assert [size / image.info["dpi"][0] * 0.0254 for size in image.size] == pytest.approx([width, height], rel=1e-4)


def test_the_board_is_detected_on_the_printed_page() -> None:
    page = board_page(BOARD)
    K = np.array([[5000.0, 0, page.shape[1] / 2], [0, 5000.0, page.shape[0] / 2], [0, 0, 1]])
    found = Detector(BOARD).find(page, K, np.zeros(5))
    assert len(found.points) == 24
    side = np.linalg.norm(found.pixels[1] - found.pixels[0])
    assert side == pytest.approx(0.035 * 1000 * PIXELS_PER_MM, abs=0.2)


def test_a_measured_square_scales_everything() -> None:
    measured = BOARD.resize(0.0348)
    assert measured.square == 0.0348
    assert measured.marker / measured.square == pytest.approx(BOARD.marker / BOARD.square)
    assert np.allclose(measured.corners, BOARD.corners * 0.0348 / 0.035)
    with raises_code(CommandError, "bad_square"):
        BOARD.resize(34.8)


def test_a_board_from_a_file(tmp_path: Path) -> None:
    path = tmp_path / "mine.yaml"
    path.write_text("columns: 4\nrows: 6\nsquare: 0.02\nmarker: 0.015\ndictionary: DICT_5X5_50\n")
    assert load_board(str(path)) == Board(4, 6, 0.02, 0.015, "DICT_5X5_50")


@pytest.mark.parametrize(
    ("line", "key"),
    [
        ("marker: 0.04", ""),
        ("columns: 2", "columns"),
        ("dictionary: DICT_9X9", "dictionary"),
        ("columns: 20", "dictionary"),  # too few markers
        ("squares: 3", "squares"),
    ],
)
def test_a_wrong_board_file_is_refused_with_its_key(tmp_path: Path, line: str, key: str) -> None:
    path = tmp_path / "mine.yaml"
    good = {"columns": "7", "rows": "6", "square": "0.035", "marker": "0.027"}
    name, value = line.split(": ")
    path.write_text("".join(f"{k}: {v}\n" for k, v in {**good, name: value}.items()))
    with pytest.raises(ConfigError) as caught:
        load_board(str(path))
    assert [problem.key for problem in caught.value.problems] == [key]


def test_unknown_names_and_suffixes_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CommandError) as name:
        load_board("chessboard")
    with pytest.raises(CommandError) as suffix:
        print_board(BOARD, tmp_path / "board.jpg")
    assert (name.value.code, suffix.value.code) == ("unknown_board", "bad_suffix")
