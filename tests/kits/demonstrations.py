"""Skills and a policy of a user, for the loop from a demonstration to a policy and back."""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

import hal
from hal.geometry import Pose
from hal.recording import Dataset
from hal.skills import gentle_grasp, grasp, grasp_pose, locate_by_truth, push_to

AHEAD = 5
"""Rows from what is seen to what is learned."""
BACK = 0.3
"""Share of the way back to where the demonstrations were; without it a policy beside them stays beside them."""
SCALE = np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.006])
"""Distance of two states that count as different: tcp (m), its yaw (cosine, sine), width (m)."""


def grasp_it(rig: hal.Rig, random: np.random.Generator) -> bool:
    """Grasp the cube with the skill."""
    arm = rig.robots["panda"]
    found = locate_by_truth(rig, arm, "cube")
    return bool(grasp(arm, grasp_pose(found, arm.gripper), width=found.width, speed=0.3))


def grasp_gently(rig: hal.Rig, random: np.random.Generator) -> bool:
    """Grasp the cube with the skill that touches it first."""
    arm = rig.robots["panda"]
    found = locate_by_truth(rig, arm, "cube")
    return bool(gentle_grasp(arm, grasp_pose(found, arm.gripper), found.width))


def push_it(rig: hal.Rig, random: np.random.Generator) -> bool:
    """Push the cube 6 cm to one side."""
    arm = rig.robots["panda"]
    goal = locate_by_truth(rig, arm, "cube").pose.position[:2] + [0.0, 0.06]
    return bool(push_to(arm, lambda: locate_by_truth(rig, arm, "cube"), goal))


def is_lifted(rig: hal.Rig, observation: object = None) -> bool:
    """Return whether the cube is above the table."""
    return bool(rig.world.pose("cube").position[2] > 0.7)


class Picker:
    """A policy of a user that sees the cube: over it, down, close, up, from wherever a person has left the arm."""

    def __init__(self, rig: hal.Rig) -> None:
        self.rig, self.arm = rig, rig.robots["panda"]

    def reset(self, seed: int) -> None:
        self.closing = 0
        cube = self.arm.base.inverse() @ self.rig.world.pose("cube")
        self.cube, self.yaw = cube.position, np.arctan2(*cube.matrix()[[1, 0], 0])

    def __call__(self, observation: hal.Observation) -> tuple[hal.CartesianTarget, float]:
        at = observation.robots["panda"].tcp_set
        yaw = np.arctan2(*at.matrix()[[1, 0], 0])
        off, turn = self.cube - at.position, self.yaw - yaw
        near = np.hypot(*off[:2]) < 0.004 and abs(turn) < 0.02
        self.closing += near and abs(off[2]) < 0.004
        rise = 0.15 if self.closing > 20 or not (near or self.closing) else 0.0
        step = off + [0.0, 0.0, rise]
        step *= min(1.0, 0.01 / max(float(np.linalg.norm(step)), 1e-9))
        target = hal.Pose.from_rpy(at.position + step, (np.pi, 0.0, yaw + np.clip(turn, -0.05, 0.05)))
        return hal.CartesianTarget(target), float(self.closing > 0)


Columns = Mapping[str, np.ndarray]


def rows(columns: Columns, base: Pose) -> tuple[np.ndarray, np.ndarray]:
    """Return what is seen, and what is asked some rows later, of the arm from there on, as (rows, 6) numbers each."""
    cube = base.inverse() @ pose_of(columns["rig.object.cube"][0])
    inside = [[cube.inverse() @ pose_of(row) for row in columns[key]] for key in ("observation.tcp", "rig.tcp_set")]
    widths = columns["observation.state"][:, -1], columns["action"][:, -1]
    seen, asked = (
        np.array([features(*pair) for pair in zip(*each, strict=True)]) for each in zip(inside, widths, strict=True)
    )
    later = asked[np.minimum(np.arange(len(asked)) + AHEAD, len(asked) - 1)]
    later[:, :5] -= seen[:, :5]
    later[:, 5] = asked[:, 5]  # the fingers close where they did, and not on the way there
    acts = (np.abs(later[:, :3]).max(axis=1) > 0.003) | (np.abs(later[:, 5] - seen[:, 5]) > 0.005)
    return seen[acts], later[acts]  # where nothing happens, there is nothing to learn, and a policy would wait for ever


def pose_of(row: np.ndarray) -> Pose:
    """Return the pose of seven numbers."""
    return Pose(row[:3], row[3:] / np.linalg.norm(row[3:]))


def features(tcp: Pose, width: float) -> np.ndarray:
    """Return the numbers of a tcp that points down, in the frame of the cube, and of the fingers."""
    return np.array([*tcp.position, *tcp.matrix()[:2, 0], width])


class Kernel:
    """Kernel regression: the mean of what the nearest demonstrated states did, as seen from the cube."""

    def __init__(self, episodes: Iterable[Columns], base: Pose) -> None:
        seen, done = zip(*(rows(columns, base) for columns in episodes), strict=True)
        self.states, self.actions = np.concatenate(seen), np.concatenate(done)

    def __call__(self, near: np.ndarray) -> np.ndarray:
        """Return the state (6,) some rows after the state ``near`` (6,)."""
        distance = np.square((self.states - near) / SCALE).sum(axis=1)
        weights = np.exp(-0.5 * (distance - distance.min()))
        weights /= weights.sum()
        after: np.ndarray = weights @ self.actions
        after[:5] += near[:5] + BACK * (weights @ self.states - near)[:5]
        return after


def demonstrations(place: str | Path) -> list[Columns]:
    """Return the columns of each episode of a dataset, or of the items that LeRobot's reader wrote into a file."""
    if Path(place).suffix != ".npz":
        return [episode.columns for episode in Dataset(place).episodes]
    items = dict(np.load(place))
    numbers = items["episode_index"].ravel()
    used = ("rig.object.cube", "observation.tcp", "rig.tcp_set", "observation.state", "action")
    return [{key: items[key][numbers == number] for key in used} for number in np.unique(numbers)]


class Regression:
    """The regression as a policy in the program."""

    def __init__(self, rig: hal.Rig) -> None:
        self.rig, self.arm = rig, rig.robots["panda"]
        self.kernel = Kernel(demonstrations(os.environ["DEMONSTRATIONS"]), self.arm.base)

    def reset(self, seed: int) -> None:
        self.cube = self.arm.base.inverse() @ self.rig.world.pose("cube")

    def __call__(self, observation: hal.Observation) -> tuple[hal.CartesianTarget, float]:
        state = observation.robots["panda"]
        near = features(self.cube.inverse() @ state.tcp, self.arm.gripper.state().width)
        x, y, z, cosine, sine, width = self.kernel(near)
        target = self.cube @ Pose.from_rpy((x, y, z), (np.pi, 0.0, np.arctan2(sine, cosine)))
        return hal.CartesianTarget(target), float(np.clip(1.0 - width / self.arm.gripper.width_max, 0.0, 1.0))


class ServedRegression:
    """The same on a server: chunks of steps of the tcp, a row of the recording each, which the regression predicts."""

    LENGTH = 30
    """Rows of a chunk."""
    CONFIG: ClassVar[dict[str, Any]] = {
        "rate_hz": 30,
        "execute": AHEAD,
        "observation": {
            "tcp": {"state": ["tcp_position", "tcp_quaternion"]},
            "width": {"state": "width"},
            "cube": {"objects": ["cube"]},
        },
        "action": {"kind": "tcp_delta", "gripper": {"metres": True}},
    }

    def __init__(self, place: Path, base: Pose) -> None:
        self.kernel, self.base = Kernel(demonstrations(place), base), base
        self.cube: Pose | None = None

    def reset(self, request: object) -> None:
        self.cube = None

    def infer(self, request: Columns) -> dict[str, np.ndarray]:
        if self.cube is None:  # where it lay: later it is in the hand
            self.cube = self.base.inverse() @ pose_of(request["cube"])
        tcp, steps = pose_of(request["tcp"]), []
        near = features(self.cube.inverse() @ tcp, float(request["width"][0]))
        for _ in range(self.LENGTH // AHEAD):
            x, y, z, cosine, sine, width = near = self.kernel(near)
            after = self.cube @ Pose.from_rpy((x, y, z), (np.pi, 0.0, np.arctan2(sine, cosine)))
            turn = np.arctan2(*after.matrix()[[1, 0], 0]) - np.arctan2(*tcp.matrix()[[1, 0], 0])
            turn = (turn + np.pi) % (2 * np.pi) - np.pi
            move = np.array([*(after.position - tcp.position), 0.0, 0.0, turn])
            steps += [[*(move / AHEAD), width]] * AHEAD
            tcp = after
        return {"actions": np.array(steps, np.float32)}


def look(rig: hal.Rig, random: np.random.Generator) -> bool:
    """Take the first picture of each camera into a file named after the episode's seed; then move a little."""
    pictures = {}
    for name, camera in rig.cameras.items():
        frame = camera.read()
        pictures |= {f"{name}.color": frame.color, f"{name}.depth": frame.depth}
    drawn = rig.world.randomization
    assert drawn is not None
    np.savez(Path(os.environ["HAL_TEST_PICTURES"]) / f"{drawn['seed']}.npz", **pictures)
    arm = next(iter(rig.robots.values()))
    arm.move_to(arm.home + 0.02)
    return True
