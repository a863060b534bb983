"""OpenCV, which only the calibration needs: loaded when it is first used."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from ..errors import DriverMissing

__all__ = ["INSTALL", "opencv"]

INSTALL = "pip install 'robot-hal[calibration]'"


def opencv() -> Any:
    """The module ``cv2``, 4.8 or later. Raises DriverMissing, which names the command that installs it."""
    try:
        cv2 = import_module("cv2")
    except ImportError as error:
        raise DriverMissing(f"the board is found by OpenCV, which cannot be imported: {error}; {INSTALL}") from error
    if not hasattr(getattr(cv2, "aruco", None), "CharucoDetector"):
        version = getattr(cv2, "__version__", "?")
        raise DriverMissing(f"OpenCV {version} has no CharucoDetector, which came with 4.7; {INSTALL}")
    return cv2
