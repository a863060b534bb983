"""The process behind the page: it shows the arms and the world, and sends the goals of dragged handles to the app.

It only reads the memory of the hosts, so no page, and no error in this process, affects a servo.
"""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from contextlib import suppress
from typing import Any

import numpy as np
import viser
import websockets.asyncio.server
from viser import ClientHandle, ViserServer

from hal.drivers.scene.mirror import WorldMirror
from hal.errors import HalError, NotSupported
from hal.host.hosts import SNAPSHOT_CAPACITY
from hal.host.memory import SeriesBox
from hal.host.process import Channel, SharedMemory, serve
from hal.host.records import GroupMemory
from hal.host.scheduling import yield_to_others
from hal.kinematics.collisions import in_one_place
from hal.specs import CameraSpec, CollisionSpec, GroupSpec, from_json

from .scene import PAGE, ArmView, BodiesView, DrawnArm, draw_cameras
from .shapes import ShapesView

_NICE = 10
"""Niceness of this process: everything else comes first."""
_FRAME = 1 / 30
"""Time between two updates of the pages, s."""
_IDLE = 0.1
"""The same while no page is open, s."""
_WORLD_PERIOD = 1 / 15
"""Time between two updates of the bodies around the arms, and of the shapes that are near each other, s."""
_PINK = (200, 40, 160)
_REPEAT = 0.1
"""Time after which a goal is sent again as a sign of life, s."""


def main(channel: Channel, memories: Sequence[SharedMemory], config: dict[str, Any]) -> None:
    """Run the child process.

    Args:
        channel: Connection to the app.
        memories: Memory of each host, in the order of ``config["groups"]``.
        config: ``label`` of the page, ``address`` of its socket, the ``groups``, and the ``cameras``.
    """
    yield_to_others(_NICE)
    server = start_server(config["address"], config["label"])
    page = ViewerPage(server, [from_json(GroupSpec, group) for group in config["groups"]], memories)
    draw_cameras(server.scene, [from_json(CameraSpec, camera) for camera in config["cameras"]], page.arms)
    channel.send({"ready": {"notes": page.notes}})

    def update() -> float:
        due = time.monotonic() + (_FRAME if page.watched else _IDLE)
        page.update()
        page.report(channel)
        return max(0.0, due - time.monotonic())

    methods: Any = {"clear": page.clear_goal, "edited": page.note_edit, "forces": page.show_forces}
    serve(channel, methods, update)


class PrivateServer(ViserServer):
    """A viser server that only programs of this user on this machine reach."""

    def request_share_url(self, verbose: bool = True) -> None:
        """Do nothing: any page may request this tunnel, which would expose the arm to the internet."""


def start_server(address: str, label: str) -> PrivateServer:
    """Start a server at the Unix socket ``address``.

    Raises:
        HalError: The installed viser listens elsewhere (code ``viser_not_guarded``).
    """
    original = websockets.asyncio.server.serve

    def serve_private(handler: Any, host: str, port: int, **options: Any) -> Any:
        async def handle(connection: Any) -> None:
            page = connection.request.path[1:]
            PAGE.set(int(page) if page.isdecimal() else 0)
            await handler(connection)

        return original(handle, unix=True, path=address, **options)

    # viser has no setting for this. It finds the function in its module, and calls it in its constructor.
    websockets.asyncio.server.serve = serve_private  # type: ignore[misc,assignment]
    try:
        server = PrivateServer(host="127.0.0.1", port=0, label=label, verbose=False)
    finally:
        websockets.asyncio.server.serve = original  # type: ignore[misc]
    if not os.path.exists(address):
        server.stop()
        raise HalError(
            f"viser {viser.__version__} does not keep other users out; install viser 1.1", code="viser_not_guarded"
        )
    return server


class ViewerPage:
    """The scene, the same on every open page."""

    def __init__(self, server: ViserServer, groups: Sequence[GroupSpec], memories: Sequence[SharedMemory]) -> None:
        self.notes: list[str] = []
        """What is not drawn, and why; for the user."""
        self._server = server
        self._due = self._report_due = 0.0
        self._sent: tuple[dict[str, int], bool] = {}, False
        """Numbers of the goals, and whether a page was open, as they were sent last."""
        self.world: BodiesView | None = None
        self._mirror: WorldMirror | None = None
        self.arms: list[ArmView] = []
        found = [GroupMemory.of(shared.buffer, group) for group, shared in zip(groups, memories, strict=True)]
        grippers = {name: mail for memory in found for name, mail in memory.grippers.items()}
        for group, shared, memory in zip(groups, memories, found, strict=True):
            for robot in group.robots:
                mail, gripper = memory.robots[robot.name], grippers[robot.gripper.name] if robot.gripper else None
                self.arms.append(ArmView(server.scene, robot, mail, gripper, self.notes))
            if group.world is not None:
                snapshots = SeriesBox(shared.buffer[GroupMemory.size_of(group) :], SNAPSHOT_CAPACITY)
                try:
                    self.world = BodiesView(server.scene, group.world, self.notes)
                    self._mirror = WorldMirror(self.world.world, snapshots)
                except HalError as error:
                    self.notes.append(f"the world is not drawn: {error}")
        self._shapes = self._draw_shapes(groups)
        bodies = [body for group in groups if group.world is not None for body in group.world.bodies]
        if not any(body.shape == "plane" and body.visible for body in bodies):
            server.scene.add_grid("/grid", 6.0, 6.0, cell_size=0.25)
        self._forces = server.scene.add_arrows(
            "/forces", np.zeros((1, 2, 3)), _PINK, shaft_radius=0.003, head_radius=0.01, head_length=0.02, visible=False
        )
        set_camera(server, self.arms)
        server.on_client_disconnect(self._on_disconnect)

    def _draw_shapes(self, groups: Sequence[GroupSpec]) -> dict[str, ShapesView]:
        """Return what is drawn of each arm whose collision shapes are known."""
        arms, drawn = [arm.spec for arm in self.arms], dict[str, ShapesView]()
        for group in groups:
            for robot in group.robots:
                others = [arm for arm in arms if arm is not robot and not in_one_place(robot, arm)]
                with suppress(NotSupported):  # the host says so
                    check = group.collisions or CollisionSpec(own=False, arms=False)
                    drawn[robot.name] = ShapesView(self._server.scene, robot, others, check)
        return drawn

    @property
    def watched(self) -> bool:
        """Whether a page is open."""
        return bool(self._server.get_clients())

    async def _on_disconnect(self, _: ClientHandle) -> None:
        for arm in self.arms:
            arm.drag.leave(PAGE.get())

    def clear_goal(self, robot: str) -> None:
        """Put the handle of an arm back to the tcp, and clear the goal."""
        for arm in self.arms:
            if robot == arm.spec.name:
                arm.drag.clear()

    def show_forces(self, arrows: Sequence[Sequence[Sequence[float]]]) -> None:
        """Draw the forces on the arms as arrows: the ends of each in the world, m."""
        self._forces.visible = bool(arrows)
        if arrows:
            self._forces.points = np.array(arrows, np.float32)

    def report(self, channel: Channel) -> None:
        """Send the goals of the handles, and whether a page is open, when they change; goals periodically.

        Raises:
            ConnectionLost: The app is gone.
        """
        goals = {arm.spec.name: goal for arm in self.arms if (goal := arm.drag.goal) is not None}
        numbers = {robot: goal.seq for robot, goal in goals.items()}
        now, watched = time.monotonic(), self.watched
        if (numbers, watched) == self._sent and (not goals or now < self._report_due):
            return
        self._sent, self._report_due = (numbers, watched), now + _REPEAT
        poses = {name: (*goal.pose.position.tolist(), *goal.pose.orientation.tolist()) for name, goal in goals.items()}
        found = {name: [goal.seq, goal.page, *poses[name]] for name, goal in goals.items()}
        channel.send({"goals": found, "t": now, "watched": watched})

    def note_edit(self, method: str, params: dict[str, Any], revision: int) -> None:
        """Note an edit of the simulated world; it is shown with the snapshot of its revision."""
        if self._mirror is not None:
            self._mirror.note_edit(method, params, revision)

    def update(self) -> None:
        """Read the states of the arms, and show them if a page is open."""
        for arm in self.arms:
            arm.read_state()
        watched, now = self.watched, time.monotonic()
        with self._server.atomic():
            for arm in self.arms if watched else ():
                arm.update()
            if now >= self._due:
                self._due = now + _WORLD_PERIOD
                moved = self._mirror is not None and self._mirror.update() is not None
                if watched and moved and self.world is not None:
                    self.world.show()
                if watched:
                    self._show_shapes()

    def _show_shapes(self) -> None:
        states = {arm.spec.name: arm.state for arm in self.arms if arm.state is not None}
        for arm in self.arms:
            shapes, state, goal = self._shapes.get(arm.spec.name), arm.state, arm.drag.goal
            if shapes is not None and state is not None:
                shapes.show_near(states)
                shapes.show_ghost(arm.mail, state, None if goal is None else goal.pose)


def set_camera(server: ViserServer, arms: Sequence[DrawnArm]) -> None:
    """Show all arms from the front and a little above."""
    target = np.mean([arm.spec.base_position for arm in arms] or [(0.0, 0.0, 0.0)], axis=0) + (0.3, 0.0, 0.2)
    server.initial_camera.look_at = tuple(target)
    server.initial_camera.position = tuple(target + (1.2, -1.2, 0.6))
    server.initial_camera.fov = 0.75
