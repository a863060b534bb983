"""Cameras on Video4Linux2 in memory, which answer the driver's requests as the kernel's documentation says."""

from __future__ import annotations

import errno
import mmap
import os
import shutil
import time
from collections import deque
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any
from unittest.mock import patch

import av
import numpy as np

from hal.drivers.webcam import capture, kernel
from hal.drivers.webcam.kernel import fourcc

YUYV, MJPEG, H264 = fourcc("YUYV"), fourcc("MJPG"), fourcc("H264")
MODES = {(YUYV, 64, 48): (30, 60), (MJPEG, 64, 48): (30, 60, 90), (MJPEG, 128, 96): (30,), (H264, 64, 48): (120,)}
BRIGHTNESS, GAIN, AUTOGAIN = 0x980900, 0x980913, 0x980912
CONTROLS = {
    BRIGHTNESS: (b"Brightness", 1, -64, 64, 0),
    AUTOGAIN: (b"Gain, Automatic", 2, 0, 1, 1),
    GAIN: (b"Gain", 1, 0, 100, 50),
    kernel.EXPOSURE_AUTO: (b"Auto Exposure", 3, 0, 3, 3),
    kernel.EXPOSURE: (b"Exposure Time, Absolute", 1, 3, 2047, 250),
    kernel.FOCUS: (b"Focus, Absolute", 1, 0, 250, 0),
    kernel.FOCUS_AUTO: (b"Focus, Automatic Continuous", 2, 0, 1, 1),
}
"""Id -> name, type, least, greatest and first value."""


def fail(number: int) -> OSError:
    return OSError(number, errno.errorcode[number])


def grey(sequence: int) -> int:
    """Brightness of every pixel of a frame."""
    return 10 + sequence * 8 % 240


class FakeWebcam:
    """A USB camera, with its node in a made-up sysfs. Each frame is of one grey, which shows its number."""

    def __init__(self, root: Path, number: int, name: str = "HD Webcam", serial: str = "", port: str = "1-2") -> None:
        self.root, self.name = root, name
        self.renumber(number)
        self.usb = root / "usb" / port
        (self.usb / f"{port}:1.0").mkdir(parents=True)
        (self.usb / "busnum").write_text("1\n")
        if serial:
            (self.usb / "serial").write_text(f"{serial}\n")
        self.values = {id: control[4] for id, control in CONTROLS.items()}
        self.plugged = self.frozen = False
        self.refused = 0
        """Number of the error with which it refuses to be opened."""
        self.clock_offset = 0.0
        """How far its clock is ahead of the monotonic one, s."""
        self.damaged: set[int] = set()
        """Numbers of the frames that arrive damaged."""
        self.streaming: FakeNode | None = None
        self.plug()

    def renumber(self, number: int) -> None:
        self.folder, self.path = self.root / "class" / f"video{number}", f"/dev/video{number}"

    def plug(self) -> None:
        self.folder.mkdir(parents=True)
        (self.folder / "name").write_text(f"{self.name}\n")
        (self.folder / "device").symlink_to(self.usb / f"{self.usb.name}:1.0")
        self.plugged, self.frozen = True, False

    def unplug(self) -> None:
        shutil.rmtree(self.folder)
        self.plugged = False


class FakeNode:
    """An open node of a camera, in the place of :class:`hal.drivers.webcam.kernel.VideoNode`."""

    def __init__(self, camera: FakeWebcam) -> None:
        self.camera = camera
        self.format, self.rate, self.start, self.next = (YUYV, 64, 48), 30.0, 0.0, 0
        self.memories: list[mmap.mmap] = []
        self.queued: deque[int] = deque()
        self.done: deque[tuple[int, int, float, int]] = deque()  # index, number, time, bytes
        self.encoder: Any = None
        """Of H.264, in which a frame depends on those before it."""
        self.answers = {
            kernel.QUERY_CAPABILITY: self.query,
            kernel.LIST_FORMATS: self.list_formats,
            kernel.LIST_SIZES: self.list_sizes,
            kernel.LIST_INTERVALS: self.list_intervals,
            kernel.SET_FORMAT: self.set_format,
            kernel.SET_PARAMETERS: self.set_parameters,
            kernel.REQUEST_BUFFERS: self.request_buffers,
            kernel.QUERY_BUFFER: self.query_buffer,
            kernel.QUEUE: lambda record: self.queued.append(record.index),
            kernel.DEQUEUE: self.dequeue,
            kernel.START: self.begin,
            kernel.QUERY_CONTROL: self.query_control,
            kernel.GET_CONTROL: lambda record: setattr(record, "value", camera.values[record.id]),
            kernel.SET_CONTROL: lambda record: camera.values.update({record.id: record.value}),
        }

    def call(self, request: int, record: Any) -> None:
        self.expose()
        if not self.camera.plugged:
            raise fail(errno.ENODEV)
        self.answers[request](record)

    def query(self, record: Any) -> None:
        record.card, record.device_caps = self.camera.name.encode(), kernel.CAPTURE

    def list_formats(self, record: Any) -> None:
        record.pixelformat = self.at(record.index, list(dict.fromkeys(code for code, _, _ in MODES)))

    def list_sizes(self, record: Any) -> None:
        record.type = 1
        sizes = [(width, height) for code, width, height in MODES if code == record.pixelformat]
        record.size[:2] = self.at(record.index, sizes)

    def list_intervals(self, record: Any) -> None:
        record.type, rates = 1, MODES.get((record.pixelformat, record.width, record.height), ())
        record.period[:2] = 1, self.at(record.index, rates)

    @staticmethod
    def at(index: int, items: Any) -> Any:
        if index >= len(items):
            raise fail(errno.EINVAL)
        return items[index]

    def set_format(self, record: Any) -> None:
        """Choose the nearest mode, as the kernel does for what a camera lacks."""
        pixels = record.pixels
        alike = [mode for mode in MODES if mode[0] == pixels.pixelformat] or [(YUYV, 64, 48)]
        self.format = min(alike, key=lambda mode: abs(mode[1] - pixels.width))
        pixels.pixelformat, pixels.width, pixels.height = self.format

    def set_parameters(self, record: Any) -> None:
        self.rate = min(MODES[self.format], key=lambda rate: abs(rate - record.denominator / record.numerator))
        record.numerator, record.denominator = 1, self.rate

    def request_buffers(self, record: Any) -> None:
        if self.camera.streaming not in (None, self):
            raise fail(errno.EBUSY)
        self.camera.streaming = self
        self.memories = [mmap.mmap(-1, 1 << 16) for _ in range(record.count)]

    def query_buffer(self, record: Any) -> None:
        record.offset, record.length, record.flags = record.index << 16, 1 << 16, kernel.MONOTONIC

    def map(self, offset: int, length: int) -> Any:
        return self.memories[offset >> 16]

    def begin(self, _: Any) -> None:
        self.start = time.monotonic()

    def expose(self) -> None:
        """Fill buffers with the frames that were due until now; without a free buffer, a frame is lost."""
        while self.start and (t := self.start + self.next / self.rate) <= time.monotonic():
            if self.queued and self.camera.plugged and not self.camera.frozen:
                index = self.queued.popleft()
                data = self.draw(self.next)
                self.memories[index][: len(data)] = data
                self.done.append((index, self.next, t, len(data)))
            self.next += 1

    def draw(self, number: int) -> bytes:
        code, width, height = self.format
        image = np.full((height, width, 3), grey(number), np.uint8)
        frame = av.VideoFrame.from_ndarray(image, format="rgb24")
        if code == YUYV:
            return bytes(frame.reformat(format="yuyv422").planes[0])
        if code == H264:
            if self.encoder is None:
                self.encoder = av.CodecContext.create("libx264", "w")
                self.encoder.width, self.encoder.height, self.encoder.framerate = width, height, 120
                self.encoder.pix_fmt, self.encoder.options = "yuv420p", {"tune": "zerolatency"}
            return b"".join(map(bytes, self.encoder.encode(frame)))
        context = av.CodecContext.create("mjpeg", "w")
        context.width, context.height, context.pix_fmt, context.framerate = width, height, "yuvj420p", 30
        return b"".join(map(bytes, [*context.encode(frame), *context.encode()]))

    def wait(self, timeout: float) -> bool:
        end = time.monotonic() + timeout
        while self.camera.plugged:
            self.expose()
            if self.done or time.monotonic() >= end:
                return bool(self.done)
            time.sleep(1e-3)
        return True

    def dequeue(self, record: Any) -> None:
        if not self.done:
            raise BlockingIOError(errno.EAGAIN, "EAGAIN")
        record.index, record.sequence, t, record.bytesused = self.done.popleft()
        t += self.camera.clock_offset
        record.seconds, record.microseconds = int(t), int(t % 1.0 * 1e6)
        record.flags = kernel.MONOTONIC | (kernel.DAMAGED if record.sequence in self.camera.damaged else 0)

    def query_control(self, record: Any) -> None:
        later = sorted(id for id in CONTROLS if id > (record.id & ~kernel.NEXT))
        record.id = self.at(0, later)
        record.name, record.type, record.minimum, record.maximum, record.default = CONTROLS[record.id]

    def close(self) -> None:
        if self.camera.streaming is self:
            self.camera.streaming = None


@contextmanager
def webcams(root: Path, *cameras: dict[str, str]) -> Iterator[list[FakeWebcam]]:
    """Connected cameras, each with the given name, serial and port, for the driver of this process."""
    made = [FakeWebcam(root, number, **camera) for number, camera in enumerate(cameras or ({},))]

    def open_node(path: str) -> FakeNode:
        for camera in made:
            if camera.path == path and camera.plugged:
                if camera.refused:
                    raise OSError(camera.refused, os.strerror(camera.refused))
                return FakeNode(camera)
        raise fail(errno.ENOENT)

    with patch.object(kernel, "CLASS", root / "class"), patch.object(capture, "VideoNode", open_node):
        yield made


def write_video(path: Path, frames: int, size: tuple[int, int] = (64, 48), rate: int = 30) -> None:
    """Write a video without loss, in which the brightness of frame k is 8 k."""
    with av.open(path, "w") as container:
        stream = container.add_stream("ffv1", rate=rate)
        stream.width, stream.height, stream.pix_fmt = *size, "bgr0"
        for k in range(frames):
            picture = np.full((size[1], size[0], 3), 8 * k % 256, np.uint8)
            for packet in stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")):
                container.mux(packet)
        container.mux(stream.encode())
