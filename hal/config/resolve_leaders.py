"""Resolve the leader arms of a rig's file."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import replace

from .. import registry
from ..errors import suggest
from ..specs import Floats, KinematicsSpec, LeaderSpec, PadSpec
from .context import Context, is_emulated
from .files import find_file, read_yaml, validate
from .models import LeaderModel
from .resolve_robots import resolve_robot
from .rigfile import LeaderConfig, RobotConfig
from .schema import Unknown


def resolve_leader(context: Context, name: str, config: LeaderConfig) -> PadSpec | None:
    """Return the record of a leader; None, with the problems added, if there are any problems so far."""
    key = f"leaders.{name}"
    with suppress(Unknown):
        _check_names(context, key, config)
    with suppress(Unknown):
        if context.is_served(config):
            return _find_served(context, key, config)
    with suppress(Unknown):
        model = _read_model(context, key, config)
        if model is None:
            return None
        driver = context.driver or (registry.pad_driver("program") if config.sim else config.driver or model.driver)
        context.check_driver(driver, "leader", f"{key}.driver")
        leader = _make_leader(context, key, config, model)
        if context.problems.found or leader is None:
            return None
        options = {**model.options, **config.options}
        if config.port is not None:
            options["port"] = config.port
        leader = replace(leader, emulated=is_emulated(driver, options))
        spec = PadSpec(name, driver, None, drives=config.drives, options=options, leader=leader)
        for relative, message, code in registry.check_record(driver, "leader", spec):
            context.report(f"{key}.{relative}", message, code)
        return spec
    return None


def _find_served(context: Context, key: str, config: LeaderConfig) -> PadSpec | None:
    """Return the record of a leader at another computer; its dead-man is a gamepad of this rig, served or not."""
    spec = context.find_served(PadSpec, key, str(config.at))
    if spec is None or spec.leader is None:
        return None
    deadman = config.deadman or spec.leader.deadman
    if deadman is not None and deadman not in context.rig.gamepads:
        message = f"its dead-man is the gamepad {deadman!r} there: add gamepads.{deadman}.at, or name another one here"
        context.report(f"{key}.deadman", message, "unknown_device")
    return replace(spec, drives=config.drives, leader=replace(spec.leader, deadman=deadman))


def _check_names(context: Context, key: str, config: LeaderConfig) -> None:
    rig = context.rig
    if config.drives is not None and config.drives not in rig.robots:
        message = f"there is no robot {config.drives!r}{suggest(config.drives, rig.robots)}"
        context.report(f"{key}.drives", message, "unknown_robot")
    if config.deadman is not None and config.deadman not in rig.gamepads:
        message = f"there is no gamepad {config.deadman!r}{suggest(config.deadman, rig.gamepads)}"
        context.report(f"{key}.deadman", message, "unknown_device")
    if config.deadman is not None and config.lever == "deadman":
        context.report(f"{key}.deadman", "its lever is the dead-man: leave one of the two out", "conflict")


def _read_model(context: Context, key: str, config: LeaderConfig) -> LeaderModel | None:
    found = find_file(config.model, "leader model", context.base, "sensors", "leaders")
    if isinstance(found, str):
        context.report(f"{key}.model", found, "unknown_model")
        return None
    data = read_yaml(found, context.problems)
    return None if data is None else validate(LeaderModel, data, found, context.problems)


def _make_leader(context: Context, key: str, config: LeaderConfig, model: LeaderModel) -> LeaderSpec | None:
    count = len(model.joints)
    values: dict[str, Floats] = {}
    for what, default in (("signs", 1.0), ("scales", 1.0), ("offsets", 0.0), ("middles", 0.0)):
        given = getattr(config, what, None) or getattr(model, what) or (default,) * count
        values[what] = tuple(map(float, given))
        if len(given) != count:
            message = f"needs {count} numbers, one for each of {', '.join(model.joints)}, not {len(given)}"
            context.report(f"{key}.{what}", message, "wrong_count")
    if any(sign not in (-1.0, 1.0) for sign in values["signs"]):
        context.report(f"{key}.signs", "must be 1 or -1 each", "out_of_range")
    lever = config.lever or ("none" if config.deadman and model.lever == "deadman" else model.lever)
    deadman = config.deadman or (next(iter(context.rig.gamepads), None) if lever != "deadman" else None)
    for what in ("follow", "feedback"):
        if getattr(config, what) and deadman is None and lever != "deadman":
            context.report(f"{key}.{what}", "needs a dead-man: a leader without one leads by moving", "conflict")
    kinematics = _find_kinematics(context, key, config, model)
    if context.problems.found:
        return None
    return LeaderSpec(
        title=model.title,
        joints=model.joints,
        gains=tuple(sign * scale for sign, scale in zip(values["signs"], values["scales"], strict=True)),
        offsets=values["offsets"],
        middles=values["middles"],
        leads=model.leads,
        kinematics=kinematics,
        pose_scale=config.pose_scale,
        engage=config.engage,
        lever=lever,
        deadman=deadman,
        follow=config.follow,
        feedback=config.feedback,
    )


def _find_kinematics(context: Context, key: str, config: LeaderConfig, model: LeaderModel) -> KinematicsSpec | None:
    """Return the leader's own kinematics if an arm of the rig needs them; add a problem if there are none."""
    robots = context.rig.robots
    driven = [robots[config.drives]] if config.drives in robots else list(robots.values())
    others = [robot.model for robot in driven if robot.model not in model.leads]
    if not others:
        return None
    if model.arm is None:
        message = f"{model.title} leads {', '.join(model.leads)} joint to joint, and {others[0]} by poses only if its "
        context.report(f"{key}.model", f"{message}model names its own kinematics (arm)", "cannot_lead")
        return None
    if config.engage == "approach":
        message = f"{others[0]} is led by poses, of which only the changes count: use clutch"
        context.report(f"{key}.engage", message, "conflict")
    if config.feedback:
        message = f"{others[0]} is led by poses: only an arm that is led joint to joint gives torques back"
        context.report(f"{key}.feedback", message, "conflict")
    driver = registry.pad_driver("program")
    own = Context(context.source, context.base, context.rig, None, driver, None, context.problems)
    arm = resolve_robot(own, "leader", RobotConfig(model=model.arm))
    return None if arm is None else arm.kinematics
