"""What the actions and observations of :class:`~hal.gym.RigEnv` are made of."""

from __future__ import annotations

from collections.abc import Collection, Iterable
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from .camera import Camera
from .errors import CommandError
from .geometry import Pose
from .observation import Observation
from .robot import Robot
from .specs import CameraSpec

__all__ = [
    "Action",
    "Spaces",
    "action_space",
    "as_numbers",
    "key",
    "numbers_and_pictures",
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


def observation_space(
    robot: Robot, cameras: Iterable[Camera], streams: Collection[str], objects: Collection[str]
) -> spaces.Dict:
    """Return a box for each entry of what :func:`numbers_and_pictures` gives, and for the pose of each of ``objects``.

    Raises:
        CommandError: Two entries would have the same key.
    """

    def free(size: int) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (size,), np.float64)

    parts: list[tuple[str, spaces.Space[Any]]] = [("q", free(robot.n)), ("dq", free(robot.n)), ("tcp", free(7))]
    if robot.gripper is not None:
        parts.append(("gripper", free(1)))
    for camera in cameras:
        found = [stream for stream in streams if stream in camera.spec.streams]
        parts += [(key(camera.name, stream), _picture_space(camera.spec, stream)) for stream in found]
    parts += [(key("object", name), free(7)) for name in objects]
    keys = [name for name, _ in parts]
    if twice := sorted({name for name in keys if keys.count(name) > 1}):
        raise CommandError(
            f"two parts of the observation would be called {', '.join(twice)}: rename a camera or an object"
        )
    return spaces.Dict(dict(parts))


def _picture_space(camera: CameraSpec, stream: str) -> spaces.Box:
    """Return the box of one camera's pictures: (H, W, 3) colour, (H, W, 1) anything else."""
    size = (camera.height, camera.width)
    if stream == "color":
        return spaces.Box(0, 255, (*size, 3), np.uint8)
    if stream == "depth":
        return spaces.Box(0.0, camera.depth_max, (*size, 1), np.float32)
    if stream == "segmentation":
        return spaces.Box(-1, np.iinfo(np.int32).max, (*size, 1), np.int32)
    return spaces.Box(0, 255, (*size, 1), np.uint8)


def numbers_and_pictures(
    observation: Observation, robot: Robot, cameras: Collection[str], streams: Collection[str]
) -> Spaces:
    """Return what an observation holds of the arm, its gripper and these streams of these cameras."""
    state = observation.robots[robot.name]
    shown: Spaces = {"q": np.array(state.q), "dq": np.array(state.dq), "tcp": as_numbers(state.tcp)}
    if robot.gripper is not None:
        shown["gripper"] = np.array([observation.grippers[robot.name].width])
    for name in cameras:
        frame = observation.cameras[name].frame
        for stream in streams:
            picture = getattr(frame, stream)
            if picture is not None:
                shown[key(name, stream)] = picture if picture.ndim == 3 else picture[..., None]
    return shown


def key(*parts: str) -> str:
    """Return the key of an entry: an identifier, because PyTorch modules that are named by keys allow no dots."""
    return "_".join(parts).replace("-", "_")


def as_numbers(pose: Pose) -> NDArray[np.float64]:
    """(7,): position in m, and quaternion xyzw."""
    return np.concatenate([pose.position, pose.orientation])
