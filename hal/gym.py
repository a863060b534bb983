"""Rigs as Gymnasium environments: :class:`RigEnv` is one rig, :func:`make_vec` many copies of a simulated one.

Tasks with a name are registered by the import: ``gymnasium.make("hal/PickCube-v0")``. :class:`TaskEnv` is their base.
"""

from __future__ import annotations

from .learning.gym import EnvSettings, RigEnv
from .learning.spaces import ActionKind, ObservationDict
from .learning.tasks.task_env import CLOSED, GRASP_HEIGHT, OPEN, TaskEnv, closeness, cube_entry, goal_entry
from .learning.vector import RigVectorEnv, make_vec

__all__ = [
    "CLOSED",
    "GRASP_HEIGHT",
    "OPEN",
    "ActionKind",
    "EnvSettings",
    "ObservationDict",
    "RigEnv",
    "RigVectorEnv",
    "TaskEnv",
    "closeness",
    "cube_entry",
    "goal_entry",
    "make_vec",
]
