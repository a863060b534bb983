"""Cameras without a library of their own: webcams on Video4Linux2, and videos from a file or a network.

See docs/cameras.md.
"""

from __future__ import annotations

from hal.registry import DriverSpec

_REQUIRES = {"av": "pip install 'robot-hal[record]'"}

V4L2 = DriverSpec(
    name="v4l2",
    camera="hal.drivers.webcam.capture:V4l2Camera",
    checks={"camera": "hal.drivers.webcam.settings:check_v4l2"},
    camera_preflight="hal.drivers.webcam.preflight:check_v4l2",
    requires=_REQUIRES,
)

VIDEO = DriverSpec(
    name="video",
    camera="hal.drivers.webcam.video:VideoCamera",
    checks={"camera": "hal.drivers.webcam.settings:check_video"},
    camera_preflight="hal.drivers.webcam.preflight:check_video",
    path_options=frozenset({"file"}),
    requires=_REQUIRES,
)
