"""Could these views tell where the camera is at all? And does the answer hold without any one of them?"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .errors import CalibrationFailed
from .refinement import Corners, Fit, Noise, refine
from .rotations import between, inverse, vector

__all__ = ["LEAST_VIEWS", "Doubt", "check_count", "check_turns", "doubt_of"]

Array = NDArray[np.float64]

LEAST_VIEWS = 6
"""Three would do for the equations; with six, one may be bad and is found out."""
LEAST_TURN = np.radians(6.0)
"""The views must turn by so much (rms, of one to another) about a second axis as well."""
_AGAIN = 8
"""Steps to a new optimum when one view is left out."""


class Doubt(NamedTuple):
    """How well a quantity is known: standard deviations."""

    position: float
    """Of X, m: the length of all three axes' together."""
    rotation: float
    """rad"""
    scale: float
    """How much larger the board looks than it was said to be, as a share."""
    scale_std: float
    moved: tuple[tuple[float, float], ...]
    """How far X goes, m and rad, when each view in turn is left out."""


def check_count(count: int) -> None:
    """Raise CalibrationFailed where there are too few views."""
    if count < LEAST_VIEWS:
        raise CalibrationFailed(f"it takes at least {LEAST_VIEWS} views, better 15, and there are {count}")


def check_turns(A: Array) -> None:
    """Raise CalibrationFailed where the arm turned too little, or about nearly one axis only.

    A turn tells the two components of the camera's place across its axis, never the one along it.
    """
    pairs = [(i, j) for i in range(len(A)) for j in range(i)]
    turns = np.array([vector((inverse(A[j]) @ A[i])[:3, :3]) for i, j in pairs])
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(turns.T @ turns / len(turns)), 0.0))
    most, second = spread[2], spread[1]
    if second >= LEAST_TURN:
        return
    found = f"from view to view the hand turned by {np.degrees(most):.0f} degrees (rms) about one axis"
    if most < LEAST_TURN:
        raise CalibrationFailed(f"{found}, which is too little: tilt it to all sides by 20 to 40 degrees")
    raise CalibrationFailed(
        f"{found}, and by {np.degrees(second):.1f} about every other one, so the camera's place along that axis stays "
        "unknown: tilt it about two more axes, by 20 degrees and more"
    )


def doubt_of(corners: Corners, fit: Fit, noise: Noise) -> Doubt:
    """By leaving out one view after the other (the jackknife; Efron and Gong, The American Statistician 37(1), 1983).

    The corners of one view are wrong together where the arm is, so it is views that count and not corners.
    """
    count = len(corners.A)
    positions, turns, scales, moved = [], [], [], []
    for k in range(count):
        rest = corners.only(np.arange(count) != k)
        without = refine(rest, fit.X, fit.Z, noise, _AGAIN)
        positions.append(without.X[:3, 3])
        turns.append(vector(fit.X[:3, :3].T @ without.X[:3, :3]))
        scales.append([without.size])
        moved.append(between(fit.X, without.X))
    return Doubt(_jackknife(positions), _jackknife(turns), fit.size, _jackknife(scales), tuple(moved))


def _jackknife(values: list[Array] | list[list[float]]) -> float:
    samples = np.array(values)
    count = len(samples)
    return float(np.sqrt((count - 1) / count * ((samples - samples.mean(axis=0)) ** 2).sum()))
