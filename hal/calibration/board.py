"""A ChArUco board: a chessboard with a marker in each white square, so that every corner has a number."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from ..config.data_files import data_folder, is_path, user_path
from ..config.files import Problems, read_yaml, validate
from ..config.schema import Pixels, Size, Strict
from ..errors import CommandError
from .library import opencv

__all__ = ["BUILT_IN", "Board", "load_board"]

BUILT_IN = "charuco_board"
"""The board that comes with the hal: on paper of A4, and as an object of the simulated world."""


@dataclass(frozen=True)
class Board:
    """What is printed.

    Its frame, as OpenCV has it: the origin in the upper left corner of the pattern, x to the right, y down, z into
    the paper.
    """

    columns: int
    rows: int
    """Squares, not corners."""
    square: float
    """Side of a square, m."""
    marker: float
    """Side of a marker, its black border included, m."""
    dictionary: str = "DICT_4X4_50"
    """Of OpenCV's predefined ones."""

    @property
    def size(self) -> tuple[float, float]:
        """Width and height of the pattern, m."""
        return self.columns * self.square, self.rows * self.square

    @property
    def corners(self) -> NDArray[np.float64]:
        """The inner corners (n, 3) in the board's frame, m, in the order of their numbers."""
        y, x = np.mgrid[1 : self.rows, 1 : self.columns].reshape(2, -1)
        return np.column_stack([x, y, np.zeros(x.size)]) * self.square

    @property
    def centre(self) -> NDArray[np.float64]:
        """(3,) in the board's frame, m."""
        return np.array([*self.size, 0.0]) / 2.0

    def measured(self, square: float) -> Board:
        """The same board as it came out of the printer: with squares of ``square`` m, and the markers with them."""
        if not 0.001 <= square <= 1.0:
            raise CommandError(f"a square of {square:g} m? It is in metres: 30.2 mm are 0.0302")
        return replace(self, square=square, marker=self.marker * square / self.square)

    def for_opencv(self) -> Any:
        """OpenCV's record of it."""
        cv2 = opencv()
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        return cv2.aruco.CharucoBoard((self.columns, self.rows), self.square, self.marker, markers)

    def picture(self, pixels_per_mm: float) -> NDArray[np.uint8]:
        """The pattern (H, W), black 0 and white 255, without a margin; squares are whole numbers of pixels.

        Painted here: not every OpenCV that finds a board paints it to the pixel.
        """
        aruco = opencv().aruco
        markers = aruco.getPredefinedDictionary(getattr(aruco, self.dictionary))
        side, inner = (round(length * 1e3 * pixels_per_mm) for length in (self.square, self.marker))
        margin = (side - inner) // 2
        painted = np.full((self.rows * side, self.columns * side), 255, np.uint8)
        number = 0
        for row, column in np.ndindex(self.rows, self.columns):
            top, left = row * side, column * side
            if (row + column) % 2 == 0:
                painted[top : top + side, left : left + side] = 0
                continue
            top, left = top + margin, left + margin
            painted[top : top + inner, left : left + inner] = aruco.generateImageMarker(markers, number, inner)
            number += 1
        return painted

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
    def _fits(self) -> BoardConfig:
        if not self.marker < self.square:
            raise ValueError("marker must be smaller than square; both are in m")
        return self


def load_board(name: str = BUILT_IN) -> Board:
    """A board: the name of the built-in one, or the path of a file of the same shape.

    Raises ConfigError with every problem, DriverMissing where OpenCV is not installed.
    """
    if is_path(name):
        path = user_path(name, Path.cwd())
    elif name == BUILT_IN:
        path = data_folder("config") / "objects" / BUILT_IN / "board.yaml"
    else:
        raise CommandError(f"there is no board {name!r}; there is {BUILT_IN!r}, or give the path of a file of your own")
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
        problems.add(path, "dictionary", f"OpenCV has none of that name; there are: {', '.join(names)}")
        return
    there = len(aruco.getPredefinedDictionary(getattr(aruco, config.dictionary)).bytesList)
    needed = config.columns * config.rows // 2
    if needed > there:
        problems.add(path, "dictionary", f"has {there} markers, the board needs {needed}")
