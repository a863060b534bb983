"""Forward and inverse kinematics of an arm, and the reader of URDF files.

``arm`` has forward kinematics and Jacobians, ``ik`` inverse kinematics (both need pinocchio, which loads when they are
imported), ``urdf`` reads a URDF as plain XML.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from .arm import Kinematics

__all__ = ["Kinematics"]


def __getattr__(name: str) -> Any:
    if name == "Kinematics":
        from .arm import Kinematics

        return Kinematics
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
