"""Find the cubes of a task in the picture of a camera with depth, as on a bench without any other measurement."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ...errors import NotSupported
from ...geometry import Pose
from ...observation import Observation
from ...skills.depth import largest_cluster
from ...types import Frame
from ..gym import RigEnv

Array = NDArray[np.float64]

_LEAST = 30
"""Points of a cube below which it counts as hidden."""
_ABOUT = 0.25
"""How far from the middle of the work area a cube may be, m."""
_HIGH = 0.35
"""Greatest height of a cube over the table, m."""
_LOW = 0.004
"""Height over the table below which points are the table's, m."""
_ALIKE = 0.9
"""Least cosine of the angle between the hue of a pixel and that of a cube."""
_COLORFUL = 0.3
"""Least share of the greatest of red, green and blue that the least is smaller by."""
_EDGE = 0.01
"""Share of the points that are beyond an edge of a cube: some of them are noise."""
_MOST = 300
"""Points of a cube of which a fit makes use."""
_YAWS = np.deg2rad(np.arange(-45.0, 45.0, 1.0))
_AXES = np.array([[[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]] for yaw in _YAWS])
"""Axes of a cube with each of these turns (yaws, 2, 2)."""


class DepthJudge:
    """Finds the cubes of a task by their colour and their depth. They stand upright, on the table or in the hand.

    Args:
        env: The task; the first of its rig's cameras with colour and depth is used.
        entries: The task's objects.

    Raises:
        NotSupported: An object is no cube (code ``not_by_depth``), or no camera has colour and depth (``no_depth``).
    """

    def __init__(self, env: RigEnv, entries: Sequence[Mapping[str, Any]]) -> None:
        self._env = env
        self._cubes = [entry for entry in entries if entry.get("collision", True)]
        self.names = {entry["name"] for entry in self._cubes}
        """Names of the objects that are found in pictures; goals are none."""
        for entry in self._cubes:
            if entry.get("shape") != "box" or len(set(entry["half_extents"])) > 1:
                text = f"{type(env).__name__}: depth finds cubes, and {entry['name']} is none; use judge='truth'"
                raise NotSupported(text, code="not_by_depth")
        cameras = [camera for camera in env.rig.cameras.values() if {"color", "depth"} <= set(camera.spec.streams)]
        if not cameras:
            text = "no camera of the rig has colour and depth, by which a task without ground truth is judged"
            raise NotSupported(f"{text}; add one to the rig file, with streams: [color, depth]", code="no_depth")
        self.camera = cameras[0].name
        """Name of the camera."""

    def find(self, observation: Observation, centre: Array) -> dict[str, Pose]:
        """Return the pose in the arm's base frame of each cube in the newest picture near ``centre`` (2,), m."""
        base, frame = self._env.robot.base, observation.cameras[self.camera].frame
        if frame.T_world_camera is None:
            text = f"the pose of camera {self.camera} is unknown: calibrate it, or give it look_at in the rig file"
            raise NotSupported(text, code="no_camera_pose")
        eye = (base.inverse() @ frame.T_world_camera).position
        found = {}
        for entry in self._cubes:
            points = select_points(frame, base, entry["rgba"][:3], centre)
            if len(points) >= _LEAST:
                found[entry["name"]] = find_cube(points, 2.0 * entry["half_extents"][0], eye)
        return found


def select_points(frame: Frame, base: Pose, rgb: Sequence[float], centre: Array) -> Array:
    """Return the points (k, 3), m, in the arm's base frame of the largest thing that has a colour.

    Args:
        frame: A picture with colour and depth.
        base: The arm's base in the world.
        rgb: The colour, each number in 0 to 1. Only its hue counts, so that light and shadow do not.
        centre: Middle of the work area (2,), m; what is far from it is ignored.
    """
    x, y, z = np.moveaxis(frame.point_image(base), 2, 0)
    near = (z > _LOW) & (z < _HIGH) & (np.abs(x - centre[0]) < _ABOUT) & (np.abs(y - centre[1]) < _ABOUT)
    near &= np.asarray(frame.depth) > 0.0
    points = np.column_stack([x[near], y[near], z[near]]).astype(float)
    colors = np.asarray(frame.color)[near].astype(float)
    most, least = colors.max(axis=1), colors.min(axis=1)
    hue, wanted = colors - colors.mean(axis=1, keepdims=True), np.subtract(rgb, np.mean(rgb))
    length = np.linalg.norm(hue, axis=1) * np.linalg.norm(wanted)
    alike = (hue @ wanted > _ALIKE * length) & (most - least > _COLORFUL * most)
    return largest_cluster(points[alike], 0.01) if alike.any() else points[:0]


def find_cube(points: Array, side: float, eye: Array) -> Pose:
    """Return the pose of an upright cube of which a camera sees these points: its middle, turned by up to 45 degrees.

    The turn is that at which the points lie best on the three faces towards the camera. Each face is where the points
    are nearest to the camera, so that neither a hidden half nor fingers in front of it move the cube.

    Args:
        points: Points of its surface (k, 3), m.
        side: Length of its sides, m.
        eye: Position of the camera (3,), m.
    """
    points = points[:: 1 + len(points) // _MOST]
    edge = round((len(points) - 1) * (1.0 - _EDGE))
    top = np.sort(points[:, 2])[edge]
    along = _AXES @ points[:, :2].T
    towards = np.sign(_AXES @ eye[:2] - np.median(along, axis=2))[..., None]
    faces = towards * np.sort(along * towards, axis=2)[..., edge : edge + 1]
    off = np.minimum(np.abs(along - faces).min(axis=1), top - points[:, 2])
    best = int(np.abs(off).mean(axis=1).argmin())
    x, y = _AXES[best].T @ (faces - 0.5 * side * towards)[best, :, 0]
    return Pose.from_rpy((x, y, float(top) - 0.5 * side), (0.0, 0.0, float(_YAWS[best])))
