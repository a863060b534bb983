"""librealsense's pipeline for one session: stream profiles, lenses, and the start and stop of a camera or a recording.

A pipeline never recovers from a lost camera; the next session has a new one.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, NamedTuple, Protocol

import numpy as np
import pyrealsense2 as rs
from numpy.typing import NDArray

from hal.errors import ConnectionLost, ControlTaken, NotSupported
from hal.geometry import Pose
from hal.images import Cropping
from hal.specs import CameraSpec, SensorSpec

from .options import FORMATS

Array = NDArray[np.float64]

_QUEUE = 4
"""Frame sets that wait in the library, at most."""
_BUSY = ("busy", "in use", "power state")
"""Words of the library's error if another program has the camera."""
_STREAMS = {
    "color": (rs.stream.color, (0,)),
    "depth": (rs.stream.depth, (0,)),
    "infrared": (rs.stream.infrared, (1, 0)),  # stereo cameras count their two from 1, an L515 has one
    "infrared_right": (rs.stream.infrared, (2,)),
}
"""Stream names of the rig file -> the library's stream type, and its possible indices."""
_GRID = 25
"""Pixels along each edge to which a lens is fitted."""


class FramePipeline(Protocol):
    """A source of frame sets."""

    is_live: bool
    """Whether its stamps belong to the present."""

    def wait(self, timeout: float) -> Any | None:
        """Return the next frame set (``rs2::frameset``); None if none came within ``timeout`` s."""

    def poll(self) -> Any | None:
        """Return another frame set that is already there; None if there is none."""

    def end_reason(self) -> ConnectionLost | None:
        """Return why no more frame sets will come; None as far as is known."""

    def stop(self) -> None:
        """Stop. Lets other threads run; a library that hangs in it never returns (librealsense issue 7252)."""


class LivePipeline:
    """A streaming camera, real or emulated."""

    is_live = True

    def __init__(self, context: Any, device: Any, serial: str, profiles: Mapping[str, Any], record: str | None) -> None:
        """Start streaming the chosen profiles; ``record`` is a file to record to.

        Raises ConnectionLost (code ``no_frames``) if the camera does not start, ControlTaken if another program has it.
        """
        self._device = device
        self._removed = threading.Event()
        self._pipeline = rs.pipeline(context)
        # A queue of our own: the pipeline's restarts the camera when it is gone, and waits 15 s for that.
        self._queue = rs.frame_queue(_QUEUE)
        config = _config(profiles)
        config.enable_device(serial)
        if record is not None:
            config.enable_record_to_file(record)
        _start(lambda: self._pipeline.start(config, self._queue), serial, "no_frames")

    def wait(self, timeout: float) -> Any | None:
        arrived, frame = self._queue.try_wait_for_frame(round(timeout * 1000.0))
        return frame.as_frameset() if arrived else None

    def poll(self) -> Any | None:
        frame = self._queue.poll_for_frame()
        return frame.as_frameset() if frame else None

    def handle_removal(self, change: Any) -> None:
        """Note whether this camera is among the removed ones of a change of devices (``rs2::event_information``)."""
        if change.was_removed(self._device):
            self._removed.set()

    def end_reason(self) -> ConnectionLost | None:
        if self._removed.is_set() or not self._device.is_connected():
            return ConnectionLost("it was unplugged, or its USB port was reset", code="unplugged")
        return None

    def stop(self) -> None:
        self._pipeline.stop()


class PlaybackPipeline:
    is_live = False

    def __init__(self, context: Any, file: str, profiles: Mapping[str, Any], *, repeat: bool, paced: bool) -> None:
        """Start playing the chosen profiles of a recording. Raises ConnectionLost if it does not start.

        Without ``paced``, frames come as fast as they are taken; with ``repeat``, it starts again at its end.
        """
        self._file = file
        self._repeat = repeat
        self._pipeline = rs.pipeline(context)
        config = _config(profiles)
        rs.config.enable_device_from_file(config, file, repeat)
        # Each look-up of a file creates a new device; the one that a configuration resolves to is the one that plays.
        self._playback = config.resolve(rs.pipeline_wrapper(self._pipeline)).get_device().as_playback()
        self._playback.set_real_time(paced)
        # With the pipeline's own queue: unpaced playback fills it even if there is one of ours.
        _start(lambda: self._pipeline.start(config), file, "unplayable")

    def wait(self, timeout: float) -> Any | None:
        arrived, frames = self._pipeline.try_wait_for_frames(round(timeout * 1000.0))
        return frames if arrived else None

    def poll(self) -> Any | None:
        return None  # its queue holds one set

    def end_reason(self) -> ConnectionLost | None:
        if self._repeat or self._playback.current_status() != rs.playback_status.stopped:
            return None
        text = f"the recording {self._file} has ended; open the rig again to replay it"
        lost = ConnectionLost(text, code="recording_ended")
        lost.final = True
        return lost

    def stop(self) -> None:
        self._pipeline.stop()


def _config(profiles: Mapping[str, Any]) -> Any:
    config = rs.config()
    for profile in profiles.values():
        config.enable_stream(
            profile.stream_type(),
            profile.stream_index(),
            profile.width(),
            profile.height(),
            profile.format(),
            profile.fps(),
        )
    return config


def _start(start: Callable[[], Any], what: str, code: str) -> None:
    try:
        start()
    except RuntimeError as error:
        text = str(error)
        if any(word in text.lower() for word in _BUSY):
            raise ControlTaken(f"{what} is in use by another program: {text}", code="device_busy") from None
        raise ConnectionLost(f"{what} does not start: {text}", code=code) from None


# Stream profiles.


def choose_profiles(device: Any, spec: CameraSpec) -> dict[str, Any]:
    """Return the library's profile (``rs2::video_stream_profile``) for each stream of a camera's record, by name.

    Raises NotSupported if the camera lacks a stream or a mode; lists the modes that it has.
    """
    profiles = [
        profile.as_video_stream_profile()
        for sensor in device.query_sensors()
        for profile in sensor.get_stream_profiles()
        if profile.is_video_stream_profile()
    ]
    return {name: _choose_profile(name, spec, profiles) for name in spec.streams}


def _choose_profile(name: str, spec: CameraSpec, profiles: list[Any]) -> Any:
    sensor = spec.sensors.get(name) or SensorSpec(spec.capture_width, spec.capture_height, spec.rate_hz, spec.K)
    formats = (sensor.format,) if sensor.format is not None else FORMATS[name]
    kind, indices = _STREAMS[name]
    available = [p for p in profiles if p.stream_type() == kind and p.stream_index() in indices]
    if not available:
        raise NotSupported(f"stream {name}: this camera has none", code="unknown_stream")
    size = (sensor.width, sensor.height)
    fitting = [p for p in available if (p.width(), p.height()) == size and p.fps() == sensor.rate_hz]
    for choice in formats:  # the cheapest comes first
        for profile in fitting:
            if profile.format().name == choice:
                return profile
    mode = f"{size[0]}x{size[1]} at {sensor.rate_hz:g} Hz as {' or '.join(formats)}"
    text = f"stream {name}: this camera has no mode {mode}; it has: {_list_modes(available)}"
    raise NotSupported(text, code="unknown_mode")


def _list_modes(profiles: list[Any]) -> str:
    """Return ``640x480 at 15, 30 Hz (bgr8, rgb8); ...``, the largest sizes first."""
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


# Intrinsics and extrinsics.
#
# The library's pixel (0, 0) is the centre of the upper left pixel, as it is here (its wiki, "Projection in RealSense
# SDK 2.0"; src/proc/align.cpp takes x - 0.5 for the left edge of pixel x), so nothing is shifted.
#
# Its brown_conrady is OpenCV's model. The colour sensors of the D400 report inverse_brown_conrady, others
# modified_brown_conrady: both are close to it and not the same, and what the library computes for the former has
# changed between its versions. So OpenCV's five coefficients are fitted to what the library itself computes for a grid
# of pixels or rays; they enter linearly, so the fit is one linear least-squares problem.


class LensModel(NamedTuple):
    """Camera matrix and distortion of one stream, in OpenCV's terms."""

    K: Array
    """(3, 3), pixels."""
    distortion: Array
    """(5,) in OpenCV's order: k1, k2, p1, p2, k3."""
    residual: float
    """Largest distance between the fitted model and the library's own, pixels; 0 where nothing was fitted."""


def describe_optics(
    spec: CameraSpec, device: Any, profiles: Mapping[str, Any], cropping: Mapping[str, Cropping]
) -> dict[str, Any]:
    """Return the optical part of a camera's description as plain data.

    It has ``streams``, ``K``, ``distortion``, ``K_infrared`` and ``depth_scale`` of :class:`~hal.driver.CameraInfo`,
    and ``residual``: the largest of all streams (:class:`LensModel`), pixels.
    """
    color = profiles.get("color") or _any_color_profile(device)
    streams, lenses = {}, {}
    for name, profile in profiles.items():
        lens = lenses[name] = convert_intrinsics(profile.get_intrinsics())
        pose = _find_pose(spec, name, profile, color)
        streams[name] = {
            "format": profile.format().name,
            "width": profile.width(),
            "height": profile.height(),
            "rate_hz": float(profile.fps()),
            "K": lens.K.tolist(),
            "distortion": lens.distortion.tolist(),
            "T_color_stream": [pose.position.tolist(), pose.orientation.tolist()],
        }
    aligned = {"color", "depth"} <= set(profiles)
    view = spec.align if aligned else next(name for name in ("color", "depth", *profiles) if name in profiles)
    infrared = next((name for name in ("infrared", "infrared_right") if name in profiles), None)

    def matrix(stream: str) -> Any:
        return np.asarray(cropping[stream].matrix(lenses[stream].K)).tolist()

    return {
        "streams": streams,
        "K": matrix(view),
        "distortion": lenses[view].distortion.tolist(),
        "K_infrared": matrix(infrared) if infrared else None,
        "depth_scale": _read_depth_scale(device),
        "residual": max(lens.residual for lens in lenses.values()),
    }


def _any_color_profile(device: Any) -> Any | None:
    """Return any profile of the colour sensor, which has the extrinsics of the others even if it does not stream."""
    for sensor in device.query_sensors():
        for profile in sensor.get_stream_profiles():
            if profile.stream_type() == rs.stream.color:
                return profile
    return None


def _find_pose(spec: CameraSpec, name: str, profile: Any, color: Any | None) -> Pose:
    """Return a stream's pose in the colour sensor's frame: the camera's own, or the model's if it has none."""
    if color is not None:
        try:
            return convert_extrinsics(profile.get_extrinsics_to(color))
        except RuntimeError:
            pass
    sensor = spec.sensors.get(name)
    return Pose(sensor.position, sensor.orientation) if sensor is not None else Pose()


def _read_depth_scale(device: Any) -> float | None:
    try:
        return float(device.first_depth_sensor().get_depth_scale())
    except RuntimeError:
        return None


def convert_intrinsics(intrinsics: Any) -> LensModel:
    K = np.array(
        [[intrinsics.fx, 0.0, intrinsics.ppx], [0.0, intrinsics.fy, intrinsics.ppy], [0.0, 0.0, 1.0]], np.float64
    )
    coefficients = np.array(intrinsics.coeffs, np.float64)
    if intrinsics.model == rs.distortion.none or not coefficients.any():
        return LensModel(K, np.zeros(5), 0.0)
    if intrinsics.model == rs.distortion.brown_conrady:
        return LensModel(K, coefficients, 0.0)
    return _fit_lens(intrinsics, K)


def _fit_lens(intrinsics: Any, K: Array) -> LensModel:
    columns = np.linspace(0.0, intrinsics.width - 1.0, _GRID)
    rows = np.linspace(0.0, intrinsics.height - 1.0, _GRID)
    pixels = np.stack(np.meshgrid(columns, rows), axis=-1).reshape(-1, 2)
    focal = K[[0, 1], [0, 1]]
    if intrinsics.model == rs.distortion.inverse_brown_conrady:
        rays = np.array([rs.rs2_deproject_pixel_to_point(intrinsics, pixel.tolist(), 1.0) for pixel in pixels])
    else:  # the library converts these from rays to pixels only
        rays = np.column_stack([(pixels - K[:2, 2]) / focal, np.ones(len(pixels))])
        pixels = np.array([rs.rs2_project_point_to_pixel(intrinsics, ray.tolist()) for ray in rays])
    x, y = rays[:, 0], rays[:, 1]
    shift = (pixels - K[:2, 2]) / focal - rays[:, :2]
    r2 = x * x + y * y
    radial, tangential = r2[:, None] ** (1, 2, 3), 2.0 * x * y
    along_x = np.column_stack([x * radial[:, 0], x * radial[:, 1], tangential, r2 + 2.0 * x * x, x * radial[:, 2]])
    along_y = np.column_stack([y * radial[:, 0], y * radial[:, 1], r2 + 2.0 * y * y, tangential, y * radial[:, 2]])
    system = np.concatenate([along_x * focal[0], along_y * focal[1]])  # in pixels, so that their error is minimised
    target = np.concatenate([shift[:, 0] * focal[0], shift[:, 1] * focal[1]])
    distortion, *_ = np.linalg.lstsq(system, target, rcond=None)
    errors = (system @ distortion - target).reshape(2, -1)
    return LensModel(K, distortion, float(np.hypot(*errors).max()))


def convert_extrinsics(extrinsics: Any) -> Pose:
    """Convert ``rs2::extrinsics``, which take points of one stream to another, to the first one's pose in the second's
    frame."""
    matrix = np.eye(4)
    matrix[:3, :3] = np.array(extrinsics.rotation, np.float64).reshape(3, 3).T  # stored column by column
    matrix[:3, 3] = extrinsics.translation
    return Pose.from_matrix(matrix)
