"""An arm of a rig: model, URDF and the rig's own words into one :class:`~hal.specs.RobotSpec`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from ..specs import Floats, GripperSpec, KinematicsSpec, LimitsSpec, RobotSpec, Vector3, WorkspaceSpec
from .files import Problems, nearest, read_yaml, validate
from .models import RobotModel, find_model
from .resolve_limits import resolve_limits, spread
from .rigfile import RobotConfig, WorkspaceConfig
from .sources import locate_urdf
from .urdf import UrdfModel, read_urdf

if TYPE_CHECKING:
    from .resolve import Context

__all__ = ["resolve_robot"]

FAR = 10.0
"""m; where a workspace is open."""
DEADLINE_SIMULATED, DEADLINE_REAL = 1.0, 0.3
"""Longest deadline of a command, s."""


def resolve_robot(context: Context, name: str, config: RobotConfig) -> RobotSpec | None:
    """The arm, or None with the problems noted."""
    key = f"robots.{name}"
    found = find_model(config.model, "robots", (), context.base)
    if isinstance(found, str):
        context.problem(f"{key}.model", found)
        return None
    data = read_yaml(found, context.problems)
    model = validate(RobotModel, data, found, context.problems) if data is not None else None
    if model is None:
        return None
    path = locate_urdf(model.urdf, found.parent, found, "urdf", context.problems)
    if path is None:
        return None
    try:
        urdf = read_urdf(path)
    except (ValueError, OSError) as error:
        context.problems.add(path, "", str(error))
        return None
    context.urdfs[name] = urdf
    before = len(context.problems.found)
    _check_names(model, urdf, found, context.problems)
    if len(context.problems.found) > before:
        return None
    limits = resolve_limits(model, urdf, found, config, context.source, f"{key}.limits", context.problems)
    if limits is None:
        return None
    if urdf.without_mass():
        links = ", ".join(urdf.without_mass())
        context.warnings.append(f"{path}: no <inertial> in {links}; the simulator makes up a mass")
    home = spread(model.home, len(model.joints), found, "home", "numbers", context.problems)
    initial = _initial(context, f"{key}.initial", model, config)
    for place, file, where in ((home, found, "home"), (initial, context.source, f"{key}.initial")):
        _check_inside(place, limits, model.joints, file, where, context.problems)
    simulated = context.simulated(config)
    driver = context.choose_driver("robot", key, simulated, config.drivers, model.drivers)
    gripper = _gripper(context, name, config, model)
    workspace = _workspace(config.workspace, f"{key}.workspace", context)
    if home is None:
        return None
    rate = context.rig.simulation.physics_hz if simulated else config.rate_hz or model.rate_hz
    return RobotSpec(
        name=name,
        model=config.model,
        driver=driver,
        rate_hz=rate,
        urdf=str(path),
        joints=model.joints,
        home=home,
        initial=initial or home,
        limits=limits,
        kinematics=KinematicsSpec(
            urdf=str(path),
            joints=model.joints,
            lower=limits.lower,
            upper=limits.upper,
            home=home,
            base_link=model.base_link,
            tcp_link=model.tcp.link,
            tcp_position=model.tcp.position,
            tcp_orientation=model.tcp.orientation,
        ),
        base_position=config.base.position,
        base_orientation=config.base.orientation,
        gripper=gripper,
        workspace=workspace,
        speed=config.speed,
        move_speed=config.move_speed,
        tcp_speed=config.tcp_speed,
        attended=not simulated,
        deadline_max=DEADLINE_SIMULATED if simulated else DEADLINE_REAL,
        options={**model.simulated, **config.simulated} if simulated else {**model.real, **config.real},
    )


def _check_names(model: RobotModel, urdf: UrdfModel, file: Path, problems: Problems) -> None:
    """Every joint and link that the model names is in the URDF, and can do what it is named for."""
    movable = [name for name, joint in urdf.joints.items() if joint.movable]
    fingers = model.gripper.joints if model.gripper else ()
    for key, names in (("joints", model.joints), ("gripper.joints", fingers)):
        for k, name in enumerate(names):
            if name not in urdf.joints:
                problems.add(file, f"{key}.{k}", f"{urdf.path.name} has no joint {name!r}{nearest(name, movable)}")
            elif name not in movable:
                kind = urdf.joints[name].kind
                problems.add(file, f"{key}.{k}", f"joint {name!r} is {kind}; those that move: {', '.join(movable)}")
            if name in names[:k]:
                problems.add(file, f"{key}.{k}", f"{name!r} is given twice; names must differ")
    for name in set(model.joints) & set(fingers):
        problems.add(file, "gripper.joints", f"{name!r} is also one of the arm's joints")
    links = [("tcp.link", model.tcp.link)] + ([("base_link", model.base_link)] if model.base_link else [])
    for key, link in links:
        if link not in urdf.links:
            problems.add(file, key, f"{urdf.path.name} has no link {link!r}{nearest(link, urdf.links)}")
    if model.tcp.link not in urdf.links:
        return
    chain = {joint.name for joint in urdf.above(model.tcp.link)}
    for k, name in enumerate(model.joints):
        if name in urdf.joints and name not in chain:
            problems.add(file, f"joints.{k}", f"joint {name!r} does not move the tcp's link {model.tcp.link!r}")


def _initial(context: Context, key: str, model: RobotModel, config: RobotConfig) -> Floats | None:
    given = config.initial
    fingers = model.gripper.joints if model.gripper else ()
    n = len(model.joints)
    if given is None or len(given) == n:
        return given
    if fingers and len(given) == n + len(fingers):
        context.warnings.append(
            f"{context.source}: {key} has {len(given)} numbers; the fingers' {len(fingers)} are not used"
        )
        return given[:n]
    context.problem(key, f"must have {n} numbers, one for each of {', '.join(model.joints)}, not {len(given)}")
    return None


def _check_inside(
    q: Floats | None, limits: LimitsSpec, joints: tuple[str, ...], file: Path | str, key: str, problems: Problems
) -> None:
    outside = [
        f"joint {joint!r} is at {value:g}, outside its limits {lower:g} to {upper:g}"
        for value, lower, upper, joint in zip(q or (), limits.lower, limits.upper, joints, strict=False)
        if not lower <= value <= upper
    ]
    if outside:
        problems.add(file, key, f"{'; '.join(outside)}; positions are in rad (m for joints that slide)")


def _gripper(context: Context, name: str, config: RobotConfig, model: RobotModel) -> GripperSpec | None:
    own, kind = config.gripper, model.gripper
    if kind is None or not own.enabled:
        if kind is None and own.model_fields_set:
            context.problem(f"robots.{name}.gripper", f"model {config.model!r} has no gripper")
        return None
    key = f"robots.{name}.gripper"
    if own.speed is not None and own.speed > kind.speed:
        context.problem(f"{key}.speed", f"must be at most {kind.speed:g} m/s, the model's, not {own.speed:g}")
    simulated = context.simulated(own, config)
    return GripperSpec(
        name=f"{name}.gripper",
        driver=context.choose_driver("gripper", key, simulated, own.drivers, kind.drivers),
        width_max=kind.width_max,
        speed=own.speed or kind.speed,
        force=own.force or kind.force,
        joints=kind.joints,
        options={**kind.simulated, **own.simulated} if simulated else {**kind.real, **own.real},
    )


def _workspace(config: WorkspaceConfig | None, key: str, context: Context) -> WorkspaceSpec | None:
    if config is None:
        return None
    lower: Vector3 = config.lower or (-FAR, -FAR, -FAR)
    upper: Vector3 = config.upper or (FAR, FAR, FAR)
    if config.table_height is not None:
        lower = (lower[0], lower[1], max(lower[2], config.table_height))
    if any(low >= high for low, high in zip(lower, upper, strict=True)):
        context.problem(key, f"is empty: lower {list(lower)} must be below upper {list(upper)}")
    return WorkspaceSpec(lower, upper)
