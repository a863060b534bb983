"""Where are the board's corners in this picture, and is the picture good enough?"""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..geometry import Pose
from ..images import undistort_pixels
from .board import Board
from .errors import NoView
from .library import opencv
from .views import Sighting

__all__ = ["BLURRED", "LEAST_CORNERS", "Detector", "edge_width", "flat_pose"]

Array = NDArray[np.float64]

LEAST_CORNERS = 8
"""Fewer say too little of how the board is tilted."""
LEAST_SHARE = 0.3
"""Nor do fewer than this share of all corners."""
BLURRED = 0.09
"""An edge that is wider than this share of a square is blurred."""
_WORST_FIT = 1.5
"""Pixels (rms) that corners of a flat board in a sharp picture may be off."""
_WORST_CORNER = 2.0
"""Pixels that one corner may be off before it is left out,"""
_MOST = 0.7
"""as long as so many of the corners are left."""
_OFF = "is it flat, is it this board, are K and distortion the camera's?"


class Detector:
    """Finds one board in pictures."""

    def __init__(self, board: Board) -> None:
        self.board = board
        self._cv2 = opencv()
        aruco = self._cv2.aruco
        found = aruco.DetectorParameters()
        found.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        self._detector = aruco.CharucoDetector(board.for_opencv(), aruco.CharucoParameters(), found)

    def find(self, picture: NDArray[np.uint8], K: ArrayLike, distortion: ArrayLike) -> Sighting:
        """The board in a picture, (H, W, 3) RGB or (H, W), of a camera with ``K`` and ``distortion`` (5,).

        Raises NoView, which says why, when it is not there, or not well enough to be seen.
        """
        grey = picture if picture.ndim == 2 else self._cv2.cvtColor(picture, self._cv2.COLOR_RGB2GRAY)
        corners, numbers, _, markers = self._detector.detectBoard(grey)
        if corners is None or numbers is None or len(numbers) == 0:
            seen = 0 if markers is None else len(markers)
            raise NoView(
                "the board is not in the picture" if seen == 0 else f"only {seen} of its markers are sharp enough"
            )
        pixels, order = np.asarray(corners, float).reshape(-1, 2), np.asarray(numbers).reshape(-1)
        points = self.board.corners[order]
        self._check_enough(points)
        side = self._side(pixels, points)
        pixels = self._exact(grey, pixels, side)
        blur = edge_width(grey, pixels, side)
        if blur > max(3.0, BLURRED * side):
            raise NoView(f"the picture is blurred: edges are {blur:.1f} pixels wide, a square {side:.0f}")
        camera = np.asarray(K, float)
        try:
            pixels = undistort_pixels(pixels, camera, distortion)
        except ValueError as reason:
            raise NoView(str(reason)) from None
        flat = self._on_one_plane(points, pixels)
        if flat.sum() < _MOST * len(flat):
            raise NoView(f"{(~flat).sum()} of its {len(flat)} corners are off a flat board: {_OFF}")
        points, pixels = points[flat], pixels[flat]
        self._check_enough(points)
        pose, error = flat_pose(points, pixels, camera)
        if error > _WORST_FIT:
            raise NoView(f"its corners are {error:.1f} pixels off a flat board: {_OFF}")
        return Sighting(points, pixels, camera, pose, error, blur)

    def _check_enough(self, points: Array) -> None:
        total = (self.board.columns - 1) * (self.board.rows - 1)
        least = max(min(LEAST_CORNERS, total), LEAST_SHARE * total)
        if len(points) < least:
            raise NoView(f"only {len(points)} of {total} corners are seen clearly; it needs {int(np.ceil(least))}")
        if np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)[1] < self.board.square:
            raise NoView("the corners that are seen lie along one line; show more of the board")

    def _on_one_plane(self, points: Array, pixels: Array) -> NDArray[np.bool_]:
        """(n,) which corners are where one plane has them. A marker that was misread puts its corners elsewhere."""
        cv2 = self._cv2
        _, inside = cv2.findHomography(np.ascontiguousarray(points[:, :2]), pixels, cv2.RANSAC, _WORST_CORNER)
        return np.zeros(len(points), bool) if inside is None else inside.reshape(-1).astype(bool)

    def _side(self, pixels: Array, points: Array) -> float:
        """Of the smallest square in the picture, pixels: the least distance of two neighbours."""
        apart = np.linalg.norm(points[:, None] - points[None], axis=2) / self.board.square
        neighbours = (apart > 0.5) & (apart < 1.1)
        sides = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)[neighbours]
        if not sides.size:
            raise NoView("no two neighbouring corners are seen; show more of the board")
        return float(sides.min())

    def _exact(self, grey: NDArray[np.uint8], pixels: Array, side: float) -> Array:
        """Corners to a fraction of a pixel, looked for no farther away than the next marker's edge."""
        cv2 = self._cv2
        margin = (self.board.square - self.board.marker) / (2.0 * self.board.square)
        half = int(np.clip(margin * side, 2, 11))
        enough = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
        start = np.ascontiguousarray(pixels.reshape(-1, 1, 2), np.float32)
        return np.asarray(cv2.cornerSubPix(grey, start, (half, half), (-1, -1), enough), float).reshape(-1, 2)


def flat_pose(points: Array, pixels: Array, K: Array) -> tuple[Pose, float]:
    """Pose in the camera's frame of flat points (n, 3), z = 0, seen at ideal pixels (n, 2); their rms error, pixels.

    A flat thing has two poses that look nearly alike; the better one is taken. Raises NoView where both are nonsense.
    """
    cv2 = opencv()
    points, pixels = np.ascontiguousarray(points), np.ascontiguousarray(pixels)
    count, turns, shifts, _ = cv2.solvePnPGeneric(points, pixels, K, None, flags=cv2.SOLVEPNP_IPPE)
    found: list[tuple[float, Array]] = []
    for start in zip(turns[:count], shifts[:count], strict=True):
        turn, shift = cv2.solvePnPRefineLM(points, pixels, K, None, *start)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(turn)[0], np.ravel(shift)
        p = points @ pose[:3, :3].T + pose[:3, 3]
        if np.isfinite(p).all() and (p[:, 2] > 0.0).all():
            off = pixels - (p / p[:, 2:]) @ K[:2].T
            found.append((float(np.sqrt((off**2).sum(axis=1).mean())), pose))
    if not found:
        raise NoView("by its corners the board is not in front of the camera")
    error, best = min(found, key=lambda one: one[0])
    return Pose.from_matrix(best), error


def edge_width(grey: NDArray[np.uint8], pixels: Array, side: float) -> float:
    """Width of the edges at corners, pixels: contrast over steepness, the median of all corners.

    A sharp edge is one or two pixels wide.
    """
    half = max(2, round(0.3 * side))
    height, width = grey.shape
    found = []
    for x, y in np.round(pixels).astype(int):
        if half <= x < width - half and half <= y < height - half:
            patch = grey[y - half : y + half + 1, x - half : x + half + 1].astype(float)
            steepest = np.hypot(*np.gradient(patch)).max()
            low, high = np.percentile(patch, [5.0, 95.0])
            found.append((high - low) / max(steepest, 1e-9))
    return float(np.median(found)) if found else 0.0
