"""The skills in simulation, in lock-step: how many tries succeed, judged by where the object really ends.

An object is put somewhere before the arm, at any angle, and found by ground truth, or by the depth of the camera on
the hand, exact or with the noise of a D435. A grasp succeeds if the object is 10 cm up after it was held there for 2 s.
A gentle grasp begins 1 to 15 mm off the middle of the cube, and may move it by 2 mm before it lifts it. A push succeeds
if the object's middle ends within 1 cm of a goal that is 5 to 15 cm away. Goals for 100 tries each: 98 by ground truth,
97 by exact depth, 92 by noisy depth, and 97 for gentle grasps and pushes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np

import hal
from hal.skills import (
    LocatedObject,
    SkillProgress,
    find_by_depth,
    gentle_grasp,
    grasp,
    grasp_pose,
    locate_by_truth,
    push_to,
)

from .kit import ENGINES, Table

PATHS = ("hal/skills", "drivers/pybullet", "drivers/mujoco", "drivers/scene")
OBJECTS: dict[str, Any] = {
    "cube": "cube",
    "cylinder": {
        "name": "cylinder",
        "shape": "cylinder",
        "radius": 0.025,
        "length": 0.08,
        "mass": 0.3,
        "position": [0, 0, 0.641],
        "rgba": [0.2, 0.6, 0.3, 1],
    },
    "duck": "duck",
    "mug": "mug",
}
LOWER, UPPER = (-0.15, -0.2), (0.1, 0.2)
"""Where objects are put, x and y in the world, m."""
BESIDE = (0.001, 0.015)
"""How far from the middle a gentle grasp begins, m."""
MOVED = 0.002
"""How far it may move the object before it lifts it, m."""
PUSHED = (0.05, 0.15)
"""How far objects are pushed, m."""
NEAR = 0.01
"""Distance from the goal up to which an object is there, m."""
PUSH_UPPER = (0.05, 0.2)
"""Upper end of where objects are pushed: the arm must reach behind them."""
LIFT = 0.1
HELD = 2.0
SPEED = 0.3
"""Share of the joint speed limits, so that simulated time is short."""
REST = 0.3
"""Time for an object to come to rest on the table, s."""


TRUTH, DEPTH, NOISY = "ground truth", "exact depth", "noisy depth"
"""How an object is found."""


@contextmanager
def opened(engine: str, thing: str, how: str = TRUTH, seed: int = 0) -> Iterator[hal.Rig]:
    """Open the built-in rig in lock-step with one object on the table, and the camera on the hand if it is used."""
    overrides: dict[str, Any] = {"objects": ["floor", "table", OBJECTS[thing]]}
    if how == TRUTH:
        overrides["cameras"] = {}
    elif how == NOISY:
        overrides["cameras.wrist.simulated"] = {"depth_noise": {"seed": seed}}
    with hal.open("panda_table", sim=True, clock="lock_step", engine=engine, pad="none", overrides=overrides) as rig:
        yield rig


def scatter(rig: hal.Rig, thing: str, random: np.random.Generator, upper: tuple[float, float] = UPPER) -> hal.Pose:
    """Reset the scene, put the object somewhere at any angle, and return its pose at rest."""
    rig.world.reset()
    start = rig.world.pose(thing)
    x, y = random.uniform(LOWER, upper)
    turned = hal.Pose.from_rpy((x, y, start.position[2]), (0.0, 0.0, random.uniform(-np.pi, np.pi)))
    rig.world.reset(thing, pose=turned)
    rig.clock.sleep(REST)
    return rig.world.pose(thing)


def find(rig: hal.Rig, thing: str, how: str) -> LocatedObject | None:
    """Find the object."""
    arm = rig.robots["panda"]
    if how == TRUTH:
        return locate_by_truth(rig, arm, thing)
    return find_by_depth(arm, rig.cameras["wrist"], speed=SPEED)


def grasps(engine: str, thing: str, how: str, tries: int, seed: int = 0) -> list[str]:
    """Return how each try of a grasp ended: empty for a success, else the reason, ``not seen`` or ``not up``."""
    random, ends = np.random.default_rng(seed), []
    with opened(engine, thing, how, seed) as rig:
        arm = rig.robots["panda"]
        for _ in range(tries):
            start = scatter(rig, thing, random)
            found = find(rig, thing, how)
            if found is None or found.width > arm.gripper.width_max:
                ends.append("not seen")
                continue
            pose = grasp_pose(found, arm.gripper)
            result = grasp(arm, pose, width=found.width, lift=LIFT, hold=HELD, speed=SPEED)
            up = rig.world.pose(thing).position[2] - start.position[2]
            ends.append(result.reason or ("" if up > 0.9 * LIFT else "not up"))
    return ends


def gentle_grasps(engine: str, thing: str, tries: int, seed: int = 0) -> list[str]:
    """Return how each try of a grasp beside the middle ended: empty for a success, else the reason, or ``moved``."""
    random, ends = np.random.default_rng(seed), []
    with opened(engine, thing) as rig:
        arm = rig.robots["panda"]
        for _ in range(tries):
            start, closed = scatter(rig, thing, random), []
            found = locate_by_truth(rig, arm, thing)
            off = random.uniform(*BESIDE) * random.choice((-1.0, 1.0))
            pose = grasp_pose(found, arm.gripper) @ hal.Pose((0.0, off, 0.0))

            def note(now: SkillProgress, closed: list[hal.Pose] = closed) -> None:
                if now.phase == "lift":
                    closed.append(rig.world.pose(thing))

            result = gentle_grasp(arm, pose, found.width, lift=LIFT, hold=HELD, speed=SPEED, progress=note)
            up = rig.world.pose(thing).position[2] - start.position[2]
            moved = float(np.linalg.norm(closed[0].position - start.position)) if closed else 0.0
            wrong = "moved" if moved > MOVED else "" if up > 0.9 * LIFT else "not up"
            ends.append(result.reason or wrong)
    return ends


def pushes(engine: str, thing: str, tries: int, seed: int = 0, friction: float = 1.0) -> list[str]:
    """Return how each try of a push to a goal ended: empty for a success, else the reason, or ``off``.

    ``friction`` is that of the table.
    """
    random, ends = np.random.default_rng(seed), []
    with opened(engine, thing) as rig:
        arm = rig.robots["panda"]
        rig.world.set_dynamics("table", lateral_friction=friction)
        locate = partial(locate_by_truth, rig, arm, thing)
        for _ in range(tries):
            start = scatter(rig, thing, random, PUSH_UPPER)
            goal = None
            while goal is None or (goal < LOWER).any() or (goal > PUSH_UPPER).any():
                angle, distance = random.uniform(-np.pi, np.pi), random.uniform(*PUSHED)
                goal = start.position[:2] + distance * np.array([np.cos(angle), np.sin(angle)])
            result = push_to(arm, locate, goal - arm.base.position[:2], speed=SPEED)
            off = np.linalg.norm(rig.world.pose(thing).position[:2] - goal)
            ends.append(result.reason or ("" if off < NEAR else "off"))
    return ends


def rows() -> Iterator[tuple[str, Callable[[str, int], list[str]]]]:
    """Yield what is tried, and its function of the engine and the number of tries."""
    for thing in OBJECTS:
        for how in (TRUTH, DEPTH, NOISY):
            yield f"grasp {thing}, {how}", lambda engine, tries, thing=thing, how=how: grasps(engine, thing, how, tries)
    yield "gentle grasp cube", lambda engine, tries: gentle_grasps(engine, "cube", tries)
    for thing in ("cube", "cylinder"):
        yield f"push {thing}", lambda engine, tries, thing=thing: pushes(engine, thing, tries)
    yield "push cube, table friction 0.1", lambda engine, tries: pushes(engine, "cube", tries, friction=0.1)


def run(quick: bool) -> Iterator[Table]:
    """Yield the table."""
    tries = 1 if quick else 100
    table = Table(f"of {tries} tries each, in lock-step", ("", *(f"{engine}; failed" for engine in ENGINES)))
    for name, measure in list(rows())[-2 if quick else 0 :]:
        ends = [Counter(measure(engine, tries)) for engine in ENGINES]
        failed = (", ".join(f"{count} {reason}" for reason, count in each.most_common() if reason) for each in ends)
        table.add(name, *(f"{each['']}; {text}".rstrip("; ") for each, text in zip(ends, failed, strict=True)))
    yield table
