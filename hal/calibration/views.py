"""What belongs to one view: where the arm was, and where the camera saw the board's corners."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from ..geometry import Pose

__all__ = ["Eye", "Sighting", "View", "camera_matrix"]

Array = NDArray[np.float64]

Eye = Literal["in-hand", "to-hand"]
"""The camera is on a link of the arm and the board stands still, or the camera stands still and a link carries the
board."""


@dataclass(frozen=True, eq=False)
class Sighting:
    """The board in one picture."""

    points: Array
    """(n, 3) corners in the board's frame, m."""
    pixels: Array
    """(n, 2) where a camera with this ``K`` and no distortion sees them; (0, 0) is the centre of the first pixel."""
    K: Array
    """(3, 3)"""
    T_camera_board: Pose
    """The board in the camera's optical frame, by this picture alone."""
    error_px: float
    """How far the corners are from where that pose puts them, rms."""
    blur_px: float = 0.0
    """Width of the edges between black and white."""


@dataclass(frozen=True, eq=False)
class View:
    """One picture of an arm at rest."""

    name: str
    T_world_link: Pose
    """The link that carries the camera, or the board."""
    sighting: Sighting
    q: Array | None = None
    """The arm's joints, rad."""
    T_color_eye: Pose = field(default_factory=Pose)
    """The optical frame that the picture is of, in the colour sensor's; the same in all views of a camera."""


def camera_matrix(eye: Eye, view: View) -> Array:
    """A (4, 4): the frame that the camera is fixed in, given in the frame that the board is fixed in.

    With it both cases are one: ``A X C = Z`` in every view, with X the camera where it is fixed, C the board seen
    from the camera, and Z the board where it is fixed.
    """
    link = view.T_world_link
    return (link if eye == "in-hand" else link.inverse()).matrix()
