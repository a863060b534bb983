"""What the actions and observations of :class:`~hal.gym.RigEnv` are made of."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from .camera import Camera
from .errors import CommandError
from .observation import Observation
from .pose import Pose
from .robot import Robot

__all__ = [
    "Action",
    "Spaces",
    "action_space",
    "as_numbers",
    "numbers_and_pictures",
    "object_key",
    "observation_space",
]

Action = Literal["joint", "tcp_delta", "twist"]
"""``joint``: positions (n,), rad; farther than 0.1 rad from the set-point they are cut to that, and
``info["clipped"]`` says so. ``tcp_delta``: by how much the tcp's goal moves (m) and turns (rotation vector, rad)
in this step, along the base's axes. ``twist``: speed of the tcp, m/s and rad/s, along the base's axes. With a gripper
one more number follows, 0 (open) to 1 (closed)."""

Spaces = dict[str, NDArray[Any]]


def action_space(robot: Robot, kind: Action, rate_hz: float, speeds: tuple[float, float]) -> spaces.Box:
    """``speeds`` are the greatest of the tcp, m/s and rad/s. CommandError for a ``kind`` that there is not."""
    linear, angular = speeds
    if kind == "joint":
        low, high = list(robot.limits.lower), list(robot.limits.upper)
    elif kind in ("tcp_delta", "twist"):
        share = 1.0 / rate_hz if kind == "tcp_delta" else 1.0
        high = [linear * share] * 3 + [angular * share] * 3
        low = [-value for value in high]
    else:
        raise CommandError(f"action must be joint, tcp_delta or twist, not {kind!r}")
    if robot.gripper is not None:
        low, high = [*low, 0.0], [*high, 1.0]
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


def observation_space(robot: Robot, cameras: Iterable[Camera], objects: Collection[str]) -> spaces.Dict:
    """One box for each part of what :func:`numbers_and_pictures` shows, and for the pose of each of ``objects``."""

    def free(size: int) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (size,), np.float64)

    parts: dict[str, spaces.Space[Any]] = {"q": free(robot.n), "dq": free(robot.n), "tcp": free(7)}
    if robot.gripper is not None:
        parts["gripper"] = free(1)
    for camera in cameras:
        spec = camera.spec
        if "color" in spec.streams:
            parts[f"{camera.name}.color"] = spaces.Box(0, 255, (spec.height, spec.width, 3), np.uint8)
        if "depth" in spec.streams:
            parts[f"{camera.name}.depth"] = spaces.Box(0.0, spec.depth_max, (spec.height, spec.width, 1), np.float32)
    return spaces.Dict(parts | {object_key(name): free(7) for name in objects})


def numbers_and_pictures(observation: Observation, robot: Robot, cameras: Collection[str]) -> Spaces:
    """What an observation says of the arm, its gripper and these cameras."""
    state = observation.robots[robot.name]
    shown: Spaces = {"q": np.array(state.q), "dq": np.array(state.dq), "tcp": as_numbers(state.tcp)}
    if robot.gripper is not None:
        shown["gripper"] = np.array([observation.grippers[robot.name].width])
    for name in cameras:
        frame = observation.cameras[name].frame
        if frame.color is not None:
            shown[f"{name}.color"] = frame.color
        if frame.depth is not None:
            shown[f"{name}.depth"] = frame.depth[..., None]
    return shown


def object_key(name: str) -> str:
    """Under which the pose of a thing of the simulated world is observed."""
    return f"object.{name}"


def as_numbers(pose: Pose) -> NDArray[np.float64]:
    """(7,): position in m, and quaternion xyzw."""
    return np.concatenate([pose.position, pose.orientation])
