"""Intrinsics of a camera, from images of a printed board that is held at different angles in front of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .board import opencv
from .detection import Detector, NoView
from .solving import CalibrationFailed

Array = NDArray[np.float64]

LEAST_PICTURES = 8
_ALIKE = 0.05
"""Mean motion of the corners between two views below which they are alike, as a share of the image's width."""
_WORST_RMS = 1.0
"""Largest error of a result, pixels."""
_UNSURE = 0.005
"""Standard deviation of focal length and principal point, as a share of the former, above which it is doubtful;"""
_TILT = 0.12
"""spread of the board's tilts (sine of the angle) in the direction in which it is least, below which it is, because the
focal length and the distance cannot be told apart;"""
_REACH = 0.75
"""and distance of the outermost corner from the image's centre, as a share of that of the image's corner."""


@dataclass(frozen=True, eq=False)
class LensFit:
    """Intrinsics of the images that were given, with their standard deviations."""

    K: Array
    """(3, 3), pixels."""
    distortion: Array
    """(5,) k1, k2, p1, p2 and k3 (OpenCV's order), which is 0."""
    size: tuple[int, int]
    """Width and height of the images, pixels."""
    std: Array
    """(4,) of fx, fy, cx, cy, pixels."""
    error_px: float
    """Distance of the corners from where the result puts them, rms."""
    views: int
    tilt: float
    """Standard deviation of the board's tilts, as their sine, in the direction in which it is least."""
    reach: float
    """Distance of the outermost corner from the image's centre, as a share of that of the image's corner."""

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons why the result should not be used."""
        relative, found = self.std.max() / self.K[0, 0], []
        if relative > _UNSURE or self.tilt < _TILT:
            found.append(
                "focal length and principal point are uncertain: tilt the board by 20 to 45 degrees, to all sides"
            )
        if self.reach < _REACH:
            found.append("the distortion is uncertain: hold the board near the corners of the image, too")
        return tuple(found)

    def entry(self) -> str:
        """Return the value of a camera's ``intrinsics`` in a rig's file."""
        (fx, _, cx), (_, fy, cy), _ = self.K
        values = {"width": self.size[0], "height": self.size[1]}
        places = {name: f"{value:.3f}" for name, value in zip(("fx", "fy", "cx", "cy"), (fx, fy, cx, cy), strict=True)}
        lens = ", ".join(f"{value:.6f}" for value in self.distortion)
        return f"{{{', '.join(f'{name}: {value}' for name, value in (values | places).items())}, distortion: [{lens}]}}"


class LensViews:
    """Collects images of a board that differ.

    Args:
        detector: Detector of the board.
    """

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._found: list[tuple[Array, Array]] = []
        self._size: tuple[int, int] = (0, 0)

    def __len__(self) -> int:
        return len(self._found)

    def add(self, picture: NDArray[np.uint8]) -> int:
        """Add an image (H, W, 3), RGB, or (H, W); return the number of its corners.

        Raises:
            NoView: The board is not visible well enough, or as in an earlier image.
        """
        self._size = (picture.shape[1], picture.shape[0])
        points, pixels = self._detector.find_corners(picture)
        for other_points, other_pixels in self._found:
            same, here, there = self._pair(points, other_points)
            if same and np.linalg.norm(pixels[here] - other_pixels[there], axis=1).mean() < _ALIKE * self._size[0]:
                raise NoView("move and tilt the board: it is as in an earlier image", code="too_similar")
        self._found.append((points, pixels))
        return len(points)

    @staticmethod
    def _pair(points: Array, others: Array) -> tuple[int, NDArray[np.intp], NDArray[np.intp]]:
        """Return how many corners two images share, and their indices in both."""
        here, there = np.nonzero(np.linalg.norm(points[:, None] - others[None], axis=2) < 1e-6)
        return len(here), here, there

    def solve(self) -> LensFit:
        """Return the intrinsics by Zhang's method, OpenCV's ``calibrateCamera``.

        Raises:
            CalibrationFailed: There are too few images, or they do not fit one camera.
        """
        if len(self) < LEAST_PICTURES:
            raise CalibrationFailed(f"{len(self)} views; at least {LEAST_PICTURES} are needed", code="too_few_views")
        points = [np.ascontiguousarray(one, np.float32) for one, _ in self._found]
        pixels = [np.ascontiguousarray(one[:, None], np.float32) for _, one in self._found]
        cv2 = opencv()  # without k3, which the corners of a board do not determine
        fit = cv2.calibrateCameraExtended(points, pixels, self._size, None, None, flags=cv2.CALIB_FIX_K3)
        rms, K, distortion, std = fit[0], np.asarray(fit[1], float), np.ravel(fit[2])[:5], np.ravel(fit[5])[:4]
        if not rms < _WORST_RMS:
            raise CalibrationFailed(
                f"the corners are {rms:.2f} pixels off: the board must be flat, the camera's focus fixed", code="misfit"
            )
        normals = np.array([cv2.Rodrigues(turn)[0][:2, 2] for turn in fit[3]])
        tilt = float(np.sqrt(np.linalg.eigvalsh(np.cov(normals.T))[0]))
        middle = (np.array(self._size) - 1) / 2
        reach = max(np.linalg.norm(one - middle, axis=1).max() for _, one in self._found) / np.linalg.norm(middle)
        return LensFit(
            K, distortion.astype(float), self._size, std.astype(float), float(rms), len(self), tilt, float(reach)
        )
