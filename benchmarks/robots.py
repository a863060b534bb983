"""Every built-in model of an arm in simulation: kinematics, a drive by the recorded tour, and its gripper.

    python benchmarks/robots.py [MODEL ...] [--poses 100] [--tour 1.0]

Models whose package is not installed are left out, and named. For each model, on each engine:

ik        largest distance of the tcp from the target over random poses, m and rad, and how many were found.
tour      seconds of the recorded tour of a gamepad, the largest distance of a joint from its set-point, rad, and trips.
gripper   width when open and when closed on nothing, m.
"""

from __future__ import annotations

import argparse
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

import hal
from hal import registry
from hal.config.data_files import find_data, list_data
from hal.config.files import read_yaml
from hal.errors import ConfigError, Unreachable
from hal.types import Trip

ENGINES = [name for name in registry.ENGINES if not registry.find_missing(name)]
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
    widths: tuple[float, float] | None = None
    """Width of the gripper when open and when closed, m; None without a gripper."""
    notes: tuple[str, ...] = ()


def entries(model: str) -> Iterator[dict[str, Any]]:
    """Yield the entries of a rig for a model: one for each of its arms."""
    data = read_yaml(find_data("robots", f"{model}.yaml"), hal.config.files.Problems()) or {}
    arms = data.get("arms") or {None: None}
    for arm in arms:
        yield {"model": model} | ({"arm": arm} if arm else {})


def run(entry: dict[str, Any], engine: str, poses: int = 100, tour: float = 1.0) -> ModelRun:
    """Return what an arm does alone in a world.

    Args:
        entry: The arm's entry in a rig.
        engine: Name of the engine.
        poses: Number of random poses for inverse kinematics.
        tour: Share of the recorded tour that is driven.
    """
    result = ModelRun()
    config = {"sim": True, "robots": {"arm": entry}, "gamepads": {"pad": {}}}
    with hal.open(config, engine=engine, clock="lock_step", pad=TOUR) as rig:
        arm, pad = rig.robots["arm"], rig.gamepads["pad"]
        result.notes = tuple(rig.notes)
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
            result.widths = gripper.open().width, gripper.move(0.0).width
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


def main() -> int:
    """Print the table; return 1 if a model misses a goal."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("models", nargs="*", help="default: all")
    parser.add_argument("--poses", type=int, default=100)
    parser.add_argument("--tour", type=float, default=1.0, help="share of the tour")
    args = parser.parse_args()
    failures = 0
    head = f"{'model':15s} {'engine':9s} {'ik':>9s} {'m':>8s} {'rad':>8s} {'tour s':>7s} {'moved m':>8s}"
    print(f"{head} {'lag rad':>8s} {'open m':>8s} {'closed m':>8s} {'took s':>7s}")
    for model in args.models or list_data("robots"):
        for entry in entries(model):
            name = " ".join(entry.values())
            for engine in ENGINES:
                began = time.perf_counter()
                try:
                    found = run(entry, engine, args.poses, args.tour)
                except ConfigError as error:
                    if not all(problem.code == "missing_package" for problem in error.problems):
                        raise
                    print(f"{name:15s} left out: {error.problems[0].message}")
                    break
                widths = "{:8.4f} {:8.4f}".format(*found.widths) if found.widths else f"{'-':>8s} {'-':>8s}"
                good = (
                    found.found == args.poses
                    and found.position <= 1e-5
                    and found.trip is Trip.NONE
                    and (found.widths is None or found.widths[1] < 2e-3 < 0.02 < found.widths[0])
                )
                failures += not good
                print(
                    f"{name:15s} {engine:9s} {found.found:4d}/{args.poses:<4d} {found.position:8.1e} "
                    f"{found.rotation:8.1e} {found.seconds:7.1f} {found.moved:8.3f} {found.lag:8.4f} {widths} "
                    f"{time.perf_counter() - began:7.1f} {'' if good else 'FAILS ' + found.trip.name}",
                    flush=True,
                )
    return min(failures, 1)


if __name__ == "__main__":
    sys.exit(main())
