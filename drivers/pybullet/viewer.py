"""A window onto the simulated world, in a process of its own: PyBullet's, whose keyboard may serve as a gamepad."""

from __future__ import annotations

import os
import time
from contextlib import suppress
from typing import Any

from hal.errors import ConnectionLost, NotSupported
from hal.host.hosts import SNAPSHOT_CAPACITY, Host, LocalHost, RemoteHost
from hal.host.mailbox import Mailbox, SeriesBox
from hal.host.process import Child, SharedMemory
from hal.pictures import Viewer
from hal.specs import to_json

from .keyboard import LAYOUT, KeyboardSource
from .viewer_process import HEARTBEAT

__all__ = ["PyBulletViewer"]


class PyBulletViewer(Viewer):
    """The window. Closing it ends nothing but the window and its keyboard.

    Raises:
        NotSupported: there is no display to open it on.
    """

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        if not os.environ.get("DISPLAY"):
            raise NotSupported(
                "the window needs a display, and DISPLAY is not set: run it on a desktop, through `ssh -X`, or under "
                "`xvfb-run`; or use --viewer none"
            )
        self._beat = SharedMemory(Mailbox.size(HEARTBEAT))
        self._keys = SharedMemory(Mailbox.size(LAYOUT))
        self._mailbox = Mailbox(self._keys.buffer, LAYOUT)
        self._watch: Child | None = None
        self._closed = False
        if isinstance(host, RemoteHost):
            snapshots, offset = host.shared, host.snapshot_offset
        elif isinstance(host, LocalHost):
            snapshots, offset = self._published(host), 0
        else:
            raise NotSupported(f"no window onto a {type(host).__name__}")
        config = {
            "world": to_json(host.spec.world),
            "snapshot_offset": offset,
            "snapshot_capacity": SNAPSHOT_CAPACITY,
        }
        target = "hal.drivers.pybullet.viewer_process:main"
        self._child = Child("viewer", target, config, [snapshots, self._beat])

    def _published(self, host: LocalHost) -> SharedMemory:
        """Lock-step: this process publishes the world while simulated time goes on."""
        memory = SharedMemory(SeriesBox.size(SNAPSHOT_CAPACITY))
        box = SeriesBox(memory.buffer, SNAPSHOT_CAPACITY)
        world = host.cycle.world

        def publish(now: float) -> None:
            if not self._closed:
                box.write(now, world.revision, world.snapshot())

        publish(host.now())
        host.pollers.append(publish)
        return memory

    def wait_ready(self) -> None:
        ready = self._child.wait_ready()
        if ready["window"] is None:
            self.notes = ("the viewer's window was not found on the display, so its keyboard is not used",)
            return
        target = "hal.drivers.pybullet.keyboard_process:main"
        self._watch = Child("keyboard", target, ready, [self._beat, self._keys])
        self._watch.wait_ready()

    def edited(self, method: str, params: dict[str, Any], revision: int) -> None:
        with suppress(ConnectionLost):  # a window that was closed needs no news
            self._child.channel.send({"method": method, "params": params, "revision": revision})

    def keyboard(self) -> KeyboardSource | None:
        if self._watch is None:
            return None
        return KeyboardSource(self._mailbox, time.monotonic, self._check)

    def _check(self) -> None:
        """Raise ConnectionLost when the window is gone."""
        assert self._watch is not None
        self._watch.check()
        self._child.check()

    def describe(self) -> str:
        return "PyBullet's window"

    def close(self) -> None:
        self._closed = True
        for child in (self._watch, self._child):
            if child is not None:
                child.close()
        self._beat.close()
        self._keys.close()
