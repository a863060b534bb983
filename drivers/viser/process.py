"""The process behind the page: it shows the arms and the world, and sends the goals of dragged handles to the app.

It only reads the memory of the hosts, so no page, and no error in this process, affects a servo.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Sequence
from math import dist
from typing import Any

import numpy as np
from viser import ClientHandle, GuiEvent, ViserServer

from hal.errors import HalError
from hal.host.hosts import SNAPSHOT_CAPACITY
from hal.host.memory import SeriesBox
from hal.host.process import Channel, SharedMemory, serve
from hal.host.records import GroupMemory
from hal.host.scheduling import yield_to_others
from hal.specs import GroupSpec, from_json
from hal.types import Limited, Trip

from .guard import HOST, start_server
from .scene import ArmView, BodiesView

PORT = 8080
"""The first port to try."""
_NICE = 10
"""Niceness of this process: everything else comes first."""
_FRAME = 1 / 30
"""Time between two updates of the pages, s."""
_IDLE = 0.1
"""The same while no page is open, s."""
_WORLD_PERIOD = 1 / 15
"""Time between two updates of the bodies around the arms, s."""
_PANEL_PERIOD = 0.2
"""Time between two updates of the panel, s."""
_STALE = 0.3
"""Age from which on a state is shown as old, s."""
_REPEAT = 0.1
"""Time after which a goal is sent again as a sign of life, s."""
_STOP_HINT = "Stops every arm within its limits, if this page is connected. Use the console's stop first."


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Run the child process.

    Args:
        channel: Connection to the app.
        memories: Memory of each host, in the order of ``config["groups"]``.
        config: ``label`` and ``secret`` of the page, and the ``groups``.
    """
    yield_to_others(_NICE)
    server = start_server(PORT, config["label"], config["secret"])
    page = ViewerPage(server, [from_json(GroupSpec, group) for group in config["groups"]], memories)
    channel.send({"ready": {"address": f"http://{HOST}:{server.get_port()}", "notes": page.notes}})

    def update() -> float:
        due = time.monotonic() + (_FRAME if page.watched else _IDLE)
        page.update()
        page.report(channel)
        return max(0.0, due - time.monotonic())

    serve(channel, {"clear": page.clear_goal, "edited": page.note_edit}, update)


class ViewerPage:
    """The scene and the panel, the same on every open page."""

    def __init__(self, server: ViserServer, groups: Sequence[GroupSpec], memories: Sequence[SharedMemory]) -> None:
        self.notes: list[str] = []
        """What is not drawn, and why; for the user."""
        self.stop = threading.Event()
        """Set when *Stop* was pressed."""
        self._server = server
        self._due = self._report_due = 0.0
        self._sent: dict[str, int] = {}
        """Numbers of the goals that were sent last."""
        self.world: BodiesView | None = None
        arms: list[tuple[ArmView, GroupMemory]] = []
        found = [GroupMemory.of(shared.buffer, group) for group, shared in zip(groups, memories, strict=True)]
        grippers = {name: mail for memory in found for name, mail in memory.grippers.items()}
        for group, shared, memory in zip(groups, memories, found, strict=True):
            for robot in group.robots:
                mail, gripper = memory.robots[robot.name], grippers[robot.gripper.name] if robot.gripper else None
                try:
                    arms.append((ArmView(server.scene, robot, mail, gripper, self.notes), memory))
                except (OSError, ValueError) as error:
                    raise HalError(f"{robot.name} cannot be drawn: {error}", code="not_drawable") from error
            if group.world is not None:
                snapshots = SeriesBox(shared.buffer[GroupMemory.size_of(group) :], SNAPSHOT_CAPACITY)
                try:
                    self.world = BodiesView(server.scene, group.world, snapshots, self.notes)
                except HalError as error:
                    self.notes.append(f"the world is not drawn: {error}")
        self.arms = [arm for arm, _ in arms]
        bodies = [body for group in groups if group.world is not None for body in group.world.bodies]
        if not any(body.shape == "plane" and body.visible for body in bodies):
            server.scene.add_grid("/grid", 6.0, 6.0, cell_size=0.25)
        _set_camera(server, [arm.spec.base_position for arm in self.arms])
        server.gui.configure_theme(show_logo=False, show_share_button=False, control_width="small")
        self._panel = StatusPanel(server, arms, self.reset_handles, self._request_stop, self.notes)
        server.on_client_disconnect(self._on_disconnect)

    @property
    def watched(self) -> bool:
        """Whether a page is open."""
        return bool(self._server.get_clients())

    async def _on_disconnect(self, client: ClientHandle) -> None:
        for arm in self.arms:
            arm.drag.leave(client.client_id)

    def reset_handles(self) -> None:
        """Put all handles back to their tcps, and clear their goals."""
        for arm in self.arms:
            arm.drag.clear()

    def _request_stop(self) -> None:
        self.reset_handles()
        self.stop.set()

    def clear_goal(self, robot: str) -> None:
        """Put the handle of one arm back to its tcp, and clear its goal."""
        for arm in self.arms:
            if arm.spec.name == robot:
                arm.drag.clear()

    def report(self, channel: Channel) -> None:
        """Send the goals of the handles, when they change and periodically, and a press of *Stop*, to the app.

        Raises:
            ConnectionLost: The app is gone.
        """
        if self.stop.is_set():
            self.stop.clear()
            channel.send({"stop": True})
        goals = {arm.spec.name: goal for arm in self.arms if (goal := arm.drag.goal) is not None}
        numbers = {robot: goal.seq for robot, goal in goals.items()}
        now = time.monotonic()
        if numbers == self._sent and (not goals or now < self._report_due):
            return
        self._sent, self._report_due = numbers, now + _REPEAT
        poses = {robot: [goal.seq, *goal.position, *goal.orientation] for robot, goal in goals.items()}
        channel.send({"goals": poses, "t": now})

    def note_edit(self, method: str, params: dict[str, Any], revision: int) -> None:
        """Note an edit of the simulated world; it is shown with the snapshot of its revision."""
        if self.world is not None:
            self.world.note_edit(method, params, revision)

    def update(self) -> None:
        """Read the states of the arms, and show them if a page is open."""
        for arm in self.arms:
            arm.read_state()
        watched, now = self.watched, time.monotonic()
        with self._server.atomic():
            for arm in self.arms if watched else ():
                arm.update()
            if self.world is not None and now >= self._due:
                self._due = now + _WORLD_PERIOD
                self.world.update(watched=watched)
        if watched:
            self._panel.update()


class StatusPanel:
    """The panel beside the scene: the status of each arm, and two buttons."""

    def __init__(
        self,
        server: ViserServer,
        arms: Sequence[tuple[ArmView, GroupMemory]],
        reset_handles: Callable[[], None],
        stop: Callable[[], None],
        notes: Sequence[str],
    ) -> None:
        self._arms = arms
        self._due = 0.0
        gui = server.gui
        self._texts = [gui.add_markdown(f"**{arm.spec.name}**") for arm, _ in arms]
        reset_button = gui.add_button("Reset gizmo", hint="Put it back to the tool, and clear its goal.")
        stop_button = gui.add_button("Stop", color="red", hint=_STOP_HINT)
        gui.add_markdown("The arm moves to the gizmo while the dead-man is held, on the console or a gamepad.")
        gui.add_markdown("*Stop* is not an emergency stop: use the console's stop, or the robot's own.")
        for note in dict.fromkeys(notes):
            gui.add_markdown(f"*{note}*")

        @reset_button.on_click
        async def _(_: GuiEvent) -> None:  # type: ignore[type-arg]
            reset_handles()

        @stop_button.on_click
        async def _(_: GuiEvent) -> None:  # type: ignore[type-arg]
            stop()

    def update(self) -> None:
        """Update the texts, a few times a second."""
        now = time.monotonic()
        if now < self._due:
            return
        self._due = now + _PANEL_PERIOD
        for (arm, memory), text in zip(self._arms, self._texts, strict=True):
            new = arm_status(arm, now - memory.get_host().t)
            if text.content != new:
                text.content = new


def arm_status(arm: ArmView, age: float) -> str:
    """Return the status of an arm as Markdown; ``age`` is the time since its host last published a state, s."""
    head = f"**{arm.spec.name}**"
    state = arm.state
    if state is None:
        return f"{head}: state unknown"
    if age > _STALE:
        return f"{head}: **old state**, no update for {age:.0f} s"
    lines = [f"{head}: {state.status.name.lower()}"]
    if state.fault is not None:
        lines.append(f"**fault**: {state.fault}")
    if state.trip is not Trip.NONE:
        lines.append(f"**stopped**: {state.trip.name.lower().replace('_', ' ')}")
    lines.append(f"dead-man: {'**held**' if arm.deadman_held else 'released'}")
    lines.append(f"limited: {state.limited if state.limited is not Limited.NONE else 'no'}")
    goal = arm.drag.goal
    if goal is not None:
        lines.append(f"goal: {1000 * dist(state.tcp.position, goal.position):.0f} mm away")
    return "  \n".join(lines)


def _set_camera(server: ViserServer, bases: Sequence[Sequence[float]]) -> None:
    """Show all arms from the front and a little above."""
    middle = np.mean(bases, axis=0) if bases else np.zeros(3)
    target = middle + (0.3, 0.0, 0.2)
    server.initial_camera.look_at = tuple(target)
    server.initial_camera.position = tuple(target + (1.2, -1.2, 0.6))
    server.initial_camera.fov = 0.75
