"""librealsense's Python package, imported when it is first needed."""

from __future__ import annotations

from typing import Any

from hal.errors import DriverMissing

__all__ = ["load_realsense"]


def load_realsense() -> Any:
    """The ``pyrealsense2`` module. Raises DriverMissing when it is not installed."""
    try:
        import pyrealsense2
    except ImportError as error:
        raise DriverMissing(
            f"an emulated RealSense is made of librealsense ({error}); "
            "install it with: pip install 'robot-hal[realsense]'",
            name="pyrealsense2",
        ) from error
    return pyrealsense2
