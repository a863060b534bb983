"""The process behind the viewer's window."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from typing import Any

from hal.errors import ConnectionLost, NotSupported
from hal.mailbox import Mailbox, SeriesBox
from hal.process import Channel, SharedMemory
from hal.specs import WorldSpec, from_json

from .keyboard import KEYS, LAYOUT, KeyboardRecord, grip
from .mirror import Mirror
from .world import World
from .x11 import Keyboard, NoDisplay, windows

__all__ = ["KeyWatch", "main"]

_NICE = 5
_PERIOD = 0.01
"""How often the keys are looked at, s."""
_FRAME = 1 / 30
"""How often the world is shown, s."""
_TITLE = "Bullet Physics"
"""What the title of PyBullet's window contains."""


class KeyWatch:
    """Writes what the keyboard does into the record that the app reads."""

    def __init__(self, mailbox: Mailbox) -> None:
        self._mailbox = mailbox
        self._record = KeyboardRecord(0.0, 0.0, 0, 0, 0.0)

    def look(self, held: frozenset[str], now: float) -> None:
        """Note that these keys are down now."""
        last = self._record
        mask = sum(1 << bit for bit, key in enumerate(KEYS) if key in held)
        dt = min(now - last.t_alive, 0.1)
        opening = grip(last.grip, held, dt)
        changed = (mask, opening) != (last.mask, last.grip)
        t_event = now if changed else last.t_event
        self._record = KeyboardRecord(now, t_event, last.events + changed, mask, opening)
        self._mailbox.write(*self._record)


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Entry point of the child process; ``memories`` are the world's snapshots and the keyboard's record."""
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
    keyboard = Keyboard(KEYS, next(iter(ours))) if len(ours) == 1 else None
    notes = [] if keyboard else ["the viewer's window was not found on the display, so its keyboard is not used"]
    channel.send({"ready": {"keyboard": keyboard is not None, "notes": notes}})
    box = SeriesBox(memories[0].buffer[config["snapshot_offset"] :], config["snapshot_capacity"])
    mirror = Mirror(world, box)
    watch = KeyWatch(Mailbox(memories[1].buffer, LAYOUT))
    due = 0.0
    while os.getppid() == parent and world.client.isConnected():
        now = time.monotonic()
        if keyboard is not None:
            if not keyboard.present():
                return
            watch.look(keyboard.held(), now)
        try:
            while (message := channel.poll()) is not None:
                if message["method"] == "close":
                    return
                mirror.edited(message["method"], message["params"], message["revision"])
            if now >= due:
                mirror.update()
                due = now + _FRAME
        except (ConnectionLost, world.client.error):
            return  # the app or the window is gone
        time.sleep(max(0.0, now + _PERIOD - time.monotonic()))


def _arrange(world: World) -> None:
    """The whole bench in view, no panels, and keys and mouse that do nothing to the world."""
    client = world.client
    for option in ("COV_ENABLE_GUI", "COV_ENABLE_KEYBOARD_SHORTCUTS", "COV_ENABLE_MOUSE_PICKING"):
        client.configureDebugVisualizer(getattr(client, option), 0)
    bases = [robot.base_position for robot in world.spec.robots]
    x, y, z = (sum(axis) / len(bases) for axis in zip(*bases, strict=True)) if bases else (0.0, 0.0, 0.0)
    client.resetDebugVisualizerCamera(
        cameraDistance=1.9, cameraYaw=60.0, cameraPitch=-28.0, cameraTargetPosition=(x + 0.35, y, z + 0.2)
    )
