"""Quaternions (x, y, z, w) as plain floats, for the servo's hot path; elsewhere use :class:`hal.Pose`."""

from __future__ import annotations

from collections.abc import Sequence
from math import atan2, cos, sin, sqrt

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
    angle = sqrt(sum([x * x for x in vector]))
    scale = 0.5 if angle < 1e-9 else sin(0.5 * angle) / angle
    x, y, z = (scale * v for v in vector)
    w = cos(0.5 * angle)
    qx, qy, qz, qw = quaternion
    product = [
        w * qx + x * qw + y * qz - z * qy,
        w * qy - x * qz + y * qw + z * qx,
        w * qz + x * qy - y * qx + z * qw,
        w * qw - x * qx - y * qy - z * qz,
    ]
    norm = sqrt(sum([c * c for c in product]))
    return [c / norm for c in product]


def difference(start: Floats, end: Floats) -> list[float]:
    """The twist (6,) along the parent's axes that takes a pose (7,) to another in 1 s, turning the shorter way."""
    ax, ay, az, aw = start[3:]
    bx, by, bz, bw = end[3:]
    # The rotation from start to end along the parent's axes is end * conjugate(start).
    w = bw * aw + bx * ax + by * ay + bz * az
    turn = [
        -bw * ax + bx * aw - by * az + bz * ay,
        -bw * ay + bx * az + by * aw - bz * ax,
        -bw * az - bx * ay + by * ax + bz * aw,
    ]
    sine = sqrt(sum([x * x for x in turn]))
    scale = 2.0 * atan2(sine, abs(w)) / sine if sine > 1e-12 else 2.0
    if w < 0.0:
        scale = -scale
    return [b - a for a, b in zip(start[:3], end[:3], strict=True)] + [scale * x for x in turn]
