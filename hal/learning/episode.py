"""Reset a scene before an episode: objects to their start poses or to random ones, the arm to its start position."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import CommandError, MotionStopped
from ..geometry import Pose
from ..randomization import list_distractors
from ..specs import BodySpec, RangesSpec, WorldSpec

if TYPE_CHECKING:
    from ..clock import Clock
    from ..deadman import Deadman
    from ..rig import Rig
    from ..robot import Robot
    from ..world import World

Array = NDArray[np.float64]

_TRIES = 100
"""Poses sampled for one object before all are sampled again."""
_ROUNDS = 20
"""How often all are sampled again: if one object took the room of the next, other poses of both may fit."""
_TOUCHING = 0.005
"""Overlap of the boxes around objects that only touch, m."""
_ROUNDING = 1e-6
"""Tolerance of an overlap, m."""
_INFINITE = 1e6
"""Size above which a body is a plane, m."""
_READS = 20
"""Attempts to read a consistent pose and box of a moving object."""


class _Box(NamedTuple):
    """A box along the world's axes, m."""

    lower: Array
    upper: Array

    def corners(self) -> Array:
        """Return the corners (8, 3), m."""
        return np.array(list(product(*zip(self.lower, self.upper, strict=True))))

    def overlap(self, box: _Box) -> float:
        """Return by how much two boxes overlap along the axis on which it is least, m; 0 or less if they do not."""
        return float(np.minimum(self.upper - box.lower, box.upper - self.lower).min())


class _Plane(NamedTuple):
    """A plane; everything below it is solid."""

    position: Array
    normal: Array

    def overlap(self, box: _Box) -> float:
        """Return how far a box reaches below the plane, m; 0 or less if it does not."""
        return float(((self.position - box.corners()) @ self.normal).max())


_Solids = dict[str, "_Box | _Plane"]


class _RandomBody(NamedTuple):
    """An object with random ranges."""

    name: str
    orientation: Sequence[float]
    ranges: RangesSpec
    corners: Array | None
    """(8, 3) of a box around it, in its own frame, m; None if nothing collides with it."""
    allowed: Mapping[str, float]
    """Additional overlap with some of the bodies that do not move, m."""

    def sample(self, random: np.random.Generator) -> tuple[Pose, _Box | None]:
        """Return a random pose, and the box around the object there."""
        numbers = random.uniform(self.ranges.lower, self.ranges.upper)
        pose = Pose.from_rpy(numbers[:3], numbers[3:].tolist()) @ Pose(orientation=self.orientation)
        return pose, None if self.corners is None else _enclose(pose.transform(self.corners))

    def find_overlaps(self, box: _Box | None, solids: _Solids) -> set[str]:
        """Return the names of the solids that it would overlap there."""
        if box is None:
            return set()
        return {name for name, solid in solids.items() if solid.overlap(box) > _ROUNDING + self.allowed.get(name, 0.0)}


class _NoRoom(Exception):
    """Every pose sampled for an object overlaps something."""

    def __init__(self, name: str, overlapped: set[str]) -> None:
        self.name, self.overlapped = name, overlapped


def sample_poses(rig: Rig, random: np.random.Generator, given: Collection[str] = ()) -> dict[str, Pose]:
    """Sample a pose for each object of the rig that has random ranges. Nothing is moved.

    Call it after ``rig.world.reset()``: objects without ranges, and those in ``given``, count at their present pose.

    At these poses the boxes around objects, along the world's axes, overlap neither each other, nor those around other
    objects, nor a plane. Exceptions: an object configured to stand *inside* the box around one without ranges (in a
    bin, on a shelf) may be anywhere in it, and one configured to rest on another may touch it. Objects that an arm
    carries, and those without collision shapes, are ignored. **Arms are ignored too**, since the box around one covers
    half the bench: ranges must keep clear of their start positions.

    Args:
        rig: The rig; without a simulated world the result is empty.
        random: Source of random numbers; the same seed gives the same poses.
        given: Names of objects that the caller places.

    Returns:
        The pose of each object in the world, in the order of the configuration.

    Raises:
        CommandError: No such poses were found in a bounded number of samples (code ``no_room``).
    """
    plan = rig.plan.world
    if plan is None or not rig.has_world:
        return {}
    there = set(rig.world.bodies) - {robot.name for robot in plan.robots}
    known = (*plan.bodies, *list_distractors(plan))
    drawn = [(body, body.random) for body in known if body.random and body.name in there - set(given)]
    if not drawn:
        return {}
    free = {body.name for body in known if body.robot is not None or not (body.collision or body.urdf)}
    rest = sorted(there - free - {body.name for body, _ in drawn})
    still = {name: solid for name in rest if (solid := _find_solid(rig.world, name)) is not None}
    home = {body.name: still[body.name] for body in known if body.name in still and body.name not in given}
    movers = [_make_random_body(rig.world, body, ranges, None if body.name in free else home) for body, ranges in drawn]
    for _ in range(_ROUNDS):
        try:
            return _arrange(movers, random, still)
        except _NoRoom as found:
            tight = found
    raise CommandError(
        f"there is no room for {tight.name!r} in its random ranges: every sampled pose overlapped "
        f"{' or '.join(map(repr, sorted(tight.overlapped)))}; change its `random` in the rig's objects",
        code="no_room",
    )


def _arrange(movers: Sequence[_RandomBody], random: np.random.Generator, still: _Solids) -> dict[str, Pose]:
    """Sample a pose for each object, one after the other. Raises _NoRoom."""
    poses: dict[str, Pose] = {}
    solids = dict(still)
    for body in movers:
        overlapped: set[str] = set()
        for _ in range(_TRIES):
            pose, box = body.sample(random)
            if not (new := body.find_overlaps(box, solids)):
                break
            overlapped |= new
        else:
            raise _NoRoom(body.name, overlapped)
        poses[body.name] = pose
        if box is not None:
            solids[body.name] = box
    return poses


def _make_random_body(world: World, body: BodySpec, ranges: RangesSpec, home: _Solids | None) -> _RandomBody:
    """Return an object with what its poses depend on.

    ``home`` has the bodies that stand where they are configured; None for an object that nothing collides with.
    """
    if home is None:
        return _RandomBody(body.name, body.orientation, ranges, None, {})
    corners = _find_corners(world, body)
    box = _enclose(Pose(body.position, body.orientation).transform(corners))
    touched = {name: depth for name, solid in home.items() if (depth := solid.overlap(box)) > 0.0}
    allowed = {name: np.inf if depth > _TOUCHING else depth for name, depth in touched.items()}
    return _RandomBody(body.name, body.orientation, ranges, corners, allowed)


def _find_corners(world: World, body: BodySpec) -> Array:
    """Return the corners (8, 3) of a box around an object, in its own frame, m."""
    half = _find_half_size(body)
    if half is not None:
        return _Box(-half, half).corners()
    for _ in range(_READS):  # it may be falling, and both must be of the same time
        pose = world.pose(body.name)
        box = _Box(*world.aabb(body.name))
        if world.pose(body.name) == pose:
            break
    return pose.inverse().transform(box.corners())


def _find_half_size(body: BodySpec) -> Array | None:
    """Return half the size (3,) of a simple shape, m; None for other shapes."""
    radius, length = body.radius or 0.0, body.length or 0.0
    sizes = {
        "box": body.half_extents,
        "sphere": (radius, radius, radius),
        "cylinder": (radius, radius, length / 2.0),
        "capsule": (radius, radius, length / 2.0 + radius),
    }
    half = sizes.get(body.shape)
    return None if half is None else np.array(half)


def _find_solid(world: World, name: str) -> _Box | _Plane | None:
    """Return the space that a body takes now; None if nothing collides with it."""
    lower, upper = world.aabb(name)
    if not (lower < upper).any():
        return None
    if (upper - lower).max() < _INFINITE:
        return _Box(lower, upper)
    pose = world.pose(name)
    return _Plane(pose.position, pose.transform([0.0, 0.0, 1.0]) - pose.position)


def _enclose(points: Array) -> _Box:
    return _Box(points.min(axis=0), points.max(axis=0))


_POLL_HZ = 50.0
"""How often the dead-man is polled, Hz."""


def stands_in_world(rig: Rig, robot: Robot) -> bool:
    """Return whether this arm is part of the simulated world, so that it can be placed without driving.

    The mirror of a real arm is not, and neither is one that another computer simulates.
    """
    world = rig.plan.world
    return world is not None and robot.spec.at is None and robot.spec.driver == world.driver


def reset_scene(
    rig: Rig,
    robot: Robot,
    q: ArrayLike | None = None,
    *,
    poses: Mapping[str, Pose] | None = None,
    random: np.random.Generator | None = None,
    seed: int | None = None,
    deadman: Deadman | None = None,
    unattended: bool = False,
    since: int | None = None,
    patience: float = 60.0,
    open_gripper: bool = True,
    vary: bool = True,
) -> dict[str, Pose]:
    """Bring a scene to its start: objects at their start poses and the arm at its start position.

    Where the rig file has ``simulation.randomize``, the scene is varied, too (:meth:`hal.world.World.randomize`).
    A simulated arm is placed. Any other arm **drives** as ``move_to`` does, then opens its gripper. With a dead-man
    that takes a new press: a press that began before this call, or that followed a stop, does not start the motion.

    Args:
        rig: The rig. Without a simulated world only the arm is moved.
        robot: The arm.
        q: Its start position (n,), rad; None for its initial position in a simulated world, else home.
        poses: Poses of objects in the world, instead of sampled ones.
        random: Sample poses of objects with random ranges, see :func:`sample_poses`; None leaves them where they are
            configured, and the scene as the rig file has it.
        seed: Seed of what ``simulation.randomize`` varies; None samples one from ``random``.
        deadman: Dead-man for a real arm.
        unattended: Let a real arm drive without a dead-man.
        since: Count of presses that a new press must exceed; None for the count at this call.
        patience: Longest time to wait for the dead-man, s.
        open_gripper: Whether a real gripper opens, which drops what it holds.
        vary: Whether the scene is varied; with several arms, in the reset of the last one.

    Returns:
        The poses of the placed objects.

    Raises:
        MotionStopped: ``rig.stop()`` is not acknowledged, or the dead-man was not pressed or held within ``patience``
            (code ``deadman_not_pressed``). Other errors are those of ``move_to``.
        CommandError: There is no room for the objects (code ``no_room``).
    """
    inside = stands_in_world(rig, robot)
    if not inside:  # before the objects are placed: its mirror would push them
        if deadman is not None:
            _wait_for_press(rig.clock, deadman, since, patience)
        target = robot.home if q is None else np.asarray(q, float)
        robot.move_to(target, deadman=deadman, unattended=unattended, patience=patience)
        if open_gripper and robot.gripper is not None:
            robot.gripper.open()
    if not rig.has_world:
        return {}
    _vary(rig.world, rig.plan.world if vary else None, random, seed)
    rig.world.reset()
    placed = _place_objects(rig, poses, random)
    if inside:
        rig.world.reset(robot.name, q=robot.spec.initial if q is None else np.asarray(q, float))
    return placed


def _place_objects(rig: Rig, poses: Mapping[str, Pose] | None, random: np.random.Generator | None) -> dict[str, Pose]:
    """Place objects at given poses, and others at sampled ones; return all of them."""
    put = dict(poses or {})
    for name, pose in put.items():
        rig.world.reset(name, pose=pose)
    drawn = {} if random is None else sample_poses(rig, random, given=put)
    for name, pose in drawn.items():
        rig.world.reset(name, pose=pose)
    return put | drawn


def _vary(world: World, spec: WorldSpec | None, random: np.random.Generator | None, seed: int | None) -> None:
    """Vary the scene by a seed, or by one from ``random``; with neither it is as in the rig file."""
    if spec is not None and spec.randomize is not None:
        if seed is None and random is not None:
            seed = int(random.integers(2**32))
        world.randomize(seed)


def _wait_for_press(clock: Clock, deadman: Deadman, since: int | None, patience: float) -> None:
    since = deadman.record.presses if since is None else since
    for tick in clock.rate(_POLL_HZ):
        record = deadman.record
        if record.held and record.presses > since:
            return
        if tick.elapsed > patience:
            raise MotionStopped(
                f"the dead-man was not pressed for {patience:g} s",
                "release it, then hold it",
                code="deadman_not_pressed",
            )
