"""Model of an arm that has none here: from Ark's file and a URDF, with a list of what the user must still fill in."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hal.geometry import Pose
from hal.kinematics.urdf import UrdfJoint, read_urdf
from hal.registry import SIMULATION

from .output import Commented, Inline, KeyReport, Remark
from .reading import ArkNode, ArkReader


class ArkUrdf:
    """Joints and links of a URDF as Ark counts and places them, through PyBullet.

    Raises:
        ValueError: The URDF is invalid.
        OSError: The file cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.model = read_urdf(path)

    def is_fixed(self, link: str) -> bool:
        """Return whether a fixed joint connects it to its parent."""
        return any(joint.kind == "fixed" and joint.child == link for joint in self.model.joints.values())

    def order(self, merged: bool) -> list[UrdfJoint]:
        """Return the joints as PyBullet numbers them: down each branch, in the order of the file.

        With ``merged`` fixed ones do not count, and the list ends where the moving ones branch: PyBullet goes through
        branches that it has merged in an order of its own.
        """
        if not merged:
            return list(self._find_joints_below(self.model.root))
        chain: list[UrdfJoint] = []
        following = self._moving(self.model.root)
        while len(following) == 1:
            chain += following
            following = self._moving(following[0].child)
        return chain

    def _find_joints_below(self, link: str) -> Iterator[UrdfJoint]:
        for joint in self.model.joints.values():
            if joint.parent == link:
                yield joint
                yield from self._find_joints_below(joint.child)

    def _moving(self, link: str) -> list[UrdfJoint]:
        """Return the next joints that are not fixed."""
        found = []
        for joint in self.model.joints.values():
            if joint.parent == link:
                found += self._moving(joint.child) if joint.kind == "fixed" else [joint]
        return found

    def place(self, link: str, known: Collection[str]) -> tuple[str, Pose] | None:
        """Return the centre of mass of a link, which Ark measures from, as a link in ``known`` and a pose in its frame.

        Returns None unless fixed joints alone connect the link to one in ``known``.
        """
        if link not in self.model.links:
            return None
        pose = self.model.links[link].inertial or Pose()
        at = link
        for joint in self.model.above(link):
            if at in known:
                break
            if joint.kind != "fixed":
                return None
            pose = joint.origin @ pose
            at = joint.parent
        return (at, pose) if at in known else None


TO_SPEED, TO_ACCELERATION = 0.3, 0.02
"""s from rest to full speed, and to full acceleration: what docs/your-own-arm.md calls gentle."""
SLOWEST, FASTEST = {"prismatic": 0.1}, {"prismatic": 0.25}
"""m/s: default for a URDF without a speed, and the largest accepted one."""
SLOW, FAST = 0.5, 3.2
"""The same for revolute joints, rad/s."""


@dataclass(frozen=True)
class ArmModel:
    """A model's file, which is written beside the rig."""

    given: str
    """The robot's name in Ark's file."""
    entries: Mapping[str, Any]
    to_fill_in: tuple[str, ...]
    """Values that the user must check, as text."""


def arm_model(
    given: str, node: ArkNode, urdf: ArkUrdf, merged: bool, reading: ArkReader, ledger: KeyReport
) -> ArmModel:
    """Return a model made from a robot's ``config``. Raises InvalidValue; the problem is noted."""
    order = urdf.order(merged)
    joints = _joints(node, urdf, order, reading, ledger)
    link, guessed = _tcp(node, urdf, order, joints, reading, ledger)
    speeds, odd = _speeds(joints)
    accelerations = [round(speed / TO_SPEED, 3) for speed in speeds]
    entries: dict[str, Any] = {
        "#head": Remark(
            f"Made from Ark's {node.file.name} and {urdf.model.path.name}. Ark has no limits of acceleration and\n"
            "jerk: lines with CHECK are defaults for simulation. There is no driver of the real arm, because it must\n"
            "not move with guessed limits. Next steps: docs/your-own-arm.md."
        ),
        "description": f"{given}, imported from Ark",
        "urdf": urdf.model.path,
        "drivers": Inline(sim=SIMULATION),
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


def _joints(
    node: ArkNode, urdf: ArkUrdf, order: list[UrdfJoint], reading: ArkReader, ledger: KeyReport
) -> list[UrdfJoint]:
    """Return the arm's joints, from base to tip: those of the group ``arm``, or all outside a gripper."""
    groups = node.get("joint_groups")
    named: dict[str, ArkNode] = {}
    for name, group in (groups.children if groups is not None else {}).items():
        names = reading.need(reading.keys(group), "joints")
        named[name] = names
        for k, joint in enumerate(reading.words(names)):
            if joint not in urdf.model.joints:
                message = f"item {k + 1}: {urdf.model.path.name} has no joint {joint!r}"
                raise reading.wrong(names, message, "unknown_joint")
        ledger.changed(group.get("control_mode"), "", "chosen by each command: JointTarget, JointVelocity, ...")
    moving = [joint for joint in (order or urdf.model.joints.values()) if joint.movable]
    fingers = {joint for name, names in named.items() if "grip" in name.lower() for joint in names.data}
    chosen = "arm" if "arm" in named else "all" if "all" in named else next(iter(named), "")
    wanted = [urdf.model.joints[joint] for joint in named[chosen].data if joint not in fingers] if chosen else []
    joints = [joint for joint in wanted if joint.movable] or [
        joint for joint in moving if joint.kind != "prismatic" and joint.name not in fingers
    ]
    if not joints:
        message = f"{urdf.model.path.name} has no joints that could be an arm's"
        raise reading.wrong(node, message, "unknown_joint")
    for name, names in named.items():
        if name == chosen:
            fixed = "; without those that are fixed" if any(not joint.movable for joint in wanted) else ""
            ledger.kept(names, "", f"joints, in the model made for it{fixed}")
        elif set(names.data) <= fingers:
            ledger.ignored(names, "not imported as a gripper: width, speed and force are unknown")
        else:
            ledger.ignored(names, "arm and gripper are commanded separately")
    return joints


def _tcp(
    node: ArkNode, urdf: ArkUrdf, order: list[UrdfJoint], joints: list[UrdfJoint], reading: ArkReader, ledger: KeyReport
) -> tuple[str, bool]:
    """Return the tcp's link, and whether it is a guess."""
    index = node.get("ee_index")
    last = joints[-1].child
    if index is None:
        return last, True
    number = reading.whole(index)
    if not 0 <= number < len(order):
        ledger.changed(index, "", f"there is no joint of that number: the tcp is at {last}; CHECK it in the model")
        return last, True
    link = order[number].child
    below = {joint.name for joint in urdf.model.above(link)}
    if not below.issuperset(joint.name for joint in joints):
        ledger.changed(index, "", f"that is {link}, which not every joint moves: the tcp is at {last}; CHECK it")
        return last, True
    ledger.kept(index, "", f"tcp.link: {link}, in the model made for it")
    return link, False


def _home(
    node: ArkNode, order: list[UrdfJoint], joints: list[UrdfJoint], reading: ArkReader, ledger: KeyReport
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
            initial,
            f"has {len(values)} numbers, and {joints[-1].name} is not among the first {len(values)} joints",
            "wrong_count",
        )
    ledger.changed(initial, "", f"home, in the model made for it: the {len(joints)} numbers of the arm's joints")
    return [values[place] for place in places]


def _speeds(joints: list[UrdfJoint]) -> tuple[list[float], list[str]]:
    """Return the speed of each joint, and notes on those that are not the URDF's."""
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
