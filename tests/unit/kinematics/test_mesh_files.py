"""Files that URDFs name: beside them, above them, or in an installed Python package."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest
from specs import world_spec

from hal.drivers.scene.drawn import DrawnWorld
from hal.errors import ConfigError
from hal.kinematics.mesh_files import hull_points, mesh_file, package_folder
from hal.specs import BodySpec

CUBE = """
v -1 -1 -1
v 1 -1 -1
v 0 1 -1
v 0 0 1
f 1 3 2
f 1 2 4
f 2 3 4
f 3 1 4
"""


def thing(folder: Path, mesh: str) -> BodySpec:
    """A body whose URDF, in ``folder``, draws ``mesh``."""
    urdf = folder / "thing.urdf"
    urdf.write_text(
        '<robot name="thing"><link name="base"><inertial><mass value="1"/><inertia ixx="1" ixy="0" ixz="0" iyy="1" '
        f'iyz="0" izz="1"/></inertial><visual><geometry><mesh filename="{mesh}"/></geometry></visual></link></robot>'
    )
    return BodySpec("thing", (0.0, 0.0, 0.0), (0.0, 0.0, 0.0, 1.0), "urdf", urdf=str(urdf))


@pytest.fixture
def package(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An installed package with a mesh in it; importing it fails."""
    folder = tmp_path / "site" / "lab_meshes"
    (folder / "parts").mkdir(parents=True)
    (folder / "__init__.py").write_text("raise RuntimeError('this must not be imported')")
    (folder / "parts" / "cube.obj").write_text(CUBE)
    monkeypatch.syspath_prepend(tmp_path / "site")
    return folder


def test_a_package_is_found_and_not_imported(package: Path) -> None:
    assert package_folder("lab_meshes") == package
    assert package_folder("lab_meshez") is None
    assert package_folder("") is None
    assert "lab_meshes" not in sys.modules


def test_files_beside_a_urdf_or_above_it_come_first(package: Path, tmp_path: Path) -> None:
    folder = tmp_path / "robot" / "urdf"
    folder.mkdir(parents=True)
    name = "package://lab_meshes/parts/cube.obj"
    assert mesh_file(name, folder) == package / "parts" / "cube.obj"
    for place in (tmp_path / "robot", folder):
        (place / "lab_meshes" / "parts").mkdir(parents=True)
        (place / "lab_meshes" / "parts" / "cube.obj").touch()
        assert mesh_file(name, folder) == place / "lab_meshes" / "parts" / "cube.obj"


@pytest.mark.parametrize("name", ["lab_meshes/parts/cube.obj", "package://lab_meshes/parts/ball.obj", ""])
def test_what_is_nowhere_should_be_beside_the_urdf(package: Path, tmp_path: Path, name: str) -> None:
    """Only ``package://`` means a package: a plain path that happens to look like one does not."""
    found = mesh_file(name, tmp_path)
    assert found.is_relative_to(tmp_path)
    assert not found.is_file()


def test_an_absolute_path_stays_one(tmp_path: Path) -> None:
    mesh = tmp_path / "cube.obj"
    mesh.write_text(CUBE)
    assert mesh_file(f"file://{mesh}", Path("/nowhere")) == mesh


def test_the_simulation_draws_a_mesh_out_of_a_package(package: Path, tmp_path: Path) -> None:
    world = DrawnWorld(world_spec(thing(tmp_path, "package://lab_meshes/parts/cube.obj")))
    (shape,) = world.visuals(world.bodies["thing"].id)
    assert Path(shape.file) == package / "parts" / "cube.obj"


def test_a_mesh_that_an_installed_package_lacks_is_a_problem(package: Path, tmp_path: Path) -> None:
    with pytest.raises(ConfigError) as caught:
        DrawnWorld(world_spec(thing(tmp_path, "package://lab_meshes/ball.obj")))
    (problem,) = caught.value.problems
    assert (problem.file, problem.code) == (str(tmp_path / "thing.urdf"), "missing_file")
    assert "package://lab_meshes/ball.obj" in problem.message


def test_the_hull_of_a_mesh_that_was_changed_is_computed_again(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    mesh = tmp_path / "cube.obj"
    for top in (1.0, 1.0, 25.0):
        mesh.write_text(CUBE.replace("v 0 0 1", f"v 0 0 {top}"))
        assert hull_points(mesh)[:, 2].max() == top
