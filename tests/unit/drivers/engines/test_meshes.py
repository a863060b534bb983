"""Objects from mesh files: what collides and weighs, what is drawn, and which files are refused."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from engines_kit import Engine
from errors_kit import raises_code
from specs import floor

import hal
from hal.drivers.scene.drawn import DrawnWorld
from hal.errors import ConfigError
from hal.kinematics.hulls import convex_hull, mesh_hulls, uniform_solid
from hal.specs import BodySpec

UPRIGHT = (0.0, 0.0, 0.0, 1.0)


def mesh(path: Path, at: tuple[float, float, float] = (0.0, 0.0, 0.5), **changes: Any) -> BodySpec:
    return BodySpec("it", at, UPRIGHT, **{"shape": "mesh", "mesh": str(path), "mass": 2.0, **changes})


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two cubes of 0.1 m with a gap of 0.2 m between them, beside the origin of their file."""
    cubes = [trimesh.creation.box((0.1, 0.1, 0.1)) for _ in range(2)]
    for cube, x in zip(cubes, (1.0, 1.3), strict=True):
        cube.apply_translation((x, 0.0, 0.0))
    path = tmp_path_factory.mktemp("meshes") / "pair.stl"
    trimesh.util.concatenate(cubes).export(path)
    return path


def bowl() -> Any:
    """Return the lower half of a ball's surface, which is not closed."""
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.06)
    return trimesh.Trimesh(ball.vertices, ball.faces[ball.triangles_center[:, 2] < 0.0])


def table() -> Any:
    """Return a slab on four legs, which is not convex."""
    legs = [trimesh.creation.box((0.02, 0.02, 0.1)) for _ in range(4)]
    for k, leg in enumerate(legs):
        leg.apply_translation((0.08 * (-1) ** k, 0.05 * (-1) ** (k // 2), -0.05))
    return trimesh.util.concatenate([trimesh.creation.box((0.2, 0.14, 0.02)), *legs])


def turned(mesh: Any, *angles: float) -> Any:
    """Return a mesh in another pose than that of its axes, off its origin."""
    mesh.apply_transform(hal.Pose.from_rpy((0.3, -0.2, 0.4), angles).matrix())
    return mesh


def random_points() -> Any:
    """Return the hull of random points."""
    return solid(np.random.default_rng(2).normal(0.0, 0.03, (60, 3)))


def solid(points: Any) -> Any:
    """Return the convex hull of points."""
    hull = convex_hull(np.array(points, float))
    return trimesh.Trimesh(hull.points, hull.faces)


SHAPES: dict[str, Callable[[], Any]] = {
    "box": lambda: trimesh.creation.box((0.1, 0.2, 0.3)),
    "heavy": lambda: trimesh.creation.torus(0.05, 0.02, major_sections=320, minor_sections=160),
    "bowl": bowl,
    "slab": lambda: trimesh.creation.box((0.3, 0.2, 0.01)),
    "ball": lambda: trimesh.creation.icosphere(subdivisions=5, radius=0.05),
    "cylinder": lambda: trimesh.creation.cylinder(0.04, 0.1, sections=1000),
    "cone": lambda: trimesh.creation.cone(0.05, 0.1, sections=64),
    "capsule": lambda: trimesh.creation.capsule(0.1, 0.03),
    "table": table,
    "turned": lambda: turned(trimesh.creation.box((0.1, 0.1, 0.2)), 0.4, 0.3, 0.2),
    "random": random_points,
    "annulus": lambda: trimesh.creation.annulus(0.03, 0.06, 0.04),
    "die": lambda: trimesh.creation.icosahedron().apply_scale(0.04),
    "rod": lambda: trimesh.creation.cylinder(0.006, 0.2, sections=48),
    "tilted": lambda: turned(trimesh.creation.torus(0.06, 0.015, major_sections=48, minor_sections=24), 1.2, 0.0, 0.5),
    "small": lambda: trimesh.creation.box((0.01, 0.012, 0.008)),
    "large": lambda: trimesh.creation.box((0.8, 0.6, 0.5)),
    "wedge": lambda: solid([(0, 0, 0), (0.1, 0, 0), (0, 0.1, 0), (0.1, 0.1, 0), (0, 0, 0.08), (0, 0.1, 0.08)]),
    "coarse": lambda: trimesh.creation.uv_sphere(radius=0.05, count=[8, 8]),
    "pair": lambda: trimesh.util.concatenate(
        [trimesh.creation.box((0.05, 0.05, 0.05)), turned(trimesh.creation.box((0.05, 0.05, 0.05)), 0.5, 0.0, 0.0)]
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


@pytest.mark.parametrize("names", [["bowl", "slab", "table"], pytest.param(None, marks=pytest.mark.slow, id="all")])
def test_meshes_load_and_rest_on_the_floor(engine: Engine, tmp_path: Path, names: list[str] | None) -> None:
    """Among them one of 102,400 faces, and a bowl, which is not closed."""
    for file in write_files(tmp_path, names or SHAPES):
        points = np.concatenate([hull.points for hull in mesh_hulls(file)])
        world = engine.world(floor(), mesh(file, (0.0, 0.0, 0.001 - points[:, 2].min()), mass=0.5))
        for _ in range(240):
            world.step()
        matrix = hal.Pose(**world.pose("it")).matrix()
        assert abs((points @ matrix[2, :3] + matrix[2, 3]).min()) <= 1e-3, file.name
        assert np.linalg.norm(world.velocity("it")[0]) < 0.1, file.name  # balls roll on their corners
        world.close()


def test_a_mesh_has_the_mass_and_inertia_of_its_hull(engine: Engine, pair: Path) -> None:
    world = engine.world(mesh(pair, scale=0.5))
    size = (0.2, 0.05, 0.05)
    squares = np.square(size)
    dynamics = world.dynamics("it")
    assert dynamics["mass"] == pytest.approx(2.0)
    assert dynamics["inertia"] == pytest.approx(2.0 * (squares.sum() - squares) / 12.0, rel=1e-4)
    world.set_gravity((0.0, 0.0, 0.0))
    world.set_velocity("it", angular=(0.0, 0.0, 1.0))
    before = np.array(world.pose("it")["position"])
    world.step()
    moved = np.array(world.pose("it")["position"]) - before
    assert moved / world.dt == pytest.approx((0.0, -0.575, 0.0), abs=1e-2), "it turns about its centre of mass"


def test_parts_have_hulls_of_their_own(engine: Engine, pair: Path) -> None:
    for parts, meets in ((False, "it"), (True, "floor")):
        world = engine.world(floor(), mesh(pair, parts=parts))
        assert world.ray((1.15, 0.0, 2.0), (1.15, 0.0, -1.0))["name"] == meets, "in the gap"
        assert world.ray((1.3, 0.0, 2.0), (1.3, 0.0, -1.0))["position"][2] == pytest.approx(0.55, abs=1e-3)
        world.close()


def test_a_mesh_is_drawn_from_its_file(engine: Engine, pair: Path) -> None:
    (visual,) = DrawnWorld(engine.spec(mesh(pair, scale=0.5))).visuals(0)
    assert (visual.kind, visual.file, visual.size) == ("mesh", str(pair), (0.5, 0.5, 0.5))


@pytest.mark.parametrize(
    ("name", "text", "code"),
    [
        ("flat.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nv 1 1 0\nf 1 2 3\nf 2 3 4\n", "bad_mesh"),
        ("index.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 9\n", "bad_mesh"),
        ("empty.obj", "", "bad_mesh"),
        ("text.stl", "no triangles here", "bad_mesh"),
        ("part.step", "ISO-10303-21;", "bad_mesh"),
        ("absent.obj", None, "missing_file"),
    ],
)
def test_a_file_that_is_no_solid_is_refused_by_name(
    engine: Engine, tmp_path: Path, name: str, text: str | None, code: str
) -> None:
    path = tmp_path / name
    if text is not None:
        path.write_text(text)
    world = engine.world()
    with pytest.raises(ConfigError) as refused:
        world.add(mesh(path))
    (problem,) = refused.value.problems
    assert (problem.file, problem.key, problem.code) == (str(path), "objects.it.mesh", code)
    assert world.names() == []


def test_a_rig_file_names_a_mesh(engine: Engine, pair: Path, tmp_path: Path) -> None:
    rig = tmp_path / "rig.yaml"
    lines = "{name: it, mesh: pair.stl, scale: 0.5, parts: true, mass: 0.3, position: [0, 0, 1]}"
    rig.write_text(f"objects: [{lines}]\nrobots: {{panda: {{model: panda}}}}\n")
    with raises_code(ConfigError, "config"):
        hal.open(rig, sim=True, engine=engine.name, clock="lock_step", pad="none")  # there is no such file
    (tmp_path / "pair.stl").write_bytes(pair.read_bytes())
    with hal.open(rig, sim=True, engine=engine.name, clock="lock_step", pad="none") as opened:
        assert opened.world.dynamics("it")["mass"] == pytest.approx(0.3)
        body = next(body for body in opened.plan.world.bodies if body.name == "it")
        assert (body.parts, body.rgba) == (True, (1.0, 1.0, 1.0, 1.0)), "the colours of its file"


def test_hulls_have_the_exact_inertia_of_a_solid_and_few_corners(tmp_path: Path) -> None:
    ball = trimesh.creation.icosphere(subdivisions=4, radius=0.05)
    ball.apply_translation((1.0, 2.0, 3.0))
    hull = convex_hull(np.array(ball.vertices))
    assert len(hull.points) < 1200 < len(ball.vertices)
    solid = uniform_solid([hull])
    assert solid.centre == pytest.approx((1.0, 2.0, 3.0), abs=1e-4)
    assert solid.moments == pytest.approx([0.4 * 0.05**2] * 3, rel=0.01)
    path = tmp_path / "tetrahedron.obj"
    path.write_text("v 0 0 0\nv 1 0 0\nv 0 1 0\nv 0 0 1\nf 1 2 3\nf 1 2 4\nf 1 3 4\nf 2 3 4\n")
    exact = uniform_solid(mesh_hulls(path))
    assert exact.centre == pytest.approx((0.25, 0.25, 0.25))
    assert np.sort(exact.moments) == pytest.approx((0.0625, 0.0625, 0.1))
