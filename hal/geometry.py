"""Rigid transforms: the class :class:`Pose`, and functions on plain floats for the servo's hot path.

Positions are in m, quaternions are (x, y, z, w), rotation vectors and Euler angles are in rad. "A pose in frame F"
means: the pose of an object's own frame, expressed in F, its parent frame.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from math import atan2, cos, hypot, sin

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .arguments import freeze, vector
from .errors import CommandError

Array = NDArray[np.float64]
Floats = Sequence[float]

_UNTURNED = freeze(np.array([0.0, 0.0, 0.0, 1.0]))


@dataclass(frozen=True, slots=True, eq=False)
class Pose:
    """A position (3,) in m and an orientation (4,) as a unit quaternion x, y, z, w; immutable, with read-only arrays.

    Args:
        position: Position (3,), m.
        orientation: Quaternion (4,) x, y, z, w, normalised here; None for no rotation, as for most objects of a
            scene. A target of a tcp needs an orientation (see :attr:`has_orientation`).

    Raises:
        CommandError: A wrong shape, a number that is not finite, or a quaternion of length 0.
    """

    position: Array
    orientation: Array

    def __init__(self, position: ArrayLike = (0.0, 0.0, 0.0), orientation: ArrayLike | None = None) -> None:
        p = vector("position", position, 3)
        object.__setattr__(self, "position", p)
        if orientation is None:
            object.__setattr__(self, "orientation", _UNTURNED)
            return
        q = vector("orientation", orientation, 4)
        norm = float(np.linalg.norm(q))
        if not 1e-9 < norm < np.inf:
            raise CommandError(f"orientation must be a unit quaternion x, y, z, w, not {q.tolist()}")
        object.__setattr__(self, "orientation", freeze(q / norm))

    @property
    def has_orientation(self) -> bool:
        """Whether an orientation was given."""
        return self.orientation is not _UNTURNED

    @classmethod
    def from_arrays(cls, position: Array, orientation: Array) -> Pose:
        """Return a pose of read-only arrays (3,) and (4,), finite and normalised; nothing is checked."""
        pose = cls.__new__(cls)
        object.__setattr__(pose, "position", position)
        object.__setattr__(pose, "orientation", orientation)
        return pose

    @classmethod
    def from_matrix(cls, matrix: ArrayLike) -> Pose:
        """Return the pose of a homogeneous matrix (4, 4)."""
        m = np.asarray(matrix, float)
        return cls(m[:3, 3], matrix_to_quaternion(m[:3, :3]))

    @classmethod
    def from_rpy(cls, position: ArrayLike, rpy: Sequence[float]) -> Pose:
        """Return the pose of a position and Euler angles.

        Args:
            position: Position (3,), m.
            rpy: Roll, pitch and yaw about the fixed axes, rad (URDF's convention).

        Raises:
            ValueError: An angle beyond two turns, which is probably in degrees.
        """
        if max(map(abs, rpy)) > 4.0 * np.pi:
            raise ValueError(f"roll, pitch and yaw are in rad, not degrees: {list(rpy)}")
        return cls(position, matrix_to_quaternion(rpy_to_matrix(*rpy)))

    def matrix(self) -> Array:
        """Return the homogeneous matrix (4, 4)."""
        m = np.eye(4)
        m[:3, :3] = quaternion_to_matrix(self.orientation)
        m[:3, 3] = self.position
        return m

    def transform(self, points: ArrayLike) -> Array:
        """Return points (3,) or (n, 3) of this frame, m, in the parent frame."""
        moved: Array = np.asarray(points, float) @ quaternion_to_matrix(self.orientation).T + self.position
        return moved

    def inverse(self) -> Pose:
        """Return the pose of the parent frame in this frame."""
        return Pose.from_matrix(np.linalg.inv(self.matrix()))

    def __matmul__(self, other: Pose) -> Pose:
        """Return the pose ``other``, which is given in this frame, in the parent frame."""
        return Pose.from_matrix(self.matrix() @ other.matrix())

    def distance(self, other: Pose) -> tuple[float, float]:
        """Return the distance in m and the angle in rad between two poses."""
        dot = min(1.0, abs(float(self.orientation @ other.orientation)))
        return float(np.linalg.norm(self.position - other.position)), 2.0 * float(np.arccos(dot))

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Pose):
            return NotImplemented
        same = np.array_equal(self.orientation, other.orientation) or np.array_equal(
            self.orientation, -other.orientation
        )
        return np.array_equal(self.position, other.position) and same

    def __hash__(self) -> int:
        return hash(self.position.tobytes())

    def __repr__(self) -> str:
        def text(values: Array) -> str:
            return "[" + ", ".join(f"{value:.4g}" for value in values) + "]"

        return f"Pose({text(self.position)}, {text(self.orientation)})"


def tcp_pose(name: str, pose: object) -> Pose:
    """Return ``pose`` if it has both a position and an orientation, as a target of a tcp must have.

    Raises:
        CommandError: Not a :class:`Pose` (``code`` is ``not_a_pose``), or one without an orientation
            (``no_orientation``).
    """
    if not isinstance(pose, Pose):
        raise CommandError(f"{name} must be a hal.Pose, not {type(pose).__name__}", code="not_a_pose")
    if not pose.has_orientation:
        raise CommandError(
            f"{name} has a position and no orientation: pass hal.Pose(position, orientation) with a quaternion "
            "x, y, z, w, for example arm.state().tcp.orientation; arm.move_to(position=...) keeps the present one",
            code="no_orientation",
        )
    return pose


# Rotation matrices


def quaternion_to_matrix(quaternion: ArrayLike) -> Array:
    """Return the rotation matrix (3, 3) of a quaternion (x, y, z, w), which is normalised first."""
    x, y, z, w = np.asarray(quaternion, float) / np.linalg.norm(quaternion)
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w)],
            [2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w)],
            [2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)],
        ]
    )


def matrix_to_quaternion(matrix: ArrayLike) -> Array:
    """Return the quaternion (x, y, z, w) with w >= 0 of a rotation matrix (3, 3).

    The branch on the largest component (Shepperd, 1978) stays accurate near half turns.
    """
    m = np.asarray(matrix, float)
    squares = np.array(
        [
            1 + m[0, 0] - m[1, 1] - m[2, 2],
            1 - m[0, 0] + m[1, 1] - m[2, 2],
            1 - m[0, 0] - m[1, 1] + m[2, 2],
            1 + m[0, 0] + m[1, 1] + m[2, 2],
        ]
    )
    largest = int(np.argmax(squares))
    s = 2.0 * np.sqrt(squares[largest])
    if largest == 3:
        q = [(m[2, 1] - m[1, 2]) / s, (m[0, 2] - m[2, 0]) / s, (m[1, 0] - m[0, 1]) / s, s / 4]
    elif largest == 0:
        q = [s / 4, (m[0, 1] + m[1, 0]) / s, (m[0, 2] + m[2, 0]) / s, (m[2, 1] - m[1, 2]) / s]
    elif largest == 1:
        q = [(m[0, 1] + m[1, 0]) / s, s / 4, (m[1, 2] + m[2, 1]) / s, (m[0, 2] - m[2, 0]) / s]
    else:
        q = [(m[0, 2] + m[2, 0]) / s, (m[1, 2] + m[2, 1]) / s, s / 4, (m[1, 0] - m[0, 1]) / s]
    quaternion = np.array(q)
    return quaternion if quaternion[3] >= 0 else -quaternion


def rpy_to_matrix(roll: float, pitch: float, yaw: float) -> Array:
    """Return the rotation matrix (3, 3) of roll, pitch, yaw in rad, as in URDF: Rz(yaw) Ry(pitch) Rx(roll)."""
    cr, sr, cp, sp, cy, sy = np.cos(roll), np.sin(roll), np.cos(pitch), np.sin(pitch), np.cos(yaw), np.sin(yaw)
    return np.array(
        [
            [cy * cp, cy * sp * sr - sy * cr, cy * sp * cr + sy * sr],
            [sy * cp, sy * sp * sr + cy * cr, sy * sp * cr - cy * sr],
            [-sp, cp * sr, cp * cr],
        ]
    )


# Plain floats: several times faster than NumPy for a single pose


Transform = tuple[tuple[float, ...], tuple[float, ...]]
"""Position (3,) in m and unit quaternion (4,)."""


def rotate(quaternion: Floats, vector: Floats) -> list[float]:
    """Return the vector (3,), given in a frame of this orientation, in the parent frame."""
    qx, qy, qz, qw = quaternion
    x, y, z = vector
    # v + 2 q x (q x v + w v)
    cx, cy, cz = qy * z - qz * y + qw * x, qz * x - qx * z + qw * y, qx * y - qy * x + qw * z
    return [x + 2.0 * (qy * cz - qz * cy), y + 2.0 * (qz * cx - qx * cz), z + 2.0 * (qx * cy - qy * cx)]


def apply_rotation(quaternion: Floats, vector: Floats) -> list[float]:
    """Return the orientation (4,) after a rotation by the rotation vector (3,) in rad; both in the parent frame."""
    x, y, z = vector
    angle = hypot(x, y, z)
    scale = 0.5 if angle < 1e-9 else sin(0.5 * angle) / angle
    x, y, z, w = scale * x, scale * y, scale * z, cos(0.5 * angle)
    qx, qy, qz, qw = quaternion
    a = w * qx + x * qw + y * qz - z * qy
    b = w * qy - x * qz + y * qw + z * qx
    c = w * qz + x * qy - y * qx + z * qw
    d = w * qw - x * qx - y * qy - z * qz
    norm = hypot(a, b, c, d)
    return [a / norm, b / norm, c / norm, d / norm]


def difference(start: Floats, end: Floats) -> list[float]:
    """Return the twist (6,) that moves one pose (7,) to another within 1 s, rotating the shorter way.

    Args:
        start: Position and quaternion (7,).
        end: Likewise.

    Returns:
        Linear velocity in m/s, then angular velocity in rad/s, along the axes of the parent frame.
    """
    x0, y0, z0, ax, ay, az, aw = start
    x1, y1, z1, bx, by, bz, bw = end
    # The rotation from start to end along the parent's axes is end * conjugate(start).
    w = bw * aw + bx * ax + by * ay + bz * az
    x = -bw * ax + bx * aw - by * az + bz * ay
    y = -bw * ay + bx * az + by * aw - bz * ax
    z = -bw * az - bx * ay + by * ax + bz * aw
    sine = hypot(x, y, z)
    scale = 2.0 * atan2(sine, abs(w)) / sine if sine > 1e-12 else 2.0
    if w < 0.0:
        scale = -scale
    return [x1 - x0, y1 - y0, z1 - z0, scale * x, scale * y, scale * z]


def compose(a: Transform, b: Transform) -> Transform:
    """Return the pose ``b``, which is given in frame ``a``, in the parent frame of ``a``."""
    (x, y, z), (ax, ay, az, aw) = a
    rx, ry, rz = rotate(a[1], b[0])
    bx, by, bz, bw = b[1]
    orientation = (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
    return (x + rx, y + ry, z + rz), orientation


def inverse(a: Transform) -> Transform:
    """Return the pose of the parent frame in frame ``a``."""
    x, y, z, w = a[1]
    back = (-x, -y, -z, w)
    px, py, pz = rotate(back, a[0])
    return (-px, -py, -pz), back
