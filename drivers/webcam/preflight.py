"""Checks of webcams and videos before the rig is opened: whether they can be opened, and their frame rate."""

from __future__ import annotations

from collections.abc import Iterator

from hal.driver import CameraDriver
from hal.errors import HalError
from hal.preflight import CheckResult, check_frames
from hal.specs import CameraSpec

from .capture import V4l2Camera
from .video import VideoCamera


def check_v4l2(spec: CameraSpec, duration: float) -> Iterator[CheckResult]:
    """Open a webcam, measure its frames for ``duration`` s, and close it; yield a result for each of both."""
    yield from _check(
        V4l2Camera(spec),
        duration,
        slow="add light, or set exposure_s: many cameras slow down in the dark",
        lossy="use another USB port, or mjpeg",
        silent="unplug it and plug it in again",
    )


def check_video(spec: CameraSpec, duration: float) -> Iterator[CheckResult]:
    """Open a video, measure its frames for ``duration`` s, and close it; yield a result for each of both."""
    yield from _check(
        VideoCamera(spec),
        duration,
        slow="set capture.rate_hz to the rate at which it is sent, or use a smaller size, which is decoded faster",
        lossy="use a smaller size, or a computer with less load",
        silent="check what sends it",
    )


def _check(driver: CameraDriver, duration: float, slow: str, lossy: str, silent: str) -> Iterator[CheckResult]:
    try:
        driver.open()
        info = driver.info
        yield CheckResult("camera", "ok", f'{info.title}, serial "{info.serial}"' if info.serial else info.title)
        yield check_frames(driver, duration, slow, lossy, silent)
    except HalError as error:
        yield CheckResult("camera", "fail", str(error))
    finally:
        driver.close()
