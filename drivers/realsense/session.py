"""One run of the library's pipeline, from a start to a stop: it never recovers from a lost camera, a new one does."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any, Protocol

import pyrealsense2 as rs

from hal.errors import ConnectionLost, ControlTaken

__all__ = ["Live", "Playing", "Session"]

_QUEUE = 4
"""Sets that wait in the library, at most."""
_BUSY = ("busy", "in use", "power state")
"""In what the library says when another program has the camera."""


class Session(Protocol):
    """Where sets of frames come from."""

    clock_is_live: bool
    """Do its stamps belong to the present?"""

    def wait(self, timeout: float) -> Any | None:
        """The next set (``rs2::frameset``); None when none came within ``timeout`` s."""

    def more(self) -> Any | None:
        """Another set that is there already."""

    def ended(self) -> str | None:
        """Why no more will come, where that is known."""

    def stop(self) -> None:
        """Stop. Lets other threads run; a library that hangs in it does so for good (librealsense issue 7252)."""


class Live:
    """A camera that streams, real or in software."""

    clock_is_live = True

    def __init__(self, context: Any, device: Any, serial: str, profiles: Mapping[str, Any], record: str | None) -> None:
        """Raises ConnectionLost, and ControlTaken when another program has the camera."""
        self._device = device
        self._removed = threading.Event()
        self._pipeline = rs.pipeline(context)
        # A queue of our own: the pipeline's would start the camera anew when it is gone, and wait 15 s for that.
        self._queue = rs.frame_queue(_QUEUE)
        config = _config(profiles)
        config.enable_device(serial)
        if record is not None:
            config.enable_record_to_file(record)
        _start(lambda: self._pipeline.start(config, self._queue), serial)

    def wait(self, timeout: float) -> Any | None:
        arrived, frame = self._queue.try_wait_for_frame(round(timeout * 1000.0))
        return frame.as_frameset() if arrived else None

    def more(self) -> Any | None:
        frame = self._queue.poll_for_frame()
        return frame.as_frameset() if frame else None

    def removed(self, news: Any) -> None:
        """The library's word that devices came or went."""
        if news.was_removed(self._device):
            self._removed.set()

    def ended(self) -> str | None:
        if self._removed.is_set() or not self._device.is_connected():
            return "it was unplugged, or its USB port was reset"
        return None

    def stop(self) -> None:
        self._pipeline.stop()


class Playing:
    """A recording."""

    clock_is_live = False

    def __init__(self, context: Any, file: str, profiles: Mapping[str, Any], *, repeat: bool, paced: bool) -> None:
        """Raises ConnectionLost."""
        self._file = file
        self._repeat = repeat
        self._pipeline = rs.pipeline(context)
        config = _config(profiles)
        rs.config.enable_device_from_file(config, file, repeat)
        # Every look at a file makes a new device; the one that a configuration was resolved to is the one that plays.
        self._playback = config.resolve(rs.pipeline_wrapper(self._pipeline)).get_device().as_playback()
        self._playback.set_real_time(paced)
        # With the pipeline's own queue: where frames wait to be taken, it fills that one even beside one of ours.
        _start(lambda: self._pipeline.start(config), file)

    def wait(self, timeout: float) -> Any | None:
        arrived, frames = self._pipeline.try_wait_for_frames(round(timeout * 1000.0))
        return frames if arrived else None

    def more(self) -> Any | None:
        return None  # its queue holds one set

    def ended(self) -> str | None:
        if not self._repeat and self._playback.current_status() == rs.playback_status.stopped:
            return f"the recording {self._file} has ended"
        return None

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


def _start(start: Callable[[], Any], what: str) -> None:
    try:
        start()
    except RuntimeError as error:
        text = str(error)
        if any(word in text.lower() for word in _BUSY):
            raise ControlTaken(f"{what} is in use by another program: {text}") from None
        raise ConnectionLost(f"{what} is there and does not start: {text}") from None
