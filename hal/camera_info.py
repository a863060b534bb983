"""What a camera is, and how it sees: read once when it is opened."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from types import MappingProxyType

import numpy as np
from numpy.typing import NDArray

from .pose import Pose, frozen
from .specs import CameraSpec

__all__ = ["CameraInfo", "StreamInfo", "nominal_info"]

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class StreamInfo:
    """One stream as the sensor takes it: before alignment, crop and scaling."""

    format: str | None
    """Of the device (``bgr8``, ``z16``, ...); None where it has none."""
    width: int
    height: int
    rate_hz: float
    K: Array
    """(3, 3) camera matrix, pixels; the centre of the upper left pixel is (0, 0)."""
    distortion: Array
    """(5,) k1, k2, p1, p2, k3 (OpenCV's order)."""
    T_color_stream: Pose
    """Pose of this sensor's optical frame in that of the colour sensor; no turn and no shift for colour itself."""


@dataclass(frozen=True, slots=True, eq=False)
class CameraInfo:
    """A camera that is open. A real one reports its own calibration, a simulated one the model's figures."""

    title: str
    """Make and model, for people."""
    K: Array
    """(3, 3) of colour and depth as they are handed out: aligned, cropped and scaled."""
    distortion: Array
    """(5,) of the same, OpenCV's order."""
    K_infrared: Array | None
    """(3, 3) of both infrared pictures as they are handed out; they are never aligned. None without infrared."""
    clock: str
    """What ``Stamp.t_device`` counts: ``hardware`` (the sensor's own clock), ``global`` (that clock, brought by its
    library to the host's time of day), ``system`` (the host's time of day at arrival), ``simulated``."""
    serial: str | None = None
    firmware: str | None = None
    usb: str | None = None
    """The link that was found, for example ``3.2``; ``2.1`` means fewer modes and is worth another cable."""
    depth_scale: float | None = None
    """Metres in one unit of the raw depth picture."""
    streams: Mapping[str, StreamInfo] = field(default_factory=lambda: MappingProxyType({}))
    """Those that are on, by the names of the rig's file."""
    options: Mapping[str, float] = field(default_factory=lambda: MappingProxyType({}))
    """What the device could be told, with its present values."""


def nominal_info(spec: CameraSpec, clock: str, title: str = "") -> CameraInfo:
    """What a camera that knows no better says of itself: the figures of its spec."""
    streams = {
        name: StreamInfo(
            format=stream.format,
            width=stream.width,
            height=stream.height,
            rate_hz=stream.rate_hz,
            K=frozen(stream.K),
            distortion=frozen(spec.distortion),
            T_color_stream=Pose(stream.position, stream.orientation),
        )
        for name, stream in spec.sensors.items()
    }
    infrared = spec.K_infrared or (spec.K if {"infrared", "infrared_right"} & set(spec.streams) else None)
    return CameraInfo(
        title=title or spec.model,
        K=frozen(spec.K),
        distortion=frozen(spec.distortion),
        K_infrared=frozen(infrared) if infrared is not None else None,
        clock=clock,
        streams=MappingProxyType(streams),
    )
