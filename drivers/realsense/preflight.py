"""Check of a rig's RealSense before the rig is opened: connected, on USB 3, and with its frame rate."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

from hal.driver import CameraInfo
from hal.errors import ConnectionLost, ControlTaken, DeviceNotFound, HalError, NotSupported
from hal.preflight import CheckResult, check_frames
from hal.specs import CameraSpec

from .camera import RealSenseCamera

_CABLE = "plug it into a USB 3 port (blue, or marked SS) of the computer itself, with the cable that came with it"
_LOAD = "use a USB 3 port of its own, fewer or smaller streams, or a computer with less load"
_DARK = "add light, or set color.auto_exposure_priority to 0: in the dark the camera lowers its frame rate"
_REMEDIES: dict[type[HalError], str] = {
    DeviceNotFound: "plug it in; `rs-enumerate-devices` of librealsense lists what the system sees",
    ControlTaken: "end the other program",
    NotSupported: "change the rig file to what the camera has",
    ConnectionLost: "unplug it, wait for 5 s, plug it in again",
}


def preflight(spec: CameraSpec, duration: float) -> Iterator[CheckResult]:
    """Open the camera, measure its frames for ``duration`` s, and close it. ``record`` is ignored."""
    options = {name: value for name, value in spec.options.items() if name not in ("record", "overwrite")}
    driver = RealSenseCamera(replace(spec, options=options))
    try:
        try:
            driver.open()
        except HalError as error:
            remedy = next((text for kind, text in _REMEDIES.items() if isinstance(error, kind)), "")
            yield CheckResult("camera", "fail", str(error), remedy)
            return
        info = driver.info
        yield CheckResult("camera", "ok", f"{info.title}, serial {info.serial}, firmware {info.firmware}")
        yield _check_link(info)
        yield check_frames(driver, duration, slow=_DARK, lossy=_LOAD, silent=_REMEDIES[ConnectionLost])
    finally:
        driver.close()


def _check_link(info: CameraInfo) -> CheckResult:
    if info.usb is None:
        return CheckResult("USB", "unknown", "the camera does not report its USB version")
    if info.usb.startswith("2"):
        return CheckResult("USB", "warn", f"USB {info.usb}: fewer modes, and frames get lost", _CABLE)
    return CheckResult("USB", "ok", f"USB {info.usb}")
