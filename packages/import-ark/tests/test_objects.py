"""Objects: primitives and URDFs, wherever Ark would find them."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from ark_kit import BALL, DATA, PANDA, changed, imported, raises_problems, row, write
from hal_import_ark import ArkOptions, import_ark

import hal
from hal.geometry import Pose

MUG = DATA / "tutorial" / "config" / "objects" / "mug" / "model.urdf"


def primitive(kind: str, sizes: dict[str, Any], drawn: dict[str, Any] | None = None) -> dict[str, Any]:
    return changed(
        BALL,
        collision={"shape_type": kind, "collision_shape": sizes},
        visual={"shape_type": kind, "visual_shape": {**(drawn or sizes), "rgbaColor": [0, 1, 0, 1]}},
    )


BOX, TALL, LONG = {"halfExtents": [0.1, 0.2, 0.3]}, {"radius": 0.1, "height": 0.3}, {"radius": 0.1, "length": 0.3}


@pytest.mark.parametrize(
    ("config", "expected"),
    [
        (primitive("GEOM_BOX", BOX), {"shape": "box", "half_extents": [0.1, 0.2, 0.3]}),
        (primitive("GEOM_SPHERE", {"radius": 0.1}), {"shape": "sphere", "radius": 0.1}),
        (primitive("GEOM_CYLINDER", TALL, LONG), {"shape": "cylinder", **LONG}),
        (primitive("geom_capsule", TALL, LONG), {"shape": "capsule", **LONG}),
        (primitive("GEOM_PLANE", {}), {"shape": "plane"}),
    ],
)
def test_primitives(tmp_path: Path, config: dict[str, Any], expected: dict[str, Any]) -> None:
    data, result = imported(tmp_path, robots={"arm": PANDA}, objects={"thing": config})
    rest = {"name": "thing", "rgba": [0, 1, 0, 1], "mass": 0.1, "position": [0, 0, 1]}
    assert data["objects"] == [{**rest, **expected}]
    assert not [one.node.key for one in result.rows if one.outcome == "unknown"]
    with hal.open(str(tmp_path / "rig.yaml"), sim=True, clock="lock_step", pad="none") as rig:
        assert "thing" in rig.world.bodies


def test_what_only_is_seen_or_only_is_touched(tmp_path: Path) -> None:
    seen, touched = changed(BALL, collision=None), changed(BALL, visual=None)
    data, _ = imported(tmp_path, objects={"seen": seen, "touched": touched})
    assert data["objects"][0]["collision"] is False
    assert data["objects"][0]["rgba"] == [0, 1, 0, 1]
    assert data["objects"][1]["visible"] is False


def test_files_for_newer_simulators_have_whole_sides(tmp_path: Path) -> None:
    config = {"source": "primitive", "size": [0.2, 0.2, 0.1], "mass": 0.05, "base_position": [0, 0, 1], "friction": 2.0}
    data, result = imported(tmp_path, objects={"box": config})
    assert data["objects"][0]["half_extents"] == [0.1, 0.1, 0.05]
    assert data["objects"][0]["mass"] == 0.05
    assert row(result, "objects.0.config.friction")[0] == "unknown"


def test_a_shape_that_looks_different_is_drawn_as_it_is_touched(tmp_path: Path) -> None:
    config = primitive("GEOM_BOX", {"halfExtents": [0.1, 0.1, 0.1]}, {"halfExtents": [0.2, 0.2, 0.2]})
    data, result = imported(tmp_path, objects={"box": config})
    assert data["objects"][0]["half_extents"] == [0.1, 0.1, 0.1]
    key = "objects.0.config.visual.visual_shape.halfExtents"
    assert row(result, key) == ("changed", "objects.0.half_extents; what is drawn here is the collision shape")


def test_a_body_without_mass_stands_still_and_its_dynamics_are_reported(tmp_path: Path) -> None:
    config = changed(BALL, multi_body__baseMass=0, dynamics={"lateralFriction": 0.7, "jointDamping": 1})
    data, result = imported(tmp_path, objects={"ball": config})
    assert data["objects"][0]["mass"] == 0
    assert row(result, "objects.0.config.dynamics.lateralFriction") == (
        "ignored",
        "not in a rig's file: rig.world.set_dynamics('ball', lateral_friction=0.7)",
    )
    assert row(result, "objects.0.config.dynamics.jointDamping")[1] == "rig.world.set_dynamics has no such"


def test_euler_angles(tmp_path: Path) -> None:
    data, result = imported(tmp_path, objects={"ball": changed(BALL, base_orientation=[0.1, -0.2, 0.3])})
    turned = Pose([0, 0, 1], data["objects"][0]["orientation"])
    assert turned.distance(Pose.from_rpy([0, 0, 1], [0.1, -0.2, 0.3])) == pytest.approx((0, 0), abs=1e-5)
    assert row(result, "objects.0.config.base_orientation")[0] == "changed"
    assert "# Ark: [0.1, -0.2, 0.3]" in (tmp_path / "rig.yaml").read_text()


def mug(path: str, **keys: Any) -> dict[str, Any]:
    return {"source": "urdf", "urdf_path": path, "base_position": [0, 0, 1], **keys}


def put(file: Path) -> Path:
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(MUG.read_text())
    return file


def test_urdfs_are_found_from_where_ark_is_started(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ark's paths are relative to that; here it need not be where this program is."""
    monkeypatch.chdir("/")
    folder = tmp_path / "lab" / "config"
    folder.mkdir(parents=True)
    source = write(folder, objects={"mug": mug("things/mug.urdf")})

    def found(options: ArkOptions | None = None) -> Path:
        entry = import_ark(source, options).entries["objects"][0]
        return Path(entry["urdf"])

    with pytest.raises(hal.ConfigError) as caught:
        found()
    assert caught.value.problems[0].file.startswith(f"{source}:")
    assert caught.value.problems[0].code == "missing_file"
    above = put(tmp_path / "lab" / "things" / "mug.urdf")
    assert found() == above
    nearer = put(folder / "things" / "mug.urdf")
    assert found() == nearer
    elsewhere = put(tmp_path / "started" / "things" / "mug.urdf")
    assert found(ArkOptions(start=tmp_path / "started")) == elsewhere
    named = put(tmp_path / "mug2.urdf")
    assert found(ArkOptions(urdfs={"mug": named})) == named


def test_urdfs_of_pybullet_are_named_by_their_package(tmp_path: Path) -> None:
    pytest.importorskip("pybullet_data")
    data, _ = imported(tmp_path, robots={"arm": PANDA}, objects={"duck": mug("duck_vhacd.urdf", global_scaling=0.5)})
    assert data["objects"][0]["urdf"] == {"package": "pybullet_data", "path": "duck_vhacd.urdf"}
    assert data["objects"][0]["scale"] == 0.5
    with hal.open(str(tmp_path / "rig.yaml"), sim=True, clock="lock_step", pad="none") as rig:
        assert np.isfinite(rig.world.pose("duck").position).all()


def test_a_file_with_a_list_of_items_is_read(tmp_path: Path) -> None:
    """As the example files of Ark's own drivers do."""
    (tmp_path / "balls.yaml").write_text(yaml.safe_dump({"objects": [{"name": "a", "config": BALL}, "balls.yaml"]}))
    source = write(tmp_path)
    data = yaml.safe_load(source.read_text())
    source.write_text(yaml.safe_dump({**data, "objects": ["balls.yaml"]}))
    with raises_problems("wrong_type"):
        import_ark(source)
    (tmp_path / "balls.yaml").write_text(yaml.safe_dump({"objects": [{"name": "a", "config": BALL}]}))
    assert [thing["name"] for thing in import_ark(source).entries["objects"]] == ["a"]


def test_a_duplicate_name_is_reported(tmp_path: Path) -> None:
    pytest.importorskip("pybullet_data")
    for name in ("one", "two"):
        (tmp_path / f"{name}.yaml").write_text("name: ball\nconfig: {source: urdf, urdf_path: duck_vhacd.urdf}\n")
    source = tmp_path / "global.yaml"
    source.write_text("simulator: {config: {}}\nobjects: [one.yaml, two.yaml]\n")
    with pytest.raises(hal.ConfigError) as caught:
        import_ark(source)
    (problem,) = caught.value.problems
    assert (problem.file, problem.code) == (f"{tmp_path / 'two.yaml'}:1", "duplicate_name")
