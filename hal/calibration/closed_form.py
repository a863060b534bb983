"""Where the camera is, roughly, from nothing but the views.

From ``A_i X C_i = Z`` in two views follows ``(A_j^-1 A_i) X = X (C_j C_i^-1)``: the arm's motion between them and the
camera's are the same motion in two frames. Their rotation vectors are then one vector in two frames, which gives the
rotation of X (the least-squares solution of Park and Martin, IEEE Trans. Robotics and Automation 10(5), 1994); what is
left is linear in its translation.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from .errors import CalibrationFailed
from .rotations import inverse, mean, nearest, vector

__all__ = ["start"]

Array = NDArray[np.float64]

LIKE = np.radians(5.0)
"""A motion's angle is the same in both frames; views whose motions differ by more, in the median, are left out."""
HALF_TURN = np.radians(165.0)
"""Near a half turn the direction of a rotation vector may flip."""


def start(A: Array, C: Array) -> tuple[Array, Array]:
    """X and Z (4, 4) of ``A[i] X C[i] = Z`` for ``A`` and ``C`` (n, 4, 4).

    A view whose pose of the board was mistaken (a small, flat board may look the same from two sides) or during which
    something moved is left out, as long as most of the others agree. Raises CalibrationFailed if they do not.
    """
    count = len(A)
    arm = np.array([[vector((inverse(A[j]) @ A[i])[:3, :3]) for j in range(count)] for i in range(count)])
    camera = np.array([[vector((C[j] @ inverse(C[i]))[:3, :3]) for j in range(count)] for i in range(count)])
    unlike = np.abs(np.linalg.norm(arm, axis=2) - np.linalg.norm(camera, axis=2))
    good = np.flatnonzero(np.median(unlike, axis=1) < LIKE)
    if len(good) < max(3, count / 2):
        raise CalibrationFailed(
            f"only {len(good)} of {count} views agree on how far the arm turned: is it the right arm and link, did the "
            "board and the camera stay where they are fixed, and is each of them fixed to what was said?"
        )
    pairs = [(i, j) for i in good for j in good if i < j and max(_length(arm[i, j]), _length(camera[i, j])) < HALF_TURN]
    X = np.eye(4)
    X[:3, :3] = nearest(sum((np.outer(arm[i, j], camera[i, j]) for i, j in pairs), np.zeros((3, 3))))
    rows, right = [], []
    for i, j in pairs:
        A_ij, C_ij = inverse(A[j]) @ A[i], C[j] @ inverse(C[i])
        rows.append(A_ij[:3, :3] - np.eye(3))
        right.append(X[:3, :3] @ C_ij[:3, 3] - A_ij[:3, 3])
    X[:3, 3] = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    return X, mean(np.array([A[k] @ X @ C[k] for k in good]))


def _length(v: Array) -> float:
    return float(np.linalg.norm(v))
