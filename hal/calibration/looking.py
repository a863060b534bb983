"""Which of a camera's pictures is looked at, and whose eyes does it see with?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..driver import CameraInfo
from ..geometry import Pose
from ..types import Frame
from .errors import NoView

__all__ = ["Look", "look_of"]

Array = NDArray[np.float64]


class Look(NamedTuple):
    """One picture, and the optical frame that it is of."""

    picture: NDArray[np.uint8]
    """(H, W, 3) RGB, or (H, W)."""
    K: Array
    """(3, 3)"""
    distortion: Array
    """(5,)"""
    T_color_eye: Pose
    """Pose of that frame in the colour sensor's, which is the one that a rig's file speaks of."""


def look_of(frame: Frame, info: CameraInfo, align: str) -> Look:
    """Colour, or infrared where there is none. Raises NoView where there is neither.

    Args:
        frame: what the camera saw.
        info: of the camera.
        align: whose view colour is handed out in, ``color`` or ``depth``.
    """
    if frame.color is not None:
        depth = info.streams.get("depth") if align == "depth" else None
        return Look(frame.color, frame.K, frame.distortion, Pose() if depth is None else depth.T_color_stream)
    if frame.infrared is None:
        raise NoView("the camera streams neither colour nor infrared")
    K = frame.K if info.K_infrared is None else info.K_infrared
    sensor = info.streams.get("infrared")
    if sensor is None:  # all its streams are one view
        return Look(frame.infrared, K, frame.distortion, Pose())
    return Look(frame.infrared, K, sensor.distortion, sensor.T_color_stream)
