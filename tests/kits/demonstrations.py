"""Skills and a policy of a user, for the loop from a demonstration to a policy and back."""

from __future__ import annotations

import os

import numpy as np

import hal
from hal.geometry import Pose
from hal.recording import Dataset, Episode
from hal.skills import gentle_grasp, grasp, grasp_pose, locate_by_truth, push_to

AHEAD = 5
"""Rows from what is seen to what is learned."""
SCALE = np.array([0.01, 0.01, 0.01, 0.05, 0.05, 0.006])
"""Distance of two states that count as different: tcp (m), its yaw (cosine, sine), width (m)."""


def grasp_it(rig: hal.Rig, random: np.random.Generator) -> bool:
    """Grasp the cube with the skill."""
    arm = rig.robots["panda"]
    found = locate_by_truth(rig, arm, "cube")
    return bool(grasp(arm, grasp_pose(found, arm.gripper), width=found.width, speed=0.5))


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


def rows(arm: hal.Robot, episode: Episode) -> tuple[np.ndarray, np.ndarray]:
    """Return what is seen, and what is asked some rows later, of the arm from there on, as (rows, 6) numbers each."""
    columns = episode.columns
    cube = arm.base.inverse() @ pose_of(columns["rig.object.cube"][0])
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


class Regression:
    """Kernel regression: the mean of what the nearest demonstrated states did, as seen from the cube."""

    def __init__(self, rig: hal.Rig) -> None:
        self.rig, self.arm = rig, rig.robots["panda"]
        seen, done = zip(*(rows(self.arm, one) for one in Dataset(os.environ["DEMONSTRATIONS"]).episodes), strict=True)
        self.states, self.actions = np.concatenate(seen), np.concatenate(done)

    def reset(self, seed: int) -> None:
        self.cube = self.arm.base.inverse() @ self.rig.world.pose("cube")

    def __call__(self, observation: hal.Observation) -> tuple[hal.CartesianTarget, float]:
        state = observation.robots["panda"]
        near = features(self.cube.inverse() @ state.tcp, self.arm.gripper.state().width)
        distance = np.square((self.states - near) / SCALE).sum(axis=1)
        weights = np.exp(-0.5 * (distance - distance.min()))
        x, y, z, cosine, sine, width = weights @ self.actions / weights.sum() + [*near[:5], 0.0]
        target = self.cube @ Pose.from_rpy((x, y, z), (np.pi, 0.0, np.arctan2(sine, cosine)))
        return hal.CartesianTarget(target), float(np.clip(1.0 - width / self.arm.gripper.width_max, 0.0, 1.0))
