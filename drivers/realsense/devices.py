"""Which RealSense cameras are plugged in, which of them a rig means, and who has it."""

from __future__ import annotations

from typing import Any, NamedTuple

import pyrealsense2 as rs

from hal.errors import DeviceNotFound
from hal.lock import DeviceLock

__all__ = ["Found", "claim_camera", "find", "found_in", "said"]


class Found(NamedTuple):
    """A camera that is plugged in."""

    device: Any
    """``rs2::device``"""
    title: str
    serial: str
    firmware: str | None
    usb: str | None

    def __str__(self) -> str:
        link = f", USB {self.usb}" if self.usb else ""
        return f"{self.title} (serial {self.serial}{link})"


def found_in(context: Any) -> list[Found]:
    """The cameras of a context, those that do not even say who they are left out."""
    found = []
    for device in context.query_devices():
        serial = said(device, rs.camera_info.serial_number)
        if serial:
            found.append(described(device, serial))
    return found


def described(device: Any, serial: str) -> Found:
    """A device with what it says of itself."""
    return Found(
        device,
        said(device, rs.camera_info.name) or "a RealSense",
        serial,
        said(device, rs.camera_info.firmware_version),
        said(device, rs.camera_info.usb_type_descriptor),
    )


def said(device: Any, what: Any) -> str | None:
    """One thing that a device says of itself; None where it does not."""
    try:
        return str(device.get_info(what)) if device.supports(what) else None
    except RuntimeError:  # it is being unplugged
        return None


def find(context: Any, serial: str | None, camera: str = "") -> Found:
    """The camera of that serial number, or the only one. Raises DeviceNotFound, which lists what is plugged in.

    The library is asked what there is: told to start a camera that is not there, it would wait for 15 s.
    """
    who = f"camera {camera}: " if camera else ""
    found = found_in(context)
    listed = ", ".join(map(str, found)) or "no RealSense at all"
    if serial is not None:
        for one in found:
            if one.serial == serial:
                return one
        raise DeviceNotFound(f"{who}there is no RealSense with serial {serial}; plugged in: {listed}")
    if len(found) == 1:
        return found[0]
    if not found:
        raise DeviceNotFound(f"{who}no RealSense is plugged in (is the cable in, and a USB 3 port?)")
    raise DeviceNotFound(f'{who}several are plugged in: {listed}; say which one: real: {{serial: "{found[0].serial}"}}')


def claim_camera(serial: str) -> DeviceLock:
    """Hold the camera of that serial number for this process. Raises ControlTaken, with the other program's number."""
    return DeviceLock(f"realsense-{serial}", f"camera {serial}")
