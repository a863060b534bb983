"""Positions and rotations of Ark's files: metres, and Euler angles in rad or quaternions x, y, z, w."""

from __future__ import annotations

import math
from typing import NamedTuple

from ..geometry import matrix_to_quaternion, rpy_to_matrix
from .ledger import Ledger
from .reading import Node, Reading
from .text import Commented

__all__ = ["Rotation", "position_of", "rotation_of", "tidy"]


class Rotation(NamedTuple):
    """A quaternion x, y, z, w, with a comment where it was something else."""

    value: list[float | int] | Commented
    turns: bool
    """Is it more than none at all?"""


def position_of(node: Node, key: str, target: str, reading: Reading, ledger: Ledger) -> list[float | int] | None:
    """Three numbers at ``key``, m; None where there is nothing."""
    child = node.get(key)
    if child is None:
        return None
    values = reading.numbers(child, (3,))
    ledger.kept(child, target)
    return values


def rotation_of(node: Node, key: str, target: str, reading: Reading, ledger: Ledger) -> Rotation | None:
    """A quaternion from the quaternion or the Euler angles at ``key``; None where there is nothing."""
    child = node.get(key)
    if child is None:
        return None
    values = reading.rotation(child)
    if len(values) == 4:
        length = math.hypot(*values)
        if abs(length - 1.0) <= 0.005:
            ledger.kept(child, target)
            return Rotation(values, any(values[:3]))
        unit = tidy([value / length for value in values])
        note = f"a quaternion of length {length:.3g}, made one of length 1"
    else:
        unit = tidy(matrix_to_quaternion(rpy_to_matrix(*values)).tolist())
        note = "Euler angles (rad) made a quaternion"
        if max(map(abs, values)) > 2.0 * math.pi:
            note += "; beyond a full turn: were these degrees? Ark takes them for rad, too"
    ledger.changed(child, target, note)
    return Rotation(Commented(unit, f"Ark: {values}"), any(unit[:3]))


def tidy(values: list[float]) -> list[float | int]:
    """Computed numbers without the dust behind the sixth digit."""
    return [int(rounded) if (rounded := round(value, 6)).is_integer() else rounded for value in values]
