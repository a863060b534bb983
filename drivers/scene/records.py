"""What every engine needs of the records of arms and objects before it loads them, and what is wrong with them."""

from __future__ import annotations

from collections.abc import Collection, Iterator, Mapping
from dataclasses import dataclass, field

from hal.errors import ConfigError, Problem
from hal.kinematics.hulls import Hull, mesh_hulls
from hal.kinematics.urdf import UrdfMimic, UrdfModel, parse_xml
from hal.specs import PRIMITIVES, BodySpec, GripperSpec, RobotSpec

from .values import listed

PAD_FRICTION = (1.0, 0.1)
"""Lateral and spinning friction of a gripper's pads: rubber."""
UNKNOWN_EFFORT = 200.0
"""Effort, Nm or N, of a joint without a limit (a URDF's effort of 0 means unknown, not powerless)."""
UNKNOWN_SPEED = 2.0
"""Speed, rad/s or m/s, of a joint without a limit."""


def primitive_size(spec: BodySpec) -> tuple[float, ...]:
    """Return the size of a primitive shape, m: half extents of a box, radius, or radius and length; a plane has none.

    Raises ConfigError if the record lacks it, or there is no such shape.
    """
    if spec.shape not in PRIMITIVES:
        message = f"is {spec.shape!r}; shapes: {', '.join(PRIMITIVES)}, mesh, urdf"
        raise ConfigError([Problem("objects", f"objects.{spec.name}.shape", message, "unknown_shape")])
    for name in PRIMITIVES[spec.shape]:
        if getattr(spec, name) is None:
            message = f"is missing, and a {spec.shape} needs it"
            raise ConfigError([Problem("objects", f"objects.{spec.name}.{name}", message, "missing_key")])
    sizes = [getattr(spec, name) for name in PRIMITIVES[spec.shape]]
    return tuple(float(side) for side in (sizes[0] if spec.shape == "box" else sizes))


def hulls_of(spec: BodySpec) -> tuple[Hull, ...]:
    """Return the hulls that collide of an object of the shape ``mesh``. Raises ConfigError, which names the file."""
    key = f"objects.{spec.name}.mesh"
    if spec.mesh is None:
        raise ConfigError([Problem("objects", key, "is missing, and the shape is mesh", "missing_key")])
    try:
        return mesh_hulls(spec.mesh, spec.scale, parts=spec.parts)
    except OSError as error:
        raise ConfigError([Problem(spec.mesh, key, f"cannot be read: {error.strerror}", "missing_file")]) from None
    except ValueError as error:
        raise ConfigError([Problem(spec.mesh, key, str(error), "bad_mesh")]) from None


def check_names(spec: RobotSpec, movable: Collection[str], links: Collection[str]) -> None:
    """Raise ConfigError unless every joint that the record names is movable, and its base link exists."""
    key = f"robots.{spec.name}"
    fingers = spec.gripper.joints if spec.gripper else ()
    problems = [
        Problem(
            spec.urdf,
            f"{key}.{where}",
            f"has no movable joint {name!r}; movable: {', '.join(sorted(movable))}",
            "unknown_joint",
        )
        for where, names in (("joints", spec.joints), ("gripper.joints", fingers))
        for name in names
        if name not in movable
    ]
    base_link = spec.kinematics.base_link
    if base_link is not None and base_link not in links:
        message = f"has no link {base_link!r}; links: {', '.join(links)}"
        problems.append(Problem(spec.urdf, f"{key}.base_link", message, "unknown_link"))
    if problems:
        raise ConfigError(problems)


@dataclass
class JointDrives:
    """Start and limits of the joints of an arm and its gripper, by joint."""

    home: dict[str, float] = field(default_factory=dict)
    """Initial position, rad or m."""
    efforts: dict[str, float] = field(default_factory=dict)
    """Greatest torque or force, Nm or N."""
    speeds: dict[str, float] = field(default_factory=dict)
    """Greatest speed, rad/s or m/s."""
    warnings: list[str] = field(default_factory=list)


def joint_drives(spec: RobotSpec, limits: Mapping[str, tuple[float, float]], urdf: UrdfModel) -> JointDrives:
    """Return the drives of an arm's movable joints. Joints that follow others by a ``<mimic>`` have no motor.

    ``limits`` are effort and speed of every movable joint in the URDF, 0 if unknown; the record's own win.
    """
    drives = JointDrives()
    fingers = spec.gripper.joints if spec.gripper else ()
    opened = spec.gripper.finger_positions(spec.gripper.width_max) if spec.gripper else []
    without: list[str] = []
    for name, (effort, speed) in limits.items():
        drives.home[name] = 0.0
        if name in spec.joints:
            place = spec.joints.index(name)
            drives.home[name] = spec.initial[place]
            speed = spec.limits.velocity[place]
            effort = spec.limits.torque[place] if spec.limits.torque else effort
        elif name in fingers:
            drives.home[name] = opened[fingers.index(name)]
        if effort <= 0.0:
            without.append(name)
        drives.efforts[name] = effort if effort > 0.0 else UNKNOWN_EFFORT
        drives.speeds[name] = speed if speed > 0.0 else UNKNOWN_SPEED
    for mimic in followers_of(spec, urdf):
        drives.home[mimic.joint] = mimic.multiplier * drives.home[mimic.of] + mimic.offset
        drives.efforts[mimic.joint] = 0.0
    if without:
        text = f"{spec.name}: no effort limit of {listed(without)}; {UNKNOWN_EFFORT:g} Nm (N) is used"
        drives.warnings.append(text)
    return drives


def followers_of(spec: RobotSpec, urdf: UrdfModel) -> tuple[UrdfMimic, ...]:
    """Return the joints that follow fingers and are no driven fingers themselves."""
    fingers = spec.gripper.joints if spec.gripper else ()
    driven = {*fingers, *spec.joints}
    return tuple(one for one in mimics_of(spec, urdf) if one.of in fingers and one.joint not in driven)


def pad_links(spec: BodySpec | RobotSpec, urdf: UrdfModel) -> dict[str, tuple[float, float] | None]:
    """Return the links that the gripper holds things with, and their lateral and spinning friction.

    They are its fingers; a single jaw closes on the link that carries it. The friction is that of rubber
    (:data:`PAD_FRICTION`); None where the file has a ``<contact>`` of its own.
    """
    if not isinstance(spec, RobotSpec) or spec.gripper is None:
        return {}
    fingers = spec.gripper.joints
    moved = {*fingers, *(one.joint for one in followers_of(spec, urdf))}
    pads = {link for link in urdf.links if any(joint.name in moved for joint in urdf.above(link))}
    if len(moved) == 1:
        pads.add(urdf.joints[fingers[0]].parent)
    given = {link.get("name") for link in parse_xml(urdf.path).findall("link") if link.find("contact") is not None}
    return {
        name: None if name in given else PAD_FRICTION
        for name, link in urdf.links.items()
        if name in pads and link.collisions
    }


def mimics_of(spec: BodySpec | RobotSpec, urdf: UrdfModel) -> tuple[UrdfMimic, ...]:
    """Return which joints follow others; an arm's fingers move together even if the URDF does not say so."""
    fingers = spec.gripper.joints if isinstance(spec, RobotSpec) and spec.gripper else ()
    if isinstance(spec, RobotSpec) and spec.gripper and spec.gripper.opened:
        mimics = (*urdf.mimics, *_couplings(spec.gripper, {mimic.joint for mimic in urdf.mimics}))
    else:
        mimics = urdf.mimics or tuple(UrdfMimic(finger, fingers[0], 1.0, 0.0) for finger in fingers[1:])
    return tuple(mimic for mimic in mimics if mimic.of in urdf.joints and mimic.multiplier != 0.0)


def _couplings(gripper: GripperSpec, known: Collection[str]) -> Iterator[UrdfMimic]:
    """Yield how the driven fingers follow the first one, without those that the URDF couples."""
    far, shut = gripper.opened[0], gripper.closed[0]
    for name, opened, closed in zip(gripper.joints[1:], gripper.opened[1:], gripper.closed[1:], strict=True):
        if name not in known:
            ratio = (opened - closed) / (far - shut)
            yield UrdfMimic(name, gripper.joints[0], ratio, closed - ratio * shut)
