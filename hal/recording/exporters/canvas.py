"""A picture to draw curves and words on, with nothing but Pillow."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image, ImageDraw, ImageFont

__all__ = ["BLACK", "GREY", "LIGHT", "Canvas", "Colour", "ticks"]

Colour = tuple[int, int, int]
BLACK: Colour = (30, 30, 30)
GREY: Colour = (120, 120, 120)
LIGHT: Colour = (225, 225, 225)
_FINE = 3
"""Shapes are drawn so many times larger, and scaled down, so that slanted lines are smooth."""


class Canvas:
    """White. Places are in pixels from the upper left corner."""

    def __init__(self, width: int, height: int) -> None:
        self.width, self.height = width, height
        self._fine = Image.new("RGB", (width * _FINE, height * _FINE), "white")
        self._draw = ImageDraw.Draw(self._fine)
        self._words: list[tuple[float, float, str, int, Colour, str]] = []
        self._photos: list[tuple[int, int, Image.Image]] = []

    def line(self, points: Sequence[tuple[float, float]], colour: Colour, width: float = 1.0) -> None:
        """From point to point."""
        if len(points) > 1:
            fine = [(x * _FINE, y * _FINE) for x, y in points]
            self._draw.line(fine, fill=colour, width=round(width * _FINE), joint="curve")

    def box(self, x: float, y: float, width: float, height: float, colour: Colour) -> None:
        """A filled rectangle, one pixel wide at least."""
        right, bottom = x + max(1.0, width), y + max(1.0, height)
        self._draw.rectangle((x * _FINE, y * _FINE, right * _FINE - 1, bottom * _FINE - 1), fill=colour)

    def text(self, x: float, y: float, words: str, size: int = 13, colour: Colour = BLACK, anchor: str = "la") -> None:
        """Words; ``anchor`` is Pillow's: left, middle or right, then ascender, middle or baseline."""
        self._words.append((x, y, words, size, colour, anchor))

    def photo(self, x: int, y: int, picture: NDArray[np.uint8], width: int, height: int) -> None:
        """A picture (H, W, 3) RGB, scaled."""
        image = Image.fromarray(picture).resize((width, height), Image.Resampling.BOX)
        self._photos.append((x, y, image))

    @staticmethod
    def length(words: str, size: int = 13) -> float:
        """How wide these words are."""
        return float(_font(size).getlength(words))

    def finished(self) -> Image.Image:
        """The picture."""
        image = self._fine.resize((self.width, self.height), Image.Resampling.BOX)
        for left, top, photo in self._photos:
            image.paste(photo, (left, top))
        draw = ImageDraw.Draw(image)
        for x, y, words, size, colour, anchor in self._words:
            draw.text((x, y), words, fill=colour, font=_font(size), anchor=anchor)
        return image


def _font(size: int) -> Any:
    return ImageFont.load_default(size)


def ticks(low: float, high: float, most: int) -> list[float]:
    """Round numbers in a range, at most so many."""
    span = high - low
    for exponent in range(-9, 10):
        for mantissa in (1.0, 2.0, 5.0):
            step = mantissa * 10.0**exponent
            if span / step <= most - 1:
                first = int(np.ceil(low / step - 1e-9))
                last = int(np.floor(high / step + 1e-9))
                return [k * step for k in range(first, last + 1)]
    return [low, high]
