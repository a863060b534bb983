"""Before an episode: everything back to where it starts."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from itertools import product
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import CommandError, MotionStopped
from ..geometry import Pose
from ..specs import BodySpec, RangesSpec

if TYPE_CHECKING:
    from ..clock import Clock
    from ..deadman import Deadman
    from ..rig import Rig
    from ..robot import Robot
    from ..world import World

__all__ = [
    "sample_poses",
    "reset_scene",
    "stands_in_world",
]

# [placement.py] Where things start in an episode: poses drawn from the random ranges that the rig gives them.

Array = NDArray[np.float64]

_TRIES = 100
"""Poses drawn for one thing before all are drawn anew."""
_ROUNDS = 20
"""How often that is done: where one thing took the room of the next, other poses of both may fit."""
_MARGINS = 0.005
"""m: boxes around things that only touch may overlap by so much."""
_ROUNDING = 1e-6
"""m"""
_ENDLESS = 1e6
"""m: what reaches farther is a plane."""
_LOOKS = 20
"""At something that moves, at most."""


class _Box(NamedTuple):
    """Along the world's axes, m."""

    lower: Array
    upper: Array

    def corners(self) -> Array:
        """(8, 3)"""
        return np.array(list(product(*zip(self.lower, self.upper, strict=True))))

    def depth(self, box: _Box) -> float:
        """By how much the two overlap along the axis on which it is least, m; 0 or less where they do not."""
        return float(np.minimum(self.upper - box.lower, box.upper - self.lower).min())


class _Plane(NamedTuple):
    """Everything below it is solid."""

    position: Array
    normal: Array

    def depth(self, box: _Box) -> float:
        """By how much a box reaches below it, m; 0 or less where it does not."""
        return float(((self.position - box.corners()) @ self.normal).max())


_Solids = dict[str, "_Box | _Plane"]


class _Thing(NamedTuple):
    """One that has ranges."""

    name: str
    orientation: Sequence[float]
    ranges: RangesSpec
    corners: Array | None
    """(8, 3) of a box that holds it, in its own frame, m; None for what nothing collides with."""
    allowed: Mapping[str, float]
    """By how much more it may overlap some of those that stand still, m."""

    def draw(self, random: np.random.Generator) -> tuple[Pose, _Box | None]:
        """A pose, and the box around the thing there."""
        numbers = random.uniform(self.ranges.lower, self.ranges.upper)
        pose = Pose.from_rpy(numbers[:3], numbers[3:].tolist()) @ Pose(orientation=self.orientation)
        return pose, None if self.corners is None else _box_around(pose.transform(self.corners))

    def met(self, box: _Box | None, solids: _Solids) -> set[str]:
        """What it would overlap there."""
        if box is None:
            return set()
        return {name for name, solid in solids.items() if solid.depth(box) > _ROUNDING + self.allowed.get(name, 0.0)}


class _NoRoom(Exception):
    """Every pose that was drawn for a thing overlaps something."""

    def __init__(self, name: str, met: set[str]) -> None:
        self.name, self.met = name, met


def sample_poses(rig: Rig, random: np.random.Generator, given: Collection[str] = ()) -> dict[str, Pose]:
    """A pose for each of the rig's things that have random ranges, in the order in which they are configured.

    Nothing is moved. Call it after ``rig.world.reset()``: what has no ranges counts where it is now, and so do things
    that are ``given`` a place by somebody else. The same seed gives the same poses.

    At these poses the boxes around things, along the world's axes, overlap neither each other, nor those around the
    other things, nor a plane. Except: what is configured to stand *inside* the box around a thing without ranges (in a
    bin, on a shelf) may be anywhere in it, and what is configured to rest on one may be drawn to rest on it. What an
    arm carries, and what nothing collides with, is in nobody's way.

    **Arms are not looked at**: the box around one covers half the bench. Ranges must keep clear of where arms start.

    Raises CommandError, which says what was in the way, where a bounded number of draws finds no such poses.
    """
    plan = rig.plan.world
    if plan is None or not rig.has_world:
        return {}
    there = set(rig.world.bodies) - {robot.name for robot in plan.robots}
    drawn = [(body, body.random) for body in plan.bodies if body.random and body.name in there - set(given)]
    if not drawn:
        return {}
    free = {body.name for body in plan.bodies if body.robot is not None or not (body.collision or body.urdf)}
    rest = sorted(there - free - {body.name for body, _ in drawn})
    still = {name: solid for name in rest if (solid := _solid(rig.world, name)) is not None}
    home = {body.name: still[body.name] for body in plan.bodies if body.name in still and body.name not in given}
    things = [_thing(rig.world, body, ranges, None if body.name in free else home) for body, ranges in drawn]
    for _ in range(_ROUNDS):
        try:
            return _arranged(things, random, still)
        except _NoRoom as found:
            tight = found
    raise CommandError(
        f"there is no room for {tight.name!r} in its random ranges: wherever it was drawn, it overlapped "
        f"{' or '.join(map(repr, sorted(tight.met)))}; change its `random`, in the rig's objects"
    )


def _arranged(things: Sequence[_Thing], random: np.random.Generator, still: _Solids) -> dict[str, Pose]:
    """A pose for each thing, one after the other. Raises _NoRoom."""
    poses: dict[str, Pose] = {}
    solids = dict(still)
    for thing in things:
        met: set[str] = set()
        for _ in range(_TRIES):
            pose, box = thing.draw(random)
            if not (new := thing.met(box, solids)):
                break
            met |= new
        else:
            raise _NoRoom(thing.name, met)
        poses[thing.name] = pose
        if box is not None:
            solids[thing.name] = box
    return poses


def _thing(world: World, body: BodySpec, ranges: RangesSpec, home: _Solids | None) -> _Thing:
    """``home``: what stands still where it is configured; None for what nothing collides with."""
    if home is None:
        return _Thing(body.name, body.orientation, ranges, None, {})
    corners = _own_corners(world, body)
    box = _box_around(Pose(body.position, body.orientation).transform(corners))
    touched = {name: depth for name, solid in home.items() if (depth := solid.depth(box)) > 0.0}
    allowed = {name: np.inf if depth > _MARGINS else depth for name, depth in touched.items()}
    return _Thing(body.name, body.orientation, ranges, corners, allowed)


def _own_corners(world: World, body: BodySpec) -> Array:
    """(8, 3) of a box that holds a thing, in its own frame, m."""
    half = _half(body)
    if half is not None:
        return _Box(-half, half).corners()
    for _ in range(_LOOKS):  # in real time it may be falling meanwhile, and both must be of one moment
        pose = world.pose(body.name)
        box = _Box(*world.aabb(body.name))
        if world.pose(body.name) == pose:
            break
    return pose.inverse().transform(box.corners())


def _half(body: BodySpec) -> Array | None:
    """Half the size (3,) of a simple shape, m: known without asking."""
    radius, length = body.radius or 0.0, body.length or 0.0
    sizes = {
        "box": body.half_extents,
        "sphere": (radius, radius, radius),
        "cylinder": (radius, radius, length / 2.0),
        "capsule": (radius, radius, length / 2.0 + radius),
    }
    half = sizes.get(body.shape)
    return None if half is None else np.array(half)


def _solid(world: World, name: str) -> _Box | _Plane | None:
    """Where a thing is now; None where nothing collides with it."""
    lower, upper = world.aabb(name)
    if not (lower < upper).any():
        return None
    if (upper - lower).max() < _ENDLESS:
        return _Box(lower, upper)
    pose = world.pose(name)
    return _Plane(pose.position, pose.transform([0.0, 0.0, 1.0]) - pose.position)


def _box_around(points: Array) -> _Box:
    return _Box(points.min(axis=0), points.max(axis=0))


_LOOKS_HZ = 50.0
"""At the dead-man."""


def stands_in_world(rig: Rig, robot: Robot) -> bool:
    """Is this arm a part of the simulated world, and no copy of a real one? Then it need not drive to be elsewhere."""
    world = rig.plan.world
    return world is not None and robot.spec.driver == world.driver


def reset_scene(
    rig: Rig,
    robot: Robot,
    q: ArrayLike | None = None,
    *,
    poses: Mapping[str, Pose] | None = None,
    random: np.random.Generator | None = None,
    deadman: Deadman | None = None,
    unattended: bool = False,
    since: int | None = None,
    patience: float = 60.0,
    hand: bool = True,
) -> dict[str, Pose]:
    """A simulated world as it began, and the arm at ``q`` (n,), rad. Returns where things are that began elsewhere.

    With ``random``, objects with random ranges are placed at poses drawn from it (:func:`draw_poses`);
    those named in ``poses`` are put there instead. On a real bench nobody puts things anywhere.

    An arm of that world is put there (where it began, without ``q``). Any other arm **drives**, as ``move_to`` does,
    and then opens its gripper, which drops what it holds, unless ``hand`` is False; without ``q`` it drives home. With
    a dead-man that takes a new press: more than ``since`` in all, or than there were at this call. What is held for
    something else, or after a stop, drives nobody home.

    Raises what ``move_to`` raises: MotionStopped, too, as long as nobody has acknowledged ``rig.stop()``, and when the
    dead-man was not pressed, or held, for ``patience`` s.
    """
    inside = stands_in_world(rig, robot)
    if not inside:  # first: on its way its copy would push what is put there
        if deadman is not None:
            _wait_for_press(rig.clock, deadman, deadman.record.presses if since is None else since, patience)
        target = robot.home if q is None else np.asarray(q, float)
        robot.move_to(target, deadman=deadman, unattended=unattended, patience=patience)
        if hand and robot.gripper is not None:
            robot.gripper.open()
    if not rig.has_world:
        return {}
    rig.world.reset()
    put = dict(poses or {})
    for name, pose in put.items():
        rig.world.reset(name, pose=pose)
    if random is not None:
        drawn = sample_poses(rig, random, given=put)
        for name, pose in drawn.items():
            rig.world.reset(name, pose=pose)
        put |= drawn
    if inside:
        rig.world.reset(robot.name, q=robot.spec.initial if q is None else np.asarray(q, float))
    return put


def _wait_for_press(clock: Clock, deadman: Deadman, since: int, patience: float) -> None:
    for tick in clock.rate(_LOOKS_HZ):
        record = deadman.record
        if record.held and record.presses > since:
            return
        if tick.elapsed > patience:
            raise MotionStopped(f"nobody pressed the dead-man for {patience:g} s", "let go of it, and hold it")
