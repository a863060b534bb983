"""The other end of ``net_camera.py``: sends 30 images a second to every client at 127.0.0.1."""

from __future__ import annotations

import select
import socket
import threading
import time
from contextlib import suppress

from net_camera import HEAD


class FakeCamera:
    """A camera that can be unplugged and frozen."""

    def __init__(self) -> None:
        self.seq, self.port, self.frozen = 0, 0, False

    def plug(self) -> None:
        self.door = socket.create_server(("127.0.0.1", self.port))
        self.port, self.ending = self.door.getsockname()[1], threading.Event()
        self.thread = threading.Thread(target=self.serve)
        self.thread.start()

    def serve(self) -> None:
        lines: list[socket.socket] = []
        while not self.ending.wait(1 / 30):
            self.seq += 1
            if select.select([self.door], [], [], 0)[0]:
                lines.append(self.door.accept()[0])
            mm = (800 + self.seq % 100).to_bytes(2, "little") * (48 * 64)
            for line in [] if self.frozen else lines:
                with suppress(OSError):  # the client has left
                    line.sendall(HEAD.pack(self.seq, round(1e3 * time.monotonic())) + mm)
        for line in (self.door, *lines):
            line.close()

    def unplug(self) -> None:
        self.ending.set()
        self.thread.join()
