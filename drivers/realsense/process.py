"""Main program of the process in which librealsense runs for one camera, and with which it can be killed.

The library blocks in ways that no thread is safe from. Measured with pyrealsense2 2.59: ``pipeline.start`` holds the
interpreter's lock for as long as it takes, 15 s if the camera is not connected; so do the calls that search for cameras
and open them (``wrappers/python`` gives no other thread a turn in them). In the app's process that would stop the
thread that keeps a dead-man alive, and so the arm, whenever a camera is plugged in again. ``pipeline.stop`` is known to
hang (librealsense issue 7252), and a library that crashes takes its process with it.
"""

from __future__ import annotations

import os
import time
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

from hal.errors import ConnectionLost
from hal.host.process import Channel, SharedMemory, serve
from hal.host.ring import FrameRing
from hal.host.scheduling import yield_to_others
from hal.specs import CameraSpec, from_json

from .device import RealSenseDevice, find_cameras

_NICE = 5
"""Frames have a lower priority than the servo."""
_CHECK = 0.5
"""s between two checks whether the app still runs."""
_LINGER = 6.0
"""s that the process of a closed camera waits for the next request. An app that lost its camera opens it again, and an
emulated one must still exist then."""
_TAKEN = 5.0
"""s for the app to take a message; an app that does not has ended or is stopped for good."""


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Serve one camera, whose record is in ``config``, until the app closes it or ends; frames go into the memory."""
    yield_to_others(_NICE)
    spec = from_json(CameraSpec, config["spec"])
    device = RealSenseDevice(spec, FrameRing(memories[0].buffer, spec), partial(_notify, channel))
    last_request = time.monotonic()

    def call(method: Callable[..., Any], **params: Any) -> Any:
        nonlocal last_request
        try:
            return method(**params)
        finally:
            last_request = time.monotonic()

    def wait_time() -> float | None:
        return _CHECK if device.is_open or time.monotonic() - last_request < _LINGER else None

    methods: dict[str, Callable[..., Any]] = {
        "open": device.open,
        "shut": device.close,
        "reset": device.reset,
        "inject": device.inject,
    }
    channel.send({"ready": True})
    try:
        serve(channel, {name: partial(call, method) for name, method in methods.items()}, wait_time, _TAKEN)
    finally:
        device.dispose()


def _notify(channel: Channel, news: dict[str, Any]) -> None:
    """Send news to the app. The news of a new frame may be dropped if the app is behind: it has older ones to read."""
    try:
        if "frame" in news:
            channel.send_if_free(news)
        else:
            channel.send(news, _TAKEN)
    except ConnectionLost:
        os._exit(0)  # the app has ended


def list_plugged(channel: Channel, memories: Sequence[SharedMemory], config: Any) -> None:
    """Entry point of a process that reports the connected cameras and ends."""
    import pyrealsense2 as rs

    channel.send({"ready": [str(found) for found in find_cameras(rs.context())]})
