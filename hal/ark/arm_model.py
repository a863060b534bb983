"""A model for an arm that the hal does not know: what Ark's file and the URDF say, and what a person must still say."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..kinematics.urdf import UrdfJoint
from .ledger import Ledger
from .links import ArkUrdf
from .reading import Node, Reading
from .text import Commented, Inline, Remark

__all__ = ["ArmModel", "arm_model"]

TO_SPEED, TO_ACCELERATION = 0.3, 0.02
"""s from rest to full speed, and to full acceleration: what docs/your-own-arm.md calls gentle."""
SLOWEST, FASTEST = {"prismatic": 0.1}, {"prismatic": 0.25}
"""m/s: taken where a URDF names no speed, and the most that is believed of one."""
SLOW, FAST = 0.5, 3.2
"""rad/s, for joints that turn."""


@dataclass(frozen=True)
class ArmModel:
    """A model's file, to be written beside the rig."""

    given: str
    """The robot's name in Ark's file."""
    entries: Mapping[str, Any]
    to_fill_in: tuple[str, ...]
    """What Ark's files do not know, in words."""


def arm_model(given: str, node: Node, urdf: ArkUrdf, merged: bool, reading: Reading, ledger: Ledger) -> ArmModel:
    """From a robot's ``config``. Raises Wrong; the problem is noted."""
    order = urdf.order(merged)
    joints = _joints(node, urdf, order, reading, ledger)
    link, guessed = _tcp(node, urdf, order, joints, reading, ledger)
    speeds, odd = _speeds(joints)
    accelerations = [round(speed / TO_SPEED, 3) for speed in speeds]
    entries: dict[str, Any] = {
        "#head": Remark(
            f"Made from Ark's {node.file.name} and {urdf.model.path.name}. Ark has no limits of acceleration and\n"
            "jerk: lines with CHECK were chosen here, for simulation. No driver of the real arm is named, since none\n"
            "shall move by guessed limits. docs/your-own-arm.md says how to go on."
        ),
        "description": f"{given}, imported from Ark",
        "urdf": urdf.model.path,
        "drivers": Inline(sim="pybullet"),
        "joints": [joint.name for joint in joints],
        "tcp": Commented(
            Inline(link=link, position=[0, 0, 0]),
            "CHECK: " + ("the last joint's link" if guessed else "Ark's ee_index") + "; add your tool's length",
        ),
        "home": _home(node, order, joints, reading, ledger),
        "limits": {
            "#positions": Remark("Positions and torques are the URDF's."),
            "velocity": Commented(speeds, "CHECK, rad/s: " + ("; ".join(odd) if odd else "the URDF's")),
            "acceleration": Commented(accelerations, f"CHECK, rad/s2: full speed in {TO_SPEED:g} s"),
            "jerk": Commented(
                [round(value / TO_ACCELERATION, 1) for value in accelerations],
                f"CHECK, rad/s3: full acceleration in {TO_ACCELERATION:g} s",
            ),
        },
    }
    to_fill_in = (
        "limits.acceleration and limits.jerk: chosen here, from the speeds",
        *(f"limits.velocity: {text}" for text in odd),
        "tcp: the tool's length and direction",
        "gripper: left out; width, speed and force of yours",
        "drivers.real: none",
    )
    return ArmModel(given, entries, to_fill_in)


def _joints(node: Node, urdf: ArkUrdf, order: list[UrdfJoint], reading: Reading, ledger: Ledger) -> list[UrdfJoint]:
    """The arm's joints, from base to tip: those of the group ``arm``, or what is in no gripper."""
    groups = node.get("joint_groups")
    named: dict[str, Node] = {}
    for name, group in (groups.children if groups is not None else {}).items():
        names = reading.need(reading.keys(group), "joints")
        named[name] = names
        for k, joint in enumerate(reading.words(names)):
            if joint not in urdf.model.joints:
                raise reading.wrong(names, f"item {k + 1}: {urdf.model.path.name} has no joint {joint!r}")
        ledger.changed(group.get("control_mode"), "", "each command says it: JointTarget, JointVelocity, ...")
    moving = [joint for joint in (order or urdf.model.joints.values()) if joint.movable]
    fingers = {joint for name, names in named.items() if "grip" in name.lower() for joint in names.data}
    chosen = "arm" if "arm" in named else "all" if "all" in named else next(iter(named), "")
    wanted = [urdf.model.joints[joint] for joint in named[chosen].data if joint not in fingers] if chosen else []
    joints = [joint for joint in wanted if joint.movable] or [
        joint for joint in moving if joint.kind != "prismatic" and joint.name not in fingers
    ]
    if not joints:
        raise reading.wrong(node, f"{urdf.model.path.name} has no joints that could be an arm's")
    for name, names in named.items():
        if name == chosen:
            fixed = "; without those that are fixed" if any(not joint.movable for joint in wanted) else ""
            ledger.kept(names, "", f"joints, in the model made for it{fixed}")
        elif set(names.data) <= fingers:
            ledger.nothing(names, "no gripper is made of them: width, speed and force are unknown")
        else:
            ledger.nothing(names, "the arm and its gripper are commanded apart")
    return joints


def _tcp(
    node: Node, urdf: ArkUrdf, order: list[UrdfJoint], joints: list[UrdfJoint], reading: Reading, ledger: Ledger
) -> tuple[str, bool]:
    """The tcp's link, and whether it had to be guessed."""
    index = node.get("ee_index")
    last = joints[-1].child
    if index is None:
        return last, True
    number = reading.whole(index)
    if not 0 <= number < len(order):
        ledger.changed(index, "", f"no joint of that number is known here: the tcp is at {last}; CHECK it in the model")
        return last, True
    link = order[number].child
    below = {joint.name for joint in urdf.model.above(link)}
    if not below.issuperset(joint.name for joint in joints):
        ledger.changed(index, "", f"that is {link}, which not every joint moves: the tcp is at {last}; CHECK it")
        return last, True
    ledger.kept(index, "", f"tcp.link: {link}, in the model made for it")
    return link, False


def _home(
    node: Node, order: list[UrdfJoint], joints: list[UrdfJoint], reading: Reading, ledger: Ledger
) -> list[float | int]:
    initial = node.get("initial_configuration")
    if initial is None:
        return [0] * len(joints)
    values = reading.numbers(initial)
    numbers = {joint.name: k for k, joint in enumerate(order)}
    if len(values) == len(joints):
        ledger.kept(initial, "", "home, in the model made for it")
        return values
    places = [numbers.get(joint.name, len(values)) for joint in joints]
    if max(places) >= len(values):
        raise reading.wrong(
            initial, f"has {len(values)} numbers, and {joints[-1].name} is none of the first as many joints"
        )
    ledger.changed(initial, "", f"home, in the model made for it: the {len(joints)} numbers of the arm's joints")
    return [values[place] for place in places]


def _speeds(joints: list[UrdfJoint]) -> tuple[list[float], list[str]]:
    """Of each joint, and in words what is not the URDF's."""
    speeds, odd = [], []
    for joint in joints:
        least, most = SLOWEST.get(joint.kind, SLOW), FASTEST.get(joint.kind, FAST)
        if not joint.velocity or joint.velocity <= 0.0:
            speeds.append(least)
            odd.append(f"{joint.name} has none in the URDF")
        elif joint.velocity > most:
            speeds.append(most)
            odd.append(f"{joint.name} has {joint.velocity:g} in the URDF, which looks like a placeholder")
        else:
            speeds.append(joint.velocity)
    return speeds, odd
