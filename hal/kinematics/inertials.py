"""Check the masses and inertias in a URDF: many files lack them, or have placeholders that no body can have.

Kinematics need none of them, but gravity and torques computed from a wrong one are wrong without any other sign.
"""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..geometry import rpy_to_matrix
from .mesh_files import hull_points, mesh_file
from .urdf import UrdfModel, parse_xml, read_urdf

Array = NDArray[np.float64]

INEXACT = 0.2
"""Relative tolerance of the triangle inequality: the published moments of some good models break it by a sixth."""
ROUGH = 2.5
"""A link may have so many times the inertia that fits its collision shapes, which are rough. Placeholders have more."""
NOTHING = 1e-9
"""Moments below this are zero, kg m2."""


def find_wrong_inertials(urdf: str | Path, joints: Iterable[str]) -> dict[str, str]:
    """Return the links whose mass or inertia is missing or impossible, among those that an arm's joints move.

    Missing: a link that has a shape has no mass, or all links that a joint moves as one body have none. Impossible: a
    moment is negative, one is larger than the sum of the other two, or one is far larger than it would be if all the
    mass of the link were in the corners of the box around its collision shapes. (Placeholders such as 0.1 kg m2 for a
    finger of 0.1 kg break this bound by orders of magnitude.)

    Args:
        urdf: The file.
        joints: Names of the arm's joints.

    Returns:
        Link -> what is wrong with it.

    Raises:
        ValueError: The file is no valid URDF.
        OSError: It cannot be read.
    """
    path = Path(urdf)
    model = read_urdf(path, meshes=False)
    elements = {element.get("name", ""): element for element in parse_xml(path).findall("link")}
    folder = path.resolve().parent
    wrong: dict[str, str] = {}
    for body in _moving_bodies(model, frozenset(joints)):
        masses = {link: _mass(elements[link]) for link in body}
        for link in body:
            if masses[link] <= 0.0 and (model.links[link].has_shapes or not any(masses.values())):
                wrong[link] = "has no mass"
            elif masses[link] > 0.0 and (problem := _problem(elements[link], masses[link], folder)):
                wrong[link] = problem
    return wrong


def _moving_bodies(model: UrdfModel, joints: frozenset[str]) -> list[list[str]]:
    """Return the links that move with any of the joints; those that fixed joints connect are together, as one body."""
    bodies: dict[str, list[str]] = {}
    body_of = {model.root: model.root}
    moving: set[str] = set()
    for joint in model.outwards:  # a parent comes before its children
        body = body_of[joint.parent] if joint.kind == "fixed" else joint.child
        body_of[joint.child] = body
        if joint.name in joints or joint.parent in moving:
            moving.add(joint.child)
            bodies.setdefault(body, []).append(joint.child)
    return list(bodies.values())


def _mass(link: ElementTree.Element) -> float:
    mass = link.find("inertial/mass")
    return 0.0 if mass is None else float(mass.get("value", "0"))


def _problem(link: ElementTree.Element, mass: float, folder: Path) -> str:
    """Return what is wrong with the inertia of a link; "" if it is possible."""
    inertia = link.find("inertial/inertia")
    if inertia is None:
        return "has no inertia"
    value = {name: float(inertia.get(name, "0")) for name in ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")}
    tensor = np.array(
        [
            [value["ixx"], value["ixy"], value["ixz"]],
            [value["ixy"], value["iyy"], value["iyz"]],
            [value["ixz"], value["iyz"], value["izz"]],
        ]
    )
    low, middle, high = np.linalg.eigvalsh(tensor)
    moments = f"moments {low:.3g}, {middle:.3g}, {high:.3g} kg m2"
    if low < -NOTHING:
        return f"has a negative moment of inertia ({moments})"
    if high > (1.0 + INEXACT) * (low + middle) + NOTHING:
        return f"has a moment of inertia above the sum of the other two ({moments})"
    sides = _extent(link, folder)
    if sides is not None:
        turn, _ = _origin(link.find("inertial"))
        along = np.diag(turn @ tensor @ turn.T)  # about the link's axes
        squares = np.square(sides)
        most = ROUGH * 0.25 * mass * (squares.sum() - squares)
        if (along > most + NOTHING).any():
            return f"is too small for its inertia ({moments}, {mass:.3g} kg, {' x '.join(f'{s:.2g}' for s in sides)} m)"
    return ""


def _extent(link: ElementTree.Element, folder: Path) -> Array | None:
    """Return the sides (3,) of the box around a link's collision shapes, along its axes, m; None if unknown."""
    corners: list[Array] = []
    for shape in link.findall("collision"):
        box = _bounds(shape.find("geometry/*"), folder)
        if box is None:
            return None
        turn, position = _origin(shape)
        grid = np.array(np.meshgrid(*zip(*box, strict=True))).reshape(3, -1)
        corners.append(turn @ grid + position[:, None])
    if not corners:
        return None
    every = np.hstack(corners)
    sides: Array = every.max(axis=1) - every.min(axis=1)
    return sides


def _bounds(shape: ElementTree.Element | None, folder: Path) -> Any:
    """Return the lower and the upper corner of a shape's box in its own frame, m; None if it cannot be read."""
    if shape is None:
        return None
    if shape.tag == "mesh":
        return _mesh_bounds(mesh_file(shape.get("filename", ""), folder), shape.get("scale", "1 1 1"))
    if shape.tag == "box":
        half = np.array(shape.get("size", "0 0 0").split(), float) / 2.0
    else:
        radius, length = float(shape.get("radius", "0")), float(shape.get("length", "0"))
        caps = 0.0 if shape.tag == "cylinder" else radius
        half = np.array([radius, radius, length / 2.0 + caps])
    return -half, half


@lru_cache(maxsize=256)
def _mesh_bounds(file: Path, scale: str) -> Any:
    try:
        corners = hull_points(file) * np.array(scale.split()[:3], float)
    except Exception:  # a mesh that is empty, or that nothing can read; the simulation reports it
        return None
    return corners.min(axis=0), corners.max(axis=0)


def _origin(element: ElementTree.Element | None) -> tuple[Array, Array]:
    """Return the rotation matrix (3, 3) and the position (3,) of an element's ``<origin>``."""
    origin = element.find("origin") if element is not None else None
    if origin is None:
        return np.eye(3), np.zeros(3)
    roll, pitch, yaw = (float(word) for word in origin.get("rpy", "0 0 0").split())
    return rpy_to_matrix(roll, pitch, yaw), np.array(origin.get("xyz", "0 0 0").split(), float)
