"""Time of a simulated RGB-D frame by each renderer, and time to the first one with and without a mesh cache.

    python benchmarks/render.py [--frames 20] [--config panda_table]

The two renderers take turns in the same run, so that their ratio holds on a busy machine too; times are medians.
The goal: OpenGL at least 4 times as fast as PyBullet's own renderer at 256 x 256.
"""

from __future__ import annotations

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path

from hal.config import load
from hal.drivers.scene.camera import choose_renderer
from hal.drivers.scene.drawn import DrawnWorld
from hal.drivers.scene.exposure import camera_pose
from hal.drivers.scene.renderer import Renderer
from hal.specs import CameraSpec

SIZES = ((256, 256), (640, 480), (1280, 720))
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


def timed(renderer: Renderer, world: DrawnWorld, camera: CameraSpec) -> float:
    """Return the time of one frame, ms."""
    start = time.perf_counter()
    renderer.render(camera, camera_pose(world, camera))
    return (time.perf_counter() - start) * 1e3


def first_frame(config: str, clock: str, cache: str) -> float:
    """Return the time from hal.open, libraries imported, to a frame of every camera, s, in a fresh process."""
    code = FIRST_FRAME.format(config=config, clock=clock)
    environment = {**os.environ, "XDG_CACHE_HOME": cache}
    done = subprocess.run(
        [sys.executable, "-c", code], env=environment, capture_output=True, text=True, check=True, timeout=120
    )
    return float(done.stdout.split()[-1])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--frames", type=int, default=20, help="of each renderer, size and camera")
    parser.add_argument("--config", default="panda_table", help="a rig")
    arguments = parser.parse_args()

    plan = load(arguments.config, sim=True).resolve()
    assert plan.world is not None
    world = DrawnWorld(plan.world)
    renderers: dict[str, Renderer] = {
        "OpenGL": choose_renderer(world, "gl"),
        "PyBullet's own": choose_renderer(world, "tiny"),
    }
    start = world.snapshot()  # the frames of the links are computed for each picture
    print(f"{renderers['OpenGL'].description}; RGB-D, median ms per frame, and their ratio")
    print(f"{'camera':10} {'size':>10} {'OpenGL':>10} {'own':>10} {'ratio':>7}")
    for camera in plan.cameras:
        for width, height in SIZES:
            view = sized(camera, width, height)
            times: dict[str, list[float]] = {name: [] for name in renderers}
            for turn in range(arguments.frames + 1):
                for name, renderer in renderers.items():
                    world.show(start)
                    spent = timed(renderer, world, view)
                    if turn:  # the first one makes buffers and shaders
                        times[name].append(spent)
            ours, own = (statistics.median(values) for values in times.values())
            print(f"{camera.name:10} {width:>5}x{height:<4} {ours:>10.1f} {own:>10.1f} {own / ours:>7.1f}")

    print("\nfirst frame of every camera, s after hal.open was called (goal: 5 without the cache, 2 with it)")
    for clock in ("lock_step", "real_time"):
        with tempfile.TemporaryDirectory() as cache:
            without = first_frame(arguments.config, clock, cache)
            files = len(list(Path(cache).rglob("*.npz")))
            cached = statistics.median(first_frame(arguments.config, clock, cache) for _ in range(3))
        print(f"{clock:10} meshes parsed {without:5.2f}   cached ({files} files) {cached:5.2f}")


if __name__ == "__main__":
    main()
