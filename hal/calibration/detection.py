"""Detection of a board in an image: the corners' pixels, the board's pose, and whether the image is good enough."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..driver import CameraInfo
from ..errors import HalError
from ..geometry import Pose
from ..images import undistort_pixels
from ..types import Frame
from .board import Board, opencv

Array = NDArray[np.float64]

LEAST_CORNERS = 8
"""Fewer corners determine the tilt of the board too poorly."""
LEAST_SHARE = 0.3
"""So does a smaller share of all corners."""
BLURRED = 0.09
"""An edge wider than this share of a square is blurred."""
_WORST_FIT = 1.5
"""Largest rms error of the corners of a flat board in a sharp image, pixels."""
_WORST_CORNER = 2.0
"""Largest error of one corner before it is left out, pixels,"""
_LEAST_FLAT = 0.7
"""as long as this share of the corners remains."""
_NOT_FLAT = "check that it is flat, that it is the given board, and that K and distortion belong to this camera"


class NoView(HalError, ValueError):
    """An image cannot be used; the next one may be usable.

    ``code`` is one of ``no_board``, ``too_few_corners``, ``blurred``, ``not_flat``, ``bad_distortion``, ``no_image``,
    ``arm_moving``, ``camera_changed`` and ``too_similar``.
    """

    code = "no_view"


@dataclass(frozen=True, eq=False)
class BoardDetection:
    """The board in one image."""

    points: Array
    """(n, 3) detected corners in the board's frame, m."""
    pixels: Array
    """(n, 2) where a camera with this ``K`` and no distortion sees them; (0, 0) is the centre of the first pixel."""
    K: Array
    """(3, 3)"""
    T_camera_board: Pose
    """The board in the camera's optical frame, by this image alone."""
    error_px: float
    """Distance of the corners from where that pose puts them, rms."""


class CalibrationImage(NamedTuple):
    """The image of a frame in which the board is detected, and its optical frame."""

    picture: NDArray[np.uint8]
    """(H, W, 3) RGB, or (H, W)."""
    K: Array
    """(3, 3)"""
    distortion: Array
    """(5,)"""
    T_color_eye: Pose
    """Pose of the image's optical frame in the colour sensor's, which a rig's file refers to."""


def select_image(frame: Frame, info: CameraInfo, align: str) -> CalibrationImage:
    """Return the colour image of a frame, or the infrared one if there is no colour.

    Raises:
        NoView: The frame has neither image.
    """
    if frame.color is not None:
        depth = info.streams.get("depth") if align == "depth" else None
        return CalibrationImage(
            frame.color, frame.K, frame.distortion, Pose() if depth is None else depth.T_color_stream
        )
    if frame.infrared is None:
        raise NoView("the camera streams neither colour nor infrared", code="no_image")
    K = frame.K if info.K_infrared is None else info.K_infrared
    sensor = info.streams.get("infrared")
    if sensor is None:  # all streams share one view
        return CalibrationImage(frame.infrared, K, frame.distortion, Pose())
    return CalibrationImage(frame.infrared, K, sensor.distortion, sensor.T_color_stream)


class Detector:
    """Detects one board in images.

    Args:
        board: The board, with the size of its squares as printed.

    Raises:
        DriverMissing: OpenCV is not installed.
    """

    def __init__(self, board: Board) -> None:
        self.board = board
        self._cv2 = opencv()
        aruco = self._cv2.aruco
        parameters = aruco.DetectorParameters()
        parameters.cornerRefinementMethod = aruco.CORNER_REFINE_SUBPIX
        self._detector = aruco.CharucoDetector(board.make_opencv(), aruco.CharucoParameters(), parameters)

    def find_corners(self, picture: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Detect the board's corners, whatever the camera's intrinsics are.

        Args:
            picture: (H, W, 3) RGB, or (H, W).

        Returns:
            The corners (n, 3) in the board's frame, m, and their pixels (n, 2).

        Raises:
            NoView: The board is not in the image, or not visible well enough.
        """
        grey = picture if picture.ndim == 2 else self._cv2.cvtColor(picture, self._cv2.COLOR_RGB2GRAY)
        corners, numbers, _, markers = self._detector.detectBoard(grey)
        if corners is None or numbers is None or len(numbers) == 0:
            seen = 0 if markers is None else len(markers)
            if seen == 0:
                raise NoView("the board is not in the image", code="no_board")
            raise NoView(f"only {seen} of the board's markers are sharp enough", code="too_few_corners")
        pixels, order = np.asarray(corners, float).reshape(-1, 2), np.asarray(numbers).reshape(-1)
        points = self.board.corners[order]
        self._check_enough(points)
        side = self._measure_smallest_side(pixels, points)
        pixels = self._refine_corners(grey, pixels, side)
        blur = edge_width(grey, pixels, side)
        if blur > max(3.0, BLURRED * side):
            raise NoView(f"the image is blurred: edges are {blur:.1f} pixels wide, a square {side:.0f}", code="blurred")
        return points, pixels

    def find(self, picture: NDArray[np.uint8], K: ArrayLike, distortion: ArrayLike) -> BoardDetection:
        """Detect the board.

        Args:
            picture: (H, W, 3) RGB, or (H, W).
            K: (3, 3) of the camera.
            distortion: (5,) of the camera.

        Raises:
            NoView: The board is not in the image, or not visible well enough.
        """
        points, pixels = self.find_corners(picture)
        camera = np.asarray(K, float)
        try:
            pixels = undistort_pixels(pixels, camera, distortion)
        except ValueError as error:
            raise NoView(str(error), code="bad_distortion") from None
        flat = self._find_coplanar(points, pixels)
        if flat.sum() < _LEAST_FLAT * len(flat):
            raise NoView(
                f"{(~flat).sum()} of {len(flat)} corners do not fit a flat board: {_NOT_FLAT}", code="not_flat"
            )
        points, pixels = points[flat], pixels[flat]
        self._check_enough(points)
        pose, rms = flat_pose(points, pixels, camera)
        if rms > _WORST_FIT:
            raise NoView(f"the corners are {rms:.1f} pixels off a flat board: {_NOT_FLAT}", code="not_flat")
        return BoardDetection(points, pixels, camera, pose, rms)

    def _check_enough(self, points: Array) -> None:
        total = (self.board.columns - 1) * (self.board.rows - 1)
        least = max(min(LEAST_CORNERS, total), LEAST_SHARE * total)
        if len(points) < least:
            raise NoView(
                f"only {len(points)} of {total} corners are visible; at least {int(np.ceil(least))} are needed",
                code="too_few_corners",
            )
        if np.linalg.svd(points[:, :2] - points[:, :2].mean(axis=0), compute_uv=False)[1] < self.board.square:
            raise NoView("the visible corners are along one line; show more of the board", code="too_few_corners")

    def _find_coplanar(self, points: Array, pixels: Array) -> NDArray[np.bool_]:
        """(n,) which corners fit one plane; those of a misread marker do not."""
        cv2 = self._cv2
        _, inside = cv2.findHomography(np.ascontiguousarray(points[:, :2]), pixels, cv2.RANSAC, _WORST_CORNER)
        return np.zeros(len(points), bool) if inside is None else inside.reshape(-1).astype(bool)

    def _measure_smallest_side(self, pixels: Array, points: Array) -> float:
        """Side of the smallest square in the image, pixels: the least distance of two neighbours."""
        apart = np.linalg.norm(points[:, None] - points[None], axis=2) / self.board.square
        neighbours = (apart > 0.5) & (apart < 1.1)
        sides = np.linalg.norm(pixels[:, None] - pixels[None], axis=2)[neighbours]
        if not sides.size:
            raise NoView("no two neighbouring corners are visible; show more of the board", code="too_few_corners")
        return float(sides.min())

    def _refine_corners(self, grey: NDArray[np.uint8], pixels: Array, side: float) -> Array:
        """Corners to a fraction of a pixel, searched no farther away than the edge of the next marker."""
        cv2 = self._cv2
        margin = (self.board.square - self.board.marker) / (2.0 * self.board.square)
        half = int(np.clip(margin * side, 2, 11))
        enough = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 50, 1e-3)
        start = np.ascontiguousarray(pixels.reshape(-1, 1, 2), np.float32)
        return np.asarray(cv2.cornerSubPix(grey, start, (half, half), (-1, -1), enough), float).reshape(-1, 2)


def flat_pose(points: Array, pixels: Array, K: Array) -> tuple[Pose, float]:
    """Return the pose of flat points in the camera's frame, and the rms error of the pixels.

    A flat object has two poses that look nearly alike; the one with the smaller error is returned.

    Args:
        points: (n, 3) with z = 0, m.
        pixels: (n, 2) of a camera without distortion.
        K: (3, 3)

    Raises:
        NoView: Neither pose is in front of the camera.
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
        raise NoView("by its corners the board is not in front of the camera", code="not_flat")
    error, best = min(found, key=lambda one: one[0])
    return Pose.from_matrix(best), error


def edge_width(grey: NDArray[np.uint8], pixels: Array, side: float) -> float:
    """Return the width of the edges at corners, pixels: contrast over steepness, the median of all corners.

    A sharp edge is one or two pixels wide.

    Args:
        grey: (H, W)
        pixels: (n, 2) corners.
        side: Side of the smallest square, pixels.
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
