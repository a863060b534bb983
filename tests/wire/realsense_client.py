"""The vendor's library as a client of an emulated RealSense, without the driver."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pyrealsense2 as rs

from hal.specs import CameraSpec
from hal.testing import camera_spec
from hal_emulators.realsense import SoftwareCamera, emulated_context

PATIENCE = 10.0
"""s within which a first picture comes on a busy machine."""
VGA = camera_spec(width=640, height=480, streams=("color", "depth", "infrared"))
STREAMS = {"depth": ("depth", 0), "color": ("color", 0), "infrared": ("infrared", 1), "infrared_right": ("infrared", 2)}


class Picture(NamedTuple):
    """One frame of a set, copied."""

    number: int
    stamp: float
    """s"""
    domain: str
    pixels: np.ndarray


class Client:
    """A pipeline on a camera. The context must outlive it."""

    def __init__(self, context: Any, serial: str, *streams: str, color: str = "rgb8", **mode: int) -> None:
        self.pipeline = rs.pipeline(context)
        config = rs.config()
        config.enable_device(serial)
        self.streams = streams or ("depth", "color", "infrared")
        size, rate = (mode.get("width", 640), mode.get("height", 480)), mode.get("rate", 30)
        for name in self.streams:
            kind, index = STREAMS[name]
            format = {"depth": "z16", "color": color}.get(name, "y8")
            config.enable_stream(getattr(rs.stream, kind), index, *size, getattr(rs.format, format), rate)
        self.profile = self.pipeline.start(config)

    def set(self, timeout: float = PATIENCE) -> dict[str, Picture]:
        """Return the next frame set with all streams in it."""
        deadline = time.monotonic() + timeout
        while time.monotonic() < deadline:
            arrived, frames = self.pipeline.try_wait_for_frames(200)
            if arrived and len(found := pictures(frames, self.streams)) == len(self.streams):
                return found
        raise AssertionError(f"no set of {self.streams} within {timeout} s")

    def whole(self) -> dict[str, Picture]:
        """Return the next set whose frames all have the same number: sensors do not start at the same time."""
        for _ in range(30):
            found = self.set()
            if len({picture.number for picture in found.values()}) == 1:
                return found
        raise AssertionError("30 sets and none that belongs together")

    def silent(self, seconds: float) -> bool:
        """Return whether nothing new arrives for that long, apart from what was on its way."""
        while self.pipeline.poll_for_frames():
            pass
        arrived, _ = self.pipeline.try_wait_for_frames(round(1e3 * seconds))
        return not arrived

    def stop(self) -> None:
        self.pipeline.stop()


def pictures(frames: Any, streams: tuple[str, ...]) -> dict[str, Picture]:
    """Return the wanted frames of a set, by the stream names of a rig file."""
    found = {}
    for frame in frames:
        kind = (frame.profile.stream_type().name, frame.profile.stream_index())
        name = next(name for name, known in STREAMS.items() if known == kind)
        if name in streams:
            domain = frame.get_frame_timestamp_domain().name
            pixels = np.asanyarray(frame.get_data()).copy()
            found[name] = Picture(frame.get_frame_number(), frame.get_timestamp() / 1e3, domain, pixels)
    return found


def played(
    path: Path, *, paced: bool = False, streams: tuple[str, ...] = ("depth", "color", "infrared")
) -> Iterator[dict[str, Picture]]:
    """Play a recording to its end; the first one or two sets may come before their last stream is started."""
    context = rs.context()
    device = context.load_device(str(path))
    pipeline = rs.pipeline(context)
    pipeline.set_device(device)  # with the file's name it would open the file again, without this:
    device.set_real_time(paced)
    pipeline.start(rs.config())
    try:
        while True:
            arrived, frames = pipeline.try_wait_for_frames(1000)
            if not arrived:
                return
            yield pictures(frames, streams)
    finally:
        pipeline.stop()


def listed(context: Any) -> list[str]:
    """Return the serial numbers of the connected cameras."""
    return [device.get_info(rs.camera_info.serial_number) for device in context.query_devices()]


class Bench:
    """A camera in a context, and the announcements of the context."""

    def __init__(self, spec: CameraSpec = VGA, context: Any = None, **options: Any) -> None:
        self.context = context if context is not None else emulated_context()
        self._clients: list[Client] = []
        self.announced: list[tuple[list[str], list[bool]]] = []
        """(serials that came, whether each watched device went)"""
        self.watched: list[Any] = []
        self.context.set_devices_changed_callback(self._note)
        self.camera = SoftwareCamera(spec, **options)
        self.camera.attach(self.context)

    def _note(self, change: Any) -> None:
        came = [device.get_info(rs.camera_info.serial_number) for device in change.get_new_devices()]
        self.announced.append((came, [change.was_removed(device) for device in self.watched]))

    def client(self, *streams: str, **options: Any) -> Client:
        """Start a pipeline on this camera."""
        self._clients.append(Client(self.context, self.camera.serial, *streams, **options))
        return self._clients[-1]

    def close(self) -> None:
        """Stop the pipelines, and remove the camera."""
        for client in self._clients:
            with contextlib.suppress(RuntimeError):  # it was stopped
                client.stop()
        self.camera.close()
