"""A video as a camera: a file at its own pace, or a stream from the network."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from typing import Any

import av

from hal.driver import CameraDriver, CameraInfo, RawFrame
from hal.errors import ConnectionLost, DeviceNotFound, NotSupported
from hal.specs import CameraSpec

from .pictures import PictureOutput, to_rgb
from .settings import VideoSettings

_OPEN = 5.0
"""Longest time to connect to a stream, s."""
_UNTIMED = ("mpjpeg", "mjpeg", "h264", "hevc")
"""Formats of streams without times, for which ffmpeg invents some."""


class VideoCamera(CameraDriver):
    """A video file or stream; the options are those of :class:`.settings.VideoSettings`.

    A thread reads it. A frame of a file is due at its time after the start, and ``t`` is that time. Nothing is known
    about the exposure of a stream's frame, and ``t`` is the time of its arrival. ``t_device`` is the time in the video,
    or that of the arrival for a stream without times.
    """

    def __init__(self, spec: CameraSpec, source: object | None = None) -> None:
        super().__init__(spec, source)
        self._settings = VideoSettings.of(spec)
        self._output = PictureOutput(spec, self._settings.undistort)
        self._news = threading.Condition()
        self._closing = threading.Event()
        self._thread: threading.Thread | None = None
        self._newest: tuple[float, float, int, Any] | None = None
        """Time, time in the video, number and picture of the newest frame that was not taken."""
        self._end: ConnectionLost | None = None
        self._clock = "video"

    @property
    def info(self) -> CameraInfo:
        place = self._settings.file or self._settings.url or ""
        return self._output.describe(self.nominal_info(place), clock=self._clock)

    def open(self) -> None:
        self.close()
        if self._end is not None and self._end.final:
            raise self._end
        self._newest, self._end, self._closing = None, None, threading.Event()
        container = self._connect()
        untimed = self._settings.file is None and container.format.name in _UNTIMED
        self._clock = "system" if untimed else "video"
        self._thread = threading.Thread(
            target=self._run, args=(container, self._closing), name=f"hal-video-{self.spec.name}", daemon=True
        )
        self._thread.start()

    def _connect(self) -> Any:
        """Return the open container; raises the errors of :meth:`open`."""
        settings, name = self._settings, self.spec.name
        options = {"rtsp_transport": settings.transport, "fflags": "nobuffer"} if settings.url else {}
        try:
            container = av.open(settings.file or settings.url, timeout=(_OPEN, settings.stall_s), options=options)
        except FileNotFoundError as error:
            raise DeviceNotFound(f"camera {name}: there is no video {settings.file or settings.url}") from error
        except (av.FFmpegError, OSError) as error:
            raise ConnectionLost(f"camera {name}: {settings.file or settings.url}: {error}") from error
        try:
            self._check(container)
        except BaseException:
            container.close()
            raise
        return container

    def _check(self, container: Any) -> None:
        spec, streams = self.spec, container.streams.video
        if not streams:
            raise NotSupported(f"camera {spec.name}: there is no video in it", code="unknown_mode")
        width, height, rate = streams[0].width, streams[0].height, float(streams[0].average_rate or 0.0)
        wrong = (width, height) != (spec.capture_width, spec.capture_height)
        if self._settings.file is not None and rate:  # the rate that a stream announces is often wrong
            wrong = wrong or abs(rate / spec.rate_hz - 1.0) > 0.02
        if wrong:
            raise NotSupported(
                f"camera {spec.name}: the video is {width}x{height} at {rate:g} Hz, the rig file has "
                f"{spec.capture_width}x{spec.capture_height} at {spec.rate_hz:g} Hz; set capture: "
                f"{{width: {width}, height: {height}, rate_hz: {rate:g}}}",
                code="unknown_mode",
            )

    def grab(self, timeout: float) -> RawFrame | None:
        if self._thread is None:
            raise ConnectionLost(f"camera {self.spec.name} is not open", code="not_open")
        with self._news:
            self._news.wait_for(lambda: self._newest is not None or self._end is not None, timeout)
            newest, self._newest, end = self._newest, None, self._end
        if newest is not None:
            t, t_device, number, picture = newest
            return RawFrame(t, t_device, number, color=self._output.finish(to_rgb(picture)))
        if end is not None:
            raise end
        return None

    def close(self) -> None:
        self._closing.set()
        thread, self._thread = self._thread, None
        if thread is not None:
            thread.join(timeout=_OPEN)

    # The thread.

    def _run(self, container: Any, closing: threading.Event) -> None:
        end = ConnectionLost(f"camera {self.spec.name}: the video is over", code="over")
        end.final = self._settings.file is not None
        size = self.spec.capture_width, self.spec.capture_height
        try:
            with container:
                frames = self._play(container, closing) if self._settings.file else self._receive(container)
                for number, (t, t_device, picture) in enumerate(frames):
                    if closing.is_set():
                        return
                    if (now := (picture.width, picture.height)) != size:
                        raise ValueError("its pictures are {}x{} now, not {}x{}".format(*now, *size))
                    with self._news:
                        self._newest = t, t_device, number, picture
                        self._news.notify_all()
        except av.error.ExitError:
            end = ConnectionLost(
                f"camera {self.spec.name} sent nothing for {self._settings.stall_s:g} s", code="stalled"
            )
        except Exception as error:
            end = ConnectionLost(f"camera {self.spec.name}: {error}", code="device_error")
            end.__cause__ = error
        with self._news:
            if closing is self._closing:
                self._end = end
                self._news.notify_all()

    def _play(self, container: Any, closing: threading.Event) -> Iterator[tuple[float, float, Any]]:
        """Yield the frames of a file, each when it is due."""
        start, played, period = time.monotonic(), 0.0, 1.0 / self.spec.rate_hz
        while True:
            first, last = None, 0.0
            for picture in container.decode(video=0):
                if picture.time is None:
                    raise ValueError("its frames have no times: put it into a container, ffmpeg -i ... out.mp4")
                first = picture.time if first is None else first
                last = played + picture.time - first
                closing.wait(max(0.0, start + last - time.monotonic()))
                yield start + last, last, picture
            if first is None or not self._settings.repeat:
                return
            played = last + period
            container.seek(0)

    def _receive(self, container: Any) -> Iterator[tuple[float, float, Any]]:
        """Yield the frames of a stream, with the time when they arrived."""
        stream = container.streams.video[0]
        stream.codec_context.thread_count = 1  # several threads would delay each frame
        for packet in container.demux(stream):
            now = time.monotonic()
            for picture in packet.decode():
                yield now, now if picture.time is None or self._clock == "system" else picture.time, picture
