"""A URDF read as plain XML: enough to check names and to fill in limits, without a physics engine."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType

__all__ = ["UrdfJoint", "UrdfModel", "read_urdf"]

MOVABLE = ("revolute", "continuous", "prismatic")
"""Joints about or along one axis."""


@dataclass(frozen=True)
class UrdfJoint:
    """A joint. Limits are None where the URDF does not give them; an effort of 0 means unknown."""

    name: str
    kind: str
    parent: str
    child: str
    lower: float | None = None
    upper: float | None = None
    velocity: float | None = None
    effort: float | None = None

    @property
    def movable(self) -> bool:
        """One axis that can be driven."""
        return self.kind in MOVABLE


@dataclass(frozen=True)
class UrdfModel:
    """Links and joints of a URDF."""

    path: Path
    links: Mapping[str, bool]
    """Name -> does the link have an ``<inertial>``?"""
    joints: Mapping[str, UrdfJoint]

    def above(self, link: str) -> Iterator[UrdfJoint]:
        """The joints between a link and the root, nearest first."""
        by_child = {joint.child: joint for joint in self.joints.values()}
        seen: set[str] = set()
        while link in by_child and link not in seen:
            seen.add(link)
            yield by_child[link]
            link = by_child[link].parent

    def without_mass(self) -> list[str]:
        """Links that move and have no ``<inertial>``: simulators make up a mass for them."""
        return [
            name
            for name, has_mass in self.links.items()
            if not has_mass and any(joint.kind != "fixed" for joint in self.above(name))
        ]


def read_urdf(path: Path) -> UrdfModel:
    """Read a URDF. Raises ValueError with what is wrong in it, and OSError."""
    try:
        root = ElementTree.parse(path).getroot()
    except ElementTree.ParseError as error:
        raise ValueError(f"is not valid XML: {error}") from None
    if root.tag != "robot":
        raise ValueError(f"is not a URDF: its root element is <{root.tag}>, not <robot>")
    links = {element.get("name", ""): element.find("inertial") is not None for element in root.findall("link")}
    joints = {}
    for element in root.findall("joint"):
        joint = _joint(element)
        joints[joint.name] = joint
        for link in (joint.parent, joint.child):
            if link not in links:
                raise ValueError(f"joint {joint.name!r} names link {link!r}, which is not there")
    if not links:
        raise ValueError("has no links")
    return UrdfModel(path, MappingProxyType(links), MappingProxyType(joints))


def _joint(element: ElementTree.Element) -> UrdfJoint:
    name = element.get("name")
    parent, child, limit = element.find("parent"), element.find("child"), element.find("limit")
    if name is None or parent is None or child is None:
        raise ValueError(f"joint {name!r} lacks its name, its parent or its child")

    def number(attribute: str) -> float | None:
        text = limit.get(attribute) if limit is not None else None
        try:
            return float(text) if text is not None else None
        except ValueError:
            raise ValueError(f"joint {name!r}: {attribute}={text!r} is no number") from None

    kind = element.get("type", "")
    bounded = kind != "continuous"
    # A URDF's lower and upper limits are 0 where they are left out of a <limit> (the specification says so).
    default = 0.0 if limit is not None else None
    lower, upper = number("lower"), number("upper")
    return UrdfJoint(
        name=name,
        kind=kind,
        parent=parent.get("link", ""),
        child=child.get("link", ""),
        lower=(lower if lower is not None else default) if bounded else None,
        upper=(upper if upper is not None else default) if bounded else None,
        velocity=number("velocity"),
        effort=number("effort"),
    )
