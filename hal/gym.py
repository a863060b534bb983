"""Rigs as Gymnasium environments: :class:`RigEnv` is one rig, :func:`make_vec` many copies of a simulated one."""

from __future__ import annotations

from .learning.gym import ActionKind, ObservationDict, RigEnv
from .learning.vector import RigVectorEnv, make_vec

__all__ = ["ActionKind", "ObservationDict", "RigEnv", "RigVectorEnv", "make_vec"]
