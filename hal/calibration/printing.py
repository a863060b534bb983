"""The board on paper, to scale: as a PDF of one page, or as a PNG that says how many pixels a metre has."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError
from .board import Board
from .library import opencv

__all__ = ["print_board", "sheet"]

PIXELS_PER_MM = 10
"""254 dots per inch, so that every tenth of a millimetre is a pixel."""
_MARGIN = 10
"""mm; a printer's own is smaller."""
_A4 = (297, 210)
"""mm; what fits gets a page of this size, so that nobody's printer is tempted to fit it."""
_LINE = 14
"""mm, for the words and the ruler below the pattern."""
_RULER = 100
"""mm"""


def sheet(board: Board) -> NDArray[np.uint8]:
    """The whole page (H, W), black on white: the pattern, what it is, and a ruler of 100 mm to check the printer."""
    cv2, scale = opencv(), PIXELS_PER_MM
    pattern = board.picture(scale)
    height, width = pattern.shape
    margin = _MARGIN * scale
    page = np.full((height + 2 * margin + _LINE * scale, max(width, _RULER * scale) + 2 * margin), 255, np.uint8)
    page[margin : margin + height, margin : margin + width] = pattern
    base = margin + height + 6 * scale
    page[base : base + 3, margin : margin + _RULER * scale] = 0
    for k in range(_RULER // 10 + 1):
        at = margin + 10 * k * scale
        page[base - (2 * scale if k % 5 == 0 else scale) : base + 3, at : at + 3] = 0
    for row, text in enumerate(
        (str(board), "print at 100 %: this ruler is 100 mm long. Measure a square all the same.")
    ):
        place = (margin, base + (4 + 5 * row) * scale)
        cv2.putText(page, text, place, cv2.FONT_HERSHEY_SIMPLEX, 1.1, 0, 2)
    missing = [size * scale - has for size, has in zip(reversed(_A4), page.shape, strict=True)]
    if min(missing) < 0:
        return page
    before = [size // 2 for size in missing]
    return np.pad(
        page, [(b, size - b) for b, size in zip(before, missing, strict=True)], mode="constant", constant_values=255
    )


def print_board(board: Board, path: str | Path) -> tuple[float, float]:
    """Write the page to a ``.pdf`` or ``.png``; returns its width and height, m. CommandError for another ending."""
    from PIL import Image

    path = Path(path)
    kinds = {".pdf": "PDF", ".png": "PNG"}
    if path.suffix.lower() not in kinds:
        raise CommandError(f"a board is written as .pdf or .png, not as {path.name!r}")
    page = sheet(board)
    dpi = PIXELS_PER_MM * 25.4
    image = Image.fromarray(np.where(page > 127, 255, 0).astype(np.uint8)).convert("1")
    if kinds[path.suffix.lower()] == "PDF":
        image.save(path, "PDF", resolution=dpi)
    else:
        image.save(path, "PNG", dpi=(dpi, dpi), optimize=True)
    height, width = page.shape
    return width / PIXELS_PER_MM / 1e3, height / PIXELS_PER_MM / 1e3
