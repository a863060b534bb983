"""Find an object on a table in depth images: the table's plane is removed, the largest cluster is what is left.

Everything is in the arm's base frame, whose z axis must point up.
"""

from __future__ import annotations

import math
import warnings
from collections import deque
from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..arguments import number, vector
from ..errors import CommandError
from ..geometry import Pose
from .objects import LocatedObject, object_from_points
from .running import SkillOptions, SkillResult, SkillRun

if TYPE_CHECKING:
    from typing_extensions import Unpack

    from ..camera import Camera
    from ..robot import Robot
    from ..types import Frame

Array = NDArray[np.float64]

_REACH = (0.2, 0.85)
"""Least and greatest distance from the base at which objects are looked for, m."""
_TALLEST = 0.25
"""Height above the table up to which a point may belong to an object, m: the arm itself is higher."""
_BELOW_HAND = 0.03
"""Distance below the tcp from which on points belong to no finger, m."""
_LOWEST = 0.008
"""Height above the table from which on a point belongs to an object, m; more where depth is noisy."""
_TILT = math.radians(15.0)
"""Greatest tilt of a table, rad."""
_ON_PLANE = 0.01
"""Distance up to which a point counts as one of a plane in the search for it, m."""
_PLANES = 100
"""Number of random planes that the search compares."""
_CELL = 0.008
"""Size of the cells in which neighbours are found, m."""
_FEWEST = 20
"""Least number of points of an object."""


class Plane(NamedTuple):
    """A nearly level plane ``z = a x + b y + c``."""

    a: float
    b: float
    c: float
    noise: float
    """Standard deviation of its points, m."""

    def height(self, points: Array) -> Array:
        """Return by how much points (k, 3) are above it, m."""
        above: Array = points[:, 2] - points[:, :2] @ [self.a, self.b] - self.c
        return above


def read_frames(camera: Camera, count: int = 5) -> list[Frame]:
    """Return frames of a camera that rests, all taken after this call."""
    frames = []
    for _ in range(count):
        frames.append(camera.read(after=camera.clock.now()))
        camera.clock.sleep(1.0 / camera.spec.rate_hz)
    return frames


def collect_points(arm: Robot, frames: Sequence[Frame]) -> Array:
    """Return the points (k, 3) that frames of one resting camera show, in the arm's base frame, m.

    The depth of a pixel is the median over the frames that measured it.

    Raises:
        NotSupported: The frames have no depth (``code`` is ``no_depth``), or the camera's pose is unknown
            (``no_camera_pose``).
    """
    newest, images = frames[-1], [frame.depth for frame in frames if frame.depth is not None]
    if images:
        stack = np.ma.masked_equal(np.stack(images), 0.0)
        depth = np.ma.median(stack, axis=0).filled(0.0)  # type: ignore[no-untyped-call]
        newest = replace(newest, depth=depth.astype(np.float32))
    return newest.points(frame=arm.base).astype(float)


def find_table(points: Array) -> Plane | None:
    """Return the nearly level plane that most of the points (k, 3) are on; None if there is none.

    The best of some random planes (RANSAC, always with the same random numbers), fitted to its points by least squares.
    """
    if len(points) < _FEWEST:
        return None
    random = np.random.default_rng(0)
    some = points[random.integers(len(points), size=min(len(points), 2000))]
    corners = some[random.integers(len(some), size=(_PLANES, 3))]
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    length = np.linalg.norm(normals, axis=1)
    level = np.abs(normals[:, 2]) > math.cos(_TILT) * np.maximum(length, 1e-12)
    if not level.any():
        return None
    normals, corners = normals[level] / length[level, None], corners[level, 0]
    away = np.abs(some @ normals.T - (normals * corners).sum(axis=1))
    best = int(np.argmax((away < _ON_PLANE).sum(axis=0)))
    near = np.abs((points - corners[best]) @ normals[best]) < _ON_PLANE
    plane = Plane(0.0, 0.0, 0.0, 0.0)
    for _ in range(3):
        ground = points[near]
        if len(ground) < _FEWEST:
            return None
        columns = np.column_stack([ground[:, :2], np.ones(len(ground))])
        (a, b, c), *_ = np.linalg.lstsq(columns, ground[:, 2], rcond=None)
        plane = Plane(float(a), float(b), float(c), 0.0)
        noise = float(np.std(plane.height(ground)))
        near = np.abs(plane.height(points)) < max(_ON_PLANE, 3.0 * noise)
        plane = plane._replace(noise=noise)
    return plane


def largest_cluster(points: Array, cell: float = _CELL) -> Array:
    """Return those of the points (k, 3) that are in the largest group of neighbours, seen from above.

    Args:
        points: The points, m.
        cell: Points in the same or in neighbouring squares of this size are neighbours, m.
    """
    cells = np.floor(points[:, :2] / cell).astype(int)
    left = {(x, y): list[int]() for x, y in map(tuple, np.unique(cells, axis=0).tolist())}
    for index, (x, y) in enumerate(cells.tolist()):
        left[x, y].append(index)
    best: list[tuple[int, int]] = []
    groups = dict(left)
    while left:
        group, waiting = [], deque([left.popitem()[0]])
        while waiting:
            x, y = waiting.popleft()
            group.append((x, y))
            beside = [(x + dx, y + dy) for dx in (-1, 0, 1) for dy in (-1, 0, 1)]
            waiting.extend(near for near in beside if left.pop(near, None) is not None)
        best = max(best, group, key=len)
    chosen = [index for place in best for index in groups[place]]
    return points[sorted(chosen)]


def locate_by_depth(
    arm: Robot, frames: Sequence[Frame], *, lower: ArrayLike | None = None, upper: ArrayLike | None = None
) -> LocatedObject | None:
    """Return the largest object on the table that frames show; None if there is none.

    Args:
        arm: The arm, at rest; what is above its tcp is left out.
        frames: Frames of one camera that rests, with depth; several are less noisy than one.
        lower: Corner (3,) of the box in which to look, in the arm's base frame, m; by default the arm's reach.
        upper: The other corner (3,), m.

    Raises:
        CommandError: The frames have no depth, or the camera's pose is unknown.
    """
    points = collect_points(arm, frames)
    away = np.hypot(points[:, 0], points[:, 1])
    inside = (away > _REACH[0]) & (away < _REACH[1])
    if lower is not None:
        inside &= (points >= vector("lower", lower, 3)).all(axis=1)
    if upper is not None:
        inside &= (points <= vector("upper", upper, 3)).all(axis=1)
    points = points[inside]
    table = find_table(points)
    if table is None:
        return None
    height = table.height(points)
    over = (height > max(_LOWEST, 3.0 * table.noise)) & (height < _TALLEST)
    over &= points[:, 2] < arm.state().tcp.position[2] - _BELOW_HAND
    if over.sum() < _FEWEST:
        return None
    cluster = largest_cluster(points[over])
    if len(cluster) < _FEWEST:
        return None
    ground = cluster[:, 2].mean() - table.height(cluster).mean()
    return object_from_points(cluster, float(ground))


def look_at(
    arm: Robot,
    camera: Camera,
    position: ArrayLike,
    *,
    distance: float = 0.4,
    **options: Unpack[SkillOptions],
) -> SkillResult:
    """Move the arm so that the camera on its hand looks at a position; the hand keeps its orientation.

    Args:
        arm: The arm that carries the camera.
        camera: The camera.
        position: Where to look (3,), in the arm's base frame, m.
        distance: Distance of the camera from there, m.
        **options: :class:`~hal.skills.running.SkillOptions`.

    Returns:
        The result; false, with the reason, if the arm does not get there.

    Raises:
        CommandError: This arm does not carry the camera (``code`` is ``not_on_the_hand``), or an invalid argument.
    """
    if not is_on_hand(arm, camera):
        raise CommandError(f"camera {camera.name} is not on the hand of {arm.name}", code="not_on_the_hand")
    target = vector("position", position, 3)
    number("distance", distance, "m", least=0.0, above=True)
    where = camera.read(after=arm.clock.now()).T_world_camera
    assert where is not None  # it is on the hand
    seen_from, tcp = arm.base.inverse() @ where, arm.state().tcp
    ahead = seen_from.transform([0.0, 0.0, distance]) - seen_from.position
    goal = Pose(tcp.position + target - ahead - seen_from.position, tcp.orientation)
    run = SkillRun("look_at", arm, ("look",), **options)
    with run:
        _, q = run.choose_way([[goal]])
        run.begin("look")
        run.go(goal, q)
    return run.result()


def find_by_depth(
    arm: Robot,
    camera: Camera,
    *,
    lower: ArrayLike | None = None,
    upper: ArrayLike | None = None,
    count: int = 5,
    closer: bool = True,
    **options: Unpack[SkillOptions],
) -> LocatedObject | None:
    """Return the largest object on the table that a camera sees; None if there is none.

    A camera on the hand looks twice: from where it is, and from near the object.

    Args:
        arm: The arm, at rest.
        camera: A camera with depth, on the hand or beside the arm.
        lower: Corner (3,) of the box in which to look, in the arm's base frame, m; by default the arm's reach.
        upper: The other corner (3,), m.
        count: Number of frames for each look.
        closer: Whether a camera on the hand looks a second time.
        **options: :class:`~hal.skills.running.SkillOptions` of the motion between the looks. If it fails, the first
            look counts, with a RuntimeWarning if the arm has moved. Stops and faults are exceptions.

    Raises:
        CommandError: The camera has no depth, or its pose is unknown.
    """
    found = locate_by_depth(arm, read_frames(camera, count), lower=lower, upper=upper)
    if found is None or not closer or not is_on_hand(arm, camera):
        return found
    looked = look_at(arm, camera, found.pose.position, **options)
    if not looked:
        if looked.reason in ("blocked", "timed_out"):
            warnings.warn(f"the second look failed, the first one counts: {looked.message}", RuntimeWarning, 2)
        return found
    again = locate_by_depth(arm, read_frames(camera, count), lower=lower, upper=upper)
    return found if again is None else again


def is_on_hand(arm: Robot, camera: Camera) -> bool:
    """Return whether an arm carries a camera."""
    view = camera.spec.view
    return view is not None and view.robot == arm.name
