"""Planning of a motion: joint positions all along the way, checked before anything moves.

The inverse kinematics is followed from the arm's present position along the way, so that it never changes its branch:
each solution is the one nearest to the last. What cannot be followed raises :class:`hal.Unreachable`, with how far the
way is possible and why it is not from there on.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from itertools import pairwise
from math import ceil, hypot
from typing import NamedTuple, NoReturn

import numpy as np
from numpy.typing import NDArray

from ..commands import PATH_KNOTS, PathSection
from ..errors import CommandError, Unreachable
from ..geometry import difference
from ..kinematics.arm import Kinematics
from ..servo.path import JointPath
from ..specs import WorkspaceSpec
from .lines import REVERSAL, STRAIGHT_ON, TcpLine, tcp_lines

Array = NDArray[np.float64]
Floats = Sequence[float]

MotionCheck = Callable[[Array], None]
"""A further check of a whole motion: gets joint positions along it (k, n), rad, and raises a HalError if the arm must
not move along them."""

STEP = 0.01
"""Distance of two knots on a straight line, m."""
_SHORTEST = 1e-4
"""Where a step fails it is halved, down to this, m."""
_FASTEST = 40.0
"""Greatest way of a joint for each metre of the tcp, rad/m: beyond it the arm is as good as singular."""
_EXACT = (1e-8, 1e-8)
"""Residual of the inverse kinematics at a knot, m and rad."""
_NEAR = (1e-4, 5e-4)
"""Greatest distance of the spline from the way between two knots, m and rad; more knots are added until it is kept."""
_REFINEMENTS = 7
"""Most rounds of adding knots where the spline is too far off the way."""
_ITERATIONS = 12
_INSIDE = 1e-3
"""A way keeps so far inside the position limits, rad, that the spline between its knots keeps them as well."""
_EASY = 0.8
_AWAY = 8.0
"""From this share of its range on, a joint is turned away from its limit where that does not move the tcp; at the limit
by so many rad for each metre of the way."""
_JOINT_STEP = 0.05
"""Greatest distance of two positions at which a straight way in joint space is checked, rad."""
_DAMPING = 1e-12
"""Keeps the shortest step finite at a singularity; too small to matter elsewhere."""
_CORNER = 12
"""Intervals of a rounded corner in joint space."""
_SAME = 1e-6


class MotionPlan(NamedTuple):
    """A motion that was checked."""

    sections: tuple[PathSection, ...]
    """Empty if the arm is there already."""
    length: float
    """Length of the way, m (rad for a way in joint space)."""


class PathPlanner:
    """Plans motions of one arm.

    Args:
        kinematics: The arm's kinematics.
        lower: Position limits (n,), rad.
        upper: Likewise.
        workspace: Box that the tcp may be in; None for no box.
        check: A further check; None for none.
        step: Distance of two knots on a straight line, m; a smaller one checks more densely.
    """

    def __init__(
        self,
        kinematics: Kinematics,
        lower: Floats,
        upper: Floats,
        workspace: WorkspaceSpec | None = None,
        check: MotionCheck | None = None,
        step: float = STEP,
    ) -> None:
        self._arm = kinematics
        self._lower, self._upper = np.array(lower, float), np.array(upper, float)
        self._middle, self._half = 0.5 * (self._lower + self._upper), 0.5 * (self._upper - self._lower)
        self._workspace = workspace
        self._check = check
        self._step = step

    def plan_poses(self, q: Floats, poses: Sequence[Floats], blend: float = 0.0) -> MotionPlan:
        """Plan straight lines of the tcp.

        Args:
            q: Joint positions (n,) at the start, rad.
            poses: Poses (7,) of the tcp to go along, in the base frame.
            blend: Distance before a pose at which the rounding of its corner begins, m.

        Raises:
            Unreachable: The way cannot be followed to its end.
            CommandError: It is too long (``code`` is ``path_too_long``).
        """
        lines = tcp_lines([self._arm.fk(q), *poses], blend)
        whole = sum(line.length for line in lines)
        self._check_box(lines, whole)
        sections: list[PathSection] = []
        done = 0.0
        for line in lines:
            section = self._follow(line, np.array(q, float), done, whole)
            sections.append(section)
            q = section.q[-1]
            done += line.length
        return self._check_plan(sections, whole)

    def plan_joints(self, q: Floats, points: Sequence[Floats], blend: float = 0.0) -> MotionPlan:
        """Plan a way that is straight in joint space between waypoints, and rests at corners that are not rounded.

        Args:
            q: Joint positions (n,) at the start, rad.
            points: Waypoints (n,), rad.
            blend: Distance before a waypoint at which the rounding of its corner begins, rad.

        Raises:
            Unreachable: The way leaves the workspace, or does not pass the further check.
            CommandError: It has too many waypoints (``code`` is ``path_too_long``).
        """
        sections = _make_sections([np.array(point, float) for point in (q, *points)], blend)
        whole = sum(section.s[-1] for section in sections)
        fk = self._arm.fk
        begun = fk(q)
        done = 0.0
        for section in sections if self._workspace is not None else ():
            path = JointPath(section)
            for s in _places(section):
                joints = path.at(s)[0]
                self._check_place(fk(joints), begun, done + s, whole, joints)
            done += section.s[-1]
        return self._check_plan(sections, whole)

    # Inverse kinematics along a line.

    def _follow(self, line: TcpLine, q: Array, done: float, whole: float) -> PathSection:
        """Return the knots of a line that begins at ``q`` (n,), ``done`` after the start of the ``whole`` way."""
        lower = np.minimum(self._lower + _INSIDE, q)
        upper = np.maximum(self._upper - _INSIDE, q)
        knots, rows = [0.0], [q]
        ahead = line.grid(self._step)[:0:-1]
        while ahead:
            start, end = knots[-1], ahead[-1]
            pose = line.at(end)
            found = self._solve(pose, rows[-1], end - start, lower, upper)
            if found is not None and float(np.abs(found - rows[-1]).max()) <= _FASTEST * (end - start):
                knots.append(end)
                rows.append(found)
                ahead.pop()
            elif end - start > _SHORTEST:
                ahead.append(0.5 * (start + end))
            else:
                self._refuse(rows[-1], pose, found, done + start, whole, lower, upper)
        for _ in range(_REFINEMENTS):
            wrong = self._find_off_line(line, knots, rows)
            for k in reversed(wrong):
                middle = 0.5 * (knots[k] + knots[k + 1])
                found = self._solve(line.at(middle), 0.5 * (rows[k] + rows[k + 1]), 0.0, lower, upper)
                if found is None:
                    self._refuse(rows[k], line.at(middle), None, done + knots[k], whole, lower, upper)
                knots.insert(k + 1, middle)
                rows.insert(k + 1, found)
            if not wrong or len(knots) > PATH_KNOTS:
                break
        else:
            self._refuse(rows[wrong[0]], line.at(knots[wrong[0]]), q, done + knots[wrong[0]], whole, lower, upper)
        section = PathSection(tuple(knots), tuple(tuple(row.tolist()) for row in rows))
        samples = JointPath(section).samples(4)
        outside = ((samples < lower - 0.9 * _INSIDE) | (samples > upper + 0.9 * _INSIDE)).any(axis=1)
        if outside.any():
            k = int(outside.argmax()) // 4
            self._refuse(np.clip(rows[k], lower, upper), line.at(knots[k]), None, done + knots[k], whole, lower, upper)
        return section

    def _solve(self, pose: Floats, q: Array, way: float, lower: Array, upper: Array) -> Array | None:
        """Return the joint positions (n,) for ``pose`` (7,) nearest to ``q``; None if there are none within the limits.

        Newton's method with the step of least length. ``way`` is that of the tcp, for the turn of joints away from
        their limits: it depends smoothly on ``q``, so that the joints' way has no corners (as it would where a joint
        runs into its limit and the others take over).
        """
        arm = self._arm
        aside: Array | None = None
        if way > 0.0 and arm.n > 6:
            share = (q - self._middle) / self._half
            excess = np.maximum(np.abs(share) - _EASY, 0.0) / (1.0 - _EASY)
            if excess.any():
                aside = -_AWAY * way * np.sign(share) * excess * excess
        for _ in range(_ITERATIONS):
            at, jacobian = arm.fk_and_jacobian(q)
            way_left = difference(at, pose)
            small = hypot(*way_left[:3]) <= _EXACT[0] and hypot(*way_left[3:]) <= _EXACT[1]
            if small and aside is None:
                return q if bool(((q >= lower) & (q <= upper)).all()) else None
            error: Array = np.array(way_left)
            if aside is not None:
                error -= jacobian @ aside
            step = _solve_step(jacobian, error)
            if aside is not None:
                step, aside = step + aside, None
            q = q + step
        return None

    def _find_off_line(self, line: TcpLine, knots: list[float], rows: list[Array]) -> list[int]:
        """Return the intervals between two knots in whose middle the spline is off the line."""
        path = JointPath(PathSection(tuple(knots), tuple(rows)))  # type: ignore[arg-type]  # rows of numbers
        wrong = []
        for k, (start, end) in enumerate(pairwise(knots)):
            middle = 0.5 * (start + end)
            error = difference(self._arm.fk(path.at(middle)[0]), line.at(middle))
            if hypot(*error[:3]) > _NEAR[0] or hypot(*error[3:]) > _NEAR[1]:
                wrong.append(k)
        return wrong

    def _refuse(
        self, q: Array, pose: Floats, found: Array | None, at: float, whole: float, lower: Array, upper: Array
    ) -> NoReturn:
        """Raise Unreachable for a way that is possible up to ``at``, where the arm is at ``q`` (n,)."""
        error = difference(self._arm.fk(q), pose)
        code, reason = "unreachable", "the way leaves the arm's reach"
        at_limit = np.flatnonzero((q <= lower + 10.0 * _INSIDE) | (q >= upper - 10.0 * _INSIDE))
        if found is not None:
            code, reason = "singular", "the way passes a singularity, where the joints would jump"
        elif at_limit.size:
            names = ", ".join(self._arm.spec.joints[k] for k in at_limit)
            code, reason = "joint_limit", f"the way leaves the position limits of {names}"
        raise Unreachable(
            reason,
            position_error=hypot(*error[:3]),
            rotation_error=hypot(*error[3:]),
            q=tuple(q.tolist()),
            along=at / whole,
            distance=at,
            code=code,
        )

    # Checks.

    def _check_box(self, lines: Sequence[TcpLine], whole: float) -> None:
        """Raise Unreachable if the tcp leaves the workspace; one that starts outside may come back in."""
        if self._workspace is None:
            return
        done = 0.0
        for line in lines:
            begun = lines[0].at(0.0)
            for s in line.grid(0.5 * self._step):
                self._check_place(line.at(s), begun, done + s, whole, None)
            done += line.length

    def _check_place(self, pose: Floats, begun: Floats, at: float, whole: float, q: Floats | None) -> None:
        box = self._workspace
        assert box is not None
        for x, x0, low, high, axis in zip(pose, begun, box.lower, box.upper, "xyz", strict=False):
            if x > max(high, x0) + 1e-6 or x < min(low, x0) - 1e-6:
                raise Unreachable(
                    f"the way leaves the workspace: {axis} = {x:.3f} m, allowed {low:.3f} to {high:.3f}",
                    position_error=max(x - high, low - x),
                    rotation_error=0.0,
                    q=None if q is None else tuple(q),
                    along=at / whole,
                    distance=at,
                    code="outside_workspace",
                )

    def _check_plan(self, sections: Sequence[PathSection], whole: float) -> MotionPlan:
        """Return the plan, if it is short enough and passes the further check."""
        count = sum(len(section.s) for section in sections)
        if count > PATH_KNOTS:
            raise CommandError(
                f"the way needs {count} knots, more than {PATH_KNOTS}: split it into several motions",
                code="path_too_long",
            )
        if self._check is not None and sections:
            samples: list[list[float]] = []
            for section in sections:
                path = JointPath(section)
                samples += [path.at(s)[0] for s in _places(section)]
            self._check(np.array(samples))
        return MotionPlan(tuple(sections), whole)


def _solve_step(jacobian: Array, error: Array) -> Array:
    """Return the shortest step of the joints (k,) that moves the tcp by ``error`` (6,), to first order."""
    gram = jacobian @ jacobian.T
    gram.flat[::7] += _DAMPING
    step: Array = jacobian.T @ np.linalg.solve(gram, error)
    return step


def _places(section: PathSection) -> list[float]:
    """Return parameters at which a section is checked: its knots, and places between them."""
    places = [0.0]
    for start, end, a, b in zip(section.s[:-1], section.s[1:], section.q[:-1], section.q[1:], strict=True):
        farthest = max(abs(x - y) for x, y in zip(a, b, strict=True))
        count = max(2, ceil(farthest / _JOINT_STEP))
        places += [start + (end - start) * k / count for k in range(1, count)] + [end]
    return places


def _make_sections(points: Sequence[Array], blend: float) -> list[PathSection]:
    """Return the sections of a way along waypoints (n,), rad, with corners as :class:`~hal.motion.lines.Corner`'s."""
    kept = [points[0]]
    for point in points[1:]:
        if float(np.linalg.norm(point - kept[-1])) > _SAME:
            kept.append(point)
    ways = [after - before for before, after in pairwise(kept)]
    lengths = [float(np.linalg.norm(way)) for way in ways]
    directions = [way / length for way, length in zip(ways, lengths, strict=True)]
    sections: list[PathSection] = []
    s, q = [0.0], [kept[0]]
    begun = 0.0

    def go(point: Array, way: float, count: int) -> None:
        start, place = q[-1], s[-1]
        for k in range(1, count + 1):
            q.append(point if k == count else start + (point - start) * (k / count))
            s.append(place + way * k / count)

    for k, (length, direction) in enumerate(zip(lengths, directions, strict=True)):
        corner, cut = kept[k + 1], _find_cut(lengths, directions, k, blend)
        straight = length - begun - cut
        if straight > _SAME:  # knots near a corner, whose curvature must not spread over a long straight part
            go(corner - cut * direction, straight, ceil(straight / (cut or begun)) if cut or begun else 1)
        begun = cut
        if cut:
            place = s[-1]
            for i in range(1, _CORNER + 1):
                u = i / _CORNER
                done = u * u * u * (1.0 - 0.5 * u)
                q.append(corner - (cut - 2.0 * cut * (u - done)) * direction + 2.0 * cut * done * directions[k + 1])
                s.append(place + 2.0 * cut * u)
        elif k + 1 == len(lengths) or float(direction @ directions[k + 1]) < STRAIGHT_ON:
            sections.append(PathSection(tuple(s), tuple(tuple(row.tolist()) for row in q)))
            s, q = [0.0], [corner]
    return sections


def _find_cut(lengths: Floats, directions: Sequence[Array], k: int, blend: float) -> float:
    """Return how far from the end of way ``k`` its corner with the next begins, rad; 0 if that is not rounded."""
    if k + 1 == len(lengths):
        return 0.0
    cut = min(blend, 0.5 * lengths[k], 0.5 * lengths[k + 1])
    return cut if cut > _SAME and REVERSAL < float(directions[k] @ directions[k + 1]) < STRAIGHT_ON else 0.0
