"""A picture's middle, scaled to the size that a rig asks for. The camera matrix goes the same way
(:mod:`hal.config.intrinsics`), so that a real camera and a simulated one hand out the same."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from .config.intrinsics import Intrinsics, centre_crop

__all__ = ["Cropping"]


class Cropping:
    """From pictures of one size to the largest part in their middle that has the output's shape, scaled to it.

    Colour and infrared are averaged over the area of each new pixel. Depth is taken from the nearest pixel, because a
    mean over an edge is a distance at which there is nothing.
    """

    def __init__(self, width: int, height: int, out_width: int, out_height: int) -> None:
        self.crop = centre_crop(width, height, out_width, out_height)
        self.size = (out_width, out_height)
        self.is_identity = (width, height) == self.size
        self._cuts_only = (self.crop.width, self.crop.height) == self.size
        x, y = self.crop.x, self.crop.y
        self._part = (slice(y, y + self.crop.height), slice(x, x + self.crop.width))
        columns = ((np.arange(out_width) + 0.5) * self.crop.width / out_width).astype(np.intp) + x
        rows = ((np.arange(out_height) + 0.5) * self.crop.height / out_height).astype(np.intp) + y
        self._nearest = np.ix_(rows, columns)

    def matrix(self, K: NDArray[np.float64]) -> NDArray[np.float64]:
        """The camera matrix (3, 3) of the pictures that come out."""
        before = Intrinsics(float(K[0, 0]), float(K[1, 1]), float(K[0, 2]), float(K[1, 2]))
        return np.array(before.through(self.crop, *self.size).matrix())

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Of (H, W, 3) or (H, W); an array of its own in any case."""
        if self._cuts_only:
            return np.array(image[self._part])
        from PIL import Image

        x, y, width, height = self.crop
        picture = Image.fromarray(image)
        scaled = picture.resize(self.size, Image.Resampling.BOX, box=(x, y, x + width, y + height))
        result: NDArray[np.uint8] = np.asarray(scaled, np.uint8).copy()
        return result

    def depth(self, image: NDArray[Any]) -> NDArray[Any]:
        """Of (H, W) of any type; an array of its own in any case."""
        return image[self._part].copy() if self._cuts_only else np.ascontiguousarray(image[self._nearest])
