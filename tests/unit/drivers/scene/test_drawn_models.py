"""How the built-in models are drawn where packages of meshes are not installed."""

from __future__ import annotations

import importlib.metadata
import importlib.util
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import coal
import numpy as np
import pytest

from hal.config import load
from hal.config.data_files import data_folder, list_data
from hal.drivers.scene.drawn import DrawnWorld
from hal.drivers.scene.meshes import MeshLibrary
from hal.drivers.scene.shapes import Mesh, parts_of
from hal.drivers.scene.urdf_files import absent_packages
from hal.errors import ConfigError
from hal.kinematics.composition import compose_urdf
from hal.kinematics.urdf import read_urdf

MODELS = list_data("robots")
OWN = ("panda", "fr3", "iiwa", "sawyer", "yam", "openarm_left", "openarm_right", "piper")
"""Models that this project has all files of."""
MESHES = ("pybullet_data", "example_robot_data", "franky_sim")
GAP = 0.005
"""Largest distance of a link from the next, m."""

Hide = Callable[..., None]


@pytest.fixture
def hide(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Hide:
    """Make packages look as if they were not installed."""
    find_spec, distribution = importlib.util.find_spec, importlib.metadata.distribution

    def apply(*names: str) -> None:
        def spec(name: str, *others: Any) -> Any:
            return None if name in names else find_spec(name, *others)

        def metadata(name: str) -> Any:
            if name.replace("-", "_") in names:
                raise importlib.metadata.PackageNotFoundError(name)
            return distribution(name)

        monkeypatch.syspath_prepend(tmp_path)  # packages that were found are looked for again
        monkeypatch.setattr(importlib.util, "find_spec", spec)
        monkeypatch.setattr(importlib.metadata, "distribution", metadata)

    return apply


def world_of(model: str) -> DrawnWorld:
    """The world of one arm; the test is skipped where the package of its URDF is not installed."""
    arm = {"model": model} | ({"arm": "left"} if model == "baxter" else {})
    try:
        plan = load({"sim": True, "robots": {"arm": arm}}).resolve()
        assert plan.world is not None
        return DrawnWorld(plan.world)
    except ConfigError as error:
        if all(problem.code == "missing_package" for problem in error.problems):
            pytest.skip(error.problems[0].message)
        raise


def meshes_of(world: DrawnWorld, folder: Path) -> dict[str, list[Mesh]]:
    """All that is drawn of each link."""
    body = world.bodies["arm"]
    names = {number: name for name, number in body.links.items()}
    found: dict[str, list[Mesh]] = {}
    for part in parts_of(body.id, body.visuals, MeshLibrary(folder).load):
        if not part.coarse:
            found.setdefault(names[part.link], []).append(part.mesh)
    return found


def gaps(world: DrawnWorld, meshes: dict[str, list[Mesh]]) -> Iterator[tuple[str, str, float]]:
    """Yield each drawn link, the next one towards the base, and their distance, m."""
    body = world.bodies["arm"]
    solids = {link: solid(parts) for link, parts in meshes.items()}
    parents = {joint.child: joint.parent for joint in body.joints}
    for link, shape in solids.items():
        above = parents.get(link)
        while above is not None and above not in solids:
            above = parents.get(above)
        if above is not None:
            frames = world.link_frames([(body.id, body.links[name]) for name in (above, link)])
            here, there = (coal.Transform3s(frame[:3, :3], frame[:3, 3]) for frame in frames)
            asked, found = coal.DistanceRequest(), coal.DistanceResult()
            yield link, above, coal.distance(solids[above], here, shape, there, asked, found)


def solid(meshes: list[Mesh]) -> Any:
    """The triangles of meshes, for coal."""
    first = np.cumsum([0, *(len(mesh.positions) for mesh in meshes)])
    points = np.concatenate([mesh.positions for mesh in meshes]).astype(float)
    faces = np.concatenate([mesh.faces.astype(np.int64) + k for mesh, k in zip(meshes, first, strict=False)])
    shape = coal.BVHModelOBBRSS()
    shape.beginModel(len(faces), len(points))
    shape.addVertices(points)
    shape.addTriangles(faces)
    shape.endModel()
    return shape


@pytest.mark.parametrize("model", MODELS)
def test_every_link_that_can_be_touched_is_drawn_without_pybullet(hide: Hide, model: str) -> None:
    hide("pybullet_data")
    world = world_of(model)
    body = world.bodies["arm"]
    drawn = {visual.link for visual in body.visuals if visual.kind != "mesh" or Path(visual.file).is_file()}
    (robot,) = world.spec.robots
    links = read_urdf(Path(robot.urdf)).links.values()
    touched = {link.name for link in links if link.collisions}
    assert len(touched) > len(robot.joints)
    assert touched <= {name for name, number in body.links.items() if number in drawn}


@pytest.mark.parametrize("model", OWN)
def test_neighbouring_links_touch_without_any_package_of_meshes(hide: Hide, tmp_path: Path, model: str) -> None:
    hide(*MESHES)
    world = world_of(model)
    (robot,) = world.spec.robots
    drawn = meshes_of(world, tmp_path)
    assert len(drawn) > len(robot.joints)  # the base too
    for name, q in (("home", robot.home), ("lower", robot.limits.lower), ("upper", robot.limits.upper)):
        moved = DrawnWorld(replace(world.spec, robots=(replace(robot, initial=tuple(np.clip(q, -3.0, 3.0))),)))
        assert {found[:2]: found[2] for found in gaps(moved, drawn) if found[2] > GAP} == {}, name


@pytest.mark.parametrize(("model", "package"), [("panda", "example_robot_data"), ("fr3", "franky_sim")])
def test_without_any_package_a_franka_arm_has_plain_shapes_and_a_note(hide: Hide, model: str, package: str) -> None:
    hide(*MESHES)
    urdf = data_folder("robots") / f"{model}.urdf"
    for path in (urdf, compose_urdf(urdf)):  # the second as it is with a tool
        files = [Path(visual.file) for link in read_urdf(path).links.values() for visual in link.visuals]
        assert len(files) == 11
        assert {file.parent.name for file in files} == {"shapes"}
        assert absent_packages(str(path)) == (package,)
    (note,) = world_of(model).notes
    assert "robot-hal[robots]" in note
