"""Make one URDF of an arm and a tool, free joints that a file has fixed, and divide the URDF of a robot with two arms.

What is made is kept in the user's cache, named by its contents, because every process of a rig reads the file.
"""

from __future__ import annotations

import hashlib
import xml.etree.ElementTree as ElementTree
from collections.abc import Collection
from dataclasses import dataclass
from math import atan2, hypot
from pathlib import Path

from ..geometry import Pose
from .mesh_files import PACKAGE, cache_folder, mesh_file, write_whole
from .urdf import UrdfModel, parse_xml

PREFIX = "tool_"
"""Put before each name of a tool that the arm has too."""

FLANGE = "tool_flange"
"""Frame in which a tool is mounted that takes the place of the arm's own."""

LIGHT = '<inertial><mass value="0.01"/><inertia ixx="1e-6" ixy="0" ixz="0" iyy="1e-6" iyz="0" izz="1e-6"/></inertial>'
"""The mass of a tool's link that has a shape and no mass, 10 g: the pads of a gripper. Simulators make 1 kg of it."""


@dataclass(frozen=True)
class MountedTool:
    """A tool with a URDF of its own, fixed to a link of an arm."""

    urdf: Path
    link: str
    """Link of the arm."""
    pose: Pose
    """Pose of the root of the tool in the frame of that link, or in :data:`FLANGE`."""
    flange: Pose | None = None
    """Pose of :data:`FLANGE` in that link: what the arm has on the link is left out. None: there is no such frame."""


def compose_urdf(arm: Path, tool: MountedTool | None = None, freed: Collection[str] = ()) -> Path:
    """Write the URDF of an arm with a tool, and return its path.

    Args:
        arm: URDF of the arm.
        tool: What is mounted on it.
        freed: Fixed joints that turn about their axis, within the limits that the file has for them.

    Raises:
        ValueError: A file is no URDF, the arm has no such link, or a freed joint is not fixed or has no limits.
        OSError: A file cannot be read, or the cache cannot be written.
    """
    root = _parse_with_absolute_files(arm)
    for name in freed:
        joint = next((one for one in root.findall("joint") if one.get("name") == name), None)
        if joint is None or joint.get("type") != "fixed" or joint.find("limit") is None:
            raise ValueError(f"has no fixed joint {name!r} with limits")
        joint.set("type", "revolute")
    if tool is not None:
        _mount(root, tool)
    return _keep(root, arm.stem)


def divide_urdf(robot: UrdfModel, joints: Collection[str], others: Collection[str], *, body: bool) -> Path:
    """Write the URDF of one arm of a robot with several, and return its path.

    Every link of the robot is in the part of one of its arms.

    Args:
        robot: The whole robot.
        joints: Joints of the arm.
        others: Joints of the other arms; all links that they move are left out.
        body: Whether all that no arm moves is part of this arm. Without it, only the frames up to the arm are.

    Raises:
        OSError: The file cannot be read, or the cache cannot be written.
    """
    root = _parse_with_absolute_files(robot.path)
    above = {link: list(robot.above(link)) for link in robot.links}
    movers = {link: {joint.name for joint in found} for link, found in above.items()}
    own = {link for link, names in movers.items() if not names.isdisjoint(joints)}
    if body:
        kept = {link for link, names in movers.items() if names.isdisjoint(others)}
    else:
        kept = own | {joint.parent for link in own for joint in above[link]}
    for part in list(root):
        child = part.find("child")
        link = part.get("name") if child is None else child.get("link")
        if part.tag in ("link", "joint") and link not in kept:
            root.remove(part)
        elif part.tag == "link" and not body and link not in own:
            part[:] = []
    return _keep(root, robot.path.stem)


def _keep(root: ElementTree.Element, stem: str) -> Path:
    return keep_urdf(ElementTree.tostring(root, encoding="utf-8"), stem)


def keep_urdf(data: bytes, stem: str) -> Path:
    """Write a URDF into the cache, unless it is there, and return its path; ``stem`` begins its name."""
    place = cache_folder("urdf") / f"{stem}-{hashlib.sha256(data).hexdigest()[:16]}.urdf"
    if not place.is_file() or place.read_bytes() != data:
        write_whole(place, data)
    return place


def _parse_with_absolute_files(urdf: Path) -> ElementTree.Element:
    root = parse_xml(urdf)
    if root.tag != "robot":
        raise ValueError(f"is not a URDF: its root element is <{root.tag}>, not <robot>")
    folder = urdf.resolve().parent
    for tag in ("mesh", "texture"):
        for element in root.iter(tag):
            name = element.get("filename", "")
            file = mesh_file(name, folder)
            if name and (file.is_file() or not name.startswith(PACKAGE)):  # else its package is not installed
                element.set("filename", str(file.resolve()))
    return root


def _mount(root: ElementTree.Element, tool: MountedTool) -> None:
    added = _parse_with_absolute_files(tool.urdf)
    if all(one.get("name") != tool.link for one in root.findall("link")):
        raise ValueError(f"has no link {tool.link!r}")
    if tool.flange is not None:
        _remove_children(root, tool.link)
    names = {(one.tag, one.get("name", "")) for one in root}
    parts = [one for one in added if one.tag in ("link", "joint", "material")]
    taken = {(one.tag, one.get("name", "")) for one in parts} & names
    for one in parts:
        _rename(one, taken)
    for one in parts:
        if one.tag == "link" and one.find("inertial") is None and one.find("collision") is not None:
            one.append(ElementTree.fromstring(LIGHT))
    children = {one.get("link") for one in added.findall("joint/child")}
    base = next(one.get("name", "") for one in parts if one.tag == "link" and one.get("name") not in children)
    parent = tool.link
    if tool.flange is not None:
        ElementTree.SubElement(root, "link", {"name": FLANGE})
        _fix(root, f"{FLANGE}_joint", tool.link, FLANGE, tool.flange)
        parent = FLANGE
    _fix(root, f"{PREFIX}mount", parent, base, tool.pose)
    root.extend(parts)


def _fix(root: ElementTree.Element, name: str, parent: str, child: str, pose: Pose) -> None:
    """Add a fixed joint."""
    joint = ElementTree.SubElement(root, "joint", {"name": name, "type": "fixed"})
    ElementTree.SubElement(joint, "parent", {"link": parent})
    ElementTree.SubElement(joint, "child", {"link": child})
    xyz = " ".join(f"{value:.9g}" for value in pose.position)
    rpy = " ".join(f"{value:.12g}" for value in _roll_pitch_yaw(pose))
    ElementTree.SubElement(joint, "origin", {"xyz": xyz, "rpy": rpy})


def _remove_children(root: ElementTree.Element, link: str) -> None:
    """Remove all links that are fixed to a link or move on it, with their joints."""
    for joint in root.findall("joint"):
        parent, child = joint.find("parent"), joint.find("child")
        if parent is not None and child is not None and parent.get("link") == link:
            root.remove(joint)
            _remove_children(root, child.get("link", ""))
            for part in root.findall("link"):
                if part.get("name") == child.get("link"):
                    root.remove(part)


def _rename(part: ElementTree.Element, taken: Collection[tuple[str, str]]) -> None:
    """Put :data:`PREFIX` before the names that the arm has, where they are given and where they are referred to."""
    for element in part.iter():
        if element is part or element.tag == "material":
            kind, key = element.tag, "name"
        else:
            kind, key = _REFERENCES.get(element.tag, ("", ""))
        if (kind, element.get(key, "")) in taken:
            element.set(key, PREFIX + element.get(key, ""))


_REFERENCES = {"parent": ("link", "link"), "child": ("link", "link"), "mimic": ("joint", "joint")}
"""Elements that refer to others: the kind of what they refer to, and the attribute with its name."""


def _roll_pitch_yaw(pose: Pose) -> tuple[float, float, float]:
    m = pose.matrix()
    level = hypot(m[0, 0], m[1, 0])
    if level > 1e-9:
        return atan2(m[2, 1], m[2, 2]), atan2(-m[2, 0], level), atan2(m[1, 0], m[0, 0])
    return atan2(-m[1, 2], m[1, 1]), atan2(-m[2, 0], level), 0.0
