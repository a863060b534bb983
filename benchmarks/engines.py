"""The engines of the simulated world as each other's referee: the same runs on each of them.

    python benchmarks/engines.py [--only lock-step|real-time|collect|pictures|speed|cameras|hold] [--seconds 5]
                                 [--robosuite PYTHON]

lock-step   the recorded tour of a gamepad: where the arms end, whether the servo's set-points are equal to the bit, and
            how far the joints are from their set-points.
real-time   the same tour in real time, twice on each engine.
collect     two recorded demonstrations: how high each cube is lifted, and the columns of the datasets.
pictures    two cameras draw the same state after each engine: the share of pixels that differ.
speed       steps/s of ``RigEnv`` at 20 Hz over 240 Hz without cameras, in turns of one second.
cameras     the same with two 256x256 RGB-D cameras, and with PyBullet's own renderer; with ``--robosuite``, the path of
            an interpreter in whose environment robosuite is installed, also the cameras of its task Lift.
hold        how far the 2 kg cube slips in the fingers while it is lifted by 15 cm, and in 10 s after that.
"""

from __future__ import annotations

import argparse
import io
import itertools
import statistics
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from contextlib import redirect_stdout
from pathlib import Path
from typing import Any

import numpy as np

import hal
from hal import registry
from hal.config.data_files import find_data
from hal.geometry import Pose
from hal.learning.gym import RigEnv

sys.path.insert(0, str(Path(__file__).resolve().parent))
from controllers import steps_of_robosuite

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests" / "kits"))
from referee_kit import TOUR, draw_state, drive_tour

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "examples"))
from pick import above, grasp_pose

ENGINES = [name for name in registry.ENGINES if not registry.find_missing(name)]
APART, TURNED = 0.002, 0.01
"""Goal for the ends of the tour, m and rad."""
REAL_TIME_HZ = 200
"""Rate of commands in real time. The slower, the more do two runs differ, on one engine, too: a twist begins and ends
with a command, and when the first one is sent depends on the computer."""


def pairs(found: dict[str, Any]) -> Iterator[tuple[str, Any, Any]]:
    """Yield "one / other" and the two results for each pair of engines."""
    for (one, a), (other, b) in itertools.combinations(found.items(), 2):
        yield f"{one} / {other}", a, b


def show_ends(ends: dict[str, Pose]) -> None:
    """Print how far the ends are apart."""
    for title, a, b in pairs(ends):
        distance, angle = a.distance(b)
        good = distance <= APART and angle <= TURNED
        print(f"  {title}: ends {1e3 * distance:.3f} mm and {1e3 * angle:.3f} mrad apart {'ok' if good else 'FAILS'}")


def lock_step(_: float) -> None:
    """Drive the tour in lock-step."""
    runs = {}
    for name in ENGINES:
        began = time.perf_counter()
        runs[name] = drive_tour(name)
        took, run = time.perf_counter() - began, runs[name]
        print(f"  {name:9s} {took:5.1f} s, joints at most {1e3 * run.lag:.2f} mrad from their set-points")
    for title, a, b in pairs(runs):
        same = a.q_set.shape == b.q_set.shape and np.array_equal(a.q_set, b.q_set)
        print(f"  {title}: {len(a.q_set)} set-points {'equal to the bit' if same else 'DIFFER'}")
    show_ends({name: run.end for name, run in runs.items()})


def real_time(_: float) -> None:
    """Drive the tour in real time, twice on each engine, with cameras."""
    ends: dict[str, list[Pose]] = {name: [] for name in ENGINES}
    for _turn in range(2):
        for name in ENGINES:
            with hal.open("panda_table", sim=True, engine=name, pad=TOUR) as rig:
                arm, pad = rig.robots["panda"], rig.gamepads["pad"]
                teleop = hal.Teleop(arm)
                with arm.control(deadman=pad.hold(teleop.mapping.deadman), rate_hz=REAL_TIME_HZ) as control:
                    for tick in rig.clock.rate(REAL_TIME_HZ):
                        motion, grip = teleop.step(pad.state(), tick.dt)
                        control.send(motion, grip=grip)
                        if pad.finished:
                            break
                ends[name].append(arm.state().tcp)
                (group,) = rig.statistics().values()
                print(f"  {name:9s} {group['ticks']} ticks, {group['missed']} missed")
    for name, (one, other) in ends.items():
        distance, angle = one.distance(other)
        print(f"  {name:9s} two runs end {1e3 * distance:.3f} mm and {1e3 * angle:.3f} mrad apart")
    for turn in range(2):
        show_ends({name: found[turn] for name, found in ends.items()})


def collect(_: float) -> None:
    """Record two demonstrations."""
    from hal.apps.collect import main
    from hal.recording import Dataset

    columns = {}
    pad = find_data("config", "teleop/demonstrations.jsonl")
    for name in ENGINES:
        with tempfile.TemporaryDirectory() as folder:
            words = ["--sim", "--engine", name, "--out", f"{folder}/data", "--pad", str(pad), "--episodes", "2"]
            words += ["--set", "cameras={}", "--set", "simulation.clock=lock_step"]
            printed = io.StringIO()
            with redirect_stdout(printed):
                status = main(words)
            if status != 0:
                print(printed.getvalue())
            episodes = list(Dataset(f"{folder}/data").episodes)
            heights = [float(np.ptp(episode.columns["rig.object.cube"][:, 2])) for episode in episodes]
            marks = [episode.success for episode in episodes]
            columns[name] = [sorted(episode.columns) for episode in episodes]
            lifted = ", ".join(f"{100 * height:.1f} cm" for height in heights)
            print(f"  {name:9s} cubes lifted by {lifted}; judged {marks}")
    for title, a, b in pairs(columns):
        print(f"  {title}: columns {'equal' if a == b else 'DIFFER'}")


def pictures(_: float) -> None:
    """Draw the state after a motion on the first engine, after each of them."""
    seen: dict[str, Any] = {}
    state = None
    for name in ENGINES:
        seen[name], state = draw_state(name, state)
    for title, a, b in pairs(seen):
        for camera in a:
            color = (a[camera].color != b[camera].color).any(axis=2)
            depth = np.abs(a[camera].depth - b[camera].depth)
            print(
                f"  {title}, {camera}: {color.sum()} of {color.size} pixels differ in colour, "
                f"{(depth > 0).sum()} in depth, by at most {1e3 * depth.max():.3f} mm"
            )


def speed(seconds: float) -> None:
    """Step an environment on each engine, in turns."""
    step_in_turns({name: RigEnv("panda_table", engine=name, overrides=("cameras={}",)) for name in ENGINES}, seconds)


ROBOSUITE_CAMERAS: dict[str, Any] = {
    "has_offscreen_renderer": True,
    "use_camera_obs": True,
    "camera_names": ["frontview", "robot0_eye_in_hand"],
    "camera_heights": 256,
    "camera_widths": 256,
    "camera_depths": True,
}
robosuite_python = ""
"""Interpreter with robosuite; empty for none."""


def cameras(seconds: float) -> None:
    """Step environments with two cameras, in turns; then robosuite."""
    environments = {name: RigEnv("panda_table", engine=name) for name in ENGINES}
    if "pybullet" in ENGINES:
        own = ("simulation.renderer=tiny",)
        environments["PyBullet's own"] = RigEnv("panda_table", engine="pybullet", overrides=own)
    step_in_turns(environments, seconds)
    if robosuite_python:
        rate = steps_of_robosuite(robosuite_python, seconds, **ROBOSUITE_CAMERAS)
        print(f"  {'robosuite':16s} {rate:7.1f} steps/s")


def hold(_: float) -> None:
    """Grasp, lift and hold the heavy cube."""
    for name in ENGINES:
        for force in (40.0, 60.0):
            with hal.open(
                "panda_table", sim=True, engine=name, clock="lock_step", pad="none", overrides=["cameras={}"]
            ) as rig:
                arm = rig.robots["panda"]
                grasp = grasp_pose(arm, rig.world.pose("cube"))
                arm.move_to(above(grasp), speed=0.5)
                arm.move_to(grasp, speed=0.2)
                arm.gripper.grasp(0.03, force=force)
                seen = [seen_from_hand(rig)]
                arm.move_to(above(grasp), speed=0.5)
                seen.append(seen_from_hand(rig))
                rig.clock.sleep(10.0)
                seen.append(seen_from_hand(rig))
                lifted, held = (1e3 * float(np.linalg.norm(b - a)) for a, b in itertools.pairwise(seen))
                print(f"  {name:9s} {force:g} N: {lifted:.2f} mm while it is lifted, {held:.2f} mm in 10 s")


def seen_from_hand(rig: hal.Rig) -> np.ndarray:
    """Return where the cube is from the tcp (3,), m."""
    arm = rig.robots["panda"]
    return ((arm.base @ arm.state().tcp).inverse() @ rig.world.pose("cube")).position


def step_in_turns(environments: dict[str, RigEnv], seconds: float) -> None:
    """Print the steps/s of environments that take turns of a second, and close them."""
    rates: dict[str, list[float]] = {name: [] for name in environments}
    try:
        actions = {}
        for name, env in environments.items():
            env.reset(seed=0)
            actions[name] = env.action_space.sample() * 0 + np.append(env.robot.home, 0.0).astype(np.float32)
        for _ in range(max(1, round(seconds))):
            for name, env in environments.items():
                began, steps = time.perf_counter(), 0
                while time.perf_counter() - began < 1.0:
                    action = actions[name].copy()
                    action[:7] += 0.05 * np.sin(0.05 * steps + np.arange(7))
                    env.step(action)
                    steps += 1
                rates[name].append(steps / (time.perf_counter() - began))
    finally:
        for env in environments.values():
            env.close()
    for name, values in rates.items():
        print(f"  {name:16s} {statistics.median(values):7.1f} steps/s")
    for title, a, b in pairs(rates):
        ratio = statistics.median(y / x for x, y in zip(a, b, strict=True))
        print(f"  {title}: the second takes {ratio:.2f} times as many steps")


PARTS: dict[str, Callable[[float], None]] = {
    "lock-step": lock_step,
    "real-time": real_time,
    "collect": collect,
    "pictures": pictures,
    "speed": speed,
    "cameras": cameras,
    "hold": hold,
}


def main() -> None:
    """Run what the command line names."""
    parser = argparse.ArgumentParser(description="the engines of the simulated world beside each other")
    parser.add_argument("--only", choices=[*PARTS], help="one part")
    parser.add_argument("--seconds", type=float, default=5.0, help="seconds for each engine's speed (%(default)g)")
    parser.add_argument("--robosuite", default="", metavar="PYTHON", help="interpreter in whose environment it is")
    args = parser.parse_args()
    global robosuite_python
    robosuite_python = args.robosuite
    print(", ".join(f"{name} {' '.join(registry.versions(name).values())}" for name in ENGINES))
    for name, part in PARTS.items():
        if args.only in (None, name):
            print(name)
            part(args.seconds)


if __name__ == "__main__":
    main()
