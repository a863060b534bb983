"""The visuals of a URDF: its tree of links, the joints between them, and the shapes on each link."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

from hal.geometry import Pose, after_rotation, rotate
from hal.kinematics.urdf import mesh_file

__all__ = ["UrdfTreeJoint", "UrdfTree", "UrdfVisual", "read_tree"]

_ROTARY = ("revolute", "continuous")
_SLIDING = "prismatic"


@dataclass(frozen=True)
class UrdfVisual:
    """One shape to draw, with its pose in the frame of its link."""

    pose: Pose
    shape: str
    """``mesh``, ``box``, ``sphere``, ``cylinder`` or ``capsule``."""
    size: tuple[float, ...]
    """Scale of a mesh along x, y, z; sides of a box; radius; radius and length; m."""
    rgba: tuple[float, ...] | None = None
    """None for the colours of the file."""
    file: str = ""
    """Path of a mesh, which may not exist."""


@dataclass(frozen=True)
class UrdfTreeJoint:
    """A joint, and the motion of its child. ``source`` is the joint whose value counts: itself, or that of a mimic."""

    name: str
    kind: str
    parent: str
    child: str
    origin: Pose
    """Pose of the child in the parent's frame, at zero."""
    axis: tuple[float, ...]
    """(3,) along the parent's axes."""
    source: str
    multiplier: float = 1.0
    offset: float = 0.0

    @property
    def moves(self) -> bool:
        """Whether the joint can move."""
        return self.kind in _ROTARY or self.kind == _SLIDING

    def placement(self, values: Mapping[str, float]) -> tuple[list[float], list[float]]:
        """Return position (3,) and quaternion (4,) of the child in the parent's frame; absent values are 0."""
        position, orientation = self.origin.position.tolist(), self.origin.orientation.tolist()
        value = self.multiplier * values.get(self.source, 0.0) + self.offset
        along = [value * part for part in self.axis]
        if self.kind in _ROTARY:
            orientation = after_rotation(orientation, along)
        elif self.kind == _SLIDING:
            position = [a + b for a, b in zip(position, along, strict=True)]
        return position, orientation


@dataclass(frozen=True)
class UrdfTree:
    """A URDF as a tree of links."""

    root: str
    joints: tuple[UrdfTreeJoint, ...]
    """From the root outwards: a parent comes before its children."""
    visuals: Mapping[str, tuple[UrdfVisual, ...]]
    """Link -> its shapes."""

    def poses(self, values: Mapping[str, float]) -> dict[str, Pose]:
        """Return the pose of each link in the root's frame."""
        found = {self.root: Pose()}
        for joint in self.joints:
            found[joint.child] = found[joint.parent] @ Pose(*joint.placement(values))
        return found


def read_tree(path: str) -> UrdfTree:
    """Read a URDF.

    Raises:
        ValueError: It is wrong; the message tells where.
        OSError: It cannot be read.
    """
    try:
        robot = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"{path} is not valid XML: {error}") from None
    colors: dict[str, tuple[float, ...]] = {}  # materials may be named after their first use
    for material in robot.iter("material"):
        color = material.find("color")
        if color is not None:
            colors.setdefault(material.get("name", ""), _numbers(color, "rgba", 4, 1.0))
    folder = Path(path).resolve().parent
    visuals = {
        link.get("name", ""): tuple(
            shown for visual in link.findall("visual") if (shown := _visual(visual, colors, folder)) is not None
        )
        for link in robot.findall("link")
    }
    joints = [_joint(element) for element in robot.findall("joint")]
    return _tree(path, joints, visuals)


def _tree(path: str, joints: list[UrdfTreeJoint], visuals: dict[str, tuple[UrdfVisual, ...]]) -> UrdfTree:
    """Order the joints. Raises ValueError where they are not a tree."""
    children = {joint.child for joint in joints}
    roots = [link for link in visuals if link not in children]
    if len(roots) != 1:
        raise ValueError(f"{path} has {len(roots)} root links, not one")
    placed, ordered, waiting = {roots[0]}, [], joints
    while waiting:
        ready = [joint for joint in waiting if joint.parent in placed]
        if not ready:
            raise ValueError(f"{path}: joint {waiting[0].name} is not connected to the root")
        ordered += ready
        waiting = [joint for joint in waiting if joint.parent not in placed]
        placed |= {joint.child for joint in ready}
    return UrdfTree(roots[0], tuple(ordered), visuals)


def _joint(element: ElementTree.Element) -> UrdfTreeJoint:
    name, mimic = element.get("name", ""), element.find("mimic")
    parent, child = element.find("parent"), element.find("child")
    if parent is None or child is None:
        raise ValueError(f"joint {name} lacks its parent or its child")
    origin = _origin(element)
    axis = _numbers(element.find("axis"), "xyz", 3, 0.0) if element.find("axis") is not None else (1.0, 0.0, 0.0)
    length = sum(part * part for part in axis) ** 0.5
    if length == 0.0 and element.get("type") in (*_ROTARY, _SLIDING):
        raise ValueError(f"joint {name} has an axis of length 0")
    return UrdfTreeJoint(
        name=name,
        kind=element.get("type", ""),
        parent=parent.get("link", ""),
        child=child.get("link", ""),
        origin=origin,
        axis=tuple(rotate(origin.orientation.tolist(), [part / (length or 1.0) for part in axis])),
        source=name if mimic is None else mimic.get("joint", ""),
        multiplier=1.0 if mimic is None else float(mimic.get("multiplier", 1.0)),
        offset=0.0 if mimic is None else float(mimic.get("offset", 0.0)),
    )


def _visual(element: ElementTree.Element, colors: Mapping[str, tuple[float, ...]], folder: Path) -> UrdfVisual | None:
    material, geometry = element.find("material"), element.find("geometry")
    rgba = colors.get(material.get("name", "")) if material is not None else None
    if material is not None and (own := material.find("color")) is not None:
        rgba = _numbers(own, "rgba", 4, 1.0)
    shape = next(iter(geometry), None) if geometry is not None else None
    if shape is None:
        return None
    pose = _origin(element)
    if shape.tag == "mesh":
        file = mesh_file(shape.get("filename", ""), folder)
        return UrdfVisual(pose, "mesh", _numbers(shape, "scale", 3, 1.0), rgba, str(file))
    if shape.tag == "box":
        return UrdfVisual(pose, "box", _numbers(shape, "size", 3, 0.0), rgba)
    if shape.tag == "sphere":
        return UrdfVisual(pose, "sphere", _numbers(shape, "radius", 1, 0.0), rgba)
    if shape.tag in ("cylinder", "capsule"):
        return UrdfVisual(pose, shape.tag, _numbers(shape, "radius", 1, 0.0) + _numbers(shape, "length", 1, 0.0), rgba)
    return None


def _origin(element: ElementTree.Element) -> Pose:
    origin = element.find("origin")
    if origin is None:
        return Pose()
    return Pose.from_rpy(_numbers(origin, "xyz", 3, 0.0), _numbers(origin, "rpy", 3, 0.0))


def _numbers(element: ElementTree.Element | None, attribute: str, count: int, default: float) -> tuple[float, ...]:
    text = element.get(attribute) if element is not None else None
    if text is None:
        return (default,) * count
    values = tuple(float(word) for word in text.split())
    if len(values) != count:
        raise ValueError(f"{attribute}={text!r} has {len(values)} numbers, not {count}")
    return values
