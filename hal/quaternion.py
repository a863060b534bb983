"""Quaternions (x, y, z, w) as plain floats, for the servo's hot path; elsewhere use :class:`hal.Pose`."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, hypot, sin

__all__ = ["after_rotation", "difference", "rotate"]

Floats = Sequence[float]


def rotate(quaternion: Floats, vector: Floats) -> list[float]:
    """The vector (3,), given in a frame of that orientation, along the axes of the frame's parent."""
    qx, qy, qz, qw = quaternion
    x, y, z = vector
    # v + 2 q x (q x v + w v)
    cx, cy, cz = qy * z - qz * y + qw * x, qz * x - qx * z + qw * y, qx * y - qy * x + qw * z
    return [x + 2.0 * (qy * cz - qz * cy), y + 2.0 * (qz * cx - qx * cz), z + 2.0 * (qx * cy - qy * cx)]


def after_rotation(quaternion: Floats, vector: Floats) -> list[float]:
    """The orientation (4,) after a turn by the rotation vector (3,) in rad, both along the parent's axes."""
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
    """The twist (6,) along the parent's axes that takes a pose (7,) to another in 1 s, turning the shorter way."""
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
