"""How an open camera sees, as plain data: each stream, and the pictures that are handed out."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import pyrealsense2 as rs

from hal.geometry import Pose
from hal.images import Cropping
from hal.specs import CameraSpec

from .lens import lens_of, pose_of

__all__ = ["calibration_of"]


def calibration_of(
    spec: CameraSpec, device: Any, chosen: Mapping[str, Any], cropping: Mapping[str, Cropping]
) -> dict[str, Any]:
    """``streams``, ``K``, ``distortion``, ``K_infrared`` and ``depth_scale`` of a camera's record.

    ``residual`` is by how much OpenCV's distortion misses the camera's at worst, pixels (:mod:`.lens`).
    """
    color = chosen.get("color") or _color_of(device)
    streams, lenses = {}, {}
    for name, profile in chosen.items():
        lens = lenses[name] = lens_of(profile.get_intrinsics())
        pose = _pose(spec, name, profile, color)
        streams[name] = {
            "format": profile.format().name,
            "width": profile.width(),
            "height": profile.height(),
            "rate_hz": float(profile.fps()),
            "K": lens.K.tolist(),
            "distortion": lens.distortion.tolist(),
            "T_color_stream": [pose.position.tolist(), pose.orientation.tolist()],
        }
    aligned = {"color", "depth"} <= set(chosen)
    view = spec.align if aligned else next(name for name in ("color", "depth", *chosen) if name in chosen)
    infrared = next((name for name in ("infrared", "infrared_right") if name in chosen), None)
    return {
        "streams": streams,
        "K": _matrix(cropping[view], lenses[view].K),
        "distortion": lenses[view].distortion.tolist(),
        "K_infrared": _matrix(cropping[infrared], lenses[infrared].K) if infrared else None,
        "depth_scale": _scale(device),
        "residual": max(lens.residual for lens in lenses.values()),
    }


def _matrix(cropping: Cropping, K: Any) -> list[list[float]]:
    matrix: list[list[float]] = np.asarray(cropping.matrix(K)).tolist()
    return matrix


def _color_of(device: Any) -> Any | None:
    """Any mode of the colour sensor, which knows where the others are even if it does not stream."""
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if profile.stream_type() == rs.stream.color:
                return profile
    return None


def _pose(spec: CameraSpec, name: str, profile: Any, color: Any | None) -> Pose:
    """The camera's own answer, and the model's figure where it has none."""
    if color is not None:
        try:
            return pose_of(profile.get_extrinsics_to(color))
        except RuntimeError:
            pass
    sensor = spec.sensors.get(name)
    return Pose(sensor.position, sensor.orientation) if sensor is not None else Pose()


def _scale(device: Any) -> float | None:
    try:
        return float(device.first_depth_sensor().get_depth_scale())
    except RuntimeError:
        return None
