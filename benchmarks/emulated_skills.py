"""Pick and place on emulated arms in a shared world, beside the same seeds in simulation.

A cube is put somewhere before the arm, grasped, lifted, carried to another place and put down there. A try succeeds if
the grasp does, the cube is up before it is carried, and it ends within 3 mm of where it was to be put down. Simulation
is in lock-step; an emulated arm moves in real time, behind the vendor's library or on an emulated bus.
"""

from __future__ import annotations

import contextlib
from collections import Counter
from collections.abc import Iterator
from typing import Any, NamedTuple

import numpy as np
from can_kit import EmulatorProcess
from numpy.typing import NDArray

import hal
from hal.skills import grasp, grasp_pose, locate_by_truth

from .kit import ENGINES, Table, emulated_franka, median

PATHS = (
    "packages/emulators/src/hal_emulators/franka",
    "packages/emulators/src/hal_emulators/can",
    "drivers/scene",
    "hal/skills",
)
LIFT = 0.05
NEAR = 0.003
"""Distance from where the cube was to be put down up to which it is there, m."""
BUSY = ("app_silent", "command_deadline", "host_late")
"""Codes of stops because the computer was too busy to stream set-points; a hand or a state may also be late then."""
MOST_STOPS = 5
"""Greatest number of them in one try."""
CAMERA = {
    "sim": True,
    "model": "realsense_d435",
    "capture": {"width": 640, "height": 480, "rate_hz": 6},
    "output": {"width": 256, "height": 256},
    "look_at": {"target": [-0.08, 0, 0.65], "distance": 0.9, "yaw_deg": 120, "pitch_deg": -30, "roll_deg": 0},
}


class Bench(NamedTuple):
    """A rig with an emulated arm, and where cubes are put before it."""

    rig: str
    cube: dict[str, Any]
    lower: tuple[float, float]
    upper: tuple[float, float]
    """Corners of the area, x and y in the world, m."""
    turn: float
    """Greatest turn of the cube either way, rad."""
    host: str = ""


def make_cube(depth: float, height: float, mass: float) -> dict[str, Any]:
    """Return the entry of a cube, or a box, that is 30 mm wide: depth and height, m, and mass, kg."""
    half, at = [depth / 2, 0.015, height / 2], [0.0, 0.0, 0.601 + height / 2]
    return {
        "name": "cube",
        "shape": "box",
        "half_extents": half,
        "mass": mass,
        "position": at,
        "rgba": [1, 0.4, 0.7, 1],
    }


BENCHES = {
    "FR3": Bench("franka_emulator", make_cube(0.06, 0.06, 2.0), (-0.15, -0.2), (0.05, 0.2), np.pi, "127.0.8.2"),
    "YAM": Bench("yam_emulator", make_cube(0.04, 0.04, 0.3), (-0.14, -0.12), (-0.02, 0.12), 0.4),
    "PiPER": Bench("piper_emulator", make_cube(0.04, 0.04, 0.3), (-0.14, -0.12), (-0.02, 0.12), np.pi),
}


class Try(NamedTuple):
    """How a try ended."""

    reason: str
    """Empty for a success."""
    width: float
    """Of the fingers on the cube, m; NaN if they did not close on it."""
    off: float
    """Distance of the cube from where it was to be put down, m."""
    stops: int = 0
    """Number of times that it was begun before, and stopped as the computer was too busy."""


@contextlib.contextmanager
def open_bench(bench: Bench, engine: str, emulated: bool, *options: str) -> Iterator[hal.Rig]:
    """Open the rig of a bench, in simulation or with its emulator."""
    sets = [f"objects=[floor, table, {flow(bench.cube)}]", f"simulation.engine={engine}"]
    if not emulated:
        overrides = [*sets, "cameras={}"]
        with hal.open(bench.rig, sim=True, clock="lock_step", pad="none", overrides=overrides) as rig:
            yield rig
        return
    sets.append(f"cameras={flow({'scene': CAMERA})}")
    with contextlib.ExitStack() as stack:
        if bench.host:
            sets += [f"robots.arm.real.host={bench.host}", "robots.arm.gripper.enabled=true"]
            words = [word for value in sets for word in ("--set", value)]
            stack.enter_context(emulated_franka("fr3", bench.host, "--config", bench.rig, *words, *options))
        else:
            emulator = stack.enter_context(EmulatorProcess(bench.rig, *sets))
            sets = emulator.overrides
        yield stack.enter_context(hal.open(bench.rig, sim=False, pad="none", overrides=sets))


def flow(value: Any) -> str:
    """Return YAML on one line."""
    if isinstance(value, dict):
        return "{" + ", ".join(f"{key}: {flow(item)}" for key, item in value.items()) + "}"
    return "[" + ", ".join(map(flow, value)) + "]" if isinstance(value, list) else str(value).replace("True", "true")


def pick_and_place(rig: hal.Rig, bench: Bench, tries: int, seed: int = 0, speed: float = 0.5) -> Iterator[Try]:
    """Yield how each try of a seed ends; one that a busy computer stops is made again."""
    random, arm, home = np.random.default_rng(seed), rig.robots["arm"], True
    for _ in range(tries):
        start, goal = random.uniform(bench.lower, bench.upper), random.uniform(bench.lower, bench.upper)
        at = hal.Pose.from_rpy((*start, bench.cube["position"][2]), (0.0, 0.0, random.uniform(-bench.turn, bench.turn)))
        for stops in range(MOST_STOPS + 1):
            try:
                if stops or home:
                    arm.move_to(arm.home, speed=speed, unattended=True)
                found = try_once(rig, at, goal, speed)
                break
            except (hal.MotionStopped, hal.RobotFault, hal.StaleStateError) as stop:
                if stops == MOST_STOPS or (isinstance(stop, hal.MotionStopped) and stop.code not in BUSY):
                    raise
        yield found._replace(stops=stops)
        home = bool(found.reason)


def try_once(rig: hal.Rig, at: hal.Pose, goal: NDArray[np.float64], speed: float) -> Try:
    """Pick the cube at a pose in the world, and put it down at x and y of the goal, m."""
    arm = rig.robots["arm"]
    gripper = arm.gripper
    assert gripper is not None
    gripper.open()
    rig.world.reset("cube", pose=at)
    rig.clock.sleep(0.2)
    before = rig.world.pose("cube").position
    found = locate_by_truth(rig, arm, "cube")
    assert found is not None
    pose = grasp_pose(found, gripper)
    done = grasp(arm, pose, width=found.width, approach=0.06, lift=LIFT, hold=0.2, speed=speed, unattended=True)
    if not done:
        return Try(done.reason, np.nan, np.nan)
    rig.clock.sleep(0.1)
    up = rig.world.pose("cube").position[2] - before[2]
    width, way = gripper.state().width, np.append(goal - before[:2], 0.0)
    over, down = (hal.Pose(done.tcp.position + way + z, done.tcp.orientation) for z in ([0, 0, 0], [0, 0, -LIFT]))
    reason = "" if up > 0.9 * LIFT else "not up"
    try:
        for there in (over, down):
            arm.move_to(there, straight=True, speed=speed, unattended=True)
    except (hal.Unreachable, hal.CommandError) as error:
        reason = error.code
    gripper.open()
    rig.clock.sleep(0.2)
    off = float(np.linalg.norm(rig.world.pose("cube").position[:2] - goal))
    if not reason:
        arm.move_to(over, straight=True, speed=speed, unattended=True)
    return Try(reason or ("" if off < NEAR else "not there"), width, off)


def summarise(found: list[Try]) -> str:
    """Return the successes and the reasons of the others."""
    ends = Counter(each.reason for each in found)
    reasons = [f"{count} {reason}" for reason, count in ends.most_common() if reason]
    if stops := sum(each.stops for each in found):
        reasons.append(f"{stops} made again after a stop")
    return "; ".join([str(ends[""]), *reasons])


def run(quick: bool) -> Iterator[Table]:
    """Yield the table."""
    tries = 1 if quick else 100
    columns = ("", "succeed; others", "width, mm: median, least, greatest", "off the goal, mm: median, greatest")
    table = Table(f"pick and place, {tries} tries each, engine {ENGINES[0]}", columns)
    for name, bench in list(BENCHES.items())[: 1 if quick else 3]:
        verdicts = []
        ways = (("simulated", False), ("emulated", True))[: 1 if quick else 2]  # tests/wire has a short emulated one
        for how, emulated in ways:
            with open_bench(bench, ENGINES[0], emulated, "--lockstep") as rig:
                found = list(pick_and_place(rig, bench, tries))
            widths = [1e3 * each.width for each in found if not each.reason] or [np.nan]
            off = [1e3 * each.off for each in found if not each.reason] or [np.nan]
            spread = f"{median(widths):.2f}, {min(widths):.2f}, {max(widths):.2f}"
            table.add(f"{name}, {how}", summarise(found), spread, f"{median(off):.2f}, {max(off):.2f}")
            verdicts.append([each.reason or "success" for each in found])
        if len(verdicts) == 2:
            pairs = enumerate(zip(*verdicts, strict=True))
            others = [f"try {k}: {one} and {other}" for k, (one, other) in pairs if one != other]
            table.add(f"{name}, simulated and emulated end differently", "; ".join(others) or "0")
    yield table
