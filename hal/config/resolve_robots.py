"""Resolve an arm of a rig: its model, its URDF and the rig's entry become one :class:`~hal.specs.RobotSpec`.

Limits are the model's, completed from the URDF, tightened by ``real_limits`` where the arm is real, then by the rig.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, NamedTuple

from .. import registry
from ..errors import suggest
from ..kinematics.composition import divide_urdf
from ..kinematics.urdf import TURNING, UrdfJoint, UrdfModel, read_urdf
from ..specs import (
    Floats,
    GripperSpec,
    KinematicsSpec,
    LimitsSpec,
    PayloadSpec,
    RobotSpec,
    Vector3,
    WorkspaceSpec,
)
from .context import Context, check_robot_spec, is_emulated, load_arm, merge_options
from .files import Problems
from .models import UNITS, LimitsModel, RobotModel
from .rigfile import LimitsConfig, RobotConfig, WorkspaceConfig
from .schema import Quantity, Unknown

MOST_REAL = {
    "velocity": Quantity("rad/s", 0.0, 15.0, above=True),
    "acceleration": Quantity("rad/s2", 0.0, 100.0, above=True),
    "jerk": Quantity("rad/s3", 0.0, 20000.0, above=True),
    "torque": Quantity("Nm", 0.0, 1000.0, above=True),
}
"""Bounds on the limits of a real arm, which no file can loosen. The fastest joints of arms on a bench reach about
12 rad/s; a Panda's jerk limit is 10000 rad/s3."""
MOST_REAL_TCP_SPEED = Quantity("m/s", 0.0, 1.5, above=True)
"""Below the 1.7 m/s at which a Panda stops by itself; 0.25 m/s is ISO 10218's reduced speed."""
ENDLESS = 1e4
"""rad; the limit of a joint that turns without end."""
FAR = 10.0
"""m; where a workspace is open."""
DEADLINE_SIMULATED, DEADLINE_REAL = 1.0, 0.3
"""Longest deadline of a command, s."""


class _Body(NamedTuple):
    """An arm's URDF, and the numbers of its joints."""

    robot: UrdfModel
    """The whole robot, which may have other arms."""
    arm: UrdfModel
    """The part of it that is this arm's."""
    limits: LimitsSpec
    home: Floats
    initial: Floats | None


def resolve_robot(context: Context, name: str, config: RobotConfig) -> RobotSpec | None:
    """Return the record of an arm; None, with the problems added, if there are any."""
    key = f"robots.{name}"
    with suppress(Unknown):
        if context.is_served(config):
            spec = context.find_served(RobotSpec, key, str(config.at))
            if spec is not None:
                context.urdfs[name] = read_urdf(Path(spec.urdf), meshes=False)
            return spec
        if config.at is not None and not config.model:
            context.report(
                f"{key}.model", f"is missing: the model of what is at {config.at}, to simulate", "missing_key"
            )
            return None
    model, file = context.read_model(RobotModel, key, config, "robots")
    simulated = True
    with suppress(Unknown):
        simulated = context.is_simulated(config)
    body = _resolve_body(context, name, config, model, file, simulated)
    with suppress(Unknown):
        context.links[name] = model.links
    with suppress(Unknown):
        if not simulated and config.tcp_speed not in MOST_REAL_TCP_SPEED:
            message = f"must be {MOST_REAL_TCP_SPEED} on a real arm, not {config.tcp_speed:g}"
            context.report(f"{key}.tcp_speed", message, "out_of_range")
    driver = context.choose_driver("robot", key, config, model)
    gripper_driver = _check_gripper(context, f"{key}.gripper", config, model)
    with suppress(Unknown):
        _check_workspace(context, f"{key}.workspace", config)
    with suppress(Unknown):
        if body is not None and driver:
            spec = _make_spec(context, name, config, model, body, driver, gripper_driver)
            check_robot_spec(context, key, spec, config, model, file)
            return spec
    return None


def _make_spec(
    context: Context, name: str, config: RobotConfig, model: RobotModel, body: _Body, driver: str, gripper_driver: str
) -> RobotSpec:
    """Return the record of an arm, and note in the context if a program stands in for its real devices."""
    key, simulated = f"robots.{name}", context.is_simulated(config)
    options = merge_options(config, model, simulated, driver)
    base = config.base if config.same is None else context.rig.robots[config.same].base
    shared = options if driver == gripper_driver else {}
    gripper = _make_gripper(context, name, config, model, gripper_driver, shared)
    real = [] if simulated else [(driver, options)]
    if gripper is not None and not context.is_simulated(config.gripper, config):
        real.append((gripper.driver, gripper.options))
    emulated = bool(real) and all(is_emulated(*device) for device in real)
    if emulated:
        context.emulated.add(key)
        if not all(registry.driver(name).steppable for name, _ in real):
            context.real_time_only.add(key)
    return RobotSpec(
        name=name,
        model=config.model,
        driver=driver,
        rate_hz=context.rig.simulation.physics_hz if simulated else config.rate_hz or model.rate_hz,
        urdf=str(body.arm.path),
        joints=model.joints,
        home=body.home,
        initial=body.initial or body.home,
        limits=body.limits,
        kinematics=_make_kinematics(model, body),
        base_position=base.position,
        base_orientation=base.orientation,
        gripper=gripper,
        workspace=_make_workspace(config.workspace) if config.workspace is not None else None,
        payload=_make_payload(context, key, config, driver, simulated),
        same=config.same,
        group=None if simulated else _group_key(driver, options),
        speed=config.speed,
        move_speed=config.move_speed,
        tcp_speed=config.tcp_speed,
        attended=bool(real),
        emulated=emulated,
        deadline_max=DEADLINE_SIMULATED if simulated else DEADLINE_REAL,
        options=options,
        source=context.source,
    )


def _resolve_body(
    context: Context, name: str, config: RobotConfig, model: RobotModel, file: Path, simulated: bool
) -> _Body | None:
    """Return an arm's URDF and the numbers of its joints; None, with the problems added, if one is unknown."""
    key = f"robots.{name}"
    robot: UrdfModel | None = None
    arm: UrdfModel | None = None
    limits: LimitsSpec | None = None
    home: Floats | None = None
    initial: Floats | None = None
    with suppress(Unknown):
        robot = load_arm(model, file, context.problems, context.warnings)
        if robot is not None:
            _check_names(model, robot, file, context.problems)
            arm = _divide_robot(context, name, config, model, robot)
            if arm is not None:
                context.urdfs[name] = arm
    with suppress(Unknown):
        where = context.source, f"{key}.limits"
        limits = resolve_limits(model, robot, file, config, *where, not simulated, context.problems)
    with suppress(Unknown):
        home = spread(model.home, len(model.joints), file, "home", "numbers", context.problems)
        _check_inside(home, limits, model.joints, file, "home", context.problems)
    with suppress(Unknown):
        initial = _check_initial(context, f"{key}.initial", model, config)
        _check_inside(initial, limits, model.joints, context.source, f"{key}.initial", context.problems)
    if robot is None or arm is None or limits is None or home is None:
        return None
    return _Body(robot, arm, limits, home, initial)


# Arms of one robot


def _divide_robot(
    context: Context, name: str, config: RobotConfig, model: RobotModel, urdf: UrdfModel
) -> UrdfModel | None:
    """Return the part of a robot that belongs to one of its arms: all of it, unless the rig has others of its arms.

    The arm that the others name has what no arm moves. As that stands still, the parts together move like one body.
    None, with the problem added, where ``same`` is wrong.
    """
    key, first = f"robots.{name}.same", config.same
    if first is not None and (problem := _find_wrong_same(context, name, config, first)):
        context.report(key, *problem)
        return None
    others = [
        (other, entry)
        for other, entry in context.rig.robots.items()
        if other != name and (other == first or entry.same == (first or name))
    ]
    if not others:
        return urdf
    taken: set[str] = set()
    for other, entry in others:
        joints = set(_read_joints(context, other, entry))
        if shared := sorted(joints & set(model.joints)):
            if first is not None:  # reported once
                text = f"robot {other!r} has joint {shared[0]!r} too: arm must be another one"
                context.report(f"robots.{name}.arm", text, "conflict")
            return None
        taken |= joints
    try:
        return read_urdf(divide_urdf(urdf, model.joints, taken, body=first is None), meshes=False)
    except OSError as error:
        context.report(key, f"the part of {urdf.path.name} cannot be written: {error}", "bad_urdf")
        return None


def _find_wrong_same(context: Context, name: str, config: RobotConfig, first: str) -> tuple[str, str] | None:
    """Return message and code of what is wrong with the arm that ``same`` names; None if nothing is."""
    robots = context.rig.robots
    others = [other for other in robots if other != name]
    if first not in others:
        return f"this rig has no other robot {first!r}{suggest(first, others)}", "unknown_robot"
    if robots[first].same is not None:
        return (
            f"robot {first!r} has same: {robots[first].same} itself; name the one without",
            "conflict",
        )
    if robots[first].model != config.model:
        return f"robot {first!r} is another model, {robots[first].model!r}, not {config.model!r}", "conflict"
    if "base" in config.model_fields_set and config.base != robots[first].base:
        return f"excludes another base than that of robot {first!r}: leave base out", "conflict"
    return None


def _read_joints(context: Context, name: str, config: RobotConfig) -> tuple[str, ...]:
    """Return the joints of another arm of the rig; none where its model has problems, which its own entry reports."""
    quiet = replace(context, problems=Problems())
    with suppress(Unknown):
        return quiet.read_model(RobotModel, f"robots.{name}", config, "robots")[0].joints
    return ()


def _make_kinematics(model: RobotModel, body: _Body) -> KinematicsSpec:
    return KinematicsSpec(
        urdf=str(body.robot.path),
        joints=model.joints,
        lower=body.limits.lower,
        upper=body.limits.upper,
        home=body.home,
        base_link=model.base_link,
        tcp_link=model.tcp.link,
        tcp_position=model.tcp.position,
        tcp_orientation=model.tcp.orientation,
    )


# Names of joints and links


def _check_names(model: RobotModel, urdf: UrdfModel, file: Path, problems: Problems) -> None:
    """Check that every joint and link that the model names is in the URDF, and fits its purpose."""
    with suppress(Unknown):
        _check_joints(model.joints, "joints", urdf, file, problems)
    with suppress(Unknown):
        _check_joints(model.gripper.names if model.gripper else (), "gripper.joints", urdf, file, problems)
        for k, finger in enumerate(model.gripper.joints if model.gripper else ()):
            kind = urdf.joints[finger.name].kind if finger.name in urdf.joints else ""
            if kind in TURNING and finger.name not in model.joints and finger.open is None:
                message = f"joint {finger.name!r} turns ({kind}), so it needs both of its ends"
                remedy = f"{{name: {finger.name}, open: ..., closed: ...}}, and widths if they are not proportional"
                problems.add(file, f"gripper.joints.{k}", f"{message}: {remedy}", "wrong_joint")
    with suppress(Unknown):
        if model.base_link is not None:
            _check_link(model.base_link, "base_link", urdf, file, problems)
            above = [joint.name for joint in urdf.above(model.base_link) if joint.name in model.joints]
            if above:
                text = f"{model.base_link!r} moves with the arm's own joints: {', '.join(above)}"
                problems.add(file, "base_link", text, "wrong_link")
    with suppress(Unknown):
        for alias, link in model.links.items():
            _check_link(link, f"links.{alias}", urdf, file, problems)
            if alias in urdf.links and alias != link:
                message = f"{urdf.path.name} has a link of that name; choose another name"
                problems.add(file, f"links.{alias}", message, "duplicate_name")
    with suppress(Unknown):
        _check_link(model.tcp.link, "tcp.link", urdf, file, problems)
        if model.tcp.link in urdf.links:
            _check_chain(model, urdf, file, problems)


def _check_joints(names: tuple[str, ...], key: str, urdf: UrdfModel, file: Path, problems: Problems) -> None:
    movable = [name for name, joint in urdf.joints.items() if joint.movable]
    for k, name in enumerate(names):
        if name not in urdf.joints:
            message = f"{urdf.path.name} has no joint {name!r}{suggest(name, movable)}"
            problems.add(file, f"{key}.{k}", message, "unknown_joint")
        elif name not in movable:
            message = f"joint {name!r} is {urdf.joints[name].kind}; movable joints: {', '.join(movable)}"
            problems.add(file, f"{key}.{k}", message, "wrong_joint")
        if name in names[:k]:
            problems.add(file, f"{key}.{k}", f"{name!r} is given twice; names must be unique", "duplicate_name")


def _check_chain(model: RobotModel, urdf: UrdfModel, file: Path, problems: Problems) -> None:
    chain = {joint.name for joint in urdf.above(model.tcp.link)}
    for k, name in enumerate(model.joints):
        if name in urdf.joints and name not in chain:
            message = f"joint {name!r} does not move the tcp's link {model.tcp.link!r}"
            problems.add(file, f"joints.{k}", message, "wrong_joint")
    for name in sorted(chain.intersection(model.joints, model.gripper.names if model.gripper else ())):
        problems.add(file, "gripper.joints", f"{name!r} is also one of the arm's joints", "wrong_joint")


def _check_link(link: str, key: str, urdf: UrdfModel, file: Path, problems: Problems) -> None:
    if link not in urdf.links:
        problems.add(file, key, f"{urdf.path.name} has no link {link!r}{suggest(link, urdf.links)}", "unknown_link")


# Limits and positions of the joints


def resolve_limits(
    model: RobotModel,
    urdf: UrdfModel | None,
    file: Path,
    config: RobotConfig,
    source: str,
    key: str,
    real: bool,
    problems: Problems,
) -> LimitsSpec:
    """Return the limits that the servo keeps; a real arm's by its ``real_limits`` and :data:`MOST_REAL`, too.

    Unknown limits are NaN, so comparisons with them are always false; a problem is added for each of them.

    Raises:
        Unknown: The number of joints is unknown.
    """
    with suppress(Unknown):
        for name in ("acceleration", "jerk"):
            if getattr(model.limits, name, ()) is None:
                text = f"is missing: {UNITS[name]}, one number for each joint or one for all; a URDF does not have it"
                problems.add(file, f"limits.{name}", text, "missing_key")
    limits = {name: _read_limits(model, urdf, name, file, problems) for name in UNITS}
    _check_order(limits, model.joints, file, "limits", problems)
    tightened = dict(limits)  # checked in simulation, too, so that mistakes are found there
    with suppress(Unknown):
        _tighten(tightened, model.real_limits, model.joints, file, "real_limits", problems, _LOOSER_THAN_OWN)
    if real:
        limits = tightened
    with suppress(Unknown):
        rule = None if getattr(config.limits, "allow_looser_limits", True) else _LOOSER_THAN_MODEL
        _tighten(limits, config.limits, model.joints, source, key, problems, rule)
    if real:
        given = getattr(config, "limits", LimitsConfig()).model_fields_set
        for name, most in MOST_REAL.items():
            fast = [value for value in limits[name] or () if value > most.most]
            if fast:
                text = f"must be {most} for every joint of a real arm, not {max(fast):g}"
                place = (source, f"{key}.{name}") if name in given else (file, f"limits.{name}")
                problems.add(place[0], place[1], text, "out_of_range")
    return LimitsSpec(**limits)  # type: ignore[arg-type]  # None only for torque, which may be


def spread(
    values: Floats, n: int, file: Path | str, key: str, unit: str, problems: Problems, *, one_for_all: bool = False
) -> Floats | None:
    """Return one number for each of ``n`` joints; None, with a problem added, if ``values`` has another count."""
    if one_for_all and len(values) == 1:
        return values * n
    if len(values) != n:
        problems.add(file, key, f"must be {n} numbers ({unit}), one for each joint, not {len(values)}", "wrong_count")
        return None
    return values


_LOOSER_THAN_OWN = "{value:g} is looser than limits.{name}, {limit:g}, for joint {joint!r}", ""
_LOOSER_THAN_MODEL = (
    "{value:g} is looser than the model's {limit:g} for joint {joint!r}",
    "; only allow_looser_limits: true beside it permits that",
)
"""Message for each number that is too loose, and the end of the sentence."""


def _tighten(
    limits: dict[str, Floats | None],
    changes: LimitsModel,
    joints: Sequence[str],
    file: Path | str,
    key: str,
    problems: Problems,
    rule: tuple[str, str] | None,
) -> None:
    """Replace ``limits`` by ``changes``, in place; with a ``rule``, looser ones are problems."""
    for name, unit in UNITS.items():
        changed: Floats | None = getattr(changes, name, None)
        if changed is None:
            continue
        values = spread(changed, len(joints), file, f"{key}.{name}", unit, problems, one_for_all=True)
        if values is None:
            continue
        if rule is not None:
            each, after = rule
            looser = [
                each.format(value=value, limit=limit, joint=joint, name=name)
                for value, limit, joint in zip(values, limits[name] or values, joints, strict=True)
                if (value < limit if name == "lower" else value > limit)
            ]
            if looser:
                problems.add(file, f"{key}.{name}", f"{'; '.join(looser)} ({unit}){after}", "looser_limit")
        limits[name] = values
    if not {"lower", "upper"}.isdisjoint(changes.model_fields_set):
        _check_order(limits, joints, file, key, problems)


def _check_order(
    limits: dict[str, Floats | None], joints: Sequence[str], file: Path | str, key: str, problems: Problems
) -> None:
    """Check that lower is below upper. Where it is not, the range is unknown, so both become NaN."""
    lower, upper = list(limits["lower"] or ()), list(limits["upper"] or ())
    empty: list[str] = []
    for k, joint in enumerate(joints):
        if lower[k] >= upper[k]:
            empty.append(f"joint {joint!r} has {lower[k]:g} and {upper[k]:g}")
            lower[k] = upper[k] = math.nan
    if empty:
        problems.add(file, key, f"lower must be below upper: {'; '.join(empty)}", "empty_range")
    limits["lower"], limits["upper"] = tuple(lower), tuple(upper)


def _read_limits(model: RobotModel, urdf: UrdfModel | None, name: str, file: Path, problems: Problems) -> Floats | None:
    n = len(model.joints)
    unknown = (math.nan,) * n
    with suppress(Unknown):
        own: Floats | None = getattr(model.limits, name)
        if own is not None:
            return spread(own, n, file, f"limits.{name}", UNITS[name], problems, one_for_all=True) or unknown
        if urdf is not None and name not in ("acceleration", "jerk"):
            return _read_urdf_limits(model, urdf, name, file, problems)
    return unknown


def _read_urdf_limits(model: RobotModel, urdf: UrdfModel, name: str, file: Path, problems: Problems) -> Floats | None:
    values = [_read_joint_limit(urdf.joints.get(joint), name) for joint in model.joints]
    lacking = [repr(joint) for joint, value in zip(model.joints, values, strict=True) if value is None]
    if lacking and name == "torque":
        return None
    if lacking:
        text = f"is missing ({UNITS[name]}), and {urdf.path.name} gives none for {', '.join(lacking)}"
        problems.add(file, f"limits.{name}", text, "missing_key")
    return tuple(math.nan if value is None else value for value in values)


def _read_joint_limit(joint: UrdfJoint | None, name: str) -> float | None:
    """Return a limit from a joint's URDF: None without one, NaN for a joint that does not move."""
    if joint is None or not joint.movable:  # already a problem of the names
        return math.nan
    value: float | None = getattr(joint, "effort" if name == "torque" else name)
    if name in ("lower", "upper"):
        endless = value is None and joint.kind == "continuous"
        return math.copysign(ENDLESS, -1.0 if name == "lower" else 1.0) if endless else value
    return value if value is not None and value > 0.0 else None  # in many files an effort of 0 means "unknown"


def _check_initial(context: Context, key: str, model: RobotModel, config: RobotConfig) -> Floats | None:
    given, n = config.initial, len(model.joints)
    if given is None or len(given) == n:
        return given
    fingers = model.gripper.names if model.gripper else ()
    if fingers and len(given) == n + len(fingers):
        message = f"{context.source}: {key} has {len(given)} numbers; those of the {len(fingers)} fingers are not used"
        context.warnings.append(message)
        return given[:n]
    message = f"must be {n} numbers, one for each of {', '.join(model.joints)}, not {len(given)}"
    context.report(key, message, "wrong_count")
    return None


def _check_inside(
    q: Floats | None, limits: LimitsSpec | None, joints: tuple[str, ...], file: Path | str, key: str, problems: Problems
) -> None:
    if q is None or limits is None:
        return
    outside = [
        f"joint {joint!r} is at {value:g}, outside its limits {lower:g} to {upper:g}"
        for value, lower, upper, joint in zip(q, limits.lower, limits.upper, joints, strict=True)
        if value < lower or value > upper
    ]
    if outside:
        message = f"{'; '.join(outside)}; positions are in rad (m for joints that slide)"
        problems.add(file, key, message, "out_of_range")


# Payload, process, gripper and workspace


def _make_payload(context: Context, key: str, config: RobotConfig, driver: str, simulated: bool) -> PayloadSpec | None:
    """Return the payload; one that the driver of a real arm cannot use is a problem."""
    if config.payload is None:
        return None
    if not simulated and not registry.driver(driver).payload:
        message = f"cannot be used by the driver {driver!r}: remove it, or give the load in the arm's own settings"
        context.report(f"{key}.payload", message, "unused_payload")
    return PayloadSpec(config.payload.mass, config.payload.position)


def _group_key(driver: str, options: Mapping[str, Any]) -> str | None:
    """Return the key of the real arms that share this one's process; None if no other may."""
    find = registry.function(driver, registry.driver(driver).group)
    key = find(options) if find is not None else None
    return None if key is None else f"{driver}:{key}"


def _check_gripper(context: Context, key: str, config: RobotConfig, model: RobotModel) -> str:
    """Return the gripper's driver; "" if there is no gripper or no such driver."""
    with suppress(Unknown):
        own, kind = config.gripper, model.gripper
        if kind is None:
            if own.model_fields_set:
                context.report(key, f"model {config.model!r} has no gripper", "no_gripper")
            return ""
        with suppress(Unknown):
            if own.enabled and own.speed is not None and own.speed > kind.speed:
                message = f"must be at most {kind.speed:g} m/s, the model's, not {own.speed:g}"
                context.report(f"{key}.speed", message, "looser_limit")
        with suppress(Unknown):
            if own.enabled and own.force is not None and own.force > kind.strongest:
                message = f"must be at most {kind.strongest:g} N, the model's force_max, not {own.force:g}"
                context.report(f"{key}.force", message, "looser_limit")
        if own.enabled:
            if context.is_simulated(own, config) and not context.is_simulated(config):
                message = "is simulated, but its arm is real: its fingers would be in another world"
                context.report(key, message, "two_worlds")
            return context.choose_driver("gripper", key, own, kind, config)
    return ""


def _make_gripper(
    context: Context, name: str, config: RobotConfig, model: RobotModel, driver: str, arm: Mapping[str, Any]
) -> GripperSpec | None:
    """Return the gripper's record; ``arm`` has the arm's options if the same driver runs both."""
    own, kind = config.gripper, model.gripper
    if kind is None or not own.enabled or not driver:
        return None
    simulated = context.is_simulated(own, config)
    options = merge_options(own, kind, simulated, driver)
    if not simulated:
        shared = registry.driver(driver).shared_options
        options = {**{name: arm[name] for name in shared if name in arm}, **options}
    return GripperSpec(
        name=f"{name}.gripper",
        driver=driver,
        width_max=kind.width_max,
        speed=own.speed or kind.speed,
        force=own.force or kind.force,
        joints=kind.names,
        opened=tuple(joint.open for joint in kind.joints if joint.open is not None),
        closed=tuple(joint.closed for joint in kind.joints if joint.closed is not None),
        widths=tuple((row[0], row[1]) for row in kind.widths),
        force_max=kind.strongest,
        options=options,
    )


def _make_workspace(config: WorkspaceConfig) -> WorkspaceSpec:
    lower: Vector3 = config.lower or (-FAR, -FAR, -FAR)
    upper: Vector3 = config.upper or (FAR, FAR, FAR)
    if config.table_height is not None:
        lower = (lower[0], lower[1], max(lower[2], config.table_height))
    return WorkspaceSpec(lower, upper)


def _check_workspace(context: Context, key: str, config: RobotConfig) -> None:
    if config.workspace is None:
        return
    box = _make_workspace(config.workspace)
    if any(low >= high for low, high in zip(box.lower, box.upper, strict=True)):
        message = f"is empty: lower {list(box.lower)} must be below upper {list(box.upper)}"
        context.report(key, message, "empty_range")
