"""Before a rig is opened: is its RealSense there, is it on USB 3, and does it send what the rig wants, in time?"""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import replace

from hal.driver import CameraInfo
from hal.errors import ConnectionLost, ControlTaken, DeviceNotFound, HalError, NotSupported
from hal.preflight import CheckResult
from hal.specs import CameraSpec

from .camera import RealSenseCamera

__all__ = ["preflight"]

_GRAB = 0.2
_SLOW = 0.95
"""Share of the wanted rate below which something is wrong."""
_CABLE = "plug it into a USB 3 port (blue, or marked SS) of the computer itself, with the cable that came with it"
_LOAD = "use a USB 3 port of its own, fewer or smaller streams, or a computer with less to do"
_DARK = "give it light, or set color.auto_exposure_priority to 0: in the dark it takes fewer pictures"
_REMEDIES: dict[type[HalError], str] = {
    DeviceNotFound: "plug it in; `rs-enumerate-devices` of librealsense lists what the system sees",
    ControlTaken: "end the other program",
    NotSupported: "change the rig's file to what it has",
    ConnectionLost: "unplug it, wait for 5 s, plug it in again",
}


def preflight(spec: CameraSpec, duration: float) -> Iterator[CheckResult]:
    """Open the camera, watch it for ``duration`` s, close it. Nothing is written: ``record`` is left out."""
    quiet = {name: value for name, value in spec.options.items() if name not in ("record", "overwrite")}
    driver = RealSenseCamera(replace(spec, options=quiet))
    try:
        try:
            driver.open()
        except HalError as error:
            remedy = next((text for kind, text in _REMEDIES.items() if isinstance(error, kind)), "")
            yield CheckResult("camera", "fail", str(error), remedy)
            return
        info = driver.info
        yield CheckResult("camera", "ok", f"{info.title}, serial {info.serial}, firmware {info.firmware}")
        yield _link(info)
        yield _measured(driver, spec, duration)
    finally:
        driver.close()


def _link(info: CameraInfo) -> CheckResult:
    if info.usb is None:
        return CheckResult("USB", "unknown", "it does not say how it is plugged in")
    if info.usb.startswith("2"):
        return CheckResult("USB", "warn", f"USB {info.usb}: fewer modes, and frames get lost", _CABLE)
    return CheckResult("USB", "ok", f"USB {info.usb}")


def _measured(driver: RealSenseCamera, spec: CameraSpec, duration: float) -> CheckResult:
    """The rate of the captures, and how many were lost."""
    wanted = min((stream.rate_hz for stream in driver.info.streams.values()), default=spec.rate_hz)
    patience = time.monotonic() + 5.0  # automatic exposure settles first
    first = last = None
    frames, start = 0, 0.0
    try:
        while first is None and time.monotonic() < patience:
            first = driver.grab(_GRAB)
        if first is None:
            return CheckResult("pictures", "fail", "none came", _REMEDIES[ConnectionLost])
        start, last = time.monotonic(), first
        while time.monotonic() - start < duration:
            frame = driver.grab(_GRAB)
            if frame is not None:
                frames, last = frames + 1, frame
    except ConnectionLost as error:
        return CheckResult("pictures", "fail", str(error), _REMEDIES[ConnectionLost])
    passed = last.t - first.t
    rate = frames / passed if passed > 0.0 else 0.0
    lost = last.seq - first.seq - frames
    tally = driver.tally
    found = f"{rate:.1f} a second of {wanted:g}, {lost} of {frames + lost} lost"
    if tally.mismatched:
        found += f", {tally.mismatched} sets of pictures that do not belong together"
    if rate < _SLOW * wanted and not lost:
        return CheckResult("pictures", "warn", found, _DARK)
    if rate < _SLOW * wanted or lost > 0.02 * (frames + lost):
        return CheckResult("pictures", "warn", found, _LOAD)
    return CheckResult("pictures", "ok", found)
