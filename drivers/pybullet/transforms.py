"""Rigid transforms of plain floats. PyBullet's own multiplyTransforms rounds to single precision."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["Transform", "compose", "inverse"]

Floats = tuple[float, ...]
Transform = tuple[Floats, Floats]
"""Position (3,) in m and unit quaternion (4,) xyzw."""


def compose(a: Transform, b: Transform) -> Transform:
    """``b``, given in the frame ``a``, in the frame that ``a`` is given in."""
    (x, y, z), (ax, ay, az, aw) = a
    rx, ry, rz = _rotate(a[1], b[0])
    bx, by, bz, bw = b[1]
    orientation = (
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
        aw * bw - ax * bx - ay * by - az * bz,
    )
    return (x + rx, y + ry, z + rz), orientation


def inverse(a: Transform) -> Transform:
    """The pose of the parent frame in ``a``."""
    x, y, z, w = a[1]
    back = (-x, -y, -z, w)
    px, py, pz = _rotate(back, a[0])
    return (-px, -py, -pz), back


def _rotate(quaternion: Sequence[float], vector: Sequence[float]) -> tuple[float, float, float]:
    """``v + 2 w (u x v) + 2 u x (u x v)`` with u the vector part of the quaternion."""
    ux, uy, uz, w = quaternion
    x, y, z = vector
    tx, ty, tz = 2.0 * (uy * z - uz * y), 2.0 * (uz * x - ux * z), 2.0 * (ux * y - uy * x)
    return x + w * tx + uy * tz - uz * ty, y + w * ty + uz * tx - ux * tz, z + w * tz + ux * ty - uy * tx
