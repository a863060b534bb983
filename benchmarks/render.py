"""Time of a simulated RGB-D frame by each renderer, of shadows and variation, and until the first one of a rig.

Renderers and rigs take turns, so that their ratios hold on a busy computer too. The goals: OpenGL at least 4 times as
fast as PyBullet's own renderer at 256 x 256; a step at most 15 % longer with shadows, and 10 % with variation.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import replace
from functools import partial

import hal
from hal.config import load
from hal.drivers.scene.camera import choose_renderer
from hal.drivers.scene.drawn import DrawnWorld
from hal.drivers.scene.exposure import camera_pose
from hal.drivers.scene.renderer import Renderer
from hal.specs import CameraSpec

from .kit import Table, median, median_ratio, run_in_turns, timed

PATHS = ("drivers/scene", "drivers/pybullet/tiny.py")
CONFIG = "panda_table"
SIZES = ((256, 256), (640, 480), (1280, 720))
PLAIN = "simulation.shadows=false"
STEPS = {
    "no camera": (CONFIG, "cameras={}"),
    "256x256": (CONFIG, PLAIN),
    "256x256, shadows": (CONFIG,),
    "256x256, variation": (f"{CONFIG}_randomized", PLAIN),
    "256x256, shadows, variation": (f"{CONFIG}_randomized",),
    "640x480": (
        CONFIG,
        PLAIN,
        *(f"cameras.{name}.output={{width: 640, height: 480}}" for name in ("scene", "wrist")),
    ),
}
"""Rigs whose steps are measured, each a configuration and overrides."""
FIRST_FRAME = """
import time, hal, hal.config, pybullet, moderngl
start = time.perf_counter()
with hal.open({config!r}, sim=True, clock={clock!r}, pad="none") as rig:
    for camera in rig.cameras.values():
        camera.read(timeout=20)
    print("first frames after", time.perf_counter() - start)
"""


def sized(camera: CameraSpec, width: int, height: int) -> CameraSpec:
    """Return the same view in another size."""
    focal = 0.9 * width
    K = ((focal, 0.0, (width - 1) / 2), (0.0, focal, (height - 1) / 2), (0.0, 0.0, 1.0))
    return replace(camera, width=width, height=height, K=K, streams=("color", "depth"))


def first_frame(clock: str, cache: str) -> float:
    """Return the time from hal.open, libraries imported, to a frame of every camera, s, in a fresh process."""
    code = FIRST_FRAME.format(config=CONFIG, clock=clock)
    environment = {**os.environ, "XDG_CACHE_HOME": cache}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    return float(done.stdout.split()[-1])


def measure_steps(rig: hal.Rig, seeds: Iterator[int | None], steps: int) -> float:
    """Return the processor time of a policy step of 20 Hz with a frame of every camera, all threads, ms."""
    rig.world.randomize(next(seeds))
    times = []
    with rig.robots["panda"].control(rate_hz=20) as control:
        for k in range(steps + 1):  # the first pictures of a variation also make its textures
            control.send(hal.Twist([0.0, 0.05 * (-1) ** (k // 4), 0.0]))
            rig.clock.sleep(0.05)
            for camera in rig.cameras.values():
                camera.read()
            times.append(time.process_time())
    return 1e3 * (times[-1] - times[0]) / steps


def step_costs(rounds: int, steps: int) -> Table:
    """Return the processor time of steps of each of :data:`STEPS`, in turns; variation has a seed for each turn."""
    with contextlib.ExitStack() as stack:
        turns = {}
        for name, (config, *overrides) in STEPS.items():
            rig = stack.enter_context(hal.open(config, sim=True, clock="lock_step", overrides=overrides, pad="none"))
            seeds = itertools.count() if "variation" in name else itertools.repeat(None)
            turns[name] = partial(measure_steps, rig, seeds, steps)
        found = run_in_turns(turns, rounds)
    columns = ("", "whole step", "of it two pictures", "of the step at 256x256")
    table = Table(f"processor time of a step of 20 Hz, ms, medians of {rounds} turns of {steps} steps", columns)
    base = median(found["no camera"])
    for name, times in found.items():
        table.add(name, median(times), median(times) - base, median_ratio(times, found["256x256"]))
    return table


def run(quick: bool) -> Iterator[Table]:
    """Yield the tables."""
    frames, sizes = (1, SIZES[:1]) if quick else (20, SIZES)
    plan = load(CONFIG, sim=True).resolve()
    assert plan.world is not None
    world = DrawnWorld(plan.world)
    start = world.snapshot()  # the frames of the links are computed for each picture
    renderers: dict[str, Renderer] = {name: choose_renderer(world, name) for name in ("gl", "tiny")}

    def draw(renderer: Renderer, view: CameraSpec) -> float:
        world.show(start)
        return 1e3 * timed(lambda: renderer.render(view, camera_pose(world, view)))

    columns = ("camera, size", renderers["gl"].description, "PyBullet's own renderer", "ratio")
    table = Table(f"RGB-D, ms, medians of {frames} frames", columns)
    for camera, (width, height) in itertools.product(plan.cameras, sizes):
        view = sized(camera, width, height)
        turns = {name: partial(draw, renderer, view) for name, renderer in renderers.items()}
        run_in_turns(turns, 1)  # makes buffers and shaders
        ours, own = (median(times) for times in run_in_turns(turns, frames).values())
        table.add(f"{camera.name}, {width}x{height}", ours, own, own / ours)
    yield table
    yield step_costs(*((1, 2) if quick else (10, 40)))
    table = Table("first frame of every camera, s after hal.open was called", ("", "meshes parsed", "meshes cached"))
    for clock in ("lock_step",) if quick else ("lock_step", "real_time"):
        with tempfile.TemporaryDirectory() as cache:
            without = first_frame(clock, cache)
            table.add(clock, without, median(first_frame(clock, cache) for _ in range(1 if quick else 3)))
    yield table
