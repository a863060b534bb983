"""From where should the board be looked at? Tilted to all sides, turned, nearer and farther, here and there."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from ..geometry import Pose
from .board import Board
from .rotations import cross

__all__ = ["looks"]

Array = NDArray[np.float64]

_TILTS = np.radians([15.0, 25.0, 35.0])
_TURNS = np.radians([0.0, 25.0, -25.0, 50.0, -50.0])
_DISTANCES = (0.75, 0.9, 1.05)
"""Of that in the first view."""
_AZIMUTH = np.radians(137.5)
"""Golden angle: however many are taken, they are spread to all sides."""
_SQUARE_PX = 14.0
"""A square is at least so large in the picture, or its marker is not read."""
_MARGIN = 0.6
"""Share of the half picture within which the board's middle stays."""


def looks(board: Board, K: Array, size: tuple[int, int], first: Pose, count: int) -> list[Pose]:
    """Poses of the board in the camera's frame, around how it was seen first; the same ones every time.

    Args:
        board: what is looked at.
        K: (3, 3) of the camera.
        size: width and height of its pictures.
        first: the board in the camera's frame, where it was seen.
        count: how many.
    """
    start = first.matrix()
    middle = start[:3, :3] @ board.centre + start[:3, 3]
    far = K[0, 0] * board.square / _SQUARE_PX
    near = K[0, 0] * max(board.size) / (0.9 * min(size))
    found = []
    for k in range(count):
        distance = float(np.clip(_DISTANCES[k % 3] * np.linalg.norm(middle), min(near, far), far))
        ray = _ray(middle, K, size, (k % 4) / 3.0)
        facing = _shortest(start[:3, 2], ray) @ start[:3, :3]
        side = np.cross(ray, [1.0, 0.0, 0.0])
        side /= np.linalg.norm(side)
        tilt = _turn(_turn(ray, k * _AZIMUTH) @ side, _TILTS[(k // 2) % 3])
        pose = np.eye(4)
        pose[:3, :3] = _turn(ray, _TURNS[k % 5]) @ tilt @ facing
        pose[:3, 3] = distance * ray - pose[:3, :3] @ board.centre
        found.append(Pose.from_matrix(pose))
    return found


def _ray(middle: Array, K: Array, size: tuple[int, int], share: float) -> Array:
    """Direction of the board's middle: from where it was seen first (0) to the middle of the picture (1)."""
    seen = (K @ (middle / middle[2]))[:2]
    half = np.array(size) / 2.0
    inside = half + np.clip(seen - half, -_MARGIN * half, _MARGIN * half)
    ray = np.linalg.inv(K) @ [*(inside + share * (half - inside)), 1.0]
    return np.asarray(ray / np.linalg.norm(ray))


def _turn(axis: Array, angle: float) -> Array:
    """Rotation (3, 3) about a unit vector (Rodrigues's formula)."""
    k = cross(axis)
    return np.asarray(np.eye(3) + np.sin(angle) * k + (1.0 - np.cos(angle)) * (k @ k))


def _shortest(a: Array, b: Array) -> Array:
    """The shortest rotation (3, 3) that takes the unit vector ``a`` to ``b``."""
    axis = np.cross(a, b)
    sine = float(np.linalg.norm(axis))
    if sine < 1e-9:
        return np.eye(3)
    return _turn(axis / sine, float(np.arctan2(sine, a @ b)))
