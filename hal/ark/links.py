"""The joints and links of a URDF as Ark counts and places them: through PyBullet."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Collection, Iterator
from pathlib import Path

from ..geometry import Pose
from ..kinematics.urdf import UrdfJoint, read_urdf

__all__ = ["ArkUrdf"]


class ArkUrdf:
    """A URDF. Raises ValueError with what is wrong in it, and OSError."""

    def __init__(self, path: Path) -> None:
        self.model = read_urdf(path)
        moved = {joint.child for joint in self.model.joints.values()}
        if moved.issuperset(self.model.links):
            raise ValueError("has no root: every link is moved by a joint")
        root = ElementTree.parse(path).getroot()
        self._joints = {joint.get("name", ""): _origin(joint.find("origin")) for joint in root.findall("joint")}
        self._centres = {link.get("name", ""): _origin(link.find("inertial/origin")) for link in root.findall("link")}

    @property
    def root(self) -> str:
        """The link that no joint moves."""
        moved = {joint.child for joint in self.model.joints.values()}
        return next(link for link in self.model.links if link not in moved)

    def is_fixed(self, link: str) -> bool:
        """Is it fixed to another link?"""
        return any(joint.kind == "fixed" and joint.child == link for joint in self.model.joints.values())

    def order(self, merged: bool) -> list[UrdfJoint]:
        """Joints as PyBullet numbers them: down each branch, in the order of the file.

        With ``merged`` fixed ones do not count, and the list ends where the moving ones branch: PyBullet goes through
        branches that it has merged in an order of its own.
        """
        if not merged:
            return list(self._below(self.root))
        chain: list[UrdfJoint] = []
        following = self._moving(self.root)
        while len(following) == 1:
            chain += following
            following = self._moving(following[0].child)
        return chain

    def _below(self, link: str) -> Iterator[UrdfJoint]:
        for joint in self.model.joints.values():
            if joint.parent == link:
                yield joint
                yield from self._below(joint.child)

    def _moving(self, link: str) -> list[UrdfJoint]:
        """The next joints that are not fixed."""
        found = []
        for joint in self.model.joints.values():
            if joint.parent == link:
                found += self._moving(joint.child) if joint.kind == "fixed" else [joint]
        return found

    def place(self, link: str, known: Collection[str]) -> tuple[str, Pose] | None:
        """Where Ark counts from on a link (its centre of mass), as a link in ``known`` and a pose in that one's frame.

        None where nothing but fixed joints leads from the link to one that is known.
        """
        if link not in self.model.links:
            return None
        pose = self._centres[link]
        at = link
        for joint in self.model.above(link):
            if at in known:
                break
            if joint.kind != "fixed":
                return None
            pose = self._joints[joint.name] @ pose
            at = joint.parent
        return (at, pose) if at in known else None


def _origin(element: ElementTree.Element | None) -> Pose:
    if element is None:
        return Pose()
    x, y, z = map(float, element.get("xyz", "0 0 0").split())
    roll, pitch, yaw = map(float, element.get("rpy", "0 0 0").split())
    return Pose.from_rpy([x, y, z], [roll, pitch, yaw])
