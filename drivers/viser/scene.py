"""The scene: arms with their handles, and the bodies of the simulated world around them."""

from __future__ import annotations

import itertools
import time
from collections.abc import Mapping, Sequence
from contextlib import suppress
from contextvars import ContextVar
from math import atan
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from viser import SceneApi, SceneNodeHandle, TransformControlsEvent, TransformControlsHandle

from hal.camera import frame_from_color
from hal.drivers.scene.drawn import DrawnBody, DrawnWorld, link_visual
from hal.drivers.scene.shapes import Visual
from hal.drivers.scene.urdf_files import absent_packages, drawn_visuals, where_to_get
from hal.errors import HalError
from hal.geometry import Pose, matrix_to_quaternion
from hal.host.records import GripperMail, RobotMail
from hal.kinematics.urdf import UrdfJoint, UrdfModel, read_urdf
from hal.specs import BodySpec, CameraSpec, RobotSpec, WorkspaceSpec, WorldSpec
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


class DrawnArm:
    """One arm: links, set-point, workspace. Every node is a child of the frame of the arm's base."""

    def __init__(self, scene: SceneApi, spec: RobotSpec, notes: list[str]) -> None:
        """Draw the arm in ``scene``; ``notes`` gets a line for everything that cannot be drawn.

        Raises HalError for a URDF that is wrong or cannot be read (code ``not_drawable``).
        """
        self.spec = spec
        try:
            urdf = read_urdf(Path(spec.urdf), meshes=False)  # a mesh that cannot be drawn becomes a note
        except (OSError, ValueError) as error:
            raise HalError(f"{spec.name} cannot be drawn: {spec.urdf}: {error}", code="not_drawable") from error
        root = f"/arms/{spec.name}"
        scene.add_frame(
            root,
            axes_length=0.12,
            axes_radius=0.004,
            position=spec.base_position,
            wxyz=_wxyz(spec.base_orientation),
        )
        self.paths, self._links = _draw_links(scene, f"{root}/links", urdf, spec, notes)
        self._set = scene.add_frame(f"{root}/set", axes_length=0.06, axes_radius=0.002, origin_radius=0.004)
        if spec.workspace is not None:
            lines = workspace_lines(spec.workspace)
            if len(lines):
                scene.add_line_segments(f"{root}/workspace", lines, _AMBER, thickness=0.003)

    def place(self, joints: Mapping[str, float], tcp_set: Pose) -> None:
        """Move the joints, rad or m, and the frame of the set-point to a pose in the base frame."""
        for joint, node in self._links:
            move_node(node, *joint.placement(joints))
        move_node(self._set, tcp_set.position, tcp_set.orientation)


class ArmView(DrawnArm):
    """An arm that is drawn from its mailboxes, and the handle on its tcp."""

    def __init__(
        self, scene: SceneApi, spec: RobotSpec, mail: RobotMail, gripper: GripperMail | None, notes: list[str]
    ) -> None:
        """Draw the arm; ``mail`` and ``gripper`` are its mailboxes in its host's memory, and those of its gripper."""
        super().__init__(scene, spec, notes)
        self.mail = mail
        self.gripper = gripper
        self.drag = HandleDrag()
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
        gripper = self.gripper.get() if self.gripper is not None else None
        width = None if gripper is None else gripper.state.width
        self.place(self.spec.joint_positions(state.q.tolist(), width), state.tcp_set)
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
                move_node(self._handle, goal.pose.position, goal.pose.orientation)
            elif free:
                move_node(self._handle, state.tcp.position.tolist(), state.tcp.orientation.tolist())


def _draw_links(
    scene: SceneApi, root: str, urdf: UrdfModel, spec: RobotSpec, notes: list[str]
) -> tuple[dict[str, str], list[tuple[UrdfJoint, SceneNodeHandle]]]:
    """Draw all links, each in a child frame of its parent's; return the paths of the links' frames, and the joints that
    move, with the frames that they move.

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
    return paths, moving


def draw_cameras(scene: SceneApi, cameras: Sequence[CameraSpec], arms: Sequence[DrawnArm]) -> None:
    """Draw what each camera sees as a small pyramid, in the world or on the link that carries it, if that is known."""
    paths = {arm.spec.name: arm.paths for arm in arms}
    for camera in cameras:
        if (view := camera.view) is not None:
            pose = Pose(view.position, view.orientation) @ frame_from_color(camera)
            wide, high = camera.width / camera.K[0][0], camera.height / camera.K[1][1]
            path = f"{paths[view.robot][str(view.link)] if view.robot else '/cameras'}/{camera.name}"
            node = scene.add_camera_frustum(path, 2.0 * atan(high / 2.0), wide / high, scale=0.06, thickness=0.003)
            move_node(node, pose.position, pose.orientation)


def workspace_lines(workspace: WorkspaceSpec) -> NDArray[np.float32]:
    """Return (n, 2, 3) line segments, the edges of all bounded sides of a workspace, in the base frame, m.

    Open sides are cut off near the base.
    """
    bounds = np.array([workspace.lower, workspace.upper])
    ends, segments = np.clip(bounds, -_OPEN_SIDE, _OPEN_SIDE), []
    for axis, first, second in itertools.product(range(3), (0, 1), (0, 1)):
        sides = [first, second], [(axis + 1) % 3, (axis + 2) % 3]
        if (ends[sides] == bounds[sides]).any():
            segment = ends.copy()
            segment[:, sides[1]] = ends[sides]
            segments.append(segment)
    return np.asarray(segments, np.float32).reshape(-1, 2, 3)


class BodiesView:
    """All bodies of a simulated world, drawn and posed as its cameras show them."""

    def __init__(self, scene: SceneApi, spec: WorldSpec, notes: list[str]) -> None:
        """Draw the bodies of ``spec``; ``notes`` gets a line for everything that cannot be drawn.

        Raises:
            HalError: A file of the world's record is broken.
        """
        self._scene = scene
        self._notes = notes
        self.world = DrawnWorld(spec)
        self._revision = -1
        self._drawn: dict[str, tuple[DrawnBody, tuple[Visual, ...], list[SceneNodeHandle]]] = {}
        """Name of a body -> the body, its shapes as they are drawn, and the frames of its links."""
        notes += self.world.notes
        self.show()

    def show(self) -> None:
        """Show the bodies where they are in :attr:`world`."""
        if self._revision != self.world.revision:
            self._revision = self.world.revision
            self._draw_changes()
        for body, _, nodes in self._drawn.values():
            frames = self.world.link_frames([(body.id, link) for link in range(len(nodes))])
            for node, frame in zip(nodes, frames, strict=True):
                move_node(node, frame[:3, 3], matrix_to_quaternion(frame[:3, :3]))

    def _draw_changes(self) -> None:
        """Draw the bodies that are new or look different, and remove those that are gone."""
        for name, (body, visuals, _) in tuple(self._drawn.items()):
            if self.world.bodies.get(name) is not body or body.visuals is not visuals:
                del self._drawn[name]
                self._scene.remove_by_name(f"/bodies/{name}")
        for name, body in self.world.bodies.items():
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
    if np.abs(node.position - at).max() > _AT_REST:
        node.position = at
    if min(np.abs(node.wxyz - turn).max(), np.abs(node.wxyz + turn).max()) > _AT_REST:
        node.wxyz = turn


def _wxyz(orientation: Vector) -> tuple[float, float, float, float]:
    """Return a quaternion x, y, z, w in viser's order."""
    x, y, z, w = map(float, orientation)
    return w, x, y, z
