"""Collisions of an arm with itself, with the boxes of its rig and with the other arms: ``arm.collisions``."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from math import dist
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import vector
from ..errors import CollisionError, CommandError
from .collision_model import CollisionModel, PairBounds, PairDistance

if TYPE_CHECKING:
    from ..specs import CollisionSpec, RobotSpec

Array = NDArray[np.float64]

_STEP = 1e-3
"""A way along which two shapes come this much nearer at most is checked at its ends only, m."""
_SAME_PLACE = 1e-3
"""Bases of two arms that are this near are in one place, m."""
_TOLERANCE = 5e-6
_BACK = 4e-5
"""Shapes that are nearer than the margin where a motion begins may come so much nearer still, m, and so much back while
they part; the servo allows twice and 5e-5 m."""


class Collisions:
    """Collisions of one arm: with itself, with the boxes of the rig and with the other arms where they are now.

    Shapes are those of the URDFs, meshes as their convex hulls, with the fingers' whole range. Which of them are
    checked, and the margin, is in the rig's file under ``collisions``.

    Args:
        robot: The arm.
        spec: What is checked.
        others: The other arms, each with a function that returns its present joint positions (n,), rad. Those whose
            bases are in the place of this one's are left out, unless they are arms of one robot.

    Raises:
        NotSupported: The arm has no collision shapes (``code`` is ``no_shapes``), or a mesh cannot be read.
    """

    def __init__(
        self,
        robot: RobotSpec,
        spec: CollisionSpec,
        others: Sequence[tuple[RobotSpec, Callable[[], Sequence[float] | Array]]] = (),
    ) -> None:
        self._robot = robot
        self._n = len(robot.joints)
        others = [(other, position) for other, position in others if not in_one_place(robot, other)]
        self._others = tuple(position for _, position in others)
        self.model = CollisionModel([robot, *(other for other, _ in others)], spec)
        self._own = self.model.slices[0]
        self.margin = spec.margin
        """Distance that motions keep, m."""
        self._bounds = PairBounds(self.model)

    @property
    def notes(self) -> tuple[str, ...]:
        """Pairs of links that are not checked, and why."""
        return self.model.notes

    def check(self, q: ArrayLike, margin: float | None = None) -> list[PairDistance]:
        """Return the pairs that are nearer than a margin, nearest first; an empty list if nothing collides.

        Args:
            q: Joint positions of this arm (n,), rad. Other arms are where they are now.
            margin: m; 0 for what really overlaps. None: each pair's own margin, which is that of the rig, and less for
                links that are nearer than twice that at home.
        """
        self.model.place(self._all(vector("q", q, self._n)))
        distances = self.model.distances()
        least = self.model.margins if margin is None else np.full(len(distances), margin)
        found = np.flatnonzero(distances < least)
        found = found[np.argsort(distances[found])]
        return _nearest_each(self.model.pair(int(k), float(distances[k])) for k in found)

    def distance(self, q: ArrayLike) -> float:
        """Return the smallest distance (m) at joint positions ``q`` (n,), rad; negative if shapes overlap."""
        return self.nearest(q).distance

    def nearest(self, q: ArrayLike) -> PairDistance:
        """Return the nearest pair at joint positions ``q`` (n,), rad."""
        return self.model.pair(*self._bounds.nearest(self._all(vector("q", q, self._n))))

    def first(self, q_samples: ArrayLike) -> tuple[int, PairDistance] | None:
        """Return the first of some positions that is nearer than the margin to anything, and the pair; None if none is.

        The way between two positions, straight in joint space, is checked, too: the position at its end is returned.

        Args:
            q_samples: Joint positions (k, n), rad, in the order of the motion. Pairs that are nearer than the margin at
                the first one may stay so or part, but not come nearer again.
        """
        found = self._first(self._samples(q_samples))
        return None if found is None else (found[0], found[2])

    def check_motion(self, q_samples: ArrayLike) -> None:
        """Check a motion along straight lines in joint space; the same rules as :meth:`first`.

        Args:
            q_samples: Joint positions (k, n), rad.

        Raises:
            CollisionError: It would collide; with the pair and how far along.
        """
        samples = self._samples(q_samples)
        found = self._first(samples)
        if found is None:
            return
        index, share, pair = found
        steps = np.abs(np.diff(samples, axis=0)).max(axis=1)
        before = float(steps[: max(0, index - 1)].sum())
        done = before + (share * float(steps[index - 1]) if index else 0.0)
        total = float(steps.sum())
        raise CollisionError(self._robot.name, pair.first, pair.second, pair.distance, done / total if total else 0.0)

    def _samples(self, q_samples: ArrayLike) -> Array:
        samples = np.array(q_samples, float)
        if samples.ndim != 2 or samples.shape[1] != self._n or not len(samples) or not np.isfinite(samples).all():
            raise CommandError(f"q_samples must be (k, {self._n}) finite numbers, not {samples.shape}")
        return samples

    def _first(self, samples: Array) -> tuple[int, float, PairDistance] | None:
        """Return the index of the end of the segment with the first collision, its share of it, and the pair.

        Each step along a segment is as long as no pair can get under its margin, but comes :data:`_STEP` nearer at
        least. What is in its margin at first may not come nearer, nor come back.
        """
        model, bounds = self.model, self._bounds
        margins = model.margins
        others = self._all(samples[0])
        model.place(others)
        least = np.minimum(margins, model.distances() - _TOLERANCE)
        start = samples[0]
        for index in range(max(1, len(samples) - 1)):
            end = samples[min(index + 1, len(samples) - 1)]
            way = np.zeros(model.n)
            way[self._own] = np.abs(end - start)
            speed = model.levers @ way  # m nearer for the whole segment, at most
            share = 0.0
            while True:
                others[self._own] = start + share * (end - start)
                near = bounds.near(others, (1.0 - share) * way, margins)
                distances, before = bounds.distances[near], least[near]
                least = margins.copy()
                if not near:
                    break
                worst = int(np.argmin(distances - before))
                if distances[worst] < before[worst]:
                    return min(index + 1, len(samples) - 1), share, model.pair(near[worst], float(distances[worst]))
                least[near] = np.maximum(before, np.minimum(margins[near], distances - _BACK))
                if share >= 1.0:
                    break
                steps = float((speed[near] / np.maximum(distances - margins[near], _STEP)).max())
                share = min(1.0, share + 1.0 / max(1.0, steps))
            start = end
        return None

    def _all(self, q: Array) -> Array:
        """Return the joint positions of all arms: ``q`` of this one, and the present ones of the others."""
        return np.concatenate([q, *(np.array(position(), float) for position in self._others)])


def in_one_place(one: RobotSpec, other: RobotSpec) -> bool:
    """Return whether two arms have their bases in one place, so that they have been given none; not arms of a robot."""
    of_one_robot = (one.same or one.name) == (other.same or other.name)
    return not of_one_robot and dist(one.base_position, other.base_position) < _SAME_PLACE


def _nearest_each(pairs: Iterable[PairDistance]) -> list[PairDistance]:
    """Return the first of the pairs with the same names: links may have several shapes."""
    found: dict[tuple[str, str], PairDistance] = {}
    for pair in pairs:
        found.setdefault((pair.first, pair.second), pair)
    return list(found.values())
