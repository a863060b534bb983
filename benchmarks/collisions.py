"""Collisions: verdicts against PyBullet's, refused and stopped motions, and the cost of the check."""

from __future__ import annotations

import contextlib
import math
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np

import hal
from hal.commands import NO_INBOX, CommandRecord, Inbox, Kind, Session
from hal.config import load
from hal.config.data_files import list_data
from hal.driver import Reading
from hal.kinematics.arm import Kinematics
from hal.kinematics.collision_model import CollisionModel
from hal.servo.collisions import CollisionGuard
from hal.servo.servo import Servo
from hal.specs import BoxSpec, CollisionSpec, RobotSpec

from .kit import Table, compare, timed

PATHS = ("hal/servo/collisions.py", "hal/kinematics/collision_model.py")
RATE_HZ = 1000.0

TABLE = BoxSpec("table", (0.55, 0.0, -0.025), (0.0, 0.0, 0.0, 1.0), (1.5, 1.0, 0.05))


ARMS = [
    arm for model in list_data("robots") for arm in (["baxter left", "baxter right"] if model == "baxter" else [model])
]
"""All built-in models of arms; of one with several arms, each of them."""


def rig_of(arm: str) -> dict[str, Any]:
    """Return a rig with one of :data:`ARMS` at the origin."""
    return {"robots": {"arm": dict(zip(("model", "arm"), arm.split(), strict=False))}}


def arm(model: str) -> RobotSpec:
    """Return the record of one of :data:`ARMS` at the origin."""
    return load(rig_of(model), sim=True, driver="mock").resolve().robots[0]


def configurations(spec: RobotSpec, count: int, seed: int = 1) -> Iterator[np.ndarray]:
    """Yield random joint positions (n,) within the limits, rad."""
    lower, upper = np.maximum(spec.limits.lower, -np.pi), np.minimum(spec.limits.upper, np.pi)
    yield from np.random.default_rng(seed).uniform(lower, upper, (count, len(spec.joints)))


class Bullet:
    """The shapes of a collision model as bodies of PyBullet."""

    def __init__(self, model: CollisionModel) -> None:
        import pybullet
        from pybullet_utils.bullet_client import BulletClient

        self.client: Any = BulletClient(pybullet.DIRECT)
        self.bodies = [self._body(shape) for _, shape, _ in model.shapes()]

    def _body(self, shape: Any) -> int:
        client, kind = self.client, type(shape).__name__
        if kind == "Box":
            one = client.createCollisionShape(client.GEOM_BOX, halfExtents=shape.halfSide.tolist())
        elif kind == "Cylinder":
            one = client.createCollisionShape(client.GEOM_CYLINDER, radius=shape.radius, height=2.0 * shape.halfLength)
        elif kind == "Sphere":
            one = client.createCollisionShape(client.GEOM_SPHERE, radius=shape.radius)
        else:
            one = client.createCollisionShape(client.GEOM_MESH, vertices=np.array(shape.points()).tolist())
        body = int(client.createMultiBody(0.0, one))
        client.changeDynamics(body, -1, collisionMargin=0.0)
        return body

    def place(self, model: CollisionModel) -> None:
        """Move the bodies to where the model's shapes are."""
        for body, (_, _, pose) in zip(self.bodies, model.shapes(), strict=True):
            at = hal.Pose.from_matrix(pose)
            self.client.resetBasePositionAndOrientation(body, at.position.tolist(), at.orientation.tolist())

    def distance(self, i: int, j: int, most: float) -> float:
        """Return the distance of two bodies, m; ``most`` if it is more."""
        points = self.client.getClosestPoints(self.bodies[i], self.bodies[j], most)
        return min((float(point[8]) for point in points), default=most)


def verdicts(model_name: str, count: int) -> dict[str, float]:
    """Compare every pair's verdict in random positions with that of PyBullet's ``getClosestPoints``."""
    spec = arm(model_name)
    model = CollisionModel([spec], CollisionSpec(boxes=(TABLE,), margin=0.0))
    bullet = Bullet(model)
    colliding = differ = wrong = unexplained = 0
    worst = 0.0
    for q in configurations(spec, count):
        model.place(q)
        bullet.place(model)
        distances = model.distances()
        collides = bool((distances < 0.0).any())
        colliding += collides
        for k in np.flatnonzero(distances < 0.02):
            theirs = bullet.distance(*model.indices[k], 0.05)
            if distances[k] > 0.0 and theirs < 0.05:
                worst = max(worst, abs(theirs - distances[k]))
            if (theirs < 0.0) != (distances[k] < 0.0):
                differ += 1
                far = max(abs(theirs), abs(distances[k])) >= 1e-3
                exact = boxes_overlap(model, *model.indices[k]) if far else None
                wrong += exact is not None and exact == (distances[k] < 0.0)
                unexplained += far and exact != (distances[k] < 0.0)
        for k in np.flatnonzero((distances >= 0.02) & (distances < 0.1)):  # none of these may touch
            unexplained += bullet.distance(*model.indices[k], 0.0) < -1e-3
    return {
        "configurations": count,
        "colliding": colliding,
        "pairs that differ": differ,
        "of those, boxes for which an exact test agrees": wrong,
        "of those, others by 1 mm or more": int(unexplained),
        "largest difference of a distance, mm": round(1e3 * float(worst), 2),
    }


def boxes_overlap(model: CollisionModel, i: int, j: int) -> bool | None:
    """Return whether two boxes overlap, by the separating axis theorem; None for other shapes."""
    (_, one, here), (_, two, there) = (list(model.shapes())[k] for k in (i, j))
    if not type(one).__name__ == type(two).__name__ == "Box":
        return None
    axes = [*here[:3, :3].T, *there[:3, :3].T]
    axes += [np.cross(a, b) for a in axes[:3] for b in axes[3:]]
    for axis in axes:
        reach = np.abs(axis @ here[:3, :3]) @ one.halfSide + np.abs(axis @ there[:3, :3]) @ two.halfSide
        if abs(axis @ (here[:3, 3] - there[:3, 3])) > reach:
            return False
    return True


_RUNS = 6


class Ticks:
    """A servo of a Panda without a device, which takes every set-point at once."""

    def __init__(self, spec: RobotSpec, guarded: bool) -> None:
        self.servo = Servo(spec, 1.0 / RATE_HZ)
        if guarded:
            model = CollisionModel([spec], CollisionSpec(boxes=(TABLE,)))
            self.servo.set_guard(CollisionGuard(model, self.servo.smoother, []))

    def times(self, start: Sequence[float], kind: Kind, values: Callable[[float], Sequence[float]], count: int) -> Any:
        """Return the times (count,) of the ticks that follow commands from 50 Hz on, us."""
        servo, now, command = self.servo, 10.0, None
        servo.anchor(list(start))
        servo.open_session(Session(1, 0.3, 0.25, False), NO_INBOX)
        times = np.empty(count)
        for k in range(count):
            now += 1.0 / RATE_HZ
            if k % 20 == 0:
                command = CommandRecord(k + 1, 1, now, now + 0.1, kind, tuple(values(k / RATE_HZ)))
            reading = Reading(now, now, k, servo.smoother.q, servo.smoother.dq)
            inbox = Inbox(command, None, 0, 0, now)
            times[k] = 1e6 * timed(lambda reading=reading, inbox=inbox, now=now: servo.tick(now, reading, inbox))
        return times


def tick(count: int) -> Table:
    """Return what the check adds to a tick at 1 kHz: each tick's least time of some runs, with and without it."""
    spec = arm("panda")
    low = (0.0, 0.55, 0.0, -2.1, 0.0, 2.65, 0.785)  # the hand points down, over the table
    swing = Kind.JOINT_VELOCITY, lambda t: [0.2 * math.sin(t + k) for k in range(7)]
    circle = Kind.TWIST, lambda t: [0.1 * math.sin(t), 0.1 * math.cos(t), 0, 0, 0, 0, 0]
    press = Kind.TWIST, lambda t: [0.1 * math.sin(2.0 * t), 0.1 * math.cos(2.0 * t), -0.2, 0, 0, 0, 0]
    motions = {
        "joint speeds, nothing near": (spec.home, *swing),
        "twist, nothing near": (spec.home, *circle),
        "twist along and into the table": (low, *press),
    }
    table = Table(
        "us that the check of the arm and a table adds to a tick", ("", "median", "mean", "p99", "median in all")
    )
    for name, motion in motions.items():
        runs = [[Ticks(spec, guarded).times(*motion, count) for guarded in (False, True)] for _ in range(_RUNS)]
        without, checked = np.min(runs, axis=0)
        more = checked - without
        table.add(name, np.median(more), more.mean(), np.percentile(more, 99), np.median(checked))
    return table


FACING = {
    "left": {"model": "panda", "base": {"position": [-0.5, 0, 0]}},
    "right": {"model": "panda", "base": {"position": [0.5, 0, 0], "orientation": [0, 0, 1, 0]}},
}


def arms(count: int) -> dict[str, float]:
    """Drive two simulated arms at each other at 0.25 m/s from random directions; return how near they came."""
    rng = np.random.default_rng(4)
    robots = load({"robots": FACING}, sim=True).resolve().robots
    solvers = [Kinematics(spec.kinematics) for spec in robots]
    bases = [hal.Pose(spec.base_position, spec.base_orientation) for spec in robots]
    model = CollisionModel(robots, CollisionSpec(own=False))
    nearest, limited = [], 0
    while len(nearest) < count:
        u = rng.normal(size=3)
        u /= np.linalg.norm(u)
        yaw = rng.uniform(-np.pi, np.pi)
        centre = np.array([0.0, 0.0, rng.uniform(0.35, 0.65)])
        start = []
        for side, base, solver in zip((1.0, -1.0), bases, solvers, strict=True):
            pose = hal.Pose(centre + side * 0.2 * u, [math.cos(yaw), math.sin(yaw), 0, 0])
            with contextlib.suppress(hal.Unreachable):
                start.append(solver.solve(base.inverse() @ pose))
        if len(start) < 2:
            continue
        model.place(np.concatenate(start))
        if model.distances().min() < 0.1:
            continue
        least, seen = drive_at_each_other(model, start, u)
        nearest.append(least)
        limited += seen
    return {
        "directions": count,
        "5 mm apart or more": sum(d >= 0.005 for d in nearest),
        "nearest of all, mm": round(1e3 * min(nearest), 2),
        "came within 20 mm": sum(d < 0.02 for d in nearest),
        "reported as limited by a collision": limited,
    }


def drive_at_each_other(model: CollisionModel, start: Sequence[np.ndarray], u: np.ndarray) -> tuple[float, bool]:
    """Return the smallest distance (m) of two arms driven at each other along ``u``, and whether they reported it."""
    overrides = {f"robots.{name}.initial": q.tolist() for name, q in zip(FACING, start, strict=True)}
    with hal.open({"robots": FACING}, sim=True, clock="lock_step", pad="none", overrides=overrides) as rig:
        one, two = rig.robots["left"], rig.robots["right"]
        least, seen = math.inf, False
        with one.control(rate_hz=50) as first, two.control(rate_hz=50) as second:
            for _ in range(120):
                first.send(hal.Twist(linear=-0.25 * u))
                second.send(hal.Twist(linear=0.25 * u * [-1, -1, 1]))  # its base is turned by half a turn
                for _ in range(4):
                    rig.clock.sleep(1 / 240)
                    states = one.state(), two.state()
                    model.place(np.concatenate([state.q for state in states]))
                    least = min(least, float(model.distances().min()))
                    seen |= any(hal.Limited.COLLISION in state.limited for state in states)
    return least, seen


def targets(count: int) -> dict[str, float]:
    """Ask for targets inside the table and inside the arm itself; return how many are refused, and how fast."""
    rng = np.random.default_rng(6)
    refused, moved, codes = [], 0, Counter[str]()
    overrides = {"collisions.boxes": ["table"], "robots.panda.workspace": {}, "cameras": {}}
    with hal.open("panda_table", sim=True, clock="lock_step", pad="none", overrides=overrides) as rig:
        panda = rig.robots["panda"]
        assert not panda.collisions.check(panda.home)  # builds the model, once
        before = panda.state().q_set
        samples = configurations(panda.spec, 100 * count, seed=7)
        for k in range(count):
            if k % 2:  # the tcp 1 to 5 cm under the top of the table
                target = hal.Pose([*rng.uniform([0.3, -0.35], [0.65, 0.35]), rng.uniform(-0.05, -0.01)], [1, 0, 0, 0])
            else:  # positions in which the arm is in itself
                target = next(q for q in samples if panda.collisions.check(q, margin=0.0))
            began = time.perf_counter()
            try:
                panda.move_to(target, timeout=0.1)
            except (hal.CollisionError, hal.Unreachable) as error:
                refused.append(time.perf_counter() - began)
                codes[error.code] += 1
            moved += not np.array_equal(panda.state().q_set, before)
    return {
        "targets": count,
        "refused": len(refused),
        **{f"of those, {code}": number for code, number in codes.items()},
        "moved": moved,
        "time, median, ms": round(1e3 * float(np.median(refused)), 1),
        "time, p99, ms": round(1e3 * float(np.percentile(refused, 99)), 1),
    }


def starts_inside(spec: RobotSpec, count: int, seed: int) -> Iterator[np.ndarray]:
    """Yield joint positions (n,), rad, up to 10 mm inside a margin: random ones, and ones on a way from home."""
    model, home = CollisionModel([spec], CollisionSpec()), np.array(spec.home)
    rng = np.random.default_rng(seed)

    def room(q: np.ndarray) -> float:
        model.place(q)
        return float((model.distances() - model.margins).min())

    found = 0
    for q in configurations(spec, 10_000 * count, seed=seed):
        if found == count:
            return
        start = q
        if found % 2 and room(q) < 0.0:
            inside = -0.01 * rng.uniform() * 10.0 ** rng.integers(-2, 1)
            low, high = 0.0, 1.0  # shares of the way from home
            for _ in range(30):
                middle = 0.5 * (low + high)
                low, high = (low, middle) if room(home + middle * (q - home)) < inside else (middle, high)
            start = home + high * (q - home)
        if -0.01 < room(start) < 0.0:
            found += 1
            yield start


def starts(arm_name: str, count: int, seed: int = 5) -> dict[str, int]:
    """Move an arm home from positions inside a margin; return how the motions end.

    At three speeds, straight in joint space and along a waypoint. An end that no motion may have is printed.
    """
    spec = arm(arm_name)
    ends = {"came home": 0, "refused at once": 0, "given up": 0, "without an end": 0}
    for k, start in enumerate(starts_inside(spec, count, seed)):
        home = np.array(spec.home)
        goal = np.array([0.5 * (start + home), home]) if k % 4 == 3 else home
        overrides = {"robots.arm.initial": start.tolist()}
        with hal.open(rig_of(arm_name), driver="mock", clock="lock_step", pad="none", overrides=overrides) as rig:
            try:
                rig.robots["arm"].move_to(goal, speed=(0.1, 0.5, 1.0)[k % 3], timeout=600.0)
                end = "came home"
            except hal.CollisionError:
                end = "refused at once"
            except hal.MotionStopped:
                end = "given up"
            except TimeoutError:
                end = "without an end"
        ends[end] += 1
        if end not in ("came home", "refused at once"):
            print(f"{arm_name}, start {k} of seed {seed}, {end}: {start.tolist()}", flush=True)
    return ends


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    models = ("panda",) if quick else ("panda", "fr3", "iiwa")
    poses = 10 if quick else 10_000
    yield compare(f"verdicts in {poses} random positions", {model: verdicts(model, poses) for model in models})
    yield compare("`move_to` into the table and into the arm itself", {"": targets(4 if quick else 1000)})
    each = {name: starts(name, 60) for name in ARMS} if not quick else {"panda": starts("panda", 1)}
    yield compare("`move_to(home)` from inside a margin", each)
    yield compare("two arms driven at each other at 0.25 m/s", {"": arms(1 if quick else 100)})
    yield tick(100 if quick else 2000)
