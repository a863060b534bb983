"""Where the camera is, exactly: the two poses that put all corners of all views nearest to where they were seen.

Levenberg and Marquardt's method with Huber's weights. The unknowns are small motions of X and of Z, each in its own
frame, so nothing is ever near a singularity of angles. Pixels are those of a camera without distortion.

An arm is never quite where its joints say. That moves all corners of a view together, by pixels, where a corner is
found to a tenth of one; who took the one for the other would believe the corners' common place too much, and their
perspective too little. So each view may have an error of the arm of its own, of an expected size (:class:`Noise`),
which is eliminated from the equations (Schur's complement) and never solved for. How large it is, the views
themselves say: :func:`arm_noise`.
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from .rotations import cross, exponential, inverse
from .views import Eye, Sighting

__all__ = ["Corners", "Fit", "Noise", "arm_noise", "refine"]

Array = NDArray[np.float64]

_ROUNDS = 60
_STILL = 1e-10
"""m and rad: a step that is smaller changes nothing."""
_HUBER = 2.5
"""Corners farther off than so many times the usual error count less."""
_LEAST_PX = 0.02
"""That error is at least this, or perfect corners would make every other one an outlier."""
_BEHIND_PX = 1e4
_LEVER = 0.5
"""m: an arm that is wrong by 1 mm is taken to be wrong by 1 mm / 0.5 m = 2 mrad as well."""
_ARMS = (0.0, 2e-5, 5e-5, 1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3)
"""m: sizes of the arm's error that are tried."""
_X, _Z, _ALL, _ARM, _ERROR = slice(0, 6), slice(6, 12), slice(0, 12), slice(13, 19), 19
"""Columns: X's motion, Z's; 12 is the size of the board; the arm's error; what is left."""


class Corners(NamedTuple):
    """All corners of all views, one below the other."""

    eye: Eye
    A: Array
    """(v, 4, 4), one a view."""
    view: NDArray[np.intp]
    """(n,) the view of each corner."""
    points: Array
    """(n, 3) in the board's frame, m."""
    pixels: Array
    """(n, 2)"""
    K: Array
    noise_px: float
    """Of a corner's coordinates, standard deviation: by how much corners leave the best pose of their own view."""

    @classmethod
    def of(cls, eye: Eye, A: Array, sightings: Sequence[Sighting]) -> Corners:
        """``A`` (v, 4, 4) and what was seen in the same views."""
        counts = [len(sighting.points) for sighting in sightings]
        return cls(
            eye,
            np.asarray(A),
            np.repeat(np.arange(len(counts)), counts),
            np.concatenate([sighting.points for sighting in sightings]),
            np.concatenate([sighting.pixels for sighting in sightings]),
            sightings[0].K,
            max(_LEAST_PX, float(np.median([sighting.error_px for sighting in sightings])) / np.sqrt(2.0)),
        )

    def only(self, views: NDArray[np.bool_]) -> Corners:
        """Those of some views, which are numbered anew."""
        kept = views[self.view]
        number = (np.cumsum(views) - 1)[self.view[kept]]
        return self._replace(A=self.A[views], view=number, points=self.points[kept], pixels=self.pixels[kept])


class Noise(NamedTuple):
    """How wrong the arm is expected to be, in each view anew: standard deviations along and about each axis."""

    position: float = 0.0
    """m"""

    @property
    def sizes(self) -> Array:
        """(6,) m and rad."""
        return np.array([self.position] * 3 + [self.position / _LEVER] * 3)


_EXACT_ARM = Noise()


class Fit(NamedTuple):
    """What came of it."""

    X: Array
    Z: Array
    errors: Array
    """(n, 2) seen minus expected, pixels."""
    hessian: Array
    """(13, 13) for X's motion, Z's, and the size of the board as a share."""
    gradient: Array
    """(13,)"""
    likelihood: float
    """Logarithm, up to a constant."""

    def per_view(self, corners: Corners) -> Array:
        """(v,) rms distance of each view's corners from where they are expected, pixels."""
        squares = np.bincount(corners.view, (self.errors**2).sum(axis=1), len(corners.A))
        return np.asarray(np.sqrt(squares / np.bincount(corners.view, minlength=len(corners.A))))

    @property
    def size(self) -> float:
        """By what share one more step would make the board larger, were its size unknown too."""
        return float(np.linalg.lstsq(self.hessian, self.gradient, rcond=None)[0][12])


def refine(corners: Corners, X: Array, Z: Array, noise: Noise = _EXACT_ARM, rounds: int = _ROUNDS) -> Fit:
    """From a start that is near enough, at most ``rounds`` steps."""
    damping = 1e-3
    columns = _columns(corners, X, Z, noise)
    for _ in range(rounds):
        weights = _weights(corners, columns)
        hessian, gradient, cost, _ = _reduced(corners, columns, weights)
        damped = hessian[_ALL, _ALL] + damping * np.diag(np.diag(hessian)[_ALL] + 1e-9)
        step = np.asarray(np.linalg.solve(damped, gradient[_ALL]), np.float64)
        tried_X, tried_Z = X @ exponential(step[_X]), Z @ exponential(step[_Z])
        tried = _columns(corners, tried_X, tried_Z, noise)
        if _reduced(corners, tried, weights)[2] <= cost:
            X, Z, columns, damping = tried_X, tried_Z, tried, max(1e-12, damping / 10.0)
        else:
            damping *= 10.0
        if np.abs(step).max() < _STILL or damping > 1e9:
            break
    hessian, gradient, cost, spread = _reduced(corners, columns, _weights(corners, columns))
    return Fit(X, Z, columns[:, :, _ERROR], hessian, gradient, -0.5 * (cost + spread))


def arm_noise(corners: Corners, X: Array, Z: Array) -> Noise:
    """The size of the arm's errors that makes what was seen most likely."""
    tried = (Noise(position) for position in _ARMS)
    return max(tried, key=lambda noise: refine(corners, X, Z, noise, rounds=15).likelihood)


def _columns(corners: Corners, X: Array, Z: Array, noise: Noise) -> Array:
    """(n, 2, 20): the expected pixels by every unknown, by the arm's error in units of its size, and what is left."""
    from_board = inverse(corners.A) @ Z  # into the frame that the camera is fixed in
    fixed = np.einsum("nij,nj->ni", from_board[corners.view, :3, :3], corners.points) + from_board[corners.view, :3, 3]
    back = X[:3, :3].T
    p = (fixed - X[:3, 3]) @ X[:3, :3]
    turn = back @ from_board[corners.view, :3, :3]
    behind = p[:, 2] < 1e-3
    p[behind, 2] = 1e-3
    K, z = corners.K, p[:, 2]
    expected = (p / z[:, None]) @ K[:2].T
    by_point = (K[None, :2, :] - expected[:, :, None] * np.array([0.0, 0.0, 1.0])) / z[:, None, None]
    by_point[behind] = 0.0
    still = np.broadcast_to(back, turn.shape)
    if corners.eye == "in-hand":  # the link is what the camera is fixed in
        arm = np.concatenate([-still, still @ cross(fixed)], axis=2)
    else:  # it is what the board is fixed in
        carried = corners.points @ Z[:3, :3].T + Z[:3, 3]
        link = back @ inverse(corners.A)[corners.view, :3, :3]
        arm = np.concatenate([link, -link @ cross(carried)], axis=2)
    point_by = np.concatenate(
        [
            -np.broadcast_to(np.eye(3), turn.shape),  # X moves: p becomes p - v - w x p
            cross(p),
            turn,  # Z moves: the point becomes P + v + w x P
            -turn @ cross(corners.points),
            turn @ corners.points[:, :, None],  # the board is larger by a share
            arm * noise.sizes,
        ],
        axis=2,
    )
    errors = np.where(behind[:, None], _BEHIND_PX, corners.pixels - expected)
    return np.concatenate([by_point @ point_by, errors[:, :, None]], axis=2)


def _moments(corners: Corners, columns: Array, weights: Array) -> Array:
    """(v, 20, 20): products of the columns, summed over the corners of each view, in units of the corners' noise."""
    count = columns.shape[2]
    weighted = columns * (weights / corners.noise_px**2)[:, None, None]
    bounds = [*np.flatnonzero(np.diff(corners.view, prepend=-1)), len(columns)]
    pairs = [(weighted[a:b].reshape(-1, count), columns[a:b].reshape(-1, count)) for a, b in pairwise(bounds)]
    return np.stack([left.T @ right for left, right in pairs])


def _reduced(corners: Corners, columns: Array, weights: Array) -> tuple[Array, Array, float, float]:
    """Hessian (13, 13), gradient (13,) and cost without the arm's errors; and how far those spread what is expected."""
    moments = _moments(corners, columns, weights)
    own = np.eye(6) + moments[:, _ARM, _ARM]
    keep = np.r_[0:13, _ERROR]
    coupling = moments[:, _ARM, :][:, :, keep]
    whole = moments[:, keep][:, :, keep] - np.swapaxes(coupling, 1, 2) @ np.linalg.solve(own, coupling)
    total = whole.sum(axis=0)
    return total[:13, :13], total[:13, 13], float(total[13, 13]), float(np.linalg.slogdet(own)[1].sum())


def _weights(corners: Corners, columns: Array) -> Array:
    """(n,) Huber's: of what is left when each view's most likely error of the arm is taken away."""
    moments = _moments(corners, columns, np.ones(len(columns)))
    own = np.eye(6) + moments[:, _ARM, _ARM]
    likely = np.linalg.solve(own, moments[:, _ARM, _ERROR, None])[..., 0]
    rest = columns[:, :, _ERROR] - np.einsum("nka,na->nk", columns[:, :, _ARM], likely[corners.view])
    sizes = np.linalg.norm(rest, axis=1)
    usual = max(_LEAST_PX, float(np.median(sizes)) / 1.18)  # of one coordinate, by the median: bad ones do not count
    return np.asarray(np.minimum(1.0, _HUBER * usual / np.maximum(sizes, 1e-12)))
