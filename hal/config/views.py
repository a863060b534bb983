"""Where cameras stand: three ways to say it, each made into the pose of the optical frame (OpenCV's axes)."""

from __future__ import annotations

import math
from typing import Annotated, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray
from pydantic import AfterValidator, model_validator

from ..geometry import Pose, matrix_to_quaternion, quaternion_to_matrix, rpy_to_matrix
from ..specs import ViewSpec
from .schema import Degrees, Direction, Distance, Offset, PoseConfig, Position, Quantity, Several, Strict

__all__ = ["Attached", "LookAt", "optical_pose", "view_of"]

Array = NDArray[np.float64]


class LookAt(Strict):
    """A fixed camera that looks at a point, as PyBullet's ``computeViewMatrixFromYawPitchRoll`` means the numbers.

    With yaw, pitch and roll 0 and ``up_axis: z`` the camera stands at ``distance`` m from ``target`` towards -y,
    upright. Pitch turns that about x (-30: the camera stands 30 degrees above the target and looks down), roll about
    y, then yaw about z. Pitch beyond +-90 goes over the top: the picture is then upside down, as in PyBullet. World
    frame.
    """

    target: Position
    distance: Distance
    yaw_deg: Degrees = 0.0
    pitch_deg: Degrees = 0.0
    roll_deg: Degrees = 0.0
    up_axis: Literal["y", "z"] = "z"

    def pose(self) -> Pose:
        """Of the optical frame in the world."""
        yaw, pitch, roll = (math.radians(angle) for angle in (self.yaw_deg, self.pitch_deg, self.roll_deg))
        if self.up_axis == "z":
            turn = rpy_to_matrix(0, 0, yaw) @ rpy_to_matrix(0, roll, 0) @ rpy_to_matrix(pitch, 0, 0)
            back, up = np.array([0.0, -1.0, 0.0]), np.array([0.0, 0.0, 1.0])
        else:  # PyBullet turns in another order here
            turn = rpy_to_matrix(0, 0, roll) @ rpy_to_matrix(0, yaw, 0) @ rpy_to_matrix(-pitch, 0, 0)
            back, up = np.array([0.0, 0.0, -1.0]), np.array([0.0, 1.0, 0.0])
        eye = np.asarray(self.target) + self.distance * (turn @ back)
        return optical_pose(eye, -(turn @ back), turn @ up)


_ROTATION = Several(
    Quantity("rad", -2.0 * math.pi, 2.0 * math.pi), None, "roll, pitch, yaw; or a unit quaternion x, y, z, w"
)


def _three_or_unit(rotation: tuple[float, ...]) -> tuple[float, ...]:
    if len(rotation) not in (3, 4):
        raise ValueError(f"must be roll, pitch, yaw in rad, or a quaternion x, y, z, w, not {len(rotation)} numbers")
    if len(rotation) == 4 and abs(math.hypot(*rotation) - 1.0) > 0.01:
        raise ValueError("must be a unit quaternion x, y, z, w, or three angles in rad")
    return rotation


class Attached(Strict):
    """A camera on a link of a robot.

    It sits at ``translation`` (m, in the frame of the link). ``rotation`` (roll, pitch, yaw in rad, or a quaternion)
    turns a bracket there; in the bracket's frame the optical axis points along ``target`` and ``up`` is upwards in
    the picture (z when left out, or x for a camera that looks along z). So, without a rotation, a camera that looks
    along the fingers of a hand has ``target: [0, 0, 1]``.

    Or ``pose`` alone: of the optical frame (x right, y down, z forward) in the frame of the link, as calibration
    writes it.
    """

    robot: str
    link: str
    translation: Offset = (0.0, 0.0, 0.0)
    rotation: Annotated[tuple[float, ...], _ROTATION, AfterValidator(_three_or_unit)] = (0.0, 0.0, 0.0)
    target: Direction = (0.0, 0.0, 1.0)
    up: Direction | None = None
    pose: PoseConfig | None = None

    @model_validator(mode="after")
    def _one_way(self) -> Attached:
        others = sorted(self.model_fields_set & {"translation", "rotation", "target", "up"})
        if self.pose is not None and others:
            raise ValueError(f"pose says everything; it cannot stand beside {', '.join(others)}")
        return self

    @model_validator(mode="after")
    def _directions(self) -> Attached:
        if self.up is not None and np.linalg.norm(np.cross(self.target, self.up)) < 1e-6:
            raise ValueError("up must not lie along target")
        return self

    def optical(self) -> Pose:
        """Pose of the optical frame in the frame of the link."""
        if self.pose is not None:
            return Pose(self.pose.position, self.pose.orientation)
        target = np.asarray(self.target) / np.linalg.norm(self.target)
        up = self.up or ((0.0, 0.0, 1.0) if abs(target[2]) < 0.999 else (1.0, 0.0, 0.0))
        bracket = quaternion_to_matrix(self.rotation) if len(self.rotation) == 4 else rpy_to_matrix(*self.rotation)
        return optical_pose(self.translation, bracket @ target, bracket @ np.asarray(up))


def optical_pose(position: ArrayLike, forward: Array, up: Array) -> Pose:
    """Pose of a camera (x right, y down, z forward) from where it is, where it looks and what is upwards."""
    z = forward / np.linalg.norm(forward)
    x = np.cross(z, up)
    x /= np.linalg.norm(x)
    return Pose(position, matrix_to_quaternion(np.column_stack([x, np.cross(z, x), z])))


def view_of(pose: Pose, robot: str | None = None, link: str | None = None) -> ViewSpec:
    """A pose as the record that drivers get."""
    x, y, z = pose.position.tolist()
    a, b, c, d = pose.orientation.tolist()
    return ViewSpec((x, y, z), (a, b, c, d), robot, link)
