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
    pixels: np.ndarray


class Client:
    """A pipeline on a camera. The context must outlive it."""

    def __init__(self, context: Any, serial: str, *streams: str, **mode: int) -> None:
        self.pipeline = rs.pipeline(context)
        config = rs.config()
        config.enable_device(serial)
        self.streams = streams or ("depth", "color", "infrared")
        size, rate = (mode.get("width", 640), mode.get("height", 480)), mode.get("rate", 30)
        for name in self.streams:
            kind, index = STREAMS[name]
            format = {"depth": "z16", "color": "rgb8"}.get(name, "y8")
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

    def stop(self) -> None:
        self.pipeline.stop()


def pictures(frames: Any, streams: tuple[str, ...]) -> dict[str, Picture]:
    """Return the wanted frames of a set, by the stream names of a rig file."""
    found = {}
    for frame in frames:
        kind = (frame.profile.stream_type().name, frame.profile.stream_index())
        name = next(name for name, known in STREAMS.items() if known == kind)
        if name in streams:
            found[name] = Picture(frame.get_frame_number(), np.asanyarray(frame.get_data()).copy())
    return found


def played(path: Path, streams: tuple[str, ...] = ("depth", "color", "infrared")) -> Iterator[dict[str, Picture]]:
    """Play a recording to its end; the first one or two sets may come before their last stream is started."""
    context = rs.context()
    device = context.load_device(str(path))
    pipeline = rs.pipeline(context)
    pipeline.set_device(device)  # with the file's name it would open the file again, without this:
    device.set_real_time(False)
    pipeline.start(rs.config())
    try:
        while True:
            arrived, frames = pipeline.try_wait_for_frames(1000)
            if not arrived:
                return
            yield pictures(frames, streams)
    finally:
        pipeline.stop()


class Bench:
    """A camera in a context of its own."""

    def __init__(self, spec: CameraSpec = VGA, **options: Any) -> None:
        self.context = emulated_context()
        self._clients: list[Client] = []
        self.camera = SoftwareCamera(spec, **options)
        self.camera.attach(self.context)

    def client(self, *streams: str, **options: int) -> Client:
        """Start a pipeline on this camera."""
        self._clients.append(Client(self.context, self.camera.serial, *streams, **options))
        return self._clients[-1]

    def close(self) -> None:
        """Stop the pipelines, and remove the camera."""
        for client in self._clients:
            with contextlib.suppress(RuntimeError):  # it was stopped
                client.stop()
        self.camera.close()
