"""Mesh files as objects of the simulated world: whether each loads, and how far from the floor it comes to rest.

    python benchmarks/meshes.py [--engine mujoco] [--count 20]

Writes 20 OBJ and STL files, among them one whose surface is not closed and one with 102,400 faces, puts each 1 mm above
the floor, and prints after 1 s how far the lowest point of its hull is from the floor, and how fast it is.
"""

from __future__ import annotations

import argparse
import tempfile
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import trimesh

from hal import registry
from hal.geometry import Pose
from hal.kinematics.hulls import convex_hull, mesh_hulls
from hal.specs import BodySpec, WorldSpec

make = trimesh.creation


def bowl() -> Any:
    """Return the lower half of a ball's surface, which is not closed."""
    ball = make.icosphere(subdivisions=4, radius=0.06)
    return trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 0.0])


def table() -> Any:
    """Return a slab on four legs, which is not convex."""
    legs = [make.box((0.02, 0.02, 0.1)) for _ in range(4)]
    for k, leg in enumerate(legs):
        leg.apply_translation((0.08 * (-1) ** k, 0.05 * (-1) ** (k // 2), -0.05))
    return trimesh.util.concatenate([make.box((0.2, 0.14, 0.02)), *legs])


def turned(mesh: Any, *angles: float) -> Any:
    """Return a mesh in another pose than that of its axes, off its origin."""
    mesh.apply_transform(Pose.from_rpy((0.3, -0.2, 0.4), angles).matrix())
    return mesh


def random_points() -> Any:
    """Return the hull of random points."""
    return solid(np.random.default_rng(2).normal(0.0, 0.03, (60, 3)))


def solid(points: Any) -> Any:
    """Return the convex hull of points."""
    hull = convex_hull(np.array(points, float))
    return trimesh.Trimesh(hull.points, hull.faces)


SHAPES: dict[str, Callable[[], Any]] = {
    "box": lambda: make.box((0.1, 0.2, 0.3)),
    "heavy": lambda: make.torus(0.05, 0.02, major_sections=320, minor_sections=160),
    "bowl": bowl,
    "slab": lambda: make.box((0.3, 0.2, 0.01)),
    "ball": lambda: make.icosphere(subdivisions=5, radius=0.05),
    "cylinder": lambda: make.cylinder(0.04, 0.1, sections=1000),
    "cone": lambda: make.cone(0.05, 0.1, sections=64),
    "capsule": lambda: make.capsule(0.1, 0.03),
    "table": table,
    "turned": lambda: turned(make.box((0.1, 0.1, 0.2)), 0.4, 0.3, 0.2),
    "random": random_points,
    "annulus": lambda: make.annulus(0.03, 0.06, 0.04),
    "die": lambda: make.icosahedron().apply_scale(0.04),
    "rod": lambda: make.cylinder(0.006, 0.2, sections=48),
    "tilted": lambda: turned(make.torus(0.06, 0.015, major_sections=48, minor_sections=24), 1.2, 0.0, 0.5),
    "small": lambda: make.box((0.01, 0.012, 0.008)),
    "large": lambda: make.box((0.8, 0.6, 0.5)),
    "wedge": lambda: solid([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0.1, 0.1, 0), (0, 0, 0.08), (0, 0.1, 0.08)]),
    "coarse": lambda: make.uv_sphere(radius=0.05, count=[8, 8]),
    "pair": lambda: trimesh.util.concatenate(
        [make.box((0.05, 0.05, 0.05)), turned(make.box((0.05, 0.05, 0.05)), 0.5, 0.0, 0.0)]
    ),
}
"""What the files show, by their names; every second one is an STL file."""


def write_files(folder: Path, names: Iterable[str]) -> list[Path]:
    """Write the files of some of :data:`SHAPES`."""
    files, every = [], list(SHAPES)
    for name in names:
        files.append(folder / f"{name}.{'stl' if every.index(name) % 2 else 'obj'}")
        SHAPES[name]().export(files[-1])
    return files


def rest(engine: str, file: Path) -> tuple[float, float, float]:
    """Return how far a mesh's lowest point is from the floor after 1 s, m, its speed, m/s, and the load time, s."""
    level = (0.0, 0.0, 0.0, 1.0)
    points = np.concatenate([hull.points for hull in mesh_hulls(file)])
    floor = BodySpec("floor", (0.0, 0.0, 0.0), level, "plane")
    it = BodySpec("it", (0.0, 0.0, 0.001 - points[:, 2].min()), level, "mesh", mesh=str(file), mass=0.5)
    start = time.perf_counter()
    world: Any = registry.load(engine, "world")(WorldSpec(engine, 240.0, (0.0, 0.0, -9.81), (floor, it), ()))
    loading = time.perf_counter() - start
    for _ in range(240):
        world.step()
    matrix = Pose(**world.pose("it")).matrix()
    lowest = (points @ matrix[2, :3] + matrix[2, 3]).min()
    speed = float(np.linalg.norm(world.velocity("it")[0]))
    world.close()
    return float(lowest), speed, loading


def main() -> None:
    """Print a line for each file and engine."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--engine", choices=registry.ENGINES, help="one engine; all by default")
    parser.add_argument("--count", type=int, default=len(SHAPES))
    arguments = parser.parse_args()
    engines = [arguments.engine] if arguments.engine else registry.ENGINES
    within = dict.fromkeys(engines, 0)
    with tempfile.TemporaryDirectory() as folder:
        files = write_files(Path(folder), list(SHAPES)[: arguments.count])
        for file in files:
            faces = len(trimesh.load(str(file), force="mesh").faces)
            for engine in engines:
                lowest, speed, loading = rest(engine, file)
                within[engine] += abs(lowest) <= 1e-3
                print(
                    f"{file.name:14} {faces:7} faces, {engine:8} {1e3 * lowest:+.3f} mm from the floor,"
                    f" {1e3 * speed:.1f} mm/s, loaded in {1e3 * loading:.0f} ms"
                )
    print(", ".join(f"{engine}: {count} of {len(files)} within 1 mm" for engine, count in within.items()))


if __name__ == "__main__":
    main()
