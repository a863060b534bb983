"""Collision shapes of an arm in the 3D view: those that come near each other, and a ghost of where the arm is going."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray
from viser import MeshHandle, SceneApi

from hal.commands import Kind
from hal.errors import Unreachable
from hal.geometry import Pose, matrix_to_quaternion
from hal.host.records import RobotMail
from hal.kinematics.arm import Kinematics
from hal.kinematics.collision_model import CollisionModel, outline_of
from hal.kinematics.hulls import convex_hull
from hal.specs import CollisionSpec, RobotSpec
from hal.types import RobotState

from .scene import move_node

Array = NDArray[np.float64]
Color = tuple[int, int, int]

_NEAR = 0.03
"""Distance beyond the margin below which two shapes are amber, m."""
_NEARER = 0.7
"""The same as a share of what they have beyond the margin at home, if it is less: an arm at home has no colours."""
_AT_MARGIN = 0.002
"""Distance beyond the margin below which they are red, m: the servo lets them come no nearer."""
_AMBER, _RED, _GHOST, _WAY = (240, 160, 30), (220, 40, 40), (110, 150, 220), (50, 90, 200)
_WAY_LINES = 40
_AWAY = 0.02
"""Way of any joint to the goal from which on the ghost is shown, rad or m."""


class ShapesView:
    """The shapes that the collision check compares, amber near each other and red at the margin; and a ghost.

    The ghost is at the goal of the dragged handle, else at the end of the arm's motion, or at the goal of the newest
    command: joint positions, a pose of the tcp, or the last point of a chunk. A velocity has no goal. A line shows the
    way of the tcp in a motion or a chunk.
    """

    def __init__(self, scene: SceneApi, spec: RobotSpec, others: Sequence[RobotSpec], check: CollisionSpec) -> None:
        """Draw the shapes, hidden.

        Args:
            scene: The scene to draw them in.
            spec: The arm.
            others: All other arms.
            check: What is checked.

        Raises:
            NotSupported: An arm has no collision shapes, or a mesh that cannot be read.
        """
        self._robots = (spec, *others) if check.arms else (spec,)
        self._kinematics = Kinematics(spec.kinematics)
        self._near = CollisionModel(self._robots, check)
        self._near.place([x for robot in self._robots for x in robot.kinematics.home])
        margins = self._near.margins
        self._amber = margins + np.clip(_NEARER * (self._near.distances() - margins), 0.0, _NEAR)
        self._red = np.minimum(margins + _AT_MARGIN, self._amber)
        self._near_nodes = _draw(scene, f"/near/{spec.name}", self._near, 0.5)
        self._ghost = CollisionModel([spec], CollisionSpec())
        self._ghost.place(spec.kinematics.home)
        self._ghost_nodes = _draw(scene, f"/ghost/{spec.name}", self._ghost, 0.3)
        line = np.zeros((_WAY_LINES, 2, 3), np.float32)
        self._way = scene.add_line_segments(f"/arms/{spec.name}/way", line, _WAY, thickness=0.004, visible=False)
        self._goal: tuple[Kind, tuple[float, ...]] | None = None
        self._goal_q: Array | None = None

    def show_near(self, states: Mapping[str, RobotState]) -> None:
        """Colour the shapes that are near each other, in the newest states of all arms."""
        if any(robot.name not in states or not np.isfinite(states[robot.name].q).all() for robot in self._robots):
            return
        self._near.place(np.concatenate([states[robot.name].q for robot in self._robots]))
        distances, colors = self._near.distances(), dict[int, Color]()
        for bound, color in ((self._amber, _AMBER), (self._red, _RED)):
            for pair in np.flatnonzero(distances < bound):
                colors |= dict.fromkeys(self._near.indices[pair], color)
        _show(self._near_nodes, self._near, colors)

    def show_ghost(self, mail: RobotMail, state: RobotState, dragged: Pose | None) -> None:
        """Show the goal of the dragged handle, in the base frame, or of the newest command, if the arm is elsewhere."""
        goal = find_goal(mail, dragged)
        if goal != self._goal:
            self._goal, self._goal_q = goal, None if goal is None else self._solve(*goal, state)
            if self._goal_q is not None:
                self._ghost.place(self._goal_q)
            if goal is not None and goal[0] is Kind.JOINT_CHUNK:
                self._way.points = self._find_way(np.vstack((state.q, np.reshape(goal[1], (-1, len(state.q))))))
            self._way.visible = goal is not None and goal[0] is Kind.JOINT_CHUNK
        away = self._goal_q is not None and bool(np.abs(self._goal_q - state.q).max() > _AWAY)
        _show(self._ghost_nodes, self._ghost, dict.fromkeys(range(len(self._ghost_nodes)), _GHOST) if away else {})

    def _find_way(self, points: Array) -> NDArray[np.float32]:
        """Return the lines (k, 2, 3) of the tcp along joint positions (k, n)."""
        share = np.linspace(0.0, len(points) - 1, _WAY_LINES + 1)
        joints = np.transpose([np.interp(share, range(len(points)), part) for part in points.T])
        tcp = np.array([self._kinematics.fk(q)[:3] for q in joints], np.float32)
        return np.stack((tcp[:-1], tcp[1:]), axis=1)

    def _solve(self, kind: Kind, values: tuple[float, ...], state: RobotState) -> Array | None:
        """Return the joint positions (n,) of a goal; None if it is out of reach."""
        if kind is not Kind.CARTESIAN_TARGET:
            return np.array(values[-len(state.q) :] if kind is Kind.JOINT_CHUNK else values[: len(state.q)])
        try:
            return self._kinematics.solve(Pose(values[:3], values[3:]), state.q_set, starts=1)
        except Unreachable:
            return None


def find_goal(mail: RobotMail, dragged: Pose | None) -> tuple[Kind, tuple[float, ...]] | None:
    """Return what the arm goes to, with the kind of its values; those of a motion or a chunk are its points alone."""
    if dragged is not None:
        return Kind.CARTESIAN_TARGET, (*dragged.position.tolist(), *dragged.orientation.tolist())
    session, command = mail.get_session().session, mail.get_command()
    if way := mail.read_way(session):
        return Kind.JOINT_CHUNK, way
    if command is None or command.session != session or command.deadline < time.monotonic() or not command.values:
        return None
    if command.kind is Kind.JOINT_CHUNK:
        return command.kind, command.values[len(command.values) // (mail.n + 1) :]
    return (command.kind, command.values) if command.kind in (Kind.JOINT_TARGET, Kind.CARTESIAN_TARGET) else None


def _draw(scene: SceneApi, root: str, model: CollisionModel, opacity: float) -> list[MeshHandle]:
    """Draw the shapes of a model, hidden."""
    nodes = []
    for number, (_, shape, _) in enumerate(model.shapes()):
        hull = convex_hull(outline_of(shape))
        name, faces = f"{root}/{number}", hull.faces.astype(np.uint32)
        node = scene.add_mesh_simple(name, hull.points, faces, opacity=opacity, cast_shadow=False, visible=False)
        nodes.append(node)
    return nodes


def _show(nodes: Sequence[MeshHandle], model: CollisionModel, colors: Mapping[int, Color]) -> None:
    """Show the shapes that have a colour where they were placed last, and hide the others."""
    for number, (node, (_, _, pose)) in enumerate(zip(nodes, model.shapes(), strict=True)):
        if number in colors:
            move_node(node, pose[:3, 3], matrix_to_quaternion(pose[:3, :3]))
            node.color = colors[number]
        node.visible = number in colors
