"""What is shown: every arm, the things around them, and the panel."""

from __future__ import annotations

import threading
import time
from collections.abc import Sequence
from typing import Any

import numpy as np
from viser import ClientHandle, ViserServer

from hal.errors import HalError
from hal.host.hosts import SNAPSHOT_CAPACITY
from hal.host.memory import SeriesBox
from hal.host.process import SharedMemory
from hal.host.records import GroupMemory
from hal.specs import GroupSpec, WorldSpec

from .arm import ArmView
from .bodies import Bodies
from .panel import Panel

__all__ = ["Page"]

_WORLD = 1 / 15
"""How often things other than arms are moved, s."""


class Page:
    """Everything that is shown, the same on every page that is open."""

    def __init__(self, server: ViserServer, groups: Sequence[GroupSpec], memories: Sequence[SharedMemory]) -> None:
        self.notes: list[str] = []
        """What a person should know: what is not drawn, and why."""
        self.stop = threading.Event()
        """Somebody pressed Stop."""
        self._server = server
        self._due = 0.0
        self.bodies: Bodies | None = None
        arms: list[tuple[ArmView, GroupMemory]] = []
        found = [GroupMemory.of(shared.buffer, group) for group, shared in zip(groups, memories, strict=True)]
        grippers = {name: mail for memory in found for name, mail in memory.grippers.items()}
        for group, shared, memory in zip(groups, memories, found, strict=True):
            for robot in group.robots:
                mail, hand = memory.robots[robot.name], grippers[robot.gripper.name] if robot.gripper else None
                try:
                    arms.append((ArmView(server.scene, robot, mail, hand, self.notes), memory))
                except (OSError, ValueError) as error:
                    raise HalError(f"{robot.name} cannot be drawn: {error}") from error
            if group.world is not None:
                snapshots = SeriesBox(shared.buffer[GroupMemory.size_of(group) :], SNAPSHOT_CAPACITY)
                self.bodies = Bodies(server.scene, group.world, snapshots, self.notes)
        self.arms = [arm for arm, _ in arms]
        if not any(group.world is not None and _has_floor(group.world) for group in groups):
            server.scene.add_grid("/grid", 6.0, 6.0, cell_size=0.25)
        _look_from(server, [arm.spec.base_position for arm in self.arms])
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="small")
        self._panel = Panel(server, arms, self.put_back, self._stop, self.notes)
        server.on_client_disconnect(self._left)

    @property
    def watched(self) -> bool:
        """Is a page open?"""
        return bool(self._server.get_clients())

    async def _left(self, client: ClientHandle) -> None:
        for arm in self.arms:
            arm.drag.leave(client.client_id)

    def put_back(self) -> None:
        """All handles go back to their tcps."""
        for arm in self.arms:
            arm.drag.clear()

    def _stop(self) -> None:
        self.put_back()
        self.stop.set()

    def clear_goal(self, robot: str) -> None:
        """Put the handle of this arm back to the arm."""
        for arm in self.arms:
            if arm.spec.name == robot:
                arm.drag.clear()

    def edited(self, method: str, params: dict[str, Any], revision: int) -> None:
        """Note an edit of the simulated world, to be shown with the snapshot of its revision."""
        if self.bodies is not None:
            self.bodies.edited(method, params, revision)

    def update(self) -> None:
        """Look at the arms, and show them where somebody looks."""
        for arm in self.arms:
            arm.look()
        if not self.watched:
            if self.bodies is not None and self.bodies.behind:
                self.bodies.show()
            return
        now = time.monotonic()
        with self._server.atomic():
            for arm in self.arms:
                arm.show()
            if self.bodies is not None and now >= self._due:
                self._due = now + _WORLD
                self.bodies.show()
        self._panel.show()


def _has_floor(world: WorldSpec) -> bool:
    return any(body.shape == "plane" and body.visible for body in world.bodies)


def _look_from(server: ViserServer, bases: Sequence[Sequence[float]]) -> None:
    """All arms in view, from the front and a little above."""
    middle = np.mean(bases, axis=0) if bases else np.zeros(3)
    target = middle + (0.3, 0.0, 0.2)
    server.initial_camera.look_at = tuple(target)
    server.initial_camera.position = tuple(target + (1.2, -1.2, 0.6))
    server.initial_camera.fov = 0.75
