"""From views to the camera's pose: bad views found out, residuals and uncertainty told, hopeless sets refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..geometry import Pose
from .checks import LEAST_VIEWS, Doubt, check_count, check_turns, doubt_of
from .closed_form import start
from .errors import CalibrationFailed
from .refinement import Corners, Fit, arm_noise, refine
from .rotations import between
from .views import Eye, View, camera_matrix

__all__ = ["Calibration", "Residual", "solve"]

Array = NDArray[np.float64]

BAD = 4.0
"""A view whose corners are off by so many times the usual (median) is left out,"""
BAD_PX = 1.0
"""if that is also more than so many pixels."""
MOST_BAD = 1.0 / 3.0
"""When more of the views are bad, something else is wrong."""
MOST_STD = 0.01, np.radians(1.0)
"""m and rad: with more doubt than this there is no answer."""
SIZE_TOLD = 0.003
SIZE_MOST = 0.03
"""Shares by which the board's size may seem wrong before that is told, and before there is no answer."""
RMS_TOLD, RMS_MOST = 1.0 / 300.0, 1.0 / 150.0
"""By how much the corners may be off, as a share of the focal length (2 and 4 px at 600 px), before that is told, and
before there is no answer. What moved is off by an angle, however fine the pixels are."""


@dataclass(frozen=True)
class Residual:
    """How one view agrees with the answer."""

    name: str
    px: float
    """rms distance of the corners from where they should be."""
    distance: float
    """Of the board, by this picture alone, from where all views together put it: m,"""
    angle: float
    """and rad."""
    used: bool
    influence: tuple[float, float] | None = None
    """How far the answer would go without this view: m, rad."""


@dataclass(frozen=True)
class Calibration:
    """The answer."""

    eye: Eye
    camera: Pose
    """Of the colour sensor's optical frame, as a rig's file has it, whichever sensor the pictures were of: in the frame
    of the link (in-hand), or in the world (to-hand)."""
    board: Pose
    """In the world (in-hand), or in the frame of the link (to-hand)."""
    residuals: tuple[Residual, ...]
    """One a view, in their order."""
    arm: float
    """How wrong the arm seems to be about where it is, m: standard deviation along each axis."""
    doubt: Doubt
    focal: float
    """Of the camera, pixels."""

    @property
    def used(self) -> tuple[Residual, ...]:
        """Residuals of the views that count."""
        return tuple(residual for residual in self.residuals if residual.used)

    def rms(self) -> tuple[float, float, float]:
        """Over those views: pixels, m, rad."""
        table = np.array([[one.px, one.distance, one.angle] for one in self.used])
        px, distance, angle = np.sqrt((table**2).mean(axis=0)).tolist()
        return px, distance, angle

    @property
    def doubtful(self) -> tuple[str, ...]:
        """Why the answer may be wrong by more than it is said to be certain to. A person should decide on it."""
        told = []
        if self.rms()[0] > RMS_TOLD * self.focal:
            told.append(_misfit(self.rms()[0]))
        if _is_off(self.doubt, SIZE_TOLD):
            told.append(_size(self.doubt))
        return tuple(told)

    @property
    def warnings(self) -> tuple[str, ...]:
        """All that a person should look at before believing it."""
        left_out = [one.name for one in self.residuals if not one.used]
        if not left_out:
            return self.doubtful
        return *self.doubtful, f"left out, since they do not fit the others: {', '.join(left_out)}"


def _misfit(px: float) -> str:
    return (
        f"the views do not fit each other, corners are off by {px:.1f} px (rms): did the board, the camera or the "
        "arm's base move, is the arm that inexact, or are the board's squares (--square) or the camera's K wrong?"
    )


def _is_off(doubt: Doubt, share: float) -> bool:
    return abs(doubt.scale) > max(share, 3.0 * doubt.scale_std)


def _size(doubt: Doubt) -> str:
    larger = "larger" if doubt.scale > 0 else "smaller"
    return (
        f"by the arm's own measure the board is {100.0 * abs(doubt.scale):.1f} % {larger} than was said: measure its "
        "squares (--square), or the camera's K is wrong"
    )


def solve(views: Sequence[View], eye: Eye) -> Calibration:
    """Where the camera is, from views of a board. Nothing else is known of it.

    Raises CalibrationFailed, with what to do, where the views are too few, turn about one axis only, do not fit each
    other, or leave the answer in doubt.
    """
    check_count(len(views))
    A = np.array([camera_matrix(eye, view) for view in views])
    check_turns(A)
    C = np.array([view.sighting.T_camera_board.matrix() for view in views])
    X, Z = start(A, C)
    corners = Corners.of(eye, A, [view.sighting for view in views])
    used, fit = _without_bad_views(corners, X, Z, [view.name for view in views])
    check_turns(A[used])
    kept = corners.only(used)
    noise = arm_noise(kept, fit.X, fit.Z)
    fit = refine(kept, fit.X, fit.Z, noise)
    doubt = doubt_of(kept, fit, noise)
    px = _errors(corners, fit)
    rms, focal = float(np.sqrt((px[used] ** 2).mean())), float(corners.K[0, 0])
    if rms > RMS_MOST * focal:
        raise CalibrationFailed("; ".join([_misfit(rms), *([_size(doubt)] if _is_off(doubt, SIZE_MOST) else [])]))
    if doubt.position > MOST_STD[0] or doubt.rotation > MOST_STD[1]:
        raise CalibrationFailed(
            f"the answer is uncertain by {1e3 * doubt.position:.1f} mm and {np.degrees(doubt.rotation):.2f} degrees, "
            f"with corners off by {rms:.1f} px. Take more views, from more sides, with a larger board"
        )
    if _is_off(doubt, SIZE_MOST):
        raise CalibrationFailed(_size(doubt))
    return Calibration(
        eye,
        Pose.from_matrix(fit.X) @ views[0].T_color_eye.inverse(),
        Pose.from_matrix(fit.Z),
        _residuals(views, px, A @ fit.X @ C, used, fit.Z, doubt),
        noise.position,
        doubt,
        focal,
    )


def _without_bad_views(corners: Corners, X: Array, Z: Array, names: Sequence[str]) -> tuple[NDArray[np.bool_], Fit]:
    """Which views count, and what they say. A view may also come back."""
    everything = np.ones(len(names), bool)
    used = everything
    fit = refine(corners, X, Z)
    for _ in range(len(names)):
        px = _errors(corners, fit)
        good = px <= max(BAD_PX, BAD * float(np.median(px)))
        if good.sum() < max(LEAST_VIEWS, (1.0 - MOST_BAD) * len(names)):
            bad = ", ".join(f"{name} ({error:.1f} px)" for name, error in zip(names, px, strict=True) if error > BAD_PX)
            raise CalibrationFailed(
                f"too many views do not fit the others: {bad}. Did the board, the camera or the arm's base move? Is it "
                "the right link?"
            )
        if (good == used).all():
            break
        used = good
        fit = refine(corners.only(used), fit.X, fit.Z)
    return used, fit


def _errors(corners: Corners, fit: Fit) -> Array:
    """(v,) rms of every view, pixels, also of those that the fit did not count."""
    return refine(corners, fit.X, fit.Z, rounds=0).per_view(corners)


def _residuals(
    views: Sequence[View], px: Array, boards: Array, used: NDArray[np.bool_], Z: Array, doubt: Doubt
) -> tuple[Residual, ...]:
    """``boards`` (v, 4, 4): where each picture alone puts the board; ``Z`` where all of them do."""
    moved = iter(doubt.moved)
    return tuple(
        Residual(view.name, float(px[k]), *between(boards[k], Z), bool(used[k]), next(moved) if used[k] else None)
        for k, view in enumerate(views)
    )
