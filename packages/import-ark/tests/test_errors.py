"""Problems in Ark's files are listed with file and line, all at once."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from ark_kit import BALL, CAMERA, DATA, PANDA, TUTORIAL, changed, write
from hal_import_ark import import_ark

from hal import ConfigError
from hal.errors import Problem


def problems(source: Path) -> Sequence[Problem]:
    with pytest.raises(ConfigError) as caught:
        import_ark(source)
    return caught.value.problems


def found(source: Path) -> tuple[str, str, str]:
    """File and line, key and code of the only problem."""
    (problem,) = problems(source)
    return problem.file, problem.key, problem.code


@pytest.fixture
def tutorial(tmp_path: Path) -> Path:
    """A copy of the tutorial's files, to break."""
    shutil.copytree(TUTORIAL.parents[1], tmp_path / "tutorial")
    return tmp_path / "tutorial" / "config" / "global_config.yaml"


@pytest.mark.parametrize(
    ("text", "lines"),
    [
        ((DATA / "unclosed_quote.yaml").read_text(), {1}),  # unclosed quotes: the line where they open
        ('name: "x"\nconfig:\n  source: "urdf', {3}),
        ("name: 'x\nconfig:\n  source: 'urdf'", {1}),
        ('name: "x"  # it\'s fine\nconfig:\n  a: "b"c"', {3, 4}),
        ("name: x\n config: {}", {1, 2}),
        ("name: x\nconfig: [1, 2", {2, 3}),
        ("\tname: x", {1}),
        ("name: x\nconfig: \0", {2}),
    ],
)
def test_invalid_yaml_is_reported_with_its_line(tutorial: Path, text: str, lines: set[int]) -> None:
    table = tutorial.parent / "objects" / "table.yaml"
    table.write_text(text)
    place, key, code = found(tutorial)
    path, _, line = place.rpartition(":")
    assert (path, key, code) == (str(table), "", "bad_yaml")
    assert int(line) in lines


@pytest.mark.parametrize(
    ("text", "line", "key", "code"),
    [
        ('simulator:\n  name: "x\n  backend_type: pybullet"\n  config: {}\n', 2, "simulator.name", "bad_yaml"),
        ("simulator:\n  name: x\n  config: {}\n  name: y\n", 4, "simulator.name", "duplicate_key"),
        ("", None, "", "wrong_type"),
        ("- a\n- b\n", None, "", "wrong_type"),
        ("just text", None, "", "wrong_type"),
    ],
)
def test_the_global_file_is_checked(tmp_path: Path, text: str, line: int | None, key: str, code: str) -> None:
    source = tmp_path / "global.yaml"
    source.write_text(text)
    assert found(source) == (str(source) if line is None else f"{source}:{line}", key, code)


def test_a_missing_file_is_reported_with_its_likely_name(tutorial: Path) -> None:
    franka = tutorial.parent / "robots" / "franka.yaml"
    franka.rename(franka.with_name("franka2.yaml"))
    for source, missing, near in (
        (tutorial, franka, "franka2.yaml"),
        (tutorial.with_name("globl_config.yaml"),) * 2 + ("global_config.yaml",),
    ):
        (problem,) = problems(source)
        assert (problem.file, problem.code) == (str(missing), "missing_file")
        assert near in problem.message


def test_all_problems_are_reported_at_once_and_each_once(tutorial: Path) -> None:
    robot = tutorial.parent / "robots" / "franka.yaml"
    robot.write_text(robot.read_text().replace("[-0.55, 0.0, 0.6]", "[-0.55, 0.6]"))
    mug = tutorial.parent / "objects" / "mug.yaml"
    mug.write_text(mug.read_text().replace("model.urdf", "modle.urdf"))
    camera = tutorial.parent / "sensors" / "fixed_camera.yaml"
    camera.write_text(camera.read_text().replace("distance: 0.9", "distance: near"))
    assert {(problem.file, problem.key, problem.code) for problem in problems(tutorial)} == {
        (f"{robot}:9", "config.base_position", "wrong_count"),
        (f"{mug}:4", "config.urdf_path", "missing_file"),
        (f"{camera}:20", "config.sim_config.fix.distance", "wrong_type"),
    }, "the camera on the arm is not wrong because the arm is"


def test_problems_of_the_rig_are_reported_at_arks_line(tmp_path: Path) -> None:
    source = write(tmp_path, robots={"Franka": changed(PANDA, initial_configuration=[0.0] * 10)})
    line = next(k for k, text in enumerate(source.read_text().splitlines(), 1) if "initial_configuration" in text)
    (problem,) = problems(source)
    assert (problem.file, problem.key) == (f"{source}:{line}", "robots.0.config.initial_configuration")
    assert problem.code == "out_of_range"
    assert "(as robots.Franka.initial of the rig)" in problem.message


BAD_ARMS: list[tuple[dict[str, Any], str, str]] = [
    ({"use_fixed_base": False}, "use_fixed_base", "no_counterpart"),
    ({"source": "mjcf"}, "source", "no_counterpart"),
    ({"initial_configuration": [0, 0, 0]}, "initial_configuration", "wrong_count"),
    ({"initial_configuration": [0] * 11}, "initial_configuration", "wrong_count"),
    ({"initial_configuration": [0, 0, 0, "x", 0, 0, 0]}, "initial_configuration", "wrong_type"),
    ({"base_orientation": [0, 0, 0, 0]}, "base_orientation", "bad_rotation"),
    ({"base_orientation": [0, 0]}, "base_orientation", "wrong_count"),
    ({"ee_index": "hand"}, "ee_index", "wrong_type"),
    ({"joint_groups__arm__joints": "panda_joint1"}, "joint_groups.arm.joints", "wrong_type"),
    ({"joint_groups": None, "urdf_path": "ur5.urdf"}, "urdf_path", "missing_file"),
]
ARM_AND_BALL: dict[str, Any] = {"robots": {"Franka": PANDA}, "objects": {"ball": BALL}}
BAD_CAMERAS: list[tuple[dict[str, Any], str, str]] = [
    ({"type": "Lidar"}, "type", "no_counterpart"),
    ({"camera_type": "flying"}, "camera_type", "invalid_choice"),
    ({"camera_type": "attached"}, "sim_config", "missing_key"),
    ({"width": 0.5}, "width", "wrong_type"),
    ({"frequency": 0}, "frequency", "out_of_range"),
    ({"streams__color__enable": False}, "streams", "missing_key"),
    ({"streams__thermal": {"enable": True}}, "streams.thermal", "unknown_stream"),
    ({"sim_config__fix__distance": None}, "sim_config.fix", "missing_key"),
    ({"sim_config__fix__up_axis_index": 0}, "sim_config.fix.up_axis_index", "invalid_choice"),
    *(
        ({"camera_type": "attached", "sim_config__attach": attach}, f"sim_config.attach.{key}", code)
        for attach, key, code in (
            ({"parent_name": "ball"}, "parent_name", "unknown_device"),
            ({"parent_name": "Frank"}, "parent_name", "unknown_device"),
            ({"parent_name": "Franka", "parent_link": "elbow"}, "parent_link", "unknown_link"),
            ({"parent_name": "Franka", "rel_camera_target": [0, 0, 0]}, "rel_camera_target", "out_of_range"),
        )
    ),
]
BAD_OBJECTS: list[tuple[dict[str, Any], str, str]] = [
    ({"source": "sdf"}, "source", "no_counterpart"),
    ({"source": None}, "", "missing_key"),
    ({"collision__shape_type": "GEOM_MESH"}, "collision.shape_type", "no_counterpart"),
    ({"collision__collision_shape__radius": None}, "collision.collision_shape", "missing_key"),
    ({"collision__collision_shape__radius": -1}, "collision.collision_shape.radius", "out_of_range"),
    ({"collision": None, "visual": None}, "", "missing_key"),
    ({"base_position": [0, 0, float("inf")]}, "base_position", "wrong_type"),
    ({"multi_body__baseMass": "heavy"}, "multi_body.baseMass", "wrong_type"),
    ({"multi_body__baseMass": -1}, "multi_body.baseMass", "out_of_range"),
]


@pytest.mark.parametrize(
    ("sections", "section", "key", "code"),
    [
        *(({"robots": {"Franka": changed(PANDA, **keys)}}, "robots", *rest) for keys, *rest in BAD_ARMS),
        *(
            ({**ARM_AND_BALL, "sensors": {"eye": changed(CAMERA, **keys)}}, "sensors", *rest)
            for keys, *rest in BAD_CAMERAS
        ),
        *(({"objects": {"ball": changed(BALL, **keys)}}, "objects", *rest) for keys, *rest in BAD_OBJECTS),
    ],
)
def test_a_wrong_value_is_one_problem_at_its_line(
    tmp_path: Path, sections: dict[str, Any], section: str, key: str, code: str
) -> None:
    place, path, reason = found(write(tmp_path, **sections))
    assert place.startswith(str(tmp_path / "global_config.yaml:"))
    assert (path, reason) == (f"{section}.0.config.{key}".rstrip("."), code)


@pytest.mark.parametrize(
    ("section", "code"),
    [
        ("a", "wrong_type"),
        ([3], "wrong_type"),
        ([{"name": "x"}], "missing_key"),
        ([{"config": {}}], "missing_key"),
        ([{"name": 3, "config": {}}], "wrong_type"),
    ],
)
def test_sections(tmp_path: Path, section: Any, code: str) -> None:
    source = write(tmp_path)
    data = yaml.safe_load(source.read_text())
    source.write_text(yaml.safe_dump({**data, "objects": section}))
    assert found(source)[2] == code


@pytest.mark.parametrize(
    ("name", "text"),
    [
        ("hosts.yaml", "local:\n  name: localhost\n"),
        ("hosts.yaml", "external:\n  lab: {ssh_alias: lab, conda_path: /opt/conda, ssh_tunnel: true}\n"),
        ("nodes.yaml", "arm:\n  host: localhost\n  conda_env: ark\n  main: lab.arm:main\n  param: {hz: 100}\n"),
        ("sim_envs.yaml", "bench:\n  n_envs: 2\n  simulator: ark.sims:PybulletSim\n"),
    ],
)
def test_the_files_of_a_newer_ark_are_recognised_and_refused(tmp_path: Path, name: str, text: str) -> None:
    source = tmp_path / name
    source.write_text(text)
    assert [(one.file, one.code) for one in problems(source)] == [(str(source), "newer_ark")]


@pytest.mark.parametrize("text", ["network: {registry: 127.0.0.1}\n", "name: table\nconfig: {mass: 1}\n", "{}\n"])
def test_a_file_that_is_no_global_file_is_refused(tmp_path: Path, text: str) -> None:
    source = tmp_path / "global.yaml"
    source.write_text(text)
    assert [one.code for one in problems(source)] == ["not_ark"]
