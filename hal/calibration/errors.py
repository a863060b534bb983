"""What can go wrong with a calibration."""

from __future__ import annotations

from ..errors import HalError

__all__ = ["CalibrationFailed", "NoView"]


class CalibrationFailed(HalError, ValueError):
    """The views do not tell where the camera is. The message says why, and what to do. Nothing was written."""


class NoView(HalError, ValueError):
    """This picture cannot be used. The message says why; the next one may be."""
