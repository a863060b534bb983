"""The process in which librealsense lives for one camera, and can be ended with it.

The library blocks in ways that no thread is safe from. Measured with pyrealsense2 2.59: ``pipeline.start`` holds the
interpreter for as long as it takes, 15 s when the camera is not there; so do the calls that look for cameras and open
them (``wrappers/python`` gives no other thread a turn in them). In the app's process that would stop the thread that
keeps a dead-man alive, and so the arm, whenever a camera is plugged in again. ``pipeline.stop`` is known to hang
(librealsense issue 7252), and a library that crashes takes its process with it.
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

from .devices import found_in
from .ring import PictureRing
from .station import Station

__all__ = ["list_plugged", "main"]

_NICE = 5
"""Pictures come after the servo."""
_LOOK = 0.5
"""s between two looks whether the app is still there."""
_LINGER = 6.0
"""s that a closed camera's process waits for the next ``open``. An app that lost its camera comes back for it, and then
an emulated one must still be there."""
_TAKEN = 5.0
"""s for the app to take a message; one that does not is gone, or stopped for good."""


class _Mouth:
    """What the process says, from any thread, whole message by whole message."""

    def __init__(self, channel: Channel) -> None:
        self._channel = Channel(channel.sock.dup())  # the other one listens, with time limits of its own
        self._bell = channel.sock.dup()
        self._lock = threading.Lock()

    def say(self, message: dict[str, Any]) -> None:
        """Answers, and news that must not be lost."""
        with self._lock:
            self._channel.send(message, _TAKEN)

    def tell(self, news: dict[str, Any]) -> None:
        """News. That there is a picture may be lost: then the app is behind, and has older such news before it."""
        if "frame" not in news:
            self.say(news)
            return
        with self._lock:
            self._bell.setblocking(False)
            try:
                self._bell.send(b'{"frame": %d}\n' % news["frame"])
            except BlockingIOError:
                pass
            except OSError:
                os._exit(0)  # the app is gone


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process; its memory is that of the pictures."""
    yield_to_others(_NICE)
    parent = os.getppid()
    spec = from_json(CameraSpec, config["spec"])
    mouth = _Mouth(channel)
    station = Station(spec, PictureRing(memories[0].buffer, spec), mouth.tell)
    mouth.say({"ready": True})
    idle_since = time.monotonic()
    try:
        while os.getppid() == parent:
            message = channel.receive(_LOOK)
            if message is None:
                if not station.is_open and time.monotonic() - idle_since > _LINGER:
                    return
                continue
            if message["method"] == "close":  # of the process; the camera's own is "shut"
                return
            _answer(station, mouth, message)
            idle_since = time.monotonic()
    finally:
        station.end()


def _answer(station: Station, mouth: _Mouth, message: dict[str, Any]) -> None:
    number, method, params = message["id"], message["method"], message["params"]
    try:
        result: Any = None
        if method == "open":
            result = station.open(**params)
        elif method == "shut":
            station.close()
        elif method == "reset":
            result = station.reset()
        elif method == "inject":
            station.inject(**params)
        else:
            raise CommandError(f"a camera's process has no {method!r}")
    except (HalError, RuntimeError, TypeError, ValueError) as error:
        mouth.say({"id": number, "error": pack_error(error)})
        return
    mouth.say({"id": number, "result": result})


def list_plugged(channel: Channel, memories: Sequence[SharedMemory], config: Any) -> None:
    """Entry point of a process that says what is plugged in, and ends."""
    import pyrealsense2 as rs

    channel.send({"ready": [str(found) for found in found_in(rs.context())]})
