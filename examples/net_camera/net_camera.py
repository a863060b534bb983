"""A driver to copy: a depth camera on TCP. An image is its number, the ms since power-on, and 64 x 48 distances in mm.

A rig names it by ``drivers: {real: net_camera}, real: {host: ..., port: ...}`` once it is installed.
"""

from __future__ import annotations

import socket
import struct
import time

import numpy as np

from hal.driver import CameraDriver, RawFrame
from hal.errors import ConnectionLost
from hal.registry import DriverSpec

DRIVER = DriverSpec(name="net_camera", camera="net_camera:NetCamera")
HEAD = struct.Struct("<II")


class NetCamera(CameraDriver):
    """A network camera at the address of its options ``host`` and ``port``."""

    line: socket.socket | None = None

    def open(self) -> None:
        self.close()
        place = self.spec.options["host"], self.spec.options["port"]
        try:
            self.line = socket.create_connection(place, timeout=2.0)
        except OSError as error:
            raise ConnectionLost(f"no camera at {place}: {error}; switch it on") from error
        self.came = b""

    def grab(self, timeout: float) -> RawFrame | None:
        if self.line is None:
            raise ConnectionLost(f"camera {self.spec.name} is not open")
        size = HEAD.size + 2 * self.spec.width * self.spec.height
        deadline = time.monotonic() + timeout
        while len(self.came) < size:
            self.line.settimeout(max(1e-3, deadline - time.monotonic()))
            try:
                news = self.line.recv(1 << 20)
            except TimeoutError:
                return None  # no frame in that time
            except OSError as error:
                raise ConnectionLost(f"camera {self.spec.name}: {error}") from error
            if not news:
                raise ConnectionLost(f"camera {self.spec.name} hung up")
            self.came += news
        whole = len(self.came) // size * size  # the newest complete image; older ones are dropped
        picture, self.came = self.came[whole - size : whole], self.came[whole:]
        seq, ms = HEAD.unpack_from(picture)
        mm = np.frombuffer(picture, "<u2", offset=HEAD.size).reshape(self.spec.height, self.spec.width)
        depth = mm.astype(np.float32) / 1000  # m, in an array of its own
        depth[(depth < self.spec.depth_min) | (depth > self.spec.depth_max)] = 0.0
        return RawFrame(time.monotonic(), ms / 1000, seq, depth=depth)

    def close(self) -> None:
        line, self.line = self.line, None
        if line is not None:
            line.close()
