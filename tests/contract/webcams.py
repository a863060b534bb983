"""Benches of cameras without a library of their own: webcams in memory, a video file, and a stream over HTTP."""

from __future__ import annotations

import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from io import BytesIO
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from hal.specs import CameraSpec
from hal.testing import CameraBench, camera_spec

pytest.importorskip("av", reason="needs PyAV: pip install 'robot-hal[record]'")

from webcam_kit import webcams, write_video

from hal.drivers.webcam.capture import V4l2Camera
from hal.drivers.webcam.video import VideoCamera

__all__ = ["network_camera", "video_file", "webcam"]


def _spec(rate_hz: float, **options: Any) -> CameraSpec:
    return camera_spec(driver="video", streams=("color",), rate_hz=rate_hz, options=options)


@contextmanager
def webcam() -> Iterator[CameraBench]:
    """A webcam; at 90 Hz it has only MJPEG."""
    with tempfile.TemporaryDirectory() as root, webcams(Path(root)) as (camera,):
        driver = V4l2Camera(_spec(90.0, stall_s=0.3))
        yield CameraBench(
            driver=driver,
            patience=2.0,
            lose=camera.unplug,
            restore=camera.plug,
            freeze=lambda: setattr(camera, "frozen", True),
        )
        driver.close()


@contextmanager
def video_file() -> Iterator[CameraBench]:
    """A file of a tenth of a second, which repeats."""
    with tempfile.TemporaryDirectory() as root:
        path = Path(root) / "video.mkv"
        write_video(path, 10, rate=60)
        driver = VideoCamera(_spec(60.0, file=str(path)))
        yield CameraBench(driver=driver)
        driver.close()


class NetworkCamera:
    """A camera that sends JPEG images over HTTP, as IP cameras do (``multipart/x-mixed-replace``)."""

    def __init__(self) -> None:
        self.port, self.frozen = 0, False
        self._lines: list[socket.socket] = []
        self.plug()

    def plug(self) -> None:
        self.frozen = False
        self._server = socket.create_server(("127.0.0.1", self.port))
        self.port = self._server.getsockname()[1]
        threading.Thread(target=self._accept, args=(self._server,), daemon=True).start()

    def unplug(self) -> None:
        for line in (self._server, *self._lines):
            with suppress(OSError):
                line.shutdown(socket.SHUT_RDWR)
            line.close()
        self._lines = []

    def _accept(self, server: socket.socket) -> None:
        with suppress(OSError):
            while True:
                line, _ = server.accept()
                self._lines.append(line)
                threading.Thread(target=self._send, args=(line,), daemon=True).start()

    def _send(self, line: socket.socket) -> None:
        with suppress(OSError):
            line.recv(4096)
            line.sendall(b"HTTP/1.0 200 OK\r\nContent-Type: multipart/x-mixed-replace; boundary=next\r\n\r\n")
            k = 0
            while True:
                if not self.frozen:
                    file = BytesIO()
                    Image.fromarray(np.full((48, 64, 3), 4 * k % 256, np.uint8)).save(file, "JPEG")
                    data = file.getvalue()
                    head = f"--next\r\nContent-Type: image/jpeg\r\nContent-Length: {len(data)}\r\n\r\n"
                    line.sendall(head.encode() + data + b"\r\n")
                    k += 1
                time.sleep(1 / 60)


@contextmanager
def network_camera() -> Iterator[CameraBench]:
    """A stream over HTTP from a server at a local port."""
    camera = NetworkCamera()
    driver = VideoCamera(_spec(60.0, url=f"http://127.0.0.1:{camera.port}/video", stall_s=0.5))
    yield CameraBench(
        driver=driver,
        patience=3.0,
        lose=camera.unplug,
        restore=camera.plug,
        freeze=lambda: setattr(camera, "frozen", True),
    )
    driver.close()
    camera.unplug()
