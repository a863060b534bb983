"""Which of a camera's modes a rig means: one stream profile of the library for each stream."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple

import pyrealsense2 as rs

from hal.errors import NotSupported
from hal.specs import CameraSpec, SensorSpec

from .settings import FORMATS

__all__ = ["choose", "wanted_of"]

_STREAMS = {
    "color": (rs.stream.color, (0,)),
    "depth": (rs.stream.depth, (0,)),
    "infrared": (rs.stream.infrared, (1, 0)),  # stereo cameras count their two from 1, an L515 has one
    "infrared_right": (rs.stream.infrared, (2,)),
}
"""Streams by the names of a rig's file -> the library's kind, and the numbers that it may have there."""


class _Wanted(NamedTuple):
    width: int
    height: int
    rate_hz: float
    formats: tuple[str, ...]


def wanted_of(spec: CameraSpec) -> dict[str, _Wanted]:
    """Size, rate and possible formats of each stream that the rig wants."""
    wanted = {}
    for name in spec.streams:
        sensor = spec.sensors.get(name) or SensorSpec(spec.capture_width, spec.capture_height, spec.rate_hz, spec.K)
        formats = (sensor.format,) if sensor.format is not None else FORMATS[name]
        wanted[name] = _Wanted(sensor.width, sensor.height, sensor.rate_hz, formats)
    return wanted


def choose(device: Any, spec: CameraSpec) -> dict[str, Any]:
    """The profile (``rs2::video_stream_profile``) for each stream. Raises NotSupported, which lists what there is."""
    profiles = [
        profile.as_video_stream_profile()
        for sensor in device.query_sensors()
        for profile in sensor.get_stream_profiles()
        if profile.is_video_stream_profile()
    ]
    return {name: _one(name, wanted, profiles) for name, wanted in wanted_of(spec).items()}


def _one(name: str, wanted: _Wanted, profiles: list[Any]) -> Any:
    kind, numbers = _STREAMS[name]
    there = [p for p in profiles if p.stream_type() == kind and p.stream_index() in numbers]
    size = (wanted.width, wanted.height)
    fit = [p for p in there if (p.width(), p.height()) == size and p.fps() == wanted.rate_hz]
    for choice in wanted.formats:  # the cheapest comes first
        for profile in fit:
            if profile.format().name == choice:
                return profile
    asked = f"{size[0]}x{size[1]} at {wanted.rate_hz:g} Hz as {' or '.join(wanted.formats)}"
    if not there:
        raise NotSupported(f"stream {name}: this camera has none")
    raise NotSupported(f"stream {name}: this camera has no mode {asked}; it has: {_listed(there)}")


def _listed(profiles: list[Any]) -> str:
    """``640x480 at 15, 30 Hz (bgr8, rgb8); ...``, the largest pictures first."""
    rates: dict[tuple[int, int], set[int]] = {}
    formats: dict[tuple[int, int], set[str]] = {}
    for profile in profiles:
        size = (profile.width(), profile.height())
        rates.setdefault(size, set()).add(profile.fps())
        formats.setdefault(size, set()).add(profile.format().name)
    return "; ".join(
        f"{width}x{height} at {', '.join(map(str, sorted(rates[width, height])))} Hz"
        f" ({', '.join(sorted(formats[width, height]))})"
        for width, height in sorted(rates, reverse=True)
    )


def rates_of(chosen: Mapping[str, Any]) -> dict[str, float]:
    """Pictures a second of each stream."""
    return {name: float(profile.fps()) for name, profile in chosen.items()}
