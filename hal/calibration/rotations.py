"""Rotations and small motions, many at a time."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

__all__ = ["angle", "between", "cross", "exponential", "inverse", "mean", "vector"]

Array = NDArray[np.float64]


def cross(v: Array) -> Array:
    """Matrices (..., 3, 3) that take the cross product with ``v`` (..., 3)."""
    zero = np.zeros(v.shape[:-1])
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    rows = [np.stack(row, -1) for row in ((zero, -z, y), (z, zero, -x), (-y, x, zero))]
    matrices: Array = np.stack(rows, -2)
    return matrices


def exponential(twist: Array) -> Array:
    """The motion (4, 4) of ``twist`` (6,): a translation, m, and a rotation vector, rad, each on its own."""
    motion = np.eye(4)
    motion[:3, 3] = twist[:3]
    turn = float(np.linalg.norm(twist[3:]))
    k = cross(twist[3:])
    small = turn < 1e-8
    motion[:3, :3] += k if small else np.sin(turn) / turn * k + (1.0 - np.cos(turn)) / turn**2 * (k @ k)
    return motion


def vector(rotation: Array) -> Array:
    """The rotation vector (3,), rad, at most pi long, of a rotation matrix (3, 3)."""
    axis = np.array([rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]])
    sine, cosine = float(np.linalg.norm(axis)) / 2.0, (float(np.trace(rotation)) - 1.0) / 2.0
    turn = float(np.arctan2(sine, cosine))
    if sine > 1e-6:
        return np.asarray(turn / (2.0 * sine) * axis)
    if cosine > 0.0:
        return np.asarray(axis / 2.0)
    column = int(np.argmax(np.diag(rotation)))  # a half turn: R + I is twice the axis times itself
    half = rotation[:, column] + np.eye(3)[column]
    return np.asarray(turn * half / np.linalg.norm(half))


def angle(rotation: Array) -> float:
    """Of a rotation matrix (3, 3), rad."""
    return float(np.linalg.norm(vector(rotation)))


def inverse(pose: Array) -> Array:
    """Of poses (..., 4, 4)."""
    result: Array = np.zeros_like(pose)
    turned = np.swapaxes(pose[..., :3, :3], -1, -2)
    result[..., :3, :3] = turned
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", turned, pose[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def mean(poses: Array) -> Array:
    """The pose (4, 4) in the middle of ``poses`` (n, 4, 4): the nearest rotation to their sum, the median position."""
    middle = np.eye(4)
    middle[:3, :3] = nearest(poses[:, :3, :3].sum(axis=0))
    middle[:3, 3] = np.median(poses[:, :3, 3], axis=0)
    return middle


def nearest(matrix: Array) -> Array:
    """The rotation (3, 3) nearest to a matrix (Arun, Huang and Blostein, IEEE PAMI 9(5), 1987)."""
    u, _, v = np.linalg.svd(matrix)
    return np.asarray(u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ v))]) @ v)


def between(a: Array, b: Array) -> tuple[float, float]:
    """Distance, m, and angle, rad, between two poses (4, 4)."""
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), angle(a[:3, :3].T @ b[:3, :3])
