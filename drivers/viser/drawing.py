"""Small things that everything on the page is drawn with."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from viser import SceneApi, SceneNodeHandle

from .meshes import glb
from .urdf import Visual

__all__ = ["draw", "place", "wxyz"]

_STILL = 1e-5
"""A node that moves by less stays where it is, m and parts of a quaternion: an arm at rest costs nothing."""


def wxyz(orientation: Sequence[float] | NDArray[np.float64]) -> tuple[float, float, float, float]:
    """A quaternion x, y, z, w in viser's order."""
    x, y, z, w = map(float, orientation)
    return w, x, y, z


def place(node: SceneNodeHandle, position: Sequence[float], orientation: Sequence[float]) -> None:
    """Put a node there, in its parent's frame; orientation x, y, z, w."""
    where, turn = np.asarray(position, float), np.asarray(wxyz(orientation))
    if not _alike(node.position, where):
        node.position = where
    if not _alike(node.wxyz, turn) and not _alike(node.wxyz, -turn):
        node.wxyz = turn


def _alike(there: NDArray[np.float64], wanted: NDArray[np.float64]) -> bool:
    return bool(np.abs(there - wanted).max() <= _STILL)


def draw(scene: SceneApi, parent: str, visuals: Iterable[Visual], notes: list[str]) -> list[Any]:
    """Draw visuals under a node; what cannot be drawn is noted. Returns the nodes."""
    nodes = []
    for number, visual in enumerate(visuals):
        try:
            data = glb(visual)
        except ValueError as error:
            notes.append(f"not drawn: {error}")
            continue
        pose = visual.pose
        nodes.append(
            scene.add_glb(
                f"{parent}/visual{number}", data, position=pose.position, wxyz=wxyz(pose.orientation.tolist())
            )
        )
    return nodes
