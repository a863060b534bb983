"""What a camera says of itself when it is open, as plain data for the app's process, and there as a record."""

from __future__ import annotations

from collections.abc import Mapping
from types import MappingProxyType
from typing import Any

from hal.driver import CameraInfo, StreamInfo
from hal.geometry import Pose, frozen

__all__ = ["info_of"]


def info_of(said: Mapping[str, Any]) -> CameraInfo:
    """The record, from what :meth:`.station.Station.open` says."""
    streams = {
        name: StreamInfo(
            format=stream["format"],
            width=stream["width"],
            height=stream["height"],
            rate_hz=stream["rate_hz"],
            K=frozen(stream["K"]),
            distortion=frozen(stream["distortion"]),
            T_color_stream=Pose(*stream["T_color_stream"]),
        )
        for name, stream in said["streams"].items()
    }
    return CameraInfo(
        title=said["title"],
        K=frozen(said["K"]),
        distortion=frozen(said["distortion"]),
        K_infrared=frozen(said["K_infrared"]) if said["K_infrared"] is not None else None,
        clock=said["clock"],
        serial=said["serial"],
        firmware=said["firmware"],
        usb=said["usb"],
        depth_scale=said["depth_scale"],
        streams=MappingProxyType(streams),
        options=MappingProxyType(dict(said["options"])),
    )
