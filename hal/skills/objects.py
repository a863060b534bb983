"""Where an object is and how wide: from points on its surface, or by ground truth; and the pose that grasps it.

Everything is in the arm's base frame, whose z axis must point up.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from ..errors import CommandError, NotSupported
from ..geometry import Pose

if TYPE_CHECKING:
    from ..gripper import Gripper
    from ..rig import Rig
    from ..robot import Robot

Array = NDArray[np.float64]

_TURN = math.radians(1.0)
"""Step of the search for the narrowest way across, rad."""
_SAME = 0.001
"""Difference up to which two boxes count as equally narrow, m."""
_TRIM = 0.5
"""Share of the points that may lie outside at either end, percent; against stray points."""
_SLICE = 0.004
"""Length of the slices in which the width is measured along an object, m."""
_WIDE = 0.9
"""Share of the greatest width from which on a slice counts as wide."""
_FINE = 0.003
"""Distance between points on the surface of a known shape, m."""


@dataclass(frozen=True)
class LocatedObject:
    """An object on a table, and the upright box around it, in the arm's base frame."""

    name: str
    """Name in the rig; empty for an object that a camera has seen."""
    pose: Pose
    """Middle of the box on the table: x along the longer side, y along the narrowest way across, z up."""
    size: tuple[float, float, float]
    """Length along x, width along y and height of the box, m."""
    widest: float
    """Where along x the object is widest across, from the middle, m: the place to grasp it."""
    points: Array
    """Points (k, 3) on its surface, m."""

    @property
    def width(self) -> float:
        """Width between the fingers that close along y, m."""
        return self.size[1]

    @property
    def height(self) -> float:
        """Height above the table, m."""
        return self.size[2]

    @property
    def table(self) -> float:
        """Height of the table, m."""
        return float(self.pose.position[2])


def object_from_points(points: Array, table: float | None = None, name: str = "") -> LocatedObject:
    """Return the object that points on its surface belong to.

    Args:
        points: Points (k, 3), at least 8, in the arm's base frame, m.
        table: Height of what it stands on, m; that of the lowest point if left out.
        name: Its name.
    """
    points = np.asarray(points, float)
    if points.ndim != 2 or points.shape[1] != 3 or len(points) < 8:
        raise CommandError(f"points must have shape (k, 3) with k of at least 8, not {points.shape}")
    if table is None:
        table = float(points[:, 2].min())
    yaw = _find_narrowest(points[:, :2])
    turn = np.array([[math.cos(yaw), math.sin(yaw)], [-math.sin(yaw), math.cos(yaw)]])
    along = points[:, :2] @ turn.T
    lower, upper = np.percentile(along, [_TRIM, 100.0 - _TRIM], axis=0)
    inside = ((along >= lower) & (along <= upper)).all(axis=1)
    widest, across = _find_widest(along[inside], lower[0], upper[0])
    middle = np.array([0.5 * (lower[0] + upper[0]), across])
    top = float(np.percentile(points[:, 2], 100.0 - _TRIM))
    length, width = upper - lower
    return LocatedObject(
        name,
        Pose.from_rpy([*(middle @ turn), table], (0.0, 0.0, yaw)),
        (float(length), float(width), max(0.0, top - table)),
        float(widest - middle[0]),
        points,
    )


def _find_narrowest(points: Array) -> float:
    """Return the angle of the long side of the narrowest box around points (k, 2), rad.

    Of boxes that are as narrow, as those around a mug with its handle, it is that of the longest.
    """
    yaws = np.arange(-0.5 * math.pi, 0.5 * math.pi, _TURN)
    axes = np.array([np.cos(yaws), np.sin(yaws)]), np.array([-np.sin(yaws), np.cos(yaws)])
    ends = (np.percentile(points @ axis, [_TRIM, 100.0 - _TRIM], axis=0) for axis in axes)
    length, width = (upper - lower for lower, upper in ends)
    return float(yaws[np.argmax(np.where(width <= width.min() + _SAME, length, 0.0))])


def _find_widest(points: Array, start: float, end: float) -> tuple[float, float]:
    """Return where along x points (k, 2) are widest across, and the middle across there, m."""
    edges = np.linspace(start, end, max(2, int((end - start) / _SLICE)) + 1)
    number = np.clip(np.searchsorted(edges, points[:, 0]) - 1, 0, len(edges) - 2)
    lower, upper = np.full(len(edges) - 1, np.inf), np.full(len(edges) - 1, -np.inf)
    np.minimum.at(lower, number, points[:, 1])
    np.maximum.at(upper, number, points[:, 1])
    width = np.where(upper >= lower, upper - lower, 0.0)
    wide = np.flatnonzero(width >= _WIDE * width.max())
    middle = 0.5 * (edges[wide[0]] + edges[wide[-1] + 1])
    return float(middle), float(np.median(0.5 * (lower[wide] + upper[wide])))


def grasp_pose(found: LocatedObject | None, gripper: Gripper, *, depth: float = 0.03, clearance: float = 0.012) -> Pose:
    """Return the pose of the tcp that grasps an object from above, across its narrowest way.

    The tcp's z axis points down and its fingers close along its y axis, as those of the Franka Hand do.

    Args:
        found: The object.
        gripper: The gripper.
        depth: Greatest distance of the tcp below the top of the object, m: the room between fingertips and palm.
        clearance: Least distance of the tcp from the table, m. More for fingers that come forward as they close: 0.03
            for a Robotiq 2F-85.

    Raises:
        CommandError: The object is wider than the gripper opens (``code`` is ``too_wide``), or ``found`` is None,
            because no object was found (``not_seen``).
    """
    if found is None:
        raise CommandError("no object was found, so there is nothing to grasp", code="not_seen")
    if found.width > gripper.width_max:
        text = f"the object is {found.width:.3f} m wide; {gripper.name} opens to {gripper.width_max:.3f} m"
        raise CommandError(text, code="too_wide")
    height = max(clearance, 0.4 * found.height, found.height - depth)
    return found.pose @ Pose.from_rpy((found.widest, 0.0, height), (math.pi, 0.0, 0.0))


# Ground truth.


def locate_by_truth(rig: Rig, arm: Robot, name: str) -> LocatedObject:
    """Return an object of the simulated world where it really is.

    Args:
        rig: The rig.
        arm: The arm in whose base frame it is given.
        name: Name of an object of ``rig.world``, of the rig's file or added later.

    Raises:
        NotSupported: Nothing is simulated (``code`` is ``no_world``), or a plane, which has no end.
        DeviceNotFound: There is no such object.
    """
    if not rig.has_world:
        raise NotSupported("ground truth exists in simulation only: find the object by depth", code="no_world")
    body, pose = rig.world.spec(name), arm.base.inverse() @ rig.world.pose(name)
    if body.shape == "urdf":
        from ..kinematics.urdf import read_urdf

        assert body.urdf is not None
        model = read_urdf(Path(body.urdf), meshes=False)
        places = model.poses(rig.world.joint_positions(name))
        parts = [
            places[link.name].transform(shape.pose.transform(_surface(shape.shape, shape.size, shape.file)))
            for link in model.links.values()
            for shape in link.collisions
        ]
        local = np.concatenate(parts) * body.scale if parts else np.zeros((0, 3))
    elif body.shape == "mesh":
        from ..kinematics.hulls import mesh_hulls

        assert body.mesh is not None
        hulls = mesh_hulls(body.mesh, body.scale, parts=body.parts)
        edges = ((hull.points[hull.faces], hull.points[np.roll(hull.faces, 1, axis=1)]) for hull in hulls)
        local = np.concatenate([_lines(start.reshape(-1, 3), end.reshape(-1, 3)) for start, end in edges])
    else:
        length, radius = body.length or 0.0, body.radius or 0.0
        sizes = {
            "box": tuple(2.0 * half for half in body.half_extents or ()),
            "sphere": (radius,),
            "cylinder": (radius, length),
            "capsule": (radius, length),
        }
        local = _surface(body.shape, sizes.get(body.shape, ()))
    if not len(local):
        raise NotSupported(f"the shape of {name!r} cannot be located: {body.shape}", code="unknown_shape")
    return object_from_points(pose.transform(local), name=name)


def _surface(shape: str, size: tuple[float, ...], file: str = "") -> Array:
    """Return points (k, 3) that outline a shape in its own frame, m; none for a shape that is not known here."""
    from trimesh import creation, load_mesh

    if shape == "mesh":
        vertices: Array = np.asarray(load_mesh(file).vertices, float) * size
        return vertices
    makers: dict[str, Callable[[], Any]] = {
        "box": lambda: creation.box(size),
        "sphere": lambda: creation.icosphere(radius=size[0]),
        "cylinder": lambda: creation.cylinder(size[0], size[1]),
        "capsule": lambda: creation.capsule(size[1], size[0], count=[16, 16]),
    }
    if shape not in makers:
        return np.zeros((0, 3))
    mesh = makers[shape]()
    points = mesh.vertices - mesh.bounds.mean(axis=0)  # some versions stand a capsule on its end
    return _lines(*np.moveaxis(points[mesh.edges_unique], 1, 0))


def _lines(starts: Array, ends: Array) -> Array:
    """Return points (k, 3) on lines from ``starts`` (n, 3) to ``ends`` (n, 3), m."""
    longest = float(np.linalg.norm(ends - starts, axis=1).max())
    steps = np.linspace(0.0, 1.0, max(2, int(longest / _FINE)))[:, None, None]
    points: Array = starts + steps * (ends - starts)
    return points.reshape(-1, 3)
