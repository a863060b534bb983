"""Camera matrices: from an angle of view, and through a centre crop and a scaling.

OpenCV's convention: the centre of the upper left pixel is (0, 0), so a picture of width w reaches from -1/2 to w - 1/2.
"""

from __future__ import annotations

import math
from typing import NamedTuple

__all__ = ["Crop", "Intrinsics", "centre_crop", "from_field_of_view"]


class Crop(NamedTuple):
    """A part of a picture, pixels."""

    x: int
    y: int
    width: int
    height: int


class Intrinsics(NamedTuple):
    """Focal lengths and principal point, pixels."""

    fx: float
    fy: float
    cx: float
    cy: float

    def through(self, crop: Crop, width: int, height: int) -> Intrinsics:
        """Of the picture that is cut out and scaled to ``width`` x ``height``."""
        sx, sy = width / crop.width, height / crop.height
        return Intrinsics(
            self.fx * sx,
            self.fy * sy,
            (self.cx - crop.x + 0.5) * sx - 0.5,
            (self.cy - crop.y + 0.5) * sy - 0.5,
        )

    def matrix(self) -> tuple[tuple[float, float, float], tuple[float, float, float], tuple[float, float, float]]:
        """The camera matrix K."""
        return (self.fx, 0.0, self.cx), (0.0, self.fy, self.cy), (0.0, 0.0, 1.0)


def centre_crop(width: int, height: int, out_width: int, out_height: int) -> Crop:
    """The largest part in the middle of a picture that has the shape of the output, to the nearest pixel."""
    if width * out_height > height * out_width:
        cut_width, cut_height = max(1, round(height * out_width / out_height)), height
    else:
        cut_width, cut_height = width, max(1, round(width * out_height / out_width))
    return Crop((width - cut_width) // 2, (height - cut_height) // 2, cut_width, cut_height)


def from_field_of_view(
    width: int,
    height: int,
    horizontal_deg: float | None,
    vertical_deg: float | None,
    sensor: tuple[int, int] | None = None,
) -> Intrinsics:
    """Of a mode ``width`` x ``height`` of a camera that sees these angles, from edge to edge, and has no offset.

    The angles are those of the picture that is ``sensor`` pixels large, of which a mode of another shape is the
    largest part in the middle; of the mode itself when None. One angle alone means square pixels.
    """
    full_width, full_height = sensor or (width, height)
    fx = full_width / 2 / math.tan(math.radians(horizontal_deg) / 2) if horizontal_deg is not None else None
    fy = full_height / 2 / math.tan(math.radians(vertical_deg) / 2) if vertical_deg is not None else None
    if fx is None and fy is None:
        raise ValueError("an angle of view is needed")
    fx, fy = fx if fx is not None else fy, fy if fy is not None else fx
    assert fx is not None
    assert fy is not None
    scale = max(width / full_width, height / full_height)  # the mode's pixels for each of the sensor's
    return Intrinsics(fx * scale, fy * scale, (width - 1) / 2, (height - 1) / 2)
