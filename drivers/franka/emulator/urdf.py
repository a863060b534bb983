"""What of a URDF goes to the client: the arm itself, without the hand and without shapes, under Franka's own names.

The client's library looks for a frame called exactly ``link8`` without asking whether there is one, and for seven
joints: with another name it reads beyond its memory when it loads the model.
"""

from __future__ import annotations

import re
import xml.etree.ElementTree as ElementTree

__all__ = ["arm_only", "without_shapes"]

_PREFIX = re.compile(r"^.*_(?=(link|joint)\d$)")


def without_shapes(urdf: str) -> str:
    """The same links and joints, with masses only. Raises ValueError when it is no XML."""
    root = _parsed(urdf)
    for link in root.findall("link"):
        for name in ("visual", "collision"):
            for shape in link.findall(name):
                link.remove(shape)
    return ElementTree.tostring(root, encoding="unicode")


def arm_only(urdf: str) -> str:
    """From the base to the link whose name ends in ``link8``, without shapes, and without prefixes before ``link`` and
    ``joint``. Raises ValueError without such a link.
    """
    root = _parsed(without_shapes(urdf))
    joints = {_end(joint, "child"): joint for joint in root.findall("joint")}
    link = next((name for name in joints if name.endswith("link8")), None)
    if link is None:
        raise ValueError("the URDF has no link whose name ends in 'link8', the flange")
    kept = {link}
    while link in joints:
        link = _end(joints[link], "parent")
        kept.add(link)
    for joint in joints.values():
        if _end(joint, "child") not in kept:
            root.remove(joint)
    for element in root.findall("link"):
        if element.get("name") not in kept:
            root.remove(element)
    for element in root.iter():
        for key in ("name", "link"):
            if key in element.attrib:
                element.set(key, _PREFIX.sub("", element.attrib[key]))
    return ElementTree.tostring(root, encoding="unicode")


def _parsed(urdf: str) -> ElementTree.Element:
    try:
        return ElementTree.fromstring(urdf)
    except ElementTree.ParseError as error:
        raise ValueError(f"the URDF is not valid XML: {error}") from None


def _end(joint: ElementTree.Element, which: str) -> str:
    element = joint.find(which)
    return "" if element is None else element.get("link", "")
