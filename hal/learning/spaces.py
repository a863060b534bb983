"""Spaces of :class:`.RigEnv`: its actions, its observations, and the names of their entries."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping, Sequence
from typing import Any, Literal

import numpy as np
from gymnasium import spaces
from numpy.typing import NDArray

from ..camera import Camera
from ..errors import CommandError, NotSupported
from ..geometry import Pose
from ..observation import Observation
from ..robot import Robot
from ..specs import CameraSpec
from ..types import STREAMS

ActionKind = Literal["joint", "tcp_delta", "twist", "velocity", "torque"]
"""``joint``: positions (n,), rad; more than 0.1 rad from the set-point they are clipped, and ``info["clipped"]`` is
True. ``tcp_delta``: translation (m) and rotation vector (rad) of the tcp's goal in this step, along the base's axes.
``twist``: velocity of the tcp, m/s and rad/s, along the base's axes. ``velocity``: joint velocities (n,), rad/s.
``torque``: joint torques (n,), Nm, on top of those that carry the arm's weight (see :class:`hal.JointTorque`). With a
gripper one more number follows, 0 (open) to 1 (closed)."""

ObservationDict = dict[str, NDArray[Any]]


def action_space(robots: Sequence[Robot], kind: ActionKind, rate_hz: float, speeds: tuple[float, float]) -> spaces.Box:
    """Return the box of actions: the numbers of each arm, one arm after the other.

    ``speeds`` are the greatest of the tcp, m/s and rad/s.

    Raises:
        NotSupported: Torques, for an arm that has no limits for them (``no_torque_limits``).
    """
    linear, angular = speeds
    low: list[float] = []
    high: list[float] = []
    for robot in robots:
        if kind == "joint":
            low += robot.limits.lower
            high += robot.limits.upper
        elif kind in ("velocity", "torque"):
            most = _find_limits(robot, kind)
            low += [-value for value in most]
            high += most
        else:
            share = 1.0 / rate_hz if kind == "tcp_delta" else 1.0
            most = [linear * share] * 3 + [angular * share] * 3
            low += [-value for value in most]
            high += most
        if robot.gripper is not None:
            low.append(0.0)
            high.append(1.0)
    return spaces.Box(np.array(low, np.float32), np.array(high, np.float32), dtype=np.float32)


def _find_limits(robot: Robot, kind: ActionKind) -> list[float]:
    """Return the greatest joint velocities of a session (n,), rad/s, or the greatest torques (n,), Nm."""
    if kind == "velocity":
        return [robot.spec.speed * value for value in robot.limits.velocity]
    if robot.limits.torque is None:
        raise NotSupported(f"{robot.name}: its model has no limits.torque, Nm per joint", code="no_torque_limits")
    return list(robot.limits.torque)


IN_JOINTS = ("joint", "velocity", "torque")
"""Kinds of action with one number for each joint."""


def action_names(robots: Sequence[Robot], kind: ActionKind, several: bool) -> tuple[str, ...]:
    """Return the name of each number of an action; with ``several`` arms the arm's name leads, as in recordings."""
    names: list[str] = []
    for robot in robots:
        own = [
            *(robot.joints if kind in IN_JOINTS else _TCP_NAMES),
            *(["gripper"] if robot.gripper is not None else []),
        ]
        names += [f"{robot.name}.{name}" if several else name for name in own]
    return tuple(names)


POINTS = "points"
"""Name of the stream of points, which follows from the depth."""
_TCP_NAMES = ("x", "y", "z", "roll", "pitch", "yaw")


def observation_space(
    robots: Mapping[str, Robot], cameras: Iterable[Camera], streams: Collection[str], objects: Collection[str]
) -> spaces.Dict:
    """Return a box for each entry of :func:`numbers_and_pictures`, and for the pose of each of ``objects``.

    Raises:
        CommandError: Two entries would have the same key (code ``duplicate_name``).
    """

    def make_box(size: int) -> spaces.Box:
        return spaces.Box(-np.inf, np.inf, (size,), np.float64)

    parts: list[tuple[str, spaces.Space[Any]]] = []
    for lead, robot in robots.items():
        sizes = {"q": robot.n, "dq": robot.n, "tcp": 7} | ({"gripper": 1} if robot.gripper is not None else {})
        parts += [(lead + name, make_box(size)) for name, size in sizes.items()]
    for camera in cameras:
        found = [stream for stream in streams if stream in list_streams(camera.spec)]
        parts += [(entry_key(camera.name, stream), _picture_space(camera.spec, stream)) for stream in found]
    parts += [(entry_key("object", name), make_box(7)) for name in objects]
    keys = [name for name, _ in parts]
    if twice := sorted({name for name in keys if keys.count(name) > 1}):
        raise CommandError(
            f"two parts of the observation would be called {', '.join(twice)}: rename an arm, a camera or an object",
            code="duplicate_name",
        )
    return spaces.Dict(dict(parts))


def _picture_space(camera: CameraSpec, stream: str) -> spaces.Box:
    """Return the box of one camera's pictures: (H, W, 3) colour and points, (H, W, 1) anything else."""
    size = (camera.height, camera.width)
    if stream == POINTS:
        return spaces.Box(-np.inf, np.inf, (*size, 3), np.float32)
    kind = STREAMS[stream]
    highest = camera.depth_max if kind.highest is None else kind.highest
    return spaces.Box(kind.lowest, highest, (*size, *(kind.shape or (1,))), np.dtype(kind.dtype).type)


def numbers_and_pictures(
    observation: Observation, robots: Mapping[str, Robot], cameras: Collection[str], streams: Collection[str]
) -> ObservationDict:
    """Return the entries of an observation: the arms, their grippers and these streams of these cameras.

    ``robots`` maps what leads the names of an arm's entries to the arm. Points are in the base frame of the first.
    """
    shown: ObservationDict = {}
    for lead, robot in robots.items():
        state = observation.robots[robot.name]
        shown |= {f"{lead}q": np.array(state.q), f"{lead}dq": np.array(state.dq), f"{lead}tcp": pose_array(state.tcp)}
        if robot.gripper is not None:
            shown[f"{lead}gripper"] = np.array([observation.grippers[robot.name].width])
    for name in cameras:
        frame = observation.cameras[name].frame
        for stream in streams:
            if stream != POINTS:
                picture = getattr(frame, stream)
            else:
                picture = None if frame.depth is None else frame.point_image(next(iter(robots.values())).base)
            if picture is not None:
                shown[entry_key(name, stream)] = picture if picture.ndim == 3 else picture[..., None]
    return shown


def list_streams(camera: CameraSpec) -> tuple[str, ...]:
    """Return the streams of a camera that can be observed: its own, and points where it has depth."""
    return (*camera.streams, POINTS) if "depth" in camera.streams else tuple(camera.streams)


def entry_key(*parts: str) -> str:
    """Return the key of an entry: an identifier, because PyTorch modules that are named by keys allow no dots."""
    return "_".join(parts).replace("-", "_")


def pose_array(pose: Pose) -> NDArray[np.float64]:
    """Return a pose as (7,): position in m, and quaternion xyzw."""
    return np.concatenate([pose.position, pose.orientation])
