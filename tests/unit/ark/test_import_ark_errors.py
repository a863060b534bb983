"""Problems in Ark's files are listed with file and line, all at once."""

from __future__ import annotations

import shutil
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
import yaml
from ark_kit import BALL, CAMERA, DATA, PANDA, TUTORIAL, changed, write

from hal import ConfigError
from hal.ark import import_ark
from hal.errors import Problem


def raised(source: Path) -> Sequence[Problem]:
    with pytest.raises(ConfigError) as caught:
        import_ark(source)
    return caught.value.problems


def problems(source: Path) -> list[str]:
    return [str(problem) for problem in raised(source)]


@pytest.fixture
def tutorial(tmp_path: Path) -> Path:
    """A copy of the tutorial's files, to break."""
    shutil.copytree(TUTORIAL.parents[1], tmp_path / "tutorial")
    return tmp_path / "tutorial" / "config" / "global_config.yaml"


def test_an_unclosed_quote_is_reported_where_it_opens(tutorial: Path) -> None:
    table = tutorial.parent / "objects" / "table.yaml"
    shutil.copy(DATA / "unclosed_quote.yaml", table)
    (told,) = problems(tutorial)
    assert told.startswith(f'{table}:1: the quote that opens here is not closed: name: "table (in line 3:')


@pytest.mark.parametrize(
    ("text", "line", "said"),
    [
        ('name: "x"\nconfig:\n  source: "urdf', 3, 'the quote that opens here is not closed: source: "urdf'),
        ("name: 'x\nconfig:\n  source: 'urdf'", 1, "the quote that opens here is not closed: name: 'x"),
        ('name: "x"  # it\'s fine\nconfig:\n  a: "b"c"', 3, "is not valid YAML"),
        ("name: x\n config: {}", 2, "is not valid YAML: mapping values are not allowed here: config: {}"),
        ("name: x\nconfig: [1, 2", 2, "is not valid YAML"),
        ("\tname: x", 1, "is not valid YAML"),
        ("name: x\nconfig: \0", 2, "holds a character that YAML does not allow: 0x0"),
    ],
)
def test_invalid_yaml_is_reported_with_its_line(tutorial: Path, text: str, line: int, said: str) -> None:
    table = tutorial.parent / "objects" / "table.yaml"
    table.write_text(text)
    (told,) = problems(tutorial)
    assert told.startswith(f"{table}:")
    assert abs(int(told.removeprefix(f"{table}:").partition(":")[0]) - line) <= (0 if "quote" in said else 1)
    assert said in told


def test_a_quote_that_closes_lines_later_is_reported(tmp_path: Path) -> None:
    source = tmp_path / "global.yaml"
    source.write_text('simulator:\n  name: "x\n  backend_type: pybullet"\n  config: {}\n')
    (told,) = problems(source)
    assert (
        told == f"{source}:2: simulator.name: the quote that opens in this line closes only in line 3: is one missing?"
    )


def test_a_key_that_is_given_twice_is_reported(tmp_path: Path) -> None:
    source = tmp_path / "global.yaml"
    source.write_text("simulator:\n  name: x\n  config: {}\n  name: y\n")
    (told,) = problems(source)
    assert told == f"{source}:4: simulator.name: is also given in line 2; Ark uses the last one. Remove one"


@pytest.mark.parametrize("text", ["", "- a\n- b\n", "just text"])
def test_a_file_without_keys_is_reported(tmp_path: Path, text: str) -> None:
    source = tmp_path / "global.yaml"
    source.write_text(text)
    (told,) = problems(source)
    assert "must be keys and values" in told


def test_a_file_that_is_not_there_is_reported(tutorial: Path) -> None:
    (tutorial.parent / "robots" / "franka.yaml").rename(tutorial.parent / "robots" / "franka2.yaml")
    (told,) = problems(tutorial)
    assert "robots/franka.yaml: there is no such file; did you mean 'franka2.yaml'?" in told
    (told,) = problems(tutorial.with_name("globl_config.yaml"))
    assert "did you mean 'global_config.yaml'?" in told


def test_all_problems_are_reported_at_once_and_each_once(tutorial: Path) -> None:
    robot = tutorial.parent / "robots" / "franka.yaml"
    robot.write_text(robot.read_text().replace("[-0.55, 0.0, 0.6]", "[-0.55, 0.6]"))
    mug = tutorial.parent / "objects" / "mug.yaml"
    mug.write_text(mug.read_text().replace("model.urdf", "modle.urdf"))
    camera = tutorial.parent / "sensors" / "fixed_camera.yaml"
    camera.write_text(camera.read_text().replace("distance: 0.9", "distance: near"))
    told = problems(tutorial)
    assert len(told) == 3, "the camera on the arm is not wrong because the arm is"
    assert any(
        t.startswith(f"{robot}:9: config.base_position: must be a list of 3 numbers, not a list of 2") for t in told
    )
    assert any(t.startswith(f"{mug}:4: config.urdf_path: there is no file") and "--without Mug" in t for t in told)
    assert any(t.startswith(f"{camera}:20: config.sim_config.fix.distance: must be a positive number") for t in told)


def test_problems_of_the_rig_are_reported_at_arks_line(tmp_path: Path) -> None:
    source = write(tmp_path, robots={"Franka": changed(PANDA, initial_configuration=[0.0] * 10)})
    line = next(k for k, text in enumerate(source.read_text().splitlines(), 1) if "initial_configuration" in text)
    (told,) = problems(source)
    assert told.startswith(f"{source}:{line}: robots.0.config.initial_configuration: joint 'panda_joint4' is at 0")
    assert "(as robots.Franka.initial of the rig)" in told


BAD_ARMS: list[tuple[dict[str, Any], str]] = [
    ({"use_fixed_base": False}, "use_fixed_base: an arm stands fixed here"),
    ({"source": "mjcf"}, "source: only a urdf can be taken over, not 'mjcf'"),
    (
        {"initial_configuration": [0, 0, 0]},
        "initial_configuration: has 3 numbers; in Ark panda has 7, 9, 10, 12 joints",
    ),
    ({"initial_configuration": [0] * 11}, "initial_configuration: has 11 numbers"),
    ({"initial_configuration": [0, 0, 0, "x", 0, 0, 0]}, "item 4 is 'x'"),
    ({"base_orientation": [0, 0, 0, 0]}, "base_orientation: is no rotation"),
    ({"base_orientation": [0, 0]}, "base_orientation: must be a list of 3 or 4 numbers, not a list of 2"),
    ({"ee_index": "hand"}, "ee_index: must be a whole number"),
    ({"joint_groups__arm__joints": "panda_joint1"}, "joints: must be a list of names"),
    ({"joint_groups": None, "urdf_path": "ur5.urdf"}, "urdf_path: there is no file 'ur5.urdf', in class_dir or in"),
]


ARM_AND_BALL: dict[str, Any] = {"robots": {"Franka": PANDA}, "objects": {"ball": BALL}}
BAD_CAMERAS: list[tuple[dict[str, Any], str]] = [
    ({"type": "Lidar"}, "type: a sensor of type 'Lidar' has no counterpart; --without eye leaves it out"),
    ({"camera_type": "flying"}, "camera_type: must be fixed or attached, not 'flying'"),
    ({"camera_type": "attached"}, "'attach' is missing"),
    ({"width": 0.5}, "width: must be a whole number"),
    ({"frequency": 0}, "frequency: must be a positive number"),
    ({"streams__color__enable": False}, "streams: every stream is off"),
    ({"streams__thermal": {"enable": True}}, "there is no such stream; there are color, depth, infrared, segmentation"),
    ({"sim_config__fix__distance": None}, "'distance' is missing"),
    ({"sim_config__fix__up_axis_index": 0}, "must be 2 (z) or 1 (y)"),
    ({"sim_config__attach": {"parent_name": "ball"}, "camera_type": "attached"}, "'ball' is an object"),
    ({"sim_config__attach": {"parent_name": "Frank"}, "camera_type": "attached"}, "is nothing that is imported"),
    (
        {"sim_config__attach": {"parent_name": "Franka", "parent_link": "elbow"}, "camera_type": "attached"},
        "robot 'Franka' has no link 'elbow'",
    ),
    (
        {"sim_config__attach": {"parent_name": "Franka", "rel_camera_target": [0, 0, 0]}, "camera_type": "attached"},
        "is no direction",
    ),
]


BAD_OBJECTS: list[tuple[dict[str, Any], str]] = [
    ({"source": "sdf"}, "source: must be urdf or primitive, not 'sdf'; --without ball leaves it out"),
    ({"source": None}, "'source' is missing"),
    ({"collision__shape_type": "GEOM_MESH"}, "GEOM_MESH has no counterpart"),
    ({"collision__collision_shape__radius": None}, "radius is missing: PyBullet would take its own default"),
    ({"collision__collision_shape__radius": -1}, "must be a positive number, not -1"),
    ({"collision": None, "visual": None}, "has neither a collision nor a visual shape"),
    ({"base_position": [0, 0, float("inf")]}, "must be numbers; item 3 is inf"),
    ({"multi_body__baseMass": "heavy"}, "must be a number, not 'heavy'"),
    ({"multi_body__baseMass": -1}, "must be 0 to 50 kg, not -1 (as objects.0"),
]


BAD_SECTIONS: list[tuple[dict[str, Any], str]] = [
    *(({"robots": {"Franka": changed(PANDA, **keys)}}, said) for keys, said in BAD_ARMS),
    *(({**ARM_AND_BALL, "sensors": {"eye": changed(CAMERA, **keys)}}, said) for keys, said in BAD_CAMERAS),
    *(({"objects": {"ball": changed(BALL, **keys)}}, said) for keys, said in BAD_OBJECTS),
]


@pytest.mark.parametrize(("sections", "said"), BAD_SECTIONS, ids=[said[:30] for _, said in BAD_SECTIONS])
def test_a_wrong_value_is_one_problem_at_its_line(tmp_path: Path, sections: dict[str, Any], said: str) -> None:
    (told,) = problems(write(tmp_path, **sections))
    assert told.startswith(str(tmp_path / "global_config.yaml:"))
    assert said in told


@pytest.mark.parametrize(
    ("section", "said"),
    [
        ("a", "must be a list of files, or of items with name and config"),
        ([3], "must be files, or items with name and config, not 3"),
        ([{"name": "x"}], "'config' is missing"),
        ([{"config": {}}], "'name' is missing"),
        ([{"name": 3, "config": {}}], "must be a text, not 3"),
    ],
)
def test_sections(tmp_path: Path, section: Any, said: str) -> None:
    source = write(tmp_path)
    data = yaml.safe_load(source.read_text())
    source.write_text(yaml.safe_dump({**data, "objects": section}))
    (told,) = problems(source)
    assert said in told


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
    assert [(one.file, one.code) for one in raised(source)] == [(str(source), "newer_ark")]


@pytest.mark.parametrize("text", ["network: {registry: 127.0.0.1}\n", "name: table\nconfig: {mass: 1}\n", "{}\n"])
def test_a_file_that_is_no_global_file_is_refused(tmp_path: Path, text: str) -> None:
    source = tmp_path / "global.yaml"
    source.write_text(text)
    assert [one.code for one in raised(source)] == ["not_ark"]
