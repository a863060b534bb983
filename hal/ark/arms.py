"""Ark's robots: an arm that the hal knows, or a model made from the URDF that Ark's file names."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from ..config.data_files import list_data
from ..config.files import nearest
from ..geometry import Pose
from .arm_model import ArmModel, arm_model
from .items import Item, Work
from .known import FIXED_LINKS, FRANKAS, JOINT_COUNTS, LINKS, TCP_LINK, KnownArm, franka_with
from .ledger import Ledger
from .links import ArkUrdf
from .options import Options
from .places import Places
from .posing import position_of, rotation_of
from .reading import Node, Reading
from .real_config import import_real
from .text import Commented, Inline, plain

__all__ = ["Arm", "import_arm"]


@dataclass
class Arm:
    """A robot as it will stand in the rig."""

    name: str
    given: str
    """Its name in Ark's file."""
    known: KnownArm | None
    """The hal's model; None where one is made."""
    urdf: ArkUrdf | None
    """Ark's, where it was found."""
    merged: bool
    """Does PyBullet merge its fixed links?"""
    entry: dict[str, Any] = field(default_factory=dict)
    made: ArmModel | None = None

    def place(self, link: str | None) -> tuple[str, Pose, str] | None:
        """Where Ark counts from on a link: a link of the model, a pose in its frame, and what a person should know.

        ``link=None`` is Ark's word for the base. None where the arm has no such link.
        """
        links = self.known.links if self.known is not None else tuple(self.urdf.model.links) if self.urdf else ()
        if link is None:
            base = self.known.base_link if self.known is not None else self.urdf.root if self.urdf else links[0]
            return base, Pose(), "Ark's file names no link, which means the base"
        found = self.urdf.place(link, links) if self.urdf is not None else None
        gone = found is None and self.urdf is not None and link not in self.urdf.model.links
        if found is None and self.known is not None:
            found = self.known.place(link)
        if found is None:
            return None
        at, pose = found
        if self.merged and (self.urdf.is_fixed(link) if self.urdf is not None else link in FIXED_LINKS):
            return at, pose, f"Ark merges {link} with another link, and then counts from the base"
        if gone and link in LINKS:
            return at, pose, f"Ark's URDF has no {link} any more, and Ark then counts from the base; it was on {at}"
        return at, pose, "" if at == link else f"{link} is fixed to {at}, and no link of this model"


def import_arm(item: Item, work: Work) -> Arm:
    """An entry of ``robots``. Raises Wrong; the problem is noted."""
    name, given, node, key = item
    reading, ledger, places, options = work.reading, work.ledger, work.places, work.options
    merge = reading.keys(node).get("merge_fixed_links")
    merged = merge is None or reading.flag(merge)
    urdf = _urdf(given, node, reading, places, options)
    model, why = _model(given, node, urdf, reading, options)
    _checks(node, reading, ledger)
    path = node.get("urdf_path")
    if model is not None:
        arm = Arm(name, given, KnownArm(model), urdf, merged)
        arm.entry["model"] = Commented(model, why)
        ledger.changed(path, f"{key}.model", f"{model} brings its own URDF; {why}")
        _groups(node, ledger)
    elif urdf is not None:
        made = arm_model(given, node, urdf, merged, reading, ledger)
        arm = Arm(name, given, None, urdf, merged, made=made)
        arm.entry["model"] = Commented(made, "made from the URDF: look at what it says about limits")
        ledger.changed(path, f"{key}.model", "a model made from it, in a file beside the rig")
    else:
        raise reading.wrong(
            path or node,
            f"there is no file {reading.need(node, 'urdf_path').data!r}, in class_dir or in {places.told()}, and the "
            f"joints are not those of {' or '.join(FRANKAS)}. Say --urdf {given}=FILE, or --arm {given}=MODEL for one "
            f"that the hal knows ({', '.join(list_data('robots'))}), or --without {given}",
        )
    _base(arm, node, key, reading, ledger)
    if arm.known is not None:
        _start(arm, arm.known, node, key, reading, ledger)
        _end_effector(arm, arm.known, node, reading, ledger)
    if arm.known is not None and arm.known.is_franka:
        arm.entry.update(import_real(node, key, arm.known.spec.gripper, reading, ledger))
    else:
        ledger.nothing(node.children.get("real_config"), "no driver here drives the real one")
    return arm


def _urdf(given: str, node: Node, reading: Reading, places: Places, options: Options) -> ArkUrdf | None:
    """Ark's URDF, if it is there: in ``class_dir``, which is relative to where Ark starts."""
    path, folder = node.get("urdf_path"), node.get("class_dir")
    if given in options.urdfs:
        found: Path | None = options.urdfs[given].resolve()
        if found is None or not found.is_file():
            raise reading.wrong(path or node, f"there is no file {found}, which --urdf names")
    elif path is None:
        return None
    else:
        beside = places.find(reading.text(folder), node.file.parent) if folder is not None else None
        found = places.find(reading.text(path), *([beside] if beside is not None else []), node.file.parent)
    if found is None or not found.is_file():
        return None
    try:
        return ArkUrdf(found)
    except (ValueError, OSError) as error:
        raise reading.wrong(path or node, f"{found}: {error}") from None


def _model(given: str, node: Node, urdf: ArkUrdf | None, reading: Reading, options: Options) -> tuple[str | None, str]:
    """The model of the hal that the robot is, and how that is known; None where it is none."""
    if given in options.arms:
        model, there = options.arms[given], list_data("robots")
        if model not in there:
            raise reading.wrong(node, f"--arm {given}={model}: there is no such model{nearest(model, there)}")
        return model, "as --arm says"
    joints = set(urdf.model.joints) if urdf is not None else set()
    groups = node.get("joint_groups")
    for group in groups.children.values() if groups is not None else ():
        names = group.get("joints")
        joints.update(reading.words(names) if names is not None else ())
    franka = franka_with(joints)
    if franka is not None:
        return franka, "its joints have that arm's names"
    path = node.get("urdf_path")
    if urdf is None and not joints and path is not None and "panda" in str(path.data).rpartition("/")[2].lower():
        return "panda", "the name of Ark's URDF says so"
    return None, ""


def _checks(node: Node, reading: Reading, ledger: Ledger) -> None:
    """Keys that only must not say something else."""
    source = node.get("source")
    if source is not None and source.data != "urdf":
        raise reading.wrong(source, f"only a urdf can be taken over, not {source.data!r}")
    ledger.kept(source, "", "every arm has one")
    fixed = node.get("use_fixed_base")
    if fixed is not None and not reading.flag(fixed):
        raise reading.wrong(fixed, "an arm stands fixed here; a robot that drives or falls has no counterpart")
    ledger.kept(fixed, "", "every arm is")
    ledger.nothing(node.children.get("class_dir"), "models and drivers are found by name")
    ledger.nothing(node.children.get("merge_fixed_links"), "links keep their names")
    ledger.nothing(
        node.children.get("frequency"),
        "a simulated arm is driven at simulation.physics_hz; control(rate_hz=) says how often a program commands",
    )


def _groups(node: Node, ledger: Ledger) -> None:
    """Joint groups of an arm whose model has its joints already."""
    groups = node.get("joint_groups")
    for name, group in (groups.children if groups is not None else {}).items():
        hand = name == "gripper"
        if name in ("arm", "gripper"):
            ledger.kept(group.get("joints"), "", f"the {name}'s, in the model")
        else:
            ledger.nothing(group.get("joints"), "one command has both: control.send(command, width=metres)")
        does = "arm.gripper.move(width in m)" if hand else "each command says it: JointTarget, JointVelocity, ..."
        ledger.changed(group.get("control_mode"), "", does)


def _base(arm: Arm, node: Node, key: str, reading: Reading, ledger: Ledger) -> None:
    position = position_of(node, "base_position", f"{key}.base.position", reading, ledger)
    rotation = rotation_of(node, "base_orientation", f"{key}.base.orientation", reading, ledger)
    base = Inline({"position": position} if position is not None else {})
    comment = ""
    if rotation is not None and rotation.turns:
        base["orientation"] = plain(rotation.value, Path())
        comment = rotation.value.comment if isinstance(rotation.value, Commented) else ""
    if base:
        arm.entry["base"] = Commented(base, comment) if comment else base


def _start(arm: Arm, known: KnownArm, node: Node, key: str, reading: Reading, ledger: Ledger) -> None:
    """The joints of a known arm come first in Ark's list; behind them fixed joints and fingers."""
    initial = node.get("initial_configuration")
    if initial is None:
        return
    home = known.spec.home
    values = reading.numbers(initial)
    if len(values) < len(home) or (known.is_franka and len(values) not in JOINT_COUNTS):
        counts = ", ".join(map(str, JOINT_COUNTS)) if known.is_franka else f"at least {len(home)}"
        raise reading.wrong(initial, f"has {len(values)} numbers; in Ark {known.name} has {counts} joints")
    q, rest = values[: len(home)], values[len(home) :]
    notes = [f"the first {len(q)} of {len(values)}; the others are fixed joints and fingers"] if rest else []
    if known.spec.gripper is not None and not any(rest):
        notes.append("a simulated hand starts open, not closed")
    if max(abs(a - b) for a, b in zip(q, home, strict=True)) < 1e-6:
        ledger.kept(initial, "", "; ".join(["the model's home, where a simulation starts", *notes]))
        return
    arm.entry["initial"] = Commented(q, "where a simulation starts; home is the model's")
    ledger.changed(initial, f"{key}.initial", "; ".join(["where a simulation starts; home is the model's", *notes]))


def _end_effector(arm: Arm, known: KnownArm, node: Node, reading: Reading, ledger: Ledger) -> None:
    index = node.get("ee_index")
    if index is None:
        return
    number = reading.whole(index)
    names = [joint.child for joint in arm.urdf.order(arm.merged)] if arm.urdf is not None else []
    link = names[number] if 0 <= number < len(names) else ""
    if not names and known.is_franka and not arm.merged and number == TCP_LINK:
        link = "tcp_link"
    far = ": 3.4 mm before it, and turned by half a turn about z" if link == "tcp_link" and known.is_franka else ""
    which = f"Ark's {link}{far}" if link else f"Ark's link {number}"
    ledger.changed(index, "", f"the model's tcp, {_tcp(known)}, not {which}")


def _tcp(known: KnownArm) -> str:
    return "between the fingertips" if known.is_franka else f"at {known.spec.kinematics.tcp_link}"
