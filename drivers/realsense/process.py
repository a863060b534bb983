"""Main program of the process in which librealsense runs for one camera, and with which it can be killed.

The library blocks in ways that no thread is safe from. Measured with pyrealsense2 2.59: ``pipeline.start`` holds the
interpreter's lock for as long as it takes, 15 s if the camera is not connected; so do the calls that search for cameras
and open them (``wrappers/python`` gives no other thread a turn in them). In the app's process that would stop the
thread that keeps a dead-man alive, and so the arm, whenever a camera is plugged in again. ``pipeline.stop`` is known to
hang (librealsense issue 7252), and a library that crashes takes its process with it.
"""

from __future__ import annotations

import os
import threading
import time
from collections.abc import Sequence
from typing import Any

from hal.errors import CommandError, HalError
from hal.host.process import Channel, SharedMemory, pack_error
from hal.host.scheduling import yield_to_others
from hal.specs import CameraSpec, from_json

from .device import RealSenseDevice, find_cameras
from .ring import PictureRing

__all__ = ["list_plugged", "main"]

_NICE = 5
"""Frames have a lower priority than the servo."""
_CHECK = 0.5
"""s between two checks whether the app still runs."""
_LINGER = 6.0
"""s that the process of a closed camera waits for the next ``open``. An app that lost its camera opens it again, and an
emulated one must still exist then."""
_TAKEN = 5.0
"""s for the app to take a message; an app that does not has ended or is stopped for good."""


class _Sender:
    """Sends messages to the app from any thread, each of them whole."""

    def __init__(self, channel: Channel) -> None:
        self._channel = Channel(channel.sock.dup())  # the other one receives, with time limits of its own
        self._notifier = channel.sock.dup()
        self._lock = threading.Lock()

    def send(self, message: dict[str, Any]) -> None:
        """Send an answer, or news that must not be lost."""
        with self._lock:
            self._channel.send(message, _TAKEN)

    def notify(self, news: dict[str, Any]) -> None:
        """Send news. The news of a new frame may be dropped if the app is behind: it has older ones to read."""
        if "frame" not in news:
            self.send(news)
            return
        with self._lock:
            self._notifier.setblocking(False)
            try:
                self._notifier.send(b'{"frame": %d}\n' % news["frame"])
            except BlockingIOError:
                pass
            except OSError:
                os._exit(0)  # the app has ended


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Serve one camera until the app closes it or ends.

    Args:
        channel: Requests and answers.
        memories: The memory of the frame ring.
        config: ``spec``: the camera's record, as JSON.
    """
    yield_to_others(_NICE)
    parent = os.getppid()
    spec = from_json(CameraSpec, config["spec"])
    sender = _Sender(channel)
    device = RealSenseDevice(spec, PictureRing(memories[0].buffer, spec), sender.notify)
    sender.send({"ready": True})
    idle_since = time.monotonic()
    try:
        while os.getppid() == parent:
            message = channel.receive(_CHECK)
            if message is None:
                if not device.is_open and time.monotonic() - idle_since > _LINGER:
                    return
                continue
            if message["method"] == "close":  # the process; "shut" closes the camera
                return
            _answer(device, sender, message)
            idle_since = time.monotonic()
    finally:
        device.dispose()


def _answer(device: RealSenseDevice, sender: _Sender, message: dict[str, Any]) -> None:
    number, method, params = message["id"], message["method"], message["params"]
    try:
        result: Any = None
        if method == "open":
            result = device.open(**params)
        elif method == "shut":
            device.close()
        elif method == "reset":
            result = device.reset()
        elif method == "inject":
            device.inject(**params)
        else:
            raise CommandError(f"a camera's process has no request {method!r}", code="unknown_request")
    except (HalError, RuntimeError, TypeError, ValueError) as error:
        sender.send({"id": number, "error": pack_error(error)})
        return
    sender.send({"id": number, "result": result})


def list_plugged(channel: Channel, memories: Sequence[SharedMemory], config: Any) -> None:
    """Entry point of a process that reports the connected cameras and ends."""
    import pyrealsense2 as rs

    channel.send({"ready": [str(found) for found in find_cameras(rs.context())]})
