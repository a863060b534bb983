"""The process behind the viewer's window.

PyBullet's window answers each call only between two of its pictures, so this process is often busy for a tenth of a
second; that is why the keys are watched by another one (:mod:`.keyboard_process`).
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import Any

from hal.errors import ConnectionLost, NotSupported
from hal.host.mailbox import Mailbox, SeriesBox
from hal.host.process import Channel, SharedMemory
from hal.specs import WorldSpec, from_json

from .mirror import Mirror
from .world import World
from .x11 import NoDisplay, windows

__all__ = ["HEARTBEAT", "main"]

HEARTBEAT = "d"
"""Layout of the mailbox in which it says when it was last alive, s."""
_NICE = 10
"""It comes after everything else."""
_FRAME = 1 / 30
"""How often the world is shown, s."""
_TITLE = "Bullet Physics"
"""What the title of PyBullet's window contains."""


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process; ``memories`` are the world's snapshots and the heartbeat."""
    os.nice(_NICE)
    os.environ.setdefault("LP_NUM_THREADS", "1")
    parent = os.getppid()
    try:
        before = windows(_TITLE)
    except NoDisplay as error:
        raise NotSupported(f"the window cannot open: {error}; or use --viewer none") from error
    world = World(from_json(WorldSpec, config["world"]), mirror=True, gui=True)
    _arrange(world)
    ours = windows(_TITLE) - before
    box = SeriesBox(memories[0].buffer[config["snapshot_offset"] :], config["snapshot_capacity"])
    heartbeat = Mailbox(memories[1].buffer, HEARTBEAT)
    heartbeat.write(time.monotonic())
    channel.send({"ready": {"window": next(iter(ours)) if len(ours) == 1 else None, "pid": os.getpid()}})
    mirror = Mirror(world, box)
    while os.getppid() == parent and world.client.isConnected():
        due = time.monotonic() + _FRAME
        try:
            while (message := channel.poll()) is not None:
                if message["method"] == "close":
                    return
                mirror.edited(message["method"], message["params"], message["revision"])
            mirror.update()
        except (ConnectionLost, world.client.error):
            return  # the app or the window is gone
        heartbeat.write(time.monotonic())
        time.sleep(max(0.0, due - time.monotonic()))


def _arrange(world: World) -> None:
    """The whole bench in view, no panels, and keys and mouse that do nothing to the world."""
    client = world.client
    for option in ("COV_ENABLE_GUI", "COV_ENABLE_KEYBOARD_SHORTCUTS", "COV_ENABLE_MOUSE_PICKING"):
        client.configureDebugVisualizer(getattr(client, option), 0)
    bases = [robot.base_position for robot in world.spec.robots]
    x, y, z = (sum(axis) / len(bases) for axis in zip(*bases, strict=True)) if bases else (0.0, 0.0, 0.0)
    client.configureDebugVisualizer(lightPosition=(x + 1.5, y - 1.5, z + 3.0))
    client.resetDebugVisualizerCamera(
        cameraDistance=1.3, cameraYaw=60.0, cameraPitch=-26.0, cameraTargetPosition=(x + 0.3, y, z + 0.25)
    )
