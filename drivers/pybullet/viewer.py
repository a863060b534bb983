"""A window onto the simulated world: PyBullet's own, in a process of its own that mirrors the world of any engine."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Sequence
from contextlib import suppress
from importlib.util import find_spec
from typing import Any

from hal.drivers.scene.mirror import WorldMirror
from hal.errors import ConnectionLost, DriverMissing, NotSupported
from hal.host.hosts import SNAPSHOT_CAPACITY, Host, LocalHost, RemoteHost
from hal.host.memory import SeriesBox
from hal.host.process import Channel, Child, SharedMemory, serve
from hal.specs import WorldSpec, from_json, to_json
from hal.views import Viewer

from .world import PyBulletWorld

_NICE = 10
"""Niceness of the window's process: everything else comes first."""
_FRAME = 1 / 30
"""Period at which the world is shown, s."""
_HANG = 20
"""PyBullet may hang when its window disappears; the process is killed after so many s without a new picture."""


class PyBulletViewer(Viewer):
    """PyBullet's window. Closing it ends only the window.

    Raises DriverMissing without PyBullet (the world may be another engine's), NotSupported without a display.
    """

    def __init__(self, host: Host) -> None:
        super().__init__(host)
        if find_spec("pybullet") is None:
            raise DriverMissing(
                "the window is PyBullet's, which is not installed: pip install 'robot-hal[sim]' (Python 3.10, 3.11, "
                "or a C++ compiler); or use --viewer 3d",
                name="pybullet",
            )
        if not os.environ.get("DISPLAY"):
            raise NotSupported(
                "the window needs a display, and DISPLAY is not set: run it on a desktop, through `ssh -X`, or under "
                "`xvfb-run`; or use --viewer none",
                code="no_display",
            )
        self._closed = False
        if isinstance(host, RemoteHost):
            snapshots, offset = host.shared, host.snapshot_offset
        elif isinstance(host, LocalHost):
            snapshots, offset = self._publish_world(host), 0
        else:
            raise NotSupported(f"no window onto a {type(host).__name__}")
        config = {
            "world": to_json(host.spec.world),
            "snapshot_offset": offset,
            "snapshot_capacity": SNAPSHOT_CAPACITY,
        }
        self._child = Child("viewer", "hal.drivers.pybullet.viewer:main", config, [snapshots])

    def _publish_world(self, host: LocalHost) -> SharedMemory:
        """Publish the world from this process in lock-step, each time that simulated time advances."""
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
        try:
            self._child.wait_ready()
        except ConnectionLost as error:  # PyBullet ends its process where it finds no X server
            text = f"the window cannot open on display {os.environ['DISPLAY']}; or use --viewer none ({error})"
            raise NotSupported(text, code="no_display") from error

    def note_edit(self, method: str, params: dict[str, Any], revision: int) -> None:
        with suppress(ConnectionLost):  # the window may have been closed
            self._child.notify("edited", {"method": method, "params": params, "revision": revision})

    def describe(self) -> str:
        return "PyBullet's window"

    def close(self) -> None:
        self._closed = True
        self._child.close()


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Run the window's process; ``memories`` holds the snapshots of the world."""
    os.nice(_NICE)
    os.environ.setdefault("LP_NUM_THREADS", "1")
    world = PyBulletWorld(from_json(WorldSpec, config["world"]), mirror=True, gui=True)
    _arrange(world)
    box = SeriesBox(memories[0].buffer[config["snapshot_offset"] :], config["snapshot_capacity"])
    channel.send({"ready": {}})
    mirror = WorldMirror(world, box)

    def show() -> float | None:
        if not world.client.isConnected():
            return None
        signal.alarm(_HANG)
        due = time.monotonic() + _FRAME
        try:
            mirror.update()
        except world.client.error:
            return None  # the window was closed
        return max(0.0, due - time.monotonic())

    serve(channel, {"edited": mirror.note_edit}, show)


def _arrange(world: PyBulletWorld) -> None:
    """Show the whole bench, without panels, and without keys or mouse gestures that change the world."""
    client = world.client
    for option in ("COV_ENABLE_GUI", "COV_ENABLE_KEYBOARD_SHORTCUTS", "COV_ENABLE_MOUSE_PICKING"):
        client.configureDebugVisualizer(getattr(client, option), 0)
    bases = [robot.base_position for robot in world.spec.robots]
    x, y, z = (sum(axis) / len(bases) for axis in zip(*bases, strict=True)) if bases else (0.0, 0.0, 0.0)
    client.configureDebugVisualizer(lightPosition=(x + 1.5, y - 1.5, z + 3.0))
    client.resetDebugVisualizerCamera(
        cameraDistance=1.3, cameraYaw=60.0, cameraPitch=-26.0, cameraTargetPosition=(x + 0.3, y, z + 0.25)
    )
