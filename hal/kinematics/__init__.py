"""Forward and inverse kinematics of an arm, and the reader of URDF files.

``arm`` has forward kinematics and Jacobians, ``ik`` inverse kinematics (both need pinocchio, which loads when they are
imported), ``urdf`` reads a URDF as plain XML.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from .._moved import names_of

if TYPE_CHECKING:
    from .arm import Kinematics

__all__ = ["Kinematics"]

_find_moved = names_of(__name__)


def __getattr__(name: str) -> Any:
    if name == "Kinematics":
        from .arm import Kinematics

        return Kinematics
    return _find_moved(name)
