"""Hand-eye calibration: from views of a board to the pose of the camera, with residuals and uncertainty.

With A the pose of the frame that the camera is fixed in, given in the frame that the board is fixed in, ``A X C = Z``
holds in every view: X is the camera where it is fixed, C the board seen from the camera, Z the board where it is fixed.
A closed form starts from the poses C of single images; the refinement then uses the pixels of all corners of all views.

An arm is never exactly where its joints put it. That shifts all corners of a view together, by pixels, while a corner
is found to a tenth of one. Without a model of it the refinement would trust the corners' common position too much and
their perspective too little. So each view has an error of the arm of its own, of an expected size. It makes the corners
of one view correlated; the refinement decorrelates them and never solves for the errors themselves. The size is the one
that makes the observations most likely.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

from ..errors import DriverMissing, HalError
from ..geometry import Pose
from .detection import BoardDetection

try:
    from scipy.optimize import least_squares
    from scipy.spatial.transform import Rotation
except ImportError as error:
    raise DriverMissing(
        f"the calibration is computed with SciPy, which cannot be imported: {error}; "
        "pip install 'robot-hal[calibration]'"
    ) from error

Array = NDArray[np.float64]

Eye = Literal["in-hand", "to-hand"]
"""In-hand: the camera is on a link of the arm and the board stands still. To-hand: the camera stands still and a link
carries the board."""

LEAST_VIEWS = 6
"""Three views determine the equations; with six, a bad one can be identified."""
LEAST_TURN = np.radians(6.0)
"""Rotation about a second axis that the views need (rms over pairs of views)."""
BAD = 4.0
"""A view is left out if its corners are off by more than this multiple of the median over the views,"""
BAD_PX = 1.0
"""and by more than this, pixels."""
MOST_BAD = 1.0 / 3.0
"""Largest share of bad views; with more, the cause is not single views."""
MOST_STD = 0.01, np.radians(1.0)
"""Largest standard deviation of a result, m and rad."""
SIZE_WARNING, SIZE_ERROR = 0.003, 0.03
"""Shares by which the board may appear larger or smaller than given, before a warning and before an error."""
RMS_WARNING, RMS_ERROR = 1.0 / 300.0, 1.0 / 150.0
"""Largest rms error of the corners as a share of the focal length (2 and 4 px at 600 px), before a warning and before
an error. A share, because an object that moved is off by an angle, whatever the resolution."""

_ALIKE = np.radians(5.0)
"""The arm and the camera turn by the same angle between two views; a view whose angles differ by more (median) does
not start the solution."""
_HALF_TURN = np.radians(165.0)
"""Near half a turn the direction of a rotation vector is ambiguous."""
_STEP = 1e-6
"""m and rad of the central differences."""
_ROUNDS = 50
"""Most steps of a refinement."""
_LEAST_PX = 0.02
"""Least noise of a corner; without it, perfect corners would make every other one an outlier."""
_HUBER = 2.5
"""Errors beyond this multiple of the usual one count linearly instead of squared."""
_BEHIND_PX = 1e4
"""Error of a corner that would be behind the camera."""
_LEVER = 0.5
"""m: an arm that is off by 1 mm is assumed to be off by 1 mm / 0.5 m = 2 mrad as well."""
_ARM_ERRORS = (0.0, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3)
"""Candidates for the size of the arm's error, m."""
_X, _Z, _SIZE, _ARM = slice(0, 6), slice(6, 12), 12, slice(13, 19)
"""Columns of the Jacobian: motion of X, motion of Z, share by which the board is larger, error of the arm."""


class CalibrationFailed(HalError, ValueError):
    """The views do not determine the camera's pose. The message gives the reason and the remedy; nothing was written.

    ``code`` is one of ``no_board``, ``too_few_views``, ``too_little_rotation``, ``one_rotation_axis``,
    ``views_disagree``, ``bad_fit``, ``wrong_size``, ``too_uncertain`` and ``not_confirmed``.
    """

    code = "calibration_failed"


@dataclass(frozen=True, eq=False)
class View:
    """One image of the board, taken with the arm at rest."""

    name: str
    T_world_link: Pose
    """Pose of the link that carries the camera (in-hand) or the board (to-hand)."""
    detection: BoardDetection
    q: Array | None = None
    """Joint positions (n,), rad."""
    T_color_eye: Pose = field(default_factory=Pose)
    """Optical frame of the image in that of the colour sensor; the same in all views of a camera."""


@dataclass(frozen=True)
class Residual:
    """Agreement of one view with the result."""

    name: str
    px: float
    """Distance of the corners from where they are expected, rms, pixels."""
    distance: float
    """Distance, m, between the board by this image alone and by all views together."""
    angle: float
    """Angle between the two, rad."""
    used: bool
    """Whether the view was used; False if it did not fit the others."""
    influence: tuple[float, float] | None = None
    """How far the result would move without this view, m and rad; None if it was not used."""


class Uncertainty(NamedTuple):
    """Standard deviations of a result, from leaving out each view in turn.

    This is the jackknife (Efron and Gong, The American Statistician 37(1), 1983). An error of the arm affects all
    corners of a view together, so views are left out and not corners.
    """

    position: float
    """Of the camera, m: the length of all three axes together."""
    rotation: float
    """Of the camera, rad."""
    scale: float
    """Share by which the board appears larger than given."""
    scale_std: float
    """Standard deviation of ``scale``."""
    moved: tuple[tuple[float, float], ...]
    """How far the camera moves when each view in turn is left out, m and rad."""

    def is_size_off(self, share: float) -> bool:
        """Return whether the board appears larger or smaller than given by more than ``share``, beyond the noise."""
        return abs(self.scale) > max(share, 3.0 * self.scale_std)


@dataclass(frozen=True)
class Calibration:
    """A solved calibration."""

    eye: Eye
    camera: Pose
    """Optical frame of the colour sensor, whichever sensor took the images: in the frame of the link (in-hand), or in
    the world (to-hand)."""
    board: Pose
    """In the world (in-hand), or in the frame of the link (to-hand)."""
    residuals: tuple[Residual, ...]
    """One per view, in their order."""
    arm_error: float
    """Estimated error of the arm's position, m: standard deviation along each axis."""
    uncertainty: Uncertainty
    focal: float
    """Focal length of the camera, pixels."""

    @property
    def used(self) -> tuple[Residual, ...]:
        """Residuals of the views that were used."""
        return tuple(residual for residual in self.residuals if residual.used)

    def rms(self) -> tuple[float, float, float]:
        """Return the rms residuals of the used views: pixels, m, rad."""
        table = np.array([[one.px, one.distance, one.angle] for one in self.used])
        px, distance, angle = np.sqrt((table**2).mean(axis=0)).tolist()
        return px, distance, angle

    @property
    def doubts(self) -> tuple[str, ...]:
        """Reasons why the error may be larger than ``uncertainty``; with any of them, a user should confirm."""
        found = []
        if self.rms()[0] > RMS_WARNING * self.focal:
            found.append(_misfit_text(self.rms()[0]))
        if self.uncertainty.is_size_off(SIZE_WARNING):
            found.append(_size_text(self.uncertainty))
        return tuple(found)

    @property
    def warnings(self) -> tuple[str, ...]:
        """The doubts, and the views that were left out."""
        left_out = [one.name for one in self.residuals if not one.used]
        if not left_out:
            return self.doubts
        return *self.doubts, f"left out because they do not fit the others: {', '.join(left_out)}"


def solve(views: Sequence[View], eye: Eye) -> Calibration:
    """Compute the camera's pose from views of a board. No initial value is needed.

    Args:
        views: At least 6, better 15, of one camera and one board, from sides that differ by 20 to 40 degrees.
        eye: Where the camera is.

    Returns:
        The pose with residuals and uncertainty. Views that do not fit the others are left out and marked.

    Raises:
        CalibrationFailed: The views are too few, turn about one axis only, do not fit each other, or leave the result
            too uncertain.
    """
    if len(views) < LEAST_VIEWS:
        raise CalibrationFailed(
            f"at least {LEAST_VIEWS} views are needed, better 15; there are {len(views)}", code="too_few_views"
        )
    links = [view.T_world_link for view in views]
    A = np.array([(link if eye == "in-hand" else link.inverse()).matrix() for link in links])
    C = np.array([view.detection.T_camera_board.matrix() for view in views])
    _check_rotation(A)
    corners = _Corners.of(eye, A, [view.detection for view in views])
    used, fit = _drop_bad_views(corners, *_closed_form(A, C), [view.name for view in views])
    _check_rotation(A[used])
    kept = corners.select(used)
    fits = [_refine(kept, fit.X, fit.Z, arm_error) for arm_error in _ARM_ERRORS]
    best = int(np.argmax([one.likelihood for one in fits]))
    arm_error = _ARM_ERRORS[best]
    fit = _refine(kept, fits[best].X, fits[best].Z, arm_error, rounds=2, tolerance=1e-10)
    uncertainty = _uncertainty(kept, fit, arm_error)
    px = _rms_per_view(corners, fit.X, fit.Z)
    focal = float(corners.K[0, 0])
    _check_result(float(np.sqrt((px[used] ** 2).mean())), focal, uncertainty)
    return Calibration(
        eye,
        Pose.from_matrix(fit.X) @ views[0].T_color_eye.inverse(),
        Pose.from_matrix(fit.Z),
        _residuals(views, px, A @ fit.X @ C, used, fit.Z, uncertainty),
        arm_error,
        uncertainty,
        focal,
    )


def motion(twist: Array) -> Array:
    """Return motions (..., 4, 4) by ``twist`` (..., 6): a translation, m, and a rotation vector, rad."""
    poses = np.zeros((*twist.shape[:-1], 4, 4))
    rotations = Rotation.from_rotvec(twist[..., 3:].reshape(-1, 3)).as_matrix()
    poses[..., :3, :3] = rotations.reshape(*twist.shape[:-1], 3, 3)
    poses[..., :3, 3] = twist[..., :3]
    poses[..., 3, 3] = 1.0
    return poses


def inverse(poses: Array) -> Array:
    """Return the inverses of poses (..., 4, 4)."""
    result = np.zeros_like(poses)
    turned = np.swapaxes(poses[..., :3, :3], -1, -2)
    result[..., :3, :3] = turned
    result[..., :3, 3] = -np.einsum("...ij,...j->...i", turned, poses[..., :3, 3])
    result[..., 3, 3] = 1.0
    return result


def _compare(a: Array, b: Array) -> tuple[float, float]:
    """Distance, m, and angle, rad, between two poses (4, 4)."""
    turn = Rotation.from_matrix(a[:3, :3].T @ b[:3, :3])
    return float(np.linalg.norm(a[:3, 3] - b[:3, 3])), float(turn.magnitude())


def _check_rotation(A: Array) -> None:
    """Raise CalibrationFailed if the arm turned too little, or about nearly one axis only.

    A rotation determines the two components of the camera's position across its axis, never the one along it.
    """
    first, second = np.triu_indices(len(A), 1)
    turns = Rotation.from_matrix((inverse(A[second]) @ A[first])[:, :3, :3]).as_rotvec()
    spread = np.sqrt(np.maximum(np.linalg.eigvalsh(turns.T @ turns / len(turns)), 0.0))
    if spread[1] >= LEAST_TURN:
        return
    found = f"the views differ by {np.degrees(spread[2]):.0f} degrees (rms) about one axis"
    if spread[2] < LEAST_TURN:
        raise CalibrationFailed(
            f"{found}, which is too little: tilt the hand to all sides by 20 to 40 degrees", code="too_little_rotation"
        )
    raise CalibrationFailed(
        f"{found} and by {np.degrees(spread[1]):.1f} about the others, so the camera's position along that axis is "
        "undetermined: tilt the hand about two more axes, by 20 degrees or more",
        code="one_rotation_axis",
    )


def _closed_form(A: Array, C: Array) -> tuple[Array, Array]:
    """X and Z (4, 4) from ``A[i] X C[i] = Z`` for ``A`` and ``C`` (n, 4, 4), without an initial value.

    From two views follows ``(A_j^-1 A_i) X = X (C_j C_i^-1)``: the motions of arm and camera between them are the same
    in two frames. Their rotation vectors give the rotation of X (the least-squares solution of Park and Martin, IEEE
    Trans. Robotics and Automation 10(5), 1994); the rest is linear in its translation. OpenCV 5 no longer has this
    solution in Python.

    Views with a mistaken pose of the board (a small, flat board can look the same from two sides) or a motion during
    the image are left out, as long as most of the others agree.
    """
    count = len(A)
    i, j = np.divmod(np.arange(count * count), count)
    arm_motion, camera_motion = inverse(A[j]) @ A[i], C[j] @ inverse(C[i])
    arm = Rotation.from_matrix(arm_motion[:, :3, :3]).as_rotvec()
    camera = Rotation.from_matrix(camera_motion[:, :3, :3]).as_rotvec()
    angles = np.stack([np.linalg.norm(arm, axis=1), np.linalg.norm(camera, axis=1)])
    good = np.median(np.abs(angles[0] - angles[1]).reshape(count, count), axis=1) < _ALIKE
    if good.sum() < max(3, count / 2):
        raise CalibrationFailed(
            f"only {good.sum()} of {count} views agree on how far the arm turned: check the arm, the link and --eye, "
            "and that board and camera do not move where they are fixed",
            code="views_disagree",
        )
    pairs = (i < j) & good[i] & good[j] & (angles.max(axis=0) < _HALF_TURN)
    X = np.eye(4)
    X[:3, :3] = Rotation.align_vectors(arm[pairs], camera[pairs])[0].as_matrix()
    left = arm_motion[pairs, :3, :3] - np.eye(3)
    right = camera_motion[pairs, :3, 3] @ X[:3, :3].T - arm_motion[pairs, :3, 3]
    X[:3, 3] = np.linalg.lstsq(left.reshape(-1, 3), right.reshape(-1), rcond=None)[0]
    boards = A[good] @ X @ C[good]
    Z = np.eye(4)
    Z[:3, :3] = Rotation.from_matrix(boards[:, :3, :3]).mean().as_matrix()
    Z[:3, 3] = np.median(boards[:, :3, 3], axis=0)
    return X, Z


class _Corners(NamedTuple):
    """The corners of all views, concatenated."""

    eye: Eye
    A: Array
    """(v, 4, 4), one per view."""
    view: NDArray[np.intp]
    """(n,) index of each corner's view, ascending."""
    points: Array
    """(n, 3) in the board's frame, m."""
    pixels: Array
    """(n, 2) of a camera without distortion."""
    K: Array
    """(3, 3)"""
    noise_px: float
    """Standard deviation of a corner's coordinates: from the corners' distances to the best pose of their own view."""

    @classmethod
    def of(cls, eye: Eye, A: Array, detections: Sequence[BoardDetection]) -> _Corners:
        noise = float(np.median([one.error_px for one in detections])) / np.sqrt(2.0)
        return cls(
            eye,
            A,
            np.repeat(np.arange(len(A)), [len(one.points) for one in detections]),
            np.concatenate([one.points for one in detections]),
            np.concatenate([one.pixels for one in detections]),
            detections[0].K,
            max(_LEAST_PX, noise),
        )

    def select(self, views: NDArray[np.bool_]) -> _Corners:
        """Those of the views in a mask (v,)."""
        kept = views[self.view]
        number = (np.cumsum(views) - 1)[self.view[kept]]
        return self._replace(A=self.A[views], view=number, points=self.points[kept], pixels=self.pixels[kept])

    def sum_per_view(self, values: Array) -> Array:
        """(v, ...) from (n, ...)."""
        return np.asarray(np.add.reduceat(values, np.flatnonzero(np.diff(self.view, prepend=-1)), axis=0))

    def errors(self, X: Array, Z: Array) -> Array:
        """(n, 2): observed minus expected pixels."""
        return self._errors(self.A, X, Z, self.points)

    def _errors(self, A: Array, X: Array, Z: Array, points: Array) -> Array:
        """The same for many A (..., v, 4, 4), X and Z (..., 4, 4) and points (..., n, 3): (..., n, 2)."""
        boards = (inverse(A @ X[..., None, :, :]) @ Z[..., None, :, :])[..., self.view, :3, :]
        p = (boards[..., :3] @ points[..., None])[..., 0] + boards[..., 3]
        behind = p[..., 2:] < 1e-3
        expected = (p / np.where(behind, 1.0, p[..., 2:])) @ self.K[:2].T
        return np.where(behind, _BEHIND_PX, self.pixels - expected)

    def derivatives(self, X: Array, Z: Array, columns: slice) -> Array:
        """(n, 2, columns) derivatives of the errors, by central differences."""
        steps = _STEP * np.eye(19)[columns]
        small = np.concatenate([steps, -steps])
        arm = motion(small[:, None, _ARM])  # of the link, which is the frame of the camera or of the board
        A = self.A @ arm if self.eye == "in-hand" else inverse(arm) @ self.A
        points = self.points * (1.0 + small[:, _SIZE, None, None])
        errors = self._errors(A, X @ motion(small[:, _X]), Z @ motion(small[:, _Z]), points)
        after, before = errors[: len(steps)], errors[len(steps) :]
        return np.moveaxis(after - before, 0, 2) / (2.0 * _STEP)


class _Fit(NamedTuple):
    """A solution of the refinement."""

    X: Array
    Z: Array
    size: float
    """Share by which one more step would enlarge the board, if its size were unknown too."""
    likelihood: float
    """Logarithm, up to a constant."""


class _Decorrelation:
    """Makes the corners of each view independent of each other, given an error of the arm of an expected size.

    In units of the corners' noise, their covariance is ``I + M M^T`` with M the derivatives by the arm's error times
    its standard deviations (n, 2, 6). With ``M = Q s V^T`` its inverse root is ``I - Q (1 - 1 / sqrt(1 + s^2)) Q^T``.
    """

    def __init__(self, corners: _Corners, X: Array, Z: Array, arm_error: float) -> None:
        self.corners = corners
        self.log_determinant = 0.0
        self._Q: Array | None = None
        if arm_error > 0.0:
            sizes = np.array([arm_error] * 3 + [arm_error / _LEVER] * 3)
            M = corners.derivatives(X, Z, _ARM) * sizes / corners.noise_px
            squares, V = np.linalg.eigh(corners.sum_per_view(np.einsum("nka,nkb->nab", M, M)))
            squares = np.maximum(squares, 1e-12)
            self._Q = np.einsum("nka,nab->nkb", M, (V / np.sqrt(squares)[:, None, :])[corners.view])
            self._spread = squares
            self.log_determinant = float(np.log1p(squares).sum())

    def __call__(self, errors: Array, power: float = 0.5) -> Array:
        """Decorrelated errors (n, 2, ...) in units of the noise; ``power`` 1 subtracts the most likely arm error."""
        errors = errors / self.corners.noise_px
        if self._Q is None:
            return errors
        gain = 1.0 - (1.0 + self._spread) ** -power
        along = self.corners.sum_per_view(np.einsum("nkb,nk...->nb...", self._Q, errors))
        along *= gain.reshape(*gain.shape, *[1] * (along.ndim - 2))
        return np.asarray(errors - np.einsum("nkb,nb...->nk...", self._Q, along[self.corners.view]))


def _refine(
    corners: _Corners, X: Array, Z: Array, arm_error: float, *, rounds: int = 1, tolerance: float = 1e-6
) -> _Fit:
    """Minimise the robust, decorrelated errors of all corners over small motions of X and Z, each in its own frame.

    Every round linearises the correlations and the usual size of an error at its start.
    """
    if rounds > 1:
        X, Z = _refine(corners, X, Z, arm_error, rounds=rounds - 1, tolerance=tolerance)[:2]
    decorrelate = _Decorrelation(corners, X, Z, arm_error)
    rest = np.linalg.norm(decorrelate(corners.errors(X, Z), power=1.0), axis=1)
    usual = max(_LEAST_PX / corners.noise_px, float(np.median(rest)) / 1.18)  # of one coordinate

    def move(step: Array) -> tuple[Array, Array]:
        return X @ motion(step[_X]), Z @ motion(step[_Z])

    def residuals(step: Array) -> Array:
        return decorrelate(corners.errors(*move(step))).reshape(-1)

    def jacobian(step: Array) -> Array:
        return decorrelate(corners.derivatives(*move(step), slice(0, 12))).reshape(-1, 12)

    found = least_squares(
        residuals,
        np.zeros(12),
        jacobian,
        loss="huber",
        f_scale=_HUBER * usual,
        xtol=tolerance,
        ftol=tolerance,
        max_nfev=_ROUNDS,
    )
    best_X, best_Z = move(found.x)
    left = residuals(found.x)
    columns = decorrelate(corners.derivatives(best_X, best_Z, slice(0, 13))).reshape(-1, 13)
    weights = np.sqrt(np.minimum(1.0, _HUBER * usual / np.maximum(np.abs(left), 1e-12)))
    size = -float(np.linalg.lstsq(columns * weights[:, None], left * weights, rcond=None)[0][_SIZE])
    return _Fit(best_X, best_Z, size, -float(found.cost) - 0.5 * decorrelate.log_determinant)


def _rms_per_view(corners: _Corners, X: Array, Z: Array) -> Array:
    """(v,) rms distance of each view's corners from where they are expected, pixels."""
    squares = (corners.errors(X, Z) ** 2).sum(axis=1)
    return np.asarray(np.sqrt(corners.sum_per_view(squares) / np.bincount(corners.view)))


def _drop_bad_views(corners: _Corners, X: Array, Z: Array, names: Sequence[str]) -> tuple[NDArray[np.bool_], _Fit]:
    """Mask (v,) of the views that fit each other, and their fit. A view may also be taken back."""
    used = np.ones(len(names), bool)
    fit = _refine(corners, X, Z, 0.0, rounds=3)
    for _ in range(len(names)):
        px = _rms_per_view(corners, fit.X, fit.Z)
        good = px <= max(BAD_PX, BAD * float(np.median(px)))
        if good.sum() < max(LEAST_VIEWS, (1.0 - MOST_BAD) * len(names)):
            bad = ", ".join(f"{name} ({error:.1f} px)" for name, error in zip(names, px, strict=True) if error > BAD_PX)
            raise CalibrationFailed(
                f"too many views do not fit the others: {bad}. The board, the camera or the arm's base moved, or the "
                "link is wrong",
                code="views_disagree",
            )
        if (good == used).all():
            break
        used = good
        fit = _refine(corners.select(used), fit.X, fit.Z, 0.0, rounds=2)
    return used, fit


def _uncertainty(corners: _Corners, fit: _Fit, arm_error: float) -> Uncertainty:
    count = len(corners.A)
    everything = np.arange(count)
    without = [_refine(corners.select(everything != k), fit.X, fit.Z, arm_error) for k in everything]
    turns = [Rotation.from_matrix(fit.X[:3, :3].T @ one.X[:3, :3]).as_rotvec() for one in without]
    moved = tuple(_compare(fit.X, one.X) for one in without)

    def std(values: list[Array] | list[float]) -> float:
        samples = np.array(values)
        return float(np.sqrt((count - 1) / count * ((samples - samples.mean(axis=0)) ** 2).sum()))

    return Uncertainty(
        std([one.X[:3, 3] for one in without]), std(turns), fit.size, std([one.size for one in without]), moved
    )


def _check_result(rms: float, focal: float, std: Uncertainty) -> None:
    """Raise CalibrationFailed if the corners are off by too much, or the result is too uncertain."""
    wrong_size = std.is_size_off(SIZE_ERROR)
    if rms > RMS_ERROR * focal:
        text = "; ".join([_misfit_text(rms), *([_size_text(std)] if wrong_size else [])])
        raise CalibrationFailed(text, code="wrong_size" if wrong_size else "bad_fit")
    if std.position > MOST_STD[0] or std.rotation > MOST_STD[1]:
        raise CalibrationFailed(
            f"the result is uncertain by {1e3 * std.position:.1f} mm and {np.degrees(std.rotation):.2f} degrees, with "
            f"corners off by {rms:.1f} px. Take more views, from more sides, with a larger board",
            code="too_uncertain",
        )
    if wrong_size:
        raise CalibrationFailed(_size_text(std), code="wrong_size")


def _misfit_text(px: float) -> str:
    return (
        f"the views do not fit each other, corners are off by {px:.1f} px (rms). Possible causes: the board, the "
        "camera or the arm's base moved, the arm is inaccurate, or the size of a square (--square) or the camera's K "
        "is wrong"
    )


def _size_text(std: Uncertainty) -> str:
    return (
        f"compared with the arm's motion the board is {100.0 * abs(std.scale):.1f} % "
        f"{'larger' if std.scale > 0 else 'smaller'} than given: measure its squares (--square), or correct the "
        "camera's K"
    )


def _residuals(
    views: Sequence[View], px: Array, boards: Array, used: NDArray[np.bool_], Z: Array, std: Uncertainty
) -> tuple[Residual, ...]:
    """``boards`` (v, 4, 4): the board by each image alone; ``Z`` (4, 4): by all of them."""
    moved = iter(std.moved)
    return tuple(
        Residual(view.name, float(px[k]), *_compare(boards[k], Z), bool(used[k]), next(moved) if used[k] else None)
        for k, view in enumerate(views)
    )
