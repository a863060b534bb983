"""The scene: arms with their handles, and the bodies of the simulated world around them."""

from __future__ import annotations

import time
from collections.abc import Sequence
from contextlib import suppress
from contextvars import ContextVar
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser import SceneApi, SceneNodeHandle, TransformControlsEvent, TransformControlsHandle

from hal.drivers.scene.drawn import DrawnBody, DrawnWorld, link_visual
from hal.drivers.scene.mirror import WorldMirror
from hal.drivers.scene.shapes import Visual
from hal.drivers.scene.urdf_files import absent_packages, drawn_visuals, where_to_get
from hal.geometry import Pose, matrix_to_quaternion
from hal.host.memory import SeriesBox
from hal.host.records import GripperMail, RobotMail
from hal.kinematics.urdf import UrdfJoint, UrdfModel, read_urdf
from hal.specs import BodySpec, RobotSpec, WorkspaceSpec, WorldSpec
from hal.types import RobotState, Trip

from .goals import HandleDrag
from .meshes import visuals_glb

Vector = Sequence[float] | NDArray[np.float64]

PAGE: ContextVar[int] = ContextVar("page", default=0)
"""Number of the console's page whose connection is served; 0 for one that came without the console."""
_OPEN_SIDE = 0.8
"""Distance from the base at which an open side of a workspace is drawn, m."""
_AMBER = (230, 150, 30)
_AT_REST = 1e-5
"""A node that moves by less is not updated, m and parts of a quaternion: an arm at rest costs no messages."""


class ArmView:
    """One arm, drawn from its mailboxes: links, set-point, workspace, and the handle on its tcp.

    Every node is a child of the frame of the arm's base.
    """

    def __init__(
        self, scene: SceneApi, spec: RobotSpec, mail: RobotMail, gripper: GripperMail | None, notes: list[str]
    ) -> None:
        """Draw the arm.

        Args:
            scene: The scene to draw it in.
            spec: The arm.
            mail: The arm's mailboxes in its host's memory.
            gripper: Those of its gripper, if it has one.
            notes: Gets a line for everything that cannot be drawn.

        Raises:
            ValueError: Its URDF is wrong.
            OSError: Its URDF cannot be read.
        """
        self.spec = spec
        self.mail = mail
        self.gripper = gripper
        self.drag = HandleDrag()
        urdf = _read_urdf(spec.urdf)
        root = f"/arms/{spec.name}"
        scene.add_frame(
            root,
            axes_length=0.12,
            axes_radius=0.004,
            position=spec.base_position,
            wxyz=_wxyz(spec.base_orientation),
        )
        self._links = _draw_links(scene, f"{root}/links", urdf, spec, notes)
        self._set = scene.add_frame(f"{root}/set", axes_length=0.06, axes_radius=0.002, origin_radius=0.004)
        if spec.workspace is not None:
            lines = workspace_lines(spec.workspace)
            if len(lines):
                scene.add_line_segments(f"{root}/workspace", lines, _AMBER, thickness=0.003)
        self.state: RobotState | None = None
        self._scene = scene
        self._handle = self._new_handle()

    def _new_handle(self) -> TransformControlsHandle:
        handle = self._scene.add_transform_controls(
            f"/arms/{self.spec.name}/handle", scale=0.18, line_width=3.0, depth_test=False
        )
        handle.on_update(self._on_drag)
        return handle

    async def _on_drag(self, event: TransformControlsEvent) -> None:
        """Handle a drag on the server's own thread, so that its phases keep their order."""
        page = PAGE.get()
        if event.phase == "start":
            self.drag.grab(page)
        elif event.phase == "end":
            self.drag.release(page)
        else:
            w, x, y, z = event.target.wxyz.tolist()
            self.drag.move(page, event.target.position.tolist(), (x, y, z, w), time.monotonic())

    def read_state(self) -> None:
        """Read the newest state, and end the goal where it is reached, unused, or older than a trip."""
        self.state = state = self.mail.get_state()
        if state is None:
            return
        tripped = state.trip is not Trip.NONE
        self.drag.update(time.monotonic(), (state.tcp, state.tcp_set), tripped=tripped)

    def update(self) -> None:
        """Update the page."""
        state = self.state
        if state is None:
            return
        values = dict(zip(self.spec.joints, state.q.tolist(), strict=True))
        gripper = self.gripper.get() if self.gripper is not None else None
        if gripper is not None and self.spec.gripper is not None:
            positions = self.spec.gripper.finger_positions(gripper.state.width)
            values |= dict(zip(self.spec.gripper.joints, positions, strict=True))
        for joint, node in self._links:
            move_node(node, *joint.placement(values))
        move_node(self._set, state.tcp_set.position.tolist(), state.tcp_set.orientation.tolist())
        self._update_handle(state)

    def _update_handle(self, state: RobotState) -> None:
        goal, free = self.drag.goal, self.drag.free
        numbers = (self._handle.position, self._handle.wxyz)
        # viser keeps whatever a page sent: too few numbers, NaN, or whole numbers, in which it then loses fractions.
        sound = [part.shape for part in numbers] == [(3,), (4,)] and all(np.isfinite(part).all() for part in numbers)
        if not sound or (free and any(part.dtype != float for part in numbers)):
            self._handle = self._new_handle()
        with suppress(ValueError):  # sent just now by a page; the next update corrects it
            if goal is not None:  # for a second page, and for one whose drag was refused
                move_node(self._handle, goal.position, goal.orientation)
            elif free:
                move_node(self._handle, state.tcp.position.tolist(), state.tcp.orientation.tolist())


def _draw_links(
    scene: SceneApi, root: str, urdf: UrdfModel, spec: RobotSpec, notes: list[str]
) -> list[tuple[UrdfJoint, SceneNodeHandle]]:
    """Draw all links, each in a child frame of its parent's; return the joints that move, with the frames they move.

    The page composes the frames by itself, so a joint at rest needs no message.
    """
    base = spec.kinematics.base_link
    to_base = Pose() if base is None else urdf.poses({})[base].inverse()
    paths = {urdf.root: root}
    scene.add_frame(root, show_axes=False, position=to_base.position, wxyz=_wxyz(to_base.orientation))
    moving: list[tuple[UrdfJoint, SceneNodeHandle]] = []
    for joint in urdf.outwards:
        path = paths[joint.child] = f"{paths[joint.parent]}/{joint.child}"
        position, orientation = joint.placement({})
        node = scene.add_frame(path, show_axes=False, position=np.array(position), wxyz=_wxyz(orientation))
        if joint.movable:
            moving.append((joint, node))
    for name, visuals in shown_visuals(urdf, spec.name, notes).items():
        _draw_visuals(scene, paths[name], visuals, notes)
    return moving


def workspace_lines(workspace: WorkspaceSpec) -> NDArray[np.float32]:
    """Return (n, 2, 3) line segments around each bounded side of a workspace, in the base frame, m.

    Open sides are cut off near the base.
    """
    low = np.clip(workspace.lower, -_OPEN_SIDE, _OPEN_SIDE)
    high = np.clip(workspace.upper, -_OPEN_SIDE, _OPEN_SIDE)
    segments = []
    for axis in range(3):
        a, b = (axis + 1) % 3, (axis + 2) % 3
        for bound, drawn in ((workspace.lower[axis], low), (workspace.upper[axis], high)):
            if drawn[axis] == bound:
                ring = np.full((5, 3), bound)
                ring[:, a] = low[a], high[a], high[a], low[a], low[a]
                ring[:, b] = low[b], low[b], high[b], high[b], low[b]
                segments.append(np.stack((ring[:-1], ring[1:]), axis=1))
    return np.asarray(segments, np.float32).reshape(-1, 2, 3)


class BodiesView:
    """All bodies of a simulated world, drawn and posed as its cameras show them."""

    def __init__(self, scene: SceneApi, spec: WorldSpec, snapshots: SeriesBox, notes: list[str]) -> None:
        """Draw the bodies of ``spec``; ``notes`` gets a line for everything that cannot be drawn.

        Raises:
            HalError: A file of the world's record is broken.
        """
        self._scene = scene
        self._notes = notes
        self._world = DrawnWorld(spec)
        self._mirror = WorldMirror(self._world, snapshots)
        self._revision = -1
        self._drawn: dict[str, tuple[DrawnBody, tuple[Visual, ...], list[SceneNodeHandle]]] = {}
        """Name of a body -> the body, its shapes as they are drawn, and the frames of its links."""
        notes += self._world.notes
        self._show()

    def note_edit(self, method: str, params: dict[str, Any], revision: int) -> None:
        """Note an edit of the world; it is repeated here before the first snapshot of its revision is shown."""
        self._mirror.note_edit(method, params, revision)

    def update(self, *, watched: bool) -> None:
        """Follow the world, and update the page if one is open."""
        if self._mirror.update() is not None and watched:
            self._show()

    def _show(self) -> None:
        if self._revision != self._world.revision:
            self._revision = self._world.revision
            self._draw_changes()
        for body, _, nodes in self._drawn.values():
            frames = self._world.link_frames([(body.id, link) for link in range(len(nodes))])
            for node, frame in zip(nodes, frames, strict=True):
                move_node(node, frame[:3, 3], matrix_to_quaternion(frame[:3, :3]))

    def _draw_changes(self) -> None:
        """Draw the bodies that are new or look different, and remove those that are gone."""
        for name, (body, visuals, _) in tuple(self._drawn.items()):
            if self._world.bodies.get(name) is not body or body.visuals is not visuals:
                del self._drawn[name]
                self._scene.remove_by_name(f"/bodies/{name}")
        for name, body in self._world.bodies.items():
            if name not in self._drawn and isinstance(body.spec, BodySpec) and body.spec.visible:
                self._drawn[name] = body, body.visuals, self._draw(body, body.spec)

    def _draw(self, body: DrawnBody, spec: BodySpec) -> list[SceneNodeHandle]:
        """Draw a body; return the frames of its links."""
        root = f"/bodies/{body.name}"
        if spec.shape == "plane":
            self._scene.add_grid(root, 6.0, 6.0, cell_size=0.25, position=spec.position, wxyz=_wxyz(spec.orientation))
            return []
        self._scene.add_frame(root, show_axes=False)
        nodes: list[SceneNodeHandle] = []
        for link in range(len(body.links)):
            nodes.append(self._scene.add_frame(f"{root}/{link}", show_axes=False))
            shapes = [visual for visual in body.visuals if visual.link == link]
            _draw_visuals(self._scene, f"{root}/{link}", shapes, self._notes)
        return nodes


def _read_urdf(path: str) -> UrdfModel:
    """Read a URDF. Raises ValueError, which names the file, or OSError."""
    try:
        return read_urdf(Path(path), meshes=False)  # a mesh that cannot be drawn becomes a note
    except ValueError as error:
        raise ValueError(f"{path}: {error}") from None


def shown_visuals(urdf: UrdfModel, name: str, notes: list[str]) -> dict[str, list[Visual]]:
    """Return what is drawn of each link, with a note for each package of meshes that is not installed."""
    absent = absent_packages(str(urdf.path))
    notes += [f"{name}: drawn with plain shapes; the meshes are in {where_to_get(package)}" for package in absent]
    return {
        key: [link_visual(shape) for shape in (drawn_visuals(link) if absent else link.visuals)]
        for key, link in urdf.links.items()
    }


def _draw_visuals(scene: SceneApi, parent: str, visuals: Sequence[Visual], notes: list[str]) -> None:
    """Draw the visual shapes of a link in its frame; ``notes`` gets a line for each that cannot be drawn."""
    data = visuals_glb(visuals, notes)
    if data:
        scene.add_glb(f"{parent}/visual", data)


def move_node(node: SceneNodeHandle, position: Vector, orientation: Vector) -> None:
    """Set the pose of a node in its parent's frame, unless it is there already; orientation x, y, z, w."""
    at, turn = np.asarray(position, float), np.asarray(_wxyz(orientation))
    if not _alike(node.position, at):
        node.position = at
    if not _alike(node.wxyz, turn) and not _alike(node.wxyz, -turn):
        node.wxyz = turn


def _alike(present: NDArray[np.float64], wanted: NDArray[np.float64]) -> bool:
    return bool(np.abs(present - wanted).max() <= _AT_REST)


def _wxyz(orientation: Vector) -> tuple[float, float, float, float]:
    """Return a quaternion x, y, z, w in viser's order."""
    x, y, z, w = map(float, orientation)
    return w, x, y, z
