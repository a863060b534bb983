"""ChArUco boards: chessboards with a marker in every white square, so that every corner has an index.

A board is read from a file (:func:`load_board`), printed to scale (:func:`print_board`), and found in images by
:class:`hal.calibration.Detector`.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ..config.data_files import data_folder, is_path, user_path
from ..config.files import Problems, read_yaml, validate
from ..config.schema import Pixels, Size, Strict, ValueProblem
from ..errors import CommandError, DriverMissing, import_library

BUILT_IN = "charuco_board"
"""The board that comes with the package: on a page of A4, and as an object of the simulated world."""
PIXELS_PER_MM = 10
"""Resolution of a printed page (254 dpi): every tenth of a millimetre is a pixel."""

_MARGIN = 10
"""mm; a printer's own margin is smaller."""
_A4 = (297, 210)
"""mm; a board that fits gets a page of this size, so that no printer scales it."""
_FOOTER = 14
"""mm, for the text and the ruler below the pattern."""
_RULER = 100
"""mm"""


def opencv() -> Any:
    """Return the module ``cv2``, 4.8 or later; DriverMissing, with the command that installs it, if there is none."""
    cv2 = import_library("cv2", "detecting the board", install := "robot-hal[calibration]")
    if not hasattr(getattr(cv2, "aruco", None), "CharucoDetector"):
        version = getattr(cv2, "__version__", "?")
        text = f"OpenCV {version} has no CharucoDetector (added in 4.7): pip install '{install}'"
        raise DriverMissing(text, name="cv2")
    return cv2


@dataclass(frozen=True)
class Board:
    """A ChArUco board.

    Its frame is OpenCV's: origin in the upper left corner of the pattern, x to the right, y down, z into the paper.
    """

    columns: int
    rows: int
    """Number of squares, not of corners."""
    square: float
    """Side of a square, m."""
    marker: float
    """Side of a marker with its black border, m."""
    dictionary: str = "DICT_4X4_50"
    """Name of one of OpenCV's predefined dictionaries."""

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the pattern, m."""
        return self.columns * self.square, self.rows * self.square

    @property
    def corners(self) -> NDArray[np.float64]:
        """Inner corners (n, 3) in the board's frame, m, in the order of their indices."""
        y, x = np.mgrid[1 : self.rows, 1 : self.columns].reshape(2, -1)
        return np.column_stack([x, y, np.zeros(x.size)]) * self.square

    @property
    def centre(self) -> NDArray[np.float64]:
        """Centre (3,) in the board's frame, m."""
        return np.array([*self.size, 0.0]) / 2.0

    def resize(self, square: float) -> Board:
        """Return the board as printed: with squares of ``square`` m, and the markers scaled with them."""
        if not 0.001 <= square <= 1.0:
            raise CommandError(
                f"a square cannot be {square:g} m; the unit is metres: 30.2 mm are 0.0302", code="bad_square"
            )
        return replace(self, square=square, marker=self.marker * square / self.square)

    def make_opencv(self) -> Any:
        """Return it as ``cv2.aruco.CharucoBoard``."""
        aruco = opencv().aruco
        markers = aruco.getPredefinedDictionary(getattr(aruco, self.dictionary))
        return aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, markers)

    def picture(self, pixels_per_mm: float) -> NDArray[np.uint8]:
        """Return the pattern (H, W), black 0 and white 255, without a margin; squares are whole numbers of pixels.

        It is drawn here because not every version of OpenCV draws a board exactly to the pixel.
        """
        aruco = opencv().aruco
        markers = aruco.getPredefinedDictionary(getattr(aruco, self.dictionary))
        side, inner = (round(length * 1e3 * pixels_per_mm) for length in (self.square, self.marker))
        margin = (side - inner) // 2
        drawn = np.full((self.rows * side, self.columns * side), 255, np.uint8)
        number = 0
        for row, column in np.ndindex(self.rows, self.columns):
            top, left = row * side, column * side
            if (row + column) % 2 == 0:
                drawn[top : top + side, left : left + side] = 0
                continue
            top, left = top + margin, left + margin
            drawn[top : top + inner, left : left + inner] = aruco.generateImageMarker(markers, number, inner)
            number += 1
        return drawn

    def __str__(self) -> str:
        return (
            f"{self.columns} x {self.rows} squares of {1e3 * self.square:g} mm, markers of {1e3 * self.marker:.4g} mm, "
            f"{self.dictionary}"
        )


class BoardConfig(Strict):
    """A board's file. Lengths in m."""

    description: str = ""
    columns: Pixels = Field(ge=3, le=50)
    rows: Pixels = Field(ge=3, le=50)
    square: Size
    marker: Size
    dictionary: str = "DICT_4X4_50"

    @model_validator(mode="after")
    def _check_marker(self) -> BoardConfig:
        if not self.marker < self.square:
            raise ValueProblem("marker must be smaller than square; both are in m", "out_of_range")
        return self


def load_board(name: str = BUILT_IN) -> Board:
    """Read a board.

    Args:
        name: ``"charuco_board"``, or the path of a file with the same keys as
            ``config/objects/charuco_board/board.yaml``.

    Raises:
        CommandError: The name is neither.
        ConfigError: The file is wrong; lists every problem.
        DriverMissing: OpenCV is not installed.
    """
    if is_path(name):
        path = user_path(name, Path.cwd())
    elif name == BUILT_IN:
        path = data_folder("config") / "objects" / BUILT_IN / "board.yaml"
    else:
        raise CommandError(f"there is no board {name!r}; use {BUILT_IN!r} or the path of a file", code="unknown_board")
    problems = Problems()
    data = read_yaml(path, problems)
    problems.raise_any()
    config = validate(BoardConfig, data, path, problems)
    problems.raise_any()
    _check_dictionary(config, path, problems)
    problems.raise_any()
    return Board(config.columns, config.rows, config.square, config.marker, config.dictionary)


def _check_dictionary(config: BoardConfig, path: Path, problems: Problems) -> None:
    aruco = opencv().aruco
    names = [name for name in dir(aruco) if name.startswith("DICT_")]
    if config.dictionary not in names:
        message = f"OpenCV has no such dictionary; available: {', '.join(names)}"
        problems.add(path, "dictionary", message, "unknown_dictionary")
        return
    available = len(aruco.getPredefinedDictionary(getattr(aruco, config.dictionary)).bytesList)
    needed = config.columns * config.rows // 2
    if needed > available:
        problems.add(path, "dictionary", f"has {available} markers, the board needs {needed}", "too_few_markers")


def print_board(board: Board, path: str | Path) -> tuple[float, float]:
    """Write a page with the board, to scale.

    Args:
        board: The board.
        path: A ``.pdf``, or a ``.png`` with its resolution.

    Returns:
        Width and height of the page, m.

    Raises:
        CommandError: Another suffix.
    """
    from PIL import Image

    path = Path(path)
    kind = {".pdf": "PDF", ".png": "PNG"}.get(path.suffix.lower())
    if kind is None:
        raise CommandError(f"a board is written as .pdf or .png, not as {path.name!r}", code="bad_suffix")
    page = board_page(board)
    dpi = PIXELS_PER_MM * 25.4
    image = Image.fromarray(np.where(page > 127, 255, 0).astype(np.uint8)).convert("1")
    if kind == "PDF":
        image.save(path, "PDF", resolution=dpi)
    else:
        image.save(path, "PNG", dpi=(dpi, dpi), optimize=True)
    height, width = page.shape
    return width / PIXELS_PER_MM / 1e3, height / PIXELS_PER_MM / 1e3


def board_page(board: Board) -> NDArray[np.uint8]:
    """Return the page (H, W), black on white: the pattern, its description, and a ruler of 100 mm."""
    cv2, scale = opencv(), PIXELS_PER_MM
    pattern = board.picture(scale)
    height, width = pattern.shape
    margin = _MARGIN * scale
    page = np.full((height + 2 * margin + _FOOTER * scale, max(width, _RULER * scale) + 2 * margin), 255, np.uint8)
    page[margin : margin + height, margin : margin + width] = pattern
    base = margin + height + 6 * scale
    page[base : base + 3, margin : margin + _RULER * scale] = 0
    for k in range(_RULER // 10 + 1):
        at = margin + 10 * k * scale
        page[base - (2 * scale if k % 5 == 0 else scale) : base + 3, at : at + 3] = 0
    for row, text in enumerate((str(board), "Print at 100 %: this ruler is 100 mm long. Then measure a square.")):
        place = (margin, base + (4 + 5 * row) * scale)
        cv2.putText(page, text, place, cv2.FONT_HERSHEY_SIMPLEX, 1.1, 0, 2)
    missing = [size * scale - has for size, has in zip(reversed(_A4), page.shape, strict=True)]
    if min(missing) < 0:
        return page
    return np.pad(page, [(size // 2, size - size // 2) for size in missing], mode="constant", constant_values=255)
