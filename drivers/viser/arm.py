"""One arm on the page: its links, where its set-point is, its workspace, and the handle on its tcp."""

from __future__ import annotations

import time
from contextlib import suppress

import numpy as np
from numpy.typing import NDArray
from viser import SceneApi, SceneNodeHandle, TransformControlsEvent, TransformControlsHandle

from hal.geometry import Pose
from hal.host.records import GripperMail, RobotMail
from hal.servo.watchdog import PAD_SILENCE
from hal.specs import RobotSpec, WorkspaceSpec
from hal.types import RobotState, Trip

from .drawing import draw, place, wxyz
from .goals import Drag
from .urdf import Joint, UrdfTree, read_tree

__all__ = ["ArmView", "workspace_lines"]

_NEAR = 0.8
"""An open side of a workspace is drawn as far as this from the base, m."""
_AMBER = (230, 150, 30)


class ArmView:
    """Draws one arm from its mailboxes. Every node hangs on the frame of the arm's base.

    Raises ValueError and OSError when its URDF cannot be read.
    """

    def __init__(
        self, scene: SceneApi, spec: RobotSpec, mail: RobotMail, gripper: GripperMail | None, notes: list[str]
    ) -> None:
        self.spec = spec
        self.mail = mail
        self.gripper = gripper
        self.drag = Drag()
        self._tree = read_tree(spec.urdf)
        root = f"/arms/{spec.name}"
        scene.add_frame(
            root,
            axes_length=0.12,
            axes_radius=0.004,
            position=spec.base_position,
            wxyz=wxyz(spec.base_orientation),
        )
        self._links = _draw_links(scene, f"{root}/links", self._tree, spec, notes)
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
        handle.on_update(self._dragged)
        return handle

    async def _dragged(self, event: TransformControlsEvent) -> None:
        """On the server's own thread, so that the phases keep their order."""
        page = event.client_id
        if page is None:
            return
        if event.phase == "start":
            self.drag.grab(page)
        elif event.phase == "end":
            self.drag.release(page)
        else:
            w, x, y, z = event.target.wxyz.tolist()
            self.drag.move(page, event.target.position.tolist(), (x, y, z, w), time.monotonic())

    @property
    def held(self) -> bool:
        """Is the arm's dead-man held, by a pad that is alive?"""
        deadman = self.mail.get_deadman()
        return deadman is not None and deadman.held and time.monotonic() - deadman.t_alive < PAD_SILENCE

    def look(self) -> None:
        """Read the newest state, and see what becomes of the goal."""
        self.state = state = self.mail.get_state()
        if state is None:
            return
        tripped = state.trip is not Trip.NONE
        self.drag.update(time.monotonic(), (state.tcp, state.tcp_set), tripped=tripped)

    def show(self) -> None:
        """Bring the page up to date."""
        state = self.state
        if state is None:
            return
        values = dict(zip(self.spec.joints, state.q.tolist(), strict=True))
        hand = self.gripper.get() if self.gripper is not None else None
        if hand is not None and self.spec.gripper is not None:
            values |= dict.fromkeys(self.spec.gripper.joints, hand.state.width / 2.0)
        for joint, node in self._links:
            place(node, *joint.placement(values))
        place(self._set, state.tcp_set.position.tolist(), state.tcp_set.orientation.tolist())
        self._show_handle(state)

    def _show_handle(self, state: RobotState) -> None:
        goal, free = self.drag.goal, self.drag.free
        numbers = (self._handle.position, self._handle.wxyz)
        # viser keeps whatever a page sent: too few numbers, NaN, or whole numbers, in which it then loses fractions.
        sound = [part.shape for part in numbers] == [(3,), (4,)] and all(np.isfinite(part).all() for part in numbers)
        if not sound or (free and any(part.dtype != float for part in numbers)):
            self._handle = self._new_handle()
        with suppress(ValueError):  # it was sent just now; the next picture mends it
            if goal is not None:  # also where a second page, or one whose drag was refused, should see it
                place(self._handle, goal.position, goal.orientation)
            elif free:
                place(self._handle, state.tcp.position.tolist(), state.tcp.orientation.tolist())


def _draw_links(
    scene: SceneApi, root: str, tree: UrdfTree, spec: RobotSpec, notes: list[str]
) -> list[tuple[Joint, SceneNodeHandle]]:
    """All links, each in a frame that hangs on its parent's; returns the joints that move, with the frames they move.

    A page then puts the arm together by itself, and a joint that stands still needs no message.
    """
    base = spec.kinematics.base_link
    to_base = Pose() if base is None else tree.poses({})[base].inverse()
    paths = {tree.root: root}
    scene.add_frame(root, show_axes=False, position=to_base.position, wxyz=wxyz(to_base.orientation))
    moving: list[tuple[Joint, SceneNodeHandle]] = []
    for joint in tree.joints:
        path = paths[joint.child] = f"{paths[joint.parent]}/{joint.child}"
        position, orientation = joint.placement({})
        node = scene.add_frame(path, show_axes=False, position=np.array(position), wxyz=wxyz(orientation))
        if joint.moves:
            moving.append((joint, node))
    for link, visuals in tree.visuals.items():
        draw(scene, paths[link], visuals, notes)
    return moving


def workspace_lines(workspace: WorkspaceSpec) -> NDArray[np.float32]:
    """(n, 2, 3) segments around each bounded side of the workspace, in the base frame; open sides are cut off."""
    low = np.clip(workspace.lower, -_NEAR, _NEAR)
    high = np.clip(workspace.upper, -_NEAR, _NEAR)
    segments: list[list[NDArray[np.float64]]] = []
    for axis in range(3):
        for bound, drawn in ((workspace.lower[axis], low), (workspace.upper[axis], high)):
            if drawn[axis] != bound:
                continue
            a, b = (axis + 1) % 3, (axis + 2) % 3
            corners = []
            for first, second in ((low, low), (high, low), (high, high), (low, high)):
                corner = np.empty(3)
                corner[[axis, a, b]] = bound, first[a], second[b]
                corners.append(corner)
            segments += [[corners[k], corners[(k + 1) % 4]] for k in range(4)]
    return np.asarray(segments, np.float32).reshape(-1, 2, 3)
