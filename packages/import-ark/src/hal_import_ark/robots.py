"""Conversion of Ark's robots: to a built-in model, or to a model made from the URDF."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from hal.config import load
from hal.config.data_files import list_data
from hal.errors import suggest
from hal.geometry import Pose
from hal.kinematics.urdf import read_urdf
from hal.specs import GripperSpec, RobotSpec

from .arm_model import ArkUrdf, ArmModel, arm_model
from .entries import ArkItem, ArkOptions, ImportState, position_of, rotation_of
from .output import Commented, Inline, KeyReport, Remark, plain
from .reading import ArkNode, ArkReader, FileFinder

FRANKAS = {"panda": "panda_", "fr3": "fr3_"}
"""Models of Franka's arms, and the prefix of their joints and links."""
JOINT_COUNTS = (7, 9, 10, 12)
"""Numbers of joints of Ark's Panda: the arm; with the fingers (fixed joints merged); with the hand's fixed joint; with
those of its camera and its tcp."""
LINKS = {
    "camera_link": ("panda_hand", Pose.from_rpy([-0.05, 0.0, 0.0], [1.3, 0.0, -1.57])),
    "tcp_link": ("panda_hand", Pose.from_rpy([0.0, 0.0, 0.1], [0.0, 0.0, 3.14])),
}
"""Links that ark_franka's URDF had besides Franka's own in July 2025: parent link and pose. The centre of mass of every
link is at its origin."""
FIXED_LINKS = ("panda_hand", *LINKS)
"""Links of that URDF that PyBullet can merge with others."""
TCP_LINK = 11
"""Index of ``tcp_link`` in that URDF."""


class KnownArm:
    """A built-in model."""

    def __init__(self, name: str) -> None:
        self.name = name
        self.spec: RobotSpec = load({"robots": {"arm": {"model": name}}}, driver="mock").resolve().robots[0]
        self.links = tuple(read_urdf(Path(self.spec.urdf)).links)

    @property
    def base_link(self) -> str:
        """Link of its base."""
        return self.spec.kinematics.base_link or self.links[0]

    @property
    def is_franka(self) -> bool:
        """Whether it is a Panda or an FR3."""
        return self.name in FRANKAS

    def place(self, link: str) -> tuple[str, Pose] | None:
        """Return a link of Ark's Panda as a link of this arm and a pose in its frame; None if it has no such link."""
        own, pose = LINKS.get(link, (link, Pose()))
        if self.is_franka:
            own = FRANKAS[self.name] + own.removeprefix("panda_")
        return (own, pose) if own in self.links else None


def franka_with(joints: set[str]) -> str | None:
    """Return the model of Franka's arm with these joints; None if neither has them."""
    for model, prefix in FRANKAS.items():
        if joints.issuperset(f"{prefix}joint{k}" for k in range(1, 8)):
            return model
    return None


MOST_SPEED = 0.3
"""Largest share of the joint speeds that an import sets, the rig's default; users may write more."""


def import_real(
    node: ArkNode, key: str, hand: GripperSpec | None, reading: ArkReader, ledger: KeyReport
) -> dict[str, Any]:
    """Return the entries of a Franka from ``real_config``: addresses, and low speeds. The rig stays simulated.

    Args:
        node: The robot's ``config``.
        key: The robot's key in the rig.
        hand: Its gripper.
        reading: Checks values.
        ledger: Receives the outcome of every key.
    """
    entries: dict[str, Any] = {
        "#workspace": Remark(
            "workspace: {table_height: 0.01}    # m over the base: Ark has no such bound, a real arm should"
        )
    }
    real = node.get("real_config")
    if real is None:
        entries["#real"] = Remark("real: {host: 172.16.0.2}            # the robot's address, for --real")
        return entries
    reading.keys(real)
    host, own = real.get("robot_ip"), real.get("gripper_ip")
    gripper: dict[str, Any] = {}
    if host is not None:
        entries["real"] = Inline(host=reading.text(host))
        ledger.kept(host, f"{key}.real.host")
    if own is not None and host is not None and own.data == host.data:
        ledger.kept(own, f"{key}.real.host", "the default of the hand is the arm's")
    elif own is not None:
        gripper["real"] = Inline(host=reading.text(own))
        ledger.kept(own, f"{key}.gripper.real.host")
    share = real.get("relative_dynamics_factor")
    if share is not None and reading.number(share, positive=True) <= MOST_SPEED:
        entries["speed"] = Commented(share.data, "Ark's relative_dynamics_factor")
        ledger.changed(share, f"{key}.speed", "share of the joint speeds for commands; move_speed is unchanged")
    else:
        ledger.changed(share, "", f"{key}.speed stays {MOST_SPEED:g} of the joint speeds; increase it by hand")
    speed = real.get("gripper_speed")
    if speed is not None and hand is not None:
        if reading.number(speed, positive=True) <= hand.speed:
            gripper["speed"] = speed.data
            ledger.kept(speed, f"{key}.gripper.speed")
        else:
            ledger.changed(speed, "", f"{hand.speed:g} m/s, the hand's maximum")
    if gripper:
        entries["gripper"] = gripper
    return entries


@dataclass
class ArkArm:
    """A converted robot."""

    name: str
    given: str
    """Name in Ark's file."""
    known: KnownArm | None
    """Built-in model; None if one is made."""
    urdf: ArkUrdf | None
    """Ark's URDF, if it was found."""
    merged: bool
    """Whether PyBullet merges its fixed links."""
    entry: dict[str, Any] = field(default_factory=dict)
    made: ArmModel | None = None

    def place(self, link: str | None) -> tuple[str, Pose, str] | None:
        """Return the frame that Ark measures from on a link: a link of the model, a pose in its frame, and a note.

        ``link=None`` means the base. Returns None if the arm has no such link.
        """
        links = self.known.links if self.known is not None else tuple(self.urdf.model.links) if self.urdf else ()
        if link is None:
            base = self.known.base_link if self.known is not None else self.urdf.model.root if self.urdf else links[0]
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


def import_arm(item: ArkItem, work: ImportState) -> ArkArm:
    """Convert an entry of ``robots``. Raises InvalidValue; the problem is noted."""
    name, given, node, key = item
    reading, ledger, places, options = work.reading, work.ledger, work.places, work.options
    merge = reading.keys(node).get("merge_fixed_links")
    merged = merge is None or reading.flag(merge)
    urdf = _urdf(given, node, reading, places, options)
    model, why = _model(given, node, urdf, reading, options)
    _checks(node, reading, ledger)
    path = node.get("urdf_path")
    if model is not None:
        arm = ArkArm(name, given, KnownArm(model), urdf, merged)
        arm.entry["model"] = Commented(model, why)
        ledger.changed(path, f"{key}.model", f"{model} brings its own URDF; {why}")
        _groups(node, ledger)
    elif urdf is not None:
        made = arm_model(given, node, urdf, merged, reading, ledger)
        arm = ArkArm(name, given, None, urdf, merged, made=made)
        arm.entry["model"] = Commented(made, "made from the URDF: check its limits")
        ledger.changed(path, f"{key}.model", "a model made from it, in a file beside the rig")
    else:
        raise reading.wrong(
            path or node,
            f"there is no file {reading.need(node, 'urdf_path').data!r}, in class_dir or in {places.searched()}, and "
            f"the joints are not those of {' or '.join(FRANKAS)}. Add --urdf {given}=FILE, or --arm {given}=MODEL for "
            f"a built-in model ({', '.join(list_data('robots'))}), or --without {given}",
            "missing_file",
        )
    _base(arm, node, key, reading, ledger)
    if arm.known is not None:
        _start(arm, arm.known, node, key, reading, ledger)
        _end_effector(arm, arm.known, node, reading, ledger)
    if arm.known is not None and arm.known.is_franka:
        arm.entry.update(import_real(node, key, arm.known.spec.gripper, reading, ledger))
    else:
        ledger.ignored(node.children.get("real_config"), "there is no driver for the real one")
    return arm


def _urdf(given: str, node: ArkNode, reading: ArkReader, places: FileFinder, options: ArkOptions) -> ArkUrdf | None:
    """Return Ark's URDF, from ``class_dir``, which is relative to where Ark starts; None if it is not found."""
    path, folder = node.get("urdf_path"), node.get("class_dir")
    if given in options.urdfs:
        found: Path | None = options.urdfs[given].resolve()
        if found is None or not found.is_file():
            raise reading.wrong(path or node, f"there is no file {found}, which --urdf names", "missing_file")
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
        raise reading.wrong(path or node, f"{found}: {error}", "bad_urdf") from None


def _model(
    given: str, node: ArkNode, urdf: ArkUrdf | None, reading: ArkReader, options: ArkOptions
) -> tuple[str | None, str]:
    """Return the robot's built-in model and the reason for the choice; None if there is none."""
    if given in options.arms:
        model, there = options.arms[given], list_data("robots")
        if model not in there:
            message = f"--arm {given}={model}: there is no such model{suggest(model, there)}"
            raise reading.wrong(node, message, "unknown_model")
        return model, "from --arm"
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
        return "panda", "by the name of Ark's URDF"
    return None, ""


def _checks(node: ArkNode, reading: ArkReader, ledger: KeyReport) -> None:
    """Check the keys whose only supported value is the default."""
    source = node.get("source")
    if source is not None and source.data != "urdf":
        raise reading.wrong(
            source, f"must be urdf, not {source.data!r}; nothing else can be imported", "no_counterpart"
        )
    ledger.kept(source, "", "every arm is a URDF")
    fixed = node.get("use_fixed_base")
    if fixed is not None and not reading.flag(fixed):
        raise reading.wrong(fixed, "must be true: mobile and free robots have no counterpart", "no_counterpart")
    ledger.kept(fixed, "", "every arm has a fixed base")
    ledger.ignored(node.children.get("class_dir"), "models and drivers are found by name")
    ledger.ignored(node.children.get("merge_fixed_links"), "links keep their names")
    ledger.ignored(
        node.children.get("frequency"),
        "a simulated arm is driven at simulation.physics_hz; control(rate_hz=) sets the rate of commands",
    )


def _groups(node: ArkNode, ledger: KeyReport) -> None:
    """Report the joint groups of an arm with a built-in model."""
    groups = node.get("joint_groups")
    for name, group in (groups.children if groups is not None else {}).items():
        hand = name == "gripper"
        if name in ("arm", "gripper"):
            ledger.kept(group.get("joints"), "", f"the {name}'s, in the model")
        else:
            ledger.ignored(group.get("joints"), "one command controls both: control.send(command, width=metres)")
        does = "arm.gripper.move(width in m)" if hand else "chosen by each command: JointTarget, JointVelocity, ..."
        ledger.changed(group.get("control_mode"), "", does)


def _base(arm: ArkArm, node: ArkNode, key: str, reading: ArkReader, ledger: KeyReport) -> None:
    position = position_of(node, "base_position", f"{key}.base.position", reading, ledger)
    rotation = rotation_of(node, "base_orientation", f"{key}.base.orientation", reading, ledger)
    base = Inline({"position": position} if position is not None else {})
    comment = ""
    if rotation is not None and rotation.turns:
        base["orientation"] = plain(rotation.value, Path())
        comment = rotation.value.comment if isinstance(rotation.value, Commented) else ""
    if base:
        arm.entry["base"] = Commented(base, comment) if comment else base


def _start(arm: ArkArm, known: KnownArm, node: ArkNode, key: str, reading: ArkReader, ledger: KeyReport) -> None:
    """Convert the start position: a known arm's joints come first in Ark's list, before fixed joints and fingers."""
    initial = node.get("initial_configuration")
    if initial is None:
        return
    home = known.spec.home
    values = reading.numbers(initial)
    if len(values) < len(home) or (known.is_franka and len(values) not in JOINT_COUNTS):
        counts = ", ".join(map(str, JOINT_COUNTS)) if known.is_franka else f"at least {len(home)}"
        raise reading.wrong(
            initial, f"has {len(values)} numbers; in Ark {known.name} has {counts} joints", "wrong_count"
        )
    q, rest = values[: len(home)], values[len(home) :]
    notes = [f"the first {len(q)} of {len(values)}; the others are fixed joints and fingers"] if rest else []
    if known.spec.gripper is not None and not any(rest):
        notes.append("a simulated hand starts open, not closed")
    if max(abs(a - b) for a, b in zip(q, home, strict=True)) < 1e-6:
        ledger.kept(initial, "", "; ".join(["the model's home, where a simulation starts", *notes]))
        return
    arm.entry["initial"] = Commented(q, "where a simulation starts; home is the model's")
    ledger.changed(initial, f"{key}.initial", "; ".join(["where a simulation starts; home is the model's", *notes]))


def _end_effector(arm: ArkArm, known: KnownArm, node: ArkNode, reading: ArkReader, ledger: KeyReport) -> None:
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
