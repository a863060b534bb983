"""Something to look at: a table with squares of 5 cm, and a box that moves on it.

All of it is known exactly, so what a driver makes of the pictures can be compared with the truth in millimetres.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from hal.geometry import Pose, quaternion_to_matrix

from .figures import Lens

__all__ = ["PHASES", "STEP", "Scene"]

Array = NDArray[np.float64]

PHASES = 8
"""Pictures after which everything repeats; only the number drawn into them goes on."""
STEP = 0.03
"""How far the box moves from one picture to the next, m."""
_TILT = math.radians(45.0)  # how far the colour sensor looks below the horizon
_HEIGHT = 0.6  # m above the table
_SQUARE = 0.05  # m
_WALL = 1.6  # m ahead of the camera, along the table; as high as one looks
_BOX = (0.12, 0.09, 0.12)  # m along right, up and ahead
_DARK, _LIGHT, _BACK = (60, 52, 44), (176, 160, 140), (96, 112, 128)
_FACES = ((200, 60, 40), (235, 120, 60), (150, 40, 30))  # of the box: its sides, its top, front and back


class Scene:
    """Seen from anywhere, in any of its phases; ``seed`` moves and colours the box."""

    def __init__(self, seed: int = 0) -> None:
        chance = np.random.default_rng(seed)
        self._x, self._ahead = chance.uniform(-0.05, 0.05), 0.6 + chance.uniform(-0.04, 0.08)
        self._turn = int(chance.integers(3))  # which colour is red's
        # Rows: right, up and ahead on the table, along the axes of the colour sensor's frame (x right, y down).
        c, s = math.cos(_TILT), math.sin(_TILT)
        self._R = np.array([[1.0, 0.0, 0.0], [0.0, -c, -s], [0.0, -s, c]])

    def look(self, lens: Lens, width: int, height: int, pose: Pose, phase: int) -> tuple[Array, NDArray[np.uint8]]:
        """Depth (H, W) along the optical axis, m, and colours (H, W, 3) RGB, for a sensor at ``pose`` in the colour
        sensor's frame."""
        eye = self._R @ pose.position
        rays = self._rays(lens, width, height, pose)
        depth, colors = self._background(eye, rays)
        low, high = self._box(phase)
        rows, columns = self._extent(lens, width, height, pose, low, high)
        if rows.start < rows.stop and columns.start < columns.stop:
            self._draw_box(eye, rays[rows, columns], low, high, depth[rows, columns], colors[rows, columns])
        return depth, colors

    def _rays(self, lens: Lens, width: int, height: int, pose: Pose) -> Array:
        """(H, W, 3) directions in the table's axes, 1 m of depth long."""
        local = np.ones((height, width, 3))
        local[..., 0] = (np.arange(width) - lens.cx) / lens.fx
        local[..., 1] = ((np.arange(height) - lens.cy) / lens.fy)[:, None]
        rays: Array = local @ (self._R @ quaternion_to_matrix(pose.orientation)).T
        return rays

    def _background(self, eye: Array, rays: Array) -> tuple[Array, NDArray[np.uint8]]:
        with np.errstate(divide="ignore"):
            table = (-_HEIGHT - eye[1]) / rays[..., 1]
            wall = (_WALL - eye[2]) / rays[..., 2]
        table[table <= 0.0] = np.inf
        wall[wall <= 0.0] = np.inf
        depth = np.minimum(table, wall)
        depth[~np.isfinite(depth)] = 0.0
        x, ahead = eye[0] + depth * rays[..., 0], eye[2] + depth * rays[..., 2]
        dark = (np.floor(x / _SQUARE) + np.floor(ahead / _SQUARE)).astype(int) % 2 == 0
        colors = np.where(dark[..., None], np.array(_DARK, np.uint8), np.array(_LIGHT, np.uint8))
        colors[wall < table] = _BACK
        return depth, colors

    def _box(self, phase: int) -> tuple[Array, Array]:
        """Its lowest and highest corner, in the table's axes from the colour sensor."""
        middle = np.array([self._x + (phase - (PHASES - 1) / 2.0) * STEP, _BOX[1] / 2.0 - _HEIGHT, self._ahead])
        return middle - np.array(_BOX) / 2.0, middle + np.array(_BOX) / 2.0

    def _extent(self, lens: Lens, width: int, height: int, pose: Pose, low: Array, high: Array) -> tuple[slice, slice]:
        """Rows and columns outside which the box is not to be seen."""
        corners = np.array(np.meshgrid(*zip(low, high, strict=True))).reshape(3, -1).T @ self._R
        x, y, z = pose.inverse().transform(corners).T
        z = np.maximum(z, 1e-3)
        u, v = lens.fx * x / z + lens.cx, lens.fy * y / z + lens.cy
        return (
            slice(max(0, math.floor(v.min())), max(0, min(height, math.ceil(v.max()) + 1))),
            slice(max(0, math.floor(u.min())), max(0, min(width, math.ceil(u.max()) + 1))),
        )

    def _draw_box(
        self, eye: Array, rays: Array, low: Array, high: Array, depth: Array, colors: NDArray[np.uint8]
    ) -> None:
        """Where a ray enters all three pairs of the box's planes before it leaves any of them, it hits the box."""
        with np.errstate(divide="ignore", invalid="ignore"):
            one, other = (low - eye) / rays, (high - eye) / rays
        enters, leaves = np.fmin(one, other), np.fmax(one, other)
        face, hit = enters.argmax(axis=2), enters.max(axis=2)
        seen = (hit < leaves.min(axis=2)) & (hit > 0.0) & (hit < depth)
        depth[seen] = hit[seen]
        colors[seen] = np.roll(np.array(_FACES, np.uint8), self._turn, axis=1)[face[seen]]
