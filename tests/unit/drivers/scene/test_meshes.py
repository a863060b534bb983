"""Mesh files: colours, normals, fewer triangles, and the cache that makes the second start quick."""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import pytest
from pictures_kit import COLLADA

from hal.drivers.scene.meshes import MeshLibrary, parse, simplify_mesh
from hal.drivers.scene.shapes import Mesh, box, capsule, cylinder, sphere
from hal.kinematics.mesh_files import cache_folder

CUBE = """\
mtllib cube.mtl
v 0 0 0
v 1 0 0
v 1 1 0
v 0 1 0
v 0 0 1
v 1 0 1
v 1 1 1
v 0 1 1
usemtl red
f 1 4 3 2
f 5 6 7 8
usemtl green
f 1 2 6 5
f 2 3 7 6
f 3 4 8 7
f 4 1 5 8
"""
MATERIALS = """\
newmtl red
Kd 1.0 0.0 0.0
newmtl green
Kd 0.0 1.0 0.0
"""


class Counted:
    """A parser that counts its calls."""

    def __init__(self) -> None:
        self.calls = 0

    def __call__(self, path: str) -> list[Mesh]:
        self.calls += 1
        return parse(path)


@pytest.fixture
def cube(tmp_path: Path) -> Path:
    (tmp_path / "model").mkdir()
    (tmp_path / "model" / "cube.mtl").write_text(MATERIALS)
    path = tmp_path / "model" / "cube.obj"
    path.write_text(CUBE)
    return path


def volume(mesh: Mesh) -> float:
    corners = mesh.positions.astype(float)[mesh.faces]
    return float(np.einsum("ij,ij->i", corners[:, 0], np.cross(corners[:, 1], corners[:, 2])).sum() / 6)


def same(one: list[Mesh], other: list[Mesh]) -> bool:
    return len(one) == len(other) and all(
        np.array_equal(getattr(a, name), getattr(b, name))
        for a, b in zip(one, other, strict=True)
        for name in ("positions", "normals", "colors", "faces", "closed", "material")
    )


def test_the_second_start_does_not_parse(cube: Path, tmp_path: Path) -> None:
    first, second = Counted(), Counted()
    parsed = MeshLibrary(tmp_path / "cache", first).load(str(cube))
    cached = MeshLibrary(tmp_path / "cache", second).load(str(cube))
    assert (first.calls, second.calls) == (1, 0)
    assert same(parsed, cached)


@pytest.mark.parametrize("name", ["cube.obj", "cube.mtl"])
def test_a_changed_file_is_parsed_again(cube: Path, tmp_path: Path, name: str) -> None:
    before = MeshLibrary(tmp_path / "cache").load(str(cube))
    file = cube.parent / name
    file.write_text(file.read_text().replace("Kd 1.0 0.0 0.0", "Kd 0.0 0.0 1.0").replace("v 1 1 1", "v 2 2 2"))
    stamp = file.stat().st_mtime_ns + 1_000_000_000
    os.utime(file, ns=(stamp, stamp))
    counted = Counted()
    after = MeshLibrary(tmp_path / "cache", counted).load(str(cube))
    assert counted.calls == 1
    assert not same(before, after)


@pytest.mark.parametrize("damage", ["", "no archive", "cut"])
def test_a_broken_cache_file_is_made_again(cube: Path, tmp_path: Path, damage: str) -> None:
    good = MeshLibrary(tmp_path / "cache").load(str(cube))
    (file,) = (tmp_path / "cache").iterdir()
    whole = file.read_bytes()
    file.write_bytes(whole[: len(whole) // 2] if damage == "cut" else damage.encode())
    counted = Counted()
    assert same(MeshLibrary(tmp_path / "cache", counted).load(str(cube)), good)
    assert counted.calls == 1
    again = Counted()
    MeshLibrary(tmp_path / "cache", again).load(str(cube))
    assert again.calls == 0


def test_cache_that_cannot_be_written_is_ignored(cube: Path, tmp_path: Path) -> None:
    obstacle = tmp_path / "obstacle"
    obstacle.write_text("a file where the folder should be")
    counted = Counted()
    library = MeshLibrary(obstacle / "cache", counted)
    assert len(library.load(str(cube))) == 1
    assert library.load(str(cube)) is library.load(str(cube))
    assert counted.calls == 1


def test_cache_folder_follows_the_environment(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    assert cache_folder("meshes") == tmp_path / "robot-hal" / "meshes"
    monkeypatch.delenv("XDG_CACHE_HOME")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert cache_folder("meshes") == tmp_path / ".cache" / "robot-hal" / "meshes"


def test_broken_files_are_left_out_with_a_warning(tmp_path: Path) -> None:
    broken = tmp_path / "broken.obj"
    broken.write_text("this is no mesh")
    with pytest.warns(UserWarning, match="broken.obj"):
        assert MeshLibrary(tmp_path / "cache").load(str(broken)) == []
    collada = tmp_path / "part.dae"
    collada.write_text("<COLLADA/>")
    with pytest.warns(UserWarning, match="part.dae"):
        assert MeshLibrary(tmp_path / "cache").load(str(collada)) == []
    with pytest.warns(UserWarning, match="gone.obj"):
        assert MeshLibrary(tmp_path / "cache").load(str(tmp_path / "gone.obj")) == []


def test_materials_normals_and_solidity(cube: Path) -> None:
    (mesh,) = parse(str(cube))
    assert volume(mesh) == pytest.approx(1.0)
    assert mesh.closed
    assert np.allclose(np.abs(mesh.normals).max(axis=1), 1.0)  # sharp edges stay sharp: every normal is an axis
    flat = np.abs(mesh.normals[:, 2]) > 0.5
    assert (mesh.colors[flat] == [255, 0, 0, 255]).all()
    assert (mesh.colors[~flat] == [0, 255, 0, 255]).all()
    painted = mesh.tinted((0.0, 0.0, 1.0, 1.0))
    assert (painted.colors == [0, 0, 255, 255]).all()  # the URDF's colour replaces the file's


def test_a_collada_file_keeps_its_units_its_nodes_scale_and_its_colours(tmp_path: Path) -> None:
    part = tmp_path / "part.dae"
    part.write_text(COLLADA)
    (mesh,) = parse(str(part))
    assert np.ptp(mesh.positions, axis=0) == pytest.approx([0.02, 0.02, 0.06])
    assert volume(mesh) == pytest.approx(0.02 * 0.02 * 0.06 / 6.0)
    assert (mesh.colors == [255, 0, 0, 255]).all()
    slope = np.array([3.0, 3.0, 1.0]) / np.sqrt(19.0)
    assert np.linalg.norm(mesh.normals - slope, axis=1).min() < 1e-6, "the normal of the stretched face"


def test_primitives_have_their_volume_and_look_outwards() -> None:
    shapes = {
        8 * 0.1 * 0.2 * 0.3: box((0.1, 0.2, 0.3)),
        4 / 3 * np.pi * 0.2**3: sphere(0.2),
        np.pi * 0.1**2 * 0.5: cylinder(0.1, 0.5),
        np.pi * 0.1**2 * 0.3 + 4 / 3 * np.pi * 0.1**3: capsule(0.1, 0.3),
    }
    for expected, mesh in shapes.items():
        assert volume(mesh) == pytest.approx(expected, rel=0.01)
        mirrored = mesh.scaled((1.0, -1.0, 1.0))
        assert volume(mirrored) == pytest.approx(volume(mesh))
        for one in (mesh, mirrored):
            corners = one.positions[one.faces]
            across = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
            assert (np.einsum("ij,ij->i", across, one.normals[one.faces].mean(axis=1)) > 0).all()


def test_a_heavy_mesh_gets_lighter_and_keeps_its_shape() -> None:
    """A finely divided box with one rounded end: flat faces and corners stay exactly, the curve nearly."""
    side = np.linspace(-1, 1, 60)
    grid = np.stack(np.meshgrid(side, side, indexing="ij"), axis=-1).reshape(-1, 2)
    height = np.where(grid[:, 0] > 0, np.sqrt(4 - np.maximum(grid[:, 0], 0) ** 2), 2.0)
    positions = np.concatenate([grid, height[:, None]], axis=1).astype(np.float32)
    first = (np.arange(59)[:, None] * 60 + np.arange(59)).reshape(-1)
    quads = np.stack([first, first + 60, first + 61, first, first + 61, first + 1], axis=1)
    faces = quads.reshape(-1, 3).astype(np.uint32)
    heavy = Mesh(positions, np.zeros_like(positions), np.zeros((3600, 4), np.uint8), faces)
    light = simplify_mesh(heavy)
    assert len(light.faces) < 0.5 * len(heavy.faces)
    used = light.positions[light.faces].reshape(-1, 3)
    assert (used.min(axis=0) == positions.min(axis=0)).all()
    assert (used.max(axis=0) == positions.max(axis=0)).all()
    middle = light.positions[light.faces].mean(axis=1)
    truth = np.where(middle[:, 0] > 0, np.sqrt(4 - np.maximum(middle[:, 0], 0) ** 2), 2.0)
    assert np.abs(middle[:, 2] - truth).max() < 2e-3  # of a diagonal of 2.8
    assert simplify_mesh(light) is light
