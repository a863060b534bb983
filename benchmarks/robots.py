"""Every built-in model of an arm in simulation: inverse kinematics, the recorded tour, and its gripper.

Models whose package is not installed are left out, and named.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import hal
from hal.config.data_files import find_data, list_data
from hal.config.files import read_yaml
from hal.errors import ConfigError, Unreachable
from hal.types import Trip

from .kit import ENGINES, Table

PATHS = ("robots", "hal/kinematics", "drivers/pybullet", "drivers/mujoco")
TOUR = str(find_data("config", "teleop/tour.jsonl"))
RATE_HZ = 50


@dataclass
class ModelRun:
    """What one model did on one engine."""

    found: int = 0
    """Poses that inverse kinematics reached."""
    position: float = 0.0
    """Largest distance of the tcp from a target, m."""
    rotation: float = 0.0
    """Largest angle to a target, rad."""
    seconds: float = 0.0
    """Length of the tour that was driven, s."""
    lag: float = 0.0
    """Largest distance of a joint from its set-point in it, rad."""
    moved: float = 0.0
    """Largest distance of the tcp from where it began, m."""
    trip: Trip = Trip.NONE
    width_min: float = 0.0
    """Least width of the gripper, m."""
    widths: tuple[float, float] | None = None
    """Width of the gripper when open and when closed, m; None without a gripper."""
    notes: tuple[str, ...] = ()


def entries(model: str) -> Iterator[dict[str, Any]]:
    """Yield the entries of a rig for a model: one for each of its arms."""
    data = read_yaml(find_data("robots", f"{model}.yaml"), hal.config.files.Problems()) or {}
    arms = data.get("arms") or {None: None}
    for arm in arms:
        yield {"model": model} | ({"arm": arm} if arm else {})


def open_model(entry: dict[str, Any], engine: str) -> hal.Rig:
    """Open a rig with an arm alone in a world, and the recorded tour as its pad.

    Args:
        entry: The arm's entry in a rig.
        engine: Name of the engine.
    """
    config = {"sim": True, "robots": {"arm": entry}, "gamepads": {"pad": {}}}
    return hal.open(config, engine=engine, clock="lock_step", pad=TOUR)


def drive_model(rig: hal.Rig, poses: int, tour: float) -> ModelRun:
    """Return what the arm of a rig does.

    Args:
        rig: That of :func:`open_model`.
        poses: Number of random poses for inverse kinematics.
        tour: Share of the recorded tour that is driven.
    """
    arm, pad, result = rig.robots["arm"], rig.gamepads["pad"], ModelRun(notes=tuple(rig.notes))
    solve_poses(arm, result, poses)
    teleop = hal.Teleop(arm)
    deadman = pad.hold(teleop.mapping.deadman)
    start, length = arm.state().tcp, tour * 60.0
    with arm.control(deadman=deadman, rate_hz=RATE_HZ) as control:
        for tick in rig.clock.rate(RATE_HZ):
            motion, grip = teleop.step(pad.state(), tick.dt)
            control.send(motion, grip=grip)
            state = arm.state()
            result.lag = max(result.lag, float(abs(state.q - state.q_set).max()))
            result.moved = max(result.moved, start.distance(state.tcp)[0])
            result.seconds += 1.0 / RATE_HZ
            if state.trip is not Trip.NONE:
                result.trip = state.trip
                break
            if pad.finished or result.seconds >= length:
                break
    gripper = arm.gripper
    if gripper is not None:
        result.widths = gripper.open().width, gripper.move(gripper.width_min).width
        result.width_min = gripper.width_min
    return result


def solve_poses(arm: Any, result: ModelRun, count: int) -> None:
    """Solve the inverse kinematics of poses of random joint positions, from home."""
    numbers = np.random.default_rng(0)
    limits = arm.spec.limits
    lower, upper = (np.clip(ends, -np.pi, np.pi) for ends in (np.array(limits.lower), np.array(limits.upper)))
    lower, upper = np.where(lower < upper, lower, limits.lower), np.where(lower < upper, upper, limits.upper)
    room = 0.025 * (upper - lower)  # at a limit there may be one solution only
    lower, upper = lower + room, upper - room
    for _ in range(count):
        target = arm.fk(numbers.uniform(lower, upper))
        try:
            q = arm.ik(target)
        except Unreachable:
            continue
        distance, angle = arm.fk(q).distance(target)
        result.found += 1
        result.position, result.rotation = max(result.position, distance), max(result.rotation, angle)


def run(quick: bool) -> Iterator[Table]:
    """Yield the table."""
    poses, tour, models = (3, 0.02, ["panda"]) if quick else (100, 1.0, list_data("robots"))
    columns = ("poses found", "off, m", "rad", "tour, s", "moved, m", "behind, rad", "trip", "gripper open, closed, m")
    table = Table(f"inverse kinematics of {poses} random poses, the tour, the gripper", ("", *columns))
    for entry in (entry for model in models for entry in entries(model)):
        for engine in ENGINES:
            try:
                with open_model(entry, engine) as rig:
                    found = drive_model(rig, poses, tour)
            except ConfigError as error:
                if not all(problem.code == "missing_package" for problem in error.problems):
                    raise
                table.add(" ".join(entry.values()), f"left out: {error.problems[0].message}")
                break
            widths = ", ".join(f"{width:.4f}" for width in found.widths or ())
            cells = (found.found, found.position, found.rotation, found.seconds, found.moved, found.lag)
            table.add(f"{' '.join(entry.values())}, {engine}", *cells, found.trip.name.lower(), widths)
    yield table
