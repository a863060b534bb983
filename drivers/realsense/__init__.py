"""Intel RealSense cameras, through librealsense."""

from __future__ import annotations

from hal.registry import DriverSpec

DRIVER = DriverSpec(
    name="realsense",
    camera="hal.drivers.realsense.camera:RealSenseCamera",
    checks={"camera": "hal.drivers.realsense.options:problems"},
    camera_preflight="hal.drivers.realsense.preflight:preflight",
    path_options=frozenset({"play", "record"}),
    requires={"pyrealsense2": "pip install 'robot-hal[realsense]'"},
)
