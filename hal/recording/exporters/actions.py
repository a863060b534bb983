"""Forms of an exported action: joint targets, joint velocities, poses or steps of the tcp, and forms of a rotation.

An action is what was commanded one row later; the last row repeats. All numbers are SI units in the arm's base frame,
and the gripper's target width follows those of its arm.
"""

from __future__ import annotations

from itertools import pairwise
from typing import Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...arguments import choice
from ...errors import CommandError
from ...geometry import apply_rotation, difference, quaternion_to_matrix
from ..layout import ACTION, SETPOINT
from .content import ArmColumns, EpisodeContent

Array = NDArray[np.float64]
ActionKind = Literal["joint_position", "joint_velocity", "tcp_pose", "tcp_delta"]
RotationForm = Literal["quaternion", "axis_angle", "rotation_6d"]

_TCP, _TCP_SETPOINT = "observation.tcp", "rig.tcp_set"

_NAMES: dict[RotationForm, tuple[str, ...]] = {
    "quaternion": ("qx", "qy", "qz", "qw"),
    "axis_angle": ("rx", "ry", "rz"),
    "rotation_6d": ("r11", "r12", "r13", "r21", "r22", "r23"),
}


class ActionForm(NamedTuple):
    """What the numbers of an exported action are."""

    kind: ActionKind = "joint_position"
    """``joint_position``: targets, rad. ``joint_velocity``: from one commanded position to the next, rad/s of true
    time. ``tcp_pose``: commanded pose. ``tcp_delta``: the step from one commanded pose to the next; translation, and a
    rotation that multiplies the orientation from the left, both along the base's axes, as robosuite's and robomimic's
    OSC controllers and ``tcp_delta`` of policies."""
    rotation: RotationForm | None = None
    """Rotation in ``tcp_pose`` and ``tcp_delta``. ``quaternion``: x, y, z, w. ``axis_angle``: rotation vector, rad, at
    most pi long. ``rotation_6d``: the first two rows of the matrix, as in PyTorch3D's ``matrix_to_rotation_6d``, UMI,
    robomimic and the training code of DROID (Zhou et al., On the Continuity of Rotation Representations in Neural
    Networks, CVPR 2019, takes columns)."""

    def checked(self) -> ActionForm:
        """Return the form with a rotation where it needs one. Raises CommandError (code ``bad_export``)."""
        choice("action", self.kind, get_args(ActionKind), "bad_export")
        if self.kind.startswith("joint"):
            if self.rotation is not None:
                raise CommandError(f"actions of {self.kind} have no rotation", code="bad_export")
            return self
        rotation = self.rotation or "quaternion"
        choice("rotation", rotation, _NAMES, "bad_export")
        return ActionForm(self.kind, rotation)

    def names(self, content: EpisodeContent) -> list[str]:
        """Return the names of the numbers."""
        if self.rotation is None:
            return content.episode.names(ACTION)
        found: list[str] = []
        for arm in content.arms:
            found += [arm.lead + name for name in ("x", "y", "z", *_NAMES[self.rotation])]
            found += [f"{arm.lead}gripper"] if content.width(arm) is not None else []
        return found

    def values(self, content: EpisodeContent) -> NDArray[np.float32] | Array:
        """Return the actions (rows, n) of an episode; all but ``joint_position`` in double precision.

        Raises DatasetError if the episode lacks the commanded poses.
        """
        if self.kind == "joint_position":
            return content.episode.columns[ACTION]
        parts: list[NDArray[np.float64]] = []
        for arm in content.arms:
            parts += _joint_velocity(content, arm) if self.rotation is None else self._tcp(content, arm)
            if (width := content.width(arm, ACTION)) is not None:
                parts.append(width[:, None].astype(np.float64))
        return np.concatenate(parts, axis=1)

    def _tcp(self, content: EpisodeContent, arm: ArmColumns) -> list[Array]:
        assert self.rotation is not None
        return list((_pose if self.kind == "tcp_pose" else _step)(content, arm, self.rotation))


def action_dict(content: EpisodeContent) -> dict[str, NDArray[np.float32]]:
    """Return every form of an episode's actions, each (rows, n), under the names of robomimic's own ``action_dict``.

    ``abs_pos``, ``abs_rot_axis_angle``, ``abs_rot_6d``, the same with ``rel_``, ``gripper`` (target width, m) and
    ``gripper_force`` (asked of it, N), and ``joint_position`` and ``joint_velocity``; without those whose columns are
    missing. With several arms the names begin with ``robot0_``, ``robot1_``, ...
    """
    found: dict[str, NDArray[np.float32]] = {}
    rotations: dict[str, RotationForm] = {"rot_axis_angle": "axis_angle", "rot_6d": "rotation_6d"}
    for k, arm in enumerate(content.arms):
        lead = f"robot{k}_" if len(content.arms) > 1 else ""
        forms: dict[str, Array] = {"joint_position": content.of(arm, ACTION)}
        if content.has(SETPOINT):
            forms["joint_velocity"] = _joint_velocity(content, arm)[0]
        for name, of in (("abs", _pose), ("rel", _step)) if content.has(_TCP_SETPOINT) else ():
            for rotation, form in rotations.items():
                forms[f"{name}_pos"], forms[f"{name}_{rotation}"] = of(content, arm, form)
        if (width := content.width(arm, ACTION)) is not None:
            forms["gripper"] = width[:, None]
        if (force := content.later_force(arm)) is not None:
            forms["gripper_force"] = force[:, None]
        found |= {lead + name: values.astype(np.float32) for name, values in forms.items()}
    return found


def rotation_observations(content: EpisodeContent, form: RotationForm | None) -> dict[str, NDArray[np.float32]]:
    """Return the measured orientation of each tcp in the action's form, for the forms that need it.

    ``robot0_eef_rot_axis_angle`` (rows, 3), with ``robot0_demo_start_pose`` and ``robot0_demo_end_pose`` (rows, 6) as
    UMI has them, or ``robot0_eef_rot_6d`` (rows, 6).
    """
    found: dict[str, NDArray[np.float32]] = {}
    for k, arm in enumerate(content.arms if form in ("axis_angle", "rotation_6d") else ()):
        assert form is not None
        measured = content.of(arm, _TCP).astype(np.float64)
        rotations = np.array([_rotation(pose[3:], form) for pose in measured])
        if form == "rotation_6d":
            found[f"robot{k}_eef_rot_6d"] = rotations.astype(np.float32)
            continue
        poses = np.concatenate([measured[:, :3], rotations], axis=1).astype(np.float32)
        found[f"robot{k}_eef_rot_axis_angle"] = poses[:, 3:]
        found[f"robot{k}_demo_start_pose"] = np.repeat(poses[:1], content.rows, axis=0)
        found[f"robot{k}_demo_end_pose"] = np.repeat(poses[-1:], content.rows, axis=0)
    return found


def _joint_velocity(content: EpisodeContent, arm: ArmColumns) -> list[Array]:
    """Return the velocity (rows, joints) that leads from each set-point to the next one, rad/s."""
    period = np.append(np.diff(content.grid), 1.0 / content.episode.fps)
    target, now = (content.of(arm, key).astype(np.float64) for key in (ACTION, SETPOINT))
    return [(target - now) / period[:, None]]


def _poses(content: EpisodeContent, arm: ArmColumns) -> Array:
    """Return the commanded poses (rows + 1, 7), the last one twice."""
    poses = content.of(arm, _TCP_SETPOINT).astype(np.float64)
    poses[:, 3:] /= np.linalg.norm(poses[:, 3:], axis=1, keepdims=True)
    return np.concatenate([poses, poses[-1:]])


def _pose(content: EpisodeContent, arm: ArmColumns, form: RotationForm) -> tuple[Array, Array]:
    """Return positions (rows, 3) and rotations (rows, n) that are commanded one row later."""
    later = _poses(content, arm)[1:]
    return later[:, :3], np.array([_rotation(pose[3:], form) for pose in later])


def _step(content: EpisodeContent, arm: ArmColumns, form: RotationForm) -> tuple[Array, Array]:
    """Return translations (rows, 3) and rotations (rows, n) from the pose of each row to that of the next one."""
    poses = _poses(content, arm)
    steps = np.array([difference(start, end) for start, end in pairwise(poses)])
    if form == "axis_angle":
        return steps[:, :3], steps[:, 3:]
    return steps[:, :3], np.array([_rotation(apply_rotation((0.0, 0.0, 0.0, 1.0), step[3:]), form) for step in steps])


def _rotation(quaternion: ArrayLike, form: RotationForm) -> Array:
    """Return a rotation, given as a unit quaternion (4,), in another form."""
    q = np.asarray(quaternion, np.float64)
    if form == "quaternion":
        return q
    if form == "axis_angle":
        return np.array(difference((0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), (0.0, 0.0, 0.0, *q))[3:])
    return quaternion_to_matrix(q)[:2].ravel()
