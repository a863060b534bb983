"""Mistakes in rig files: all of them are reported at once, each with its file, key and code."""

from __future__ import annotations

import copy
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml
from errors_kit import NONSENSE, places
from pydantic import BaseModel

from hal.calibration.board import BoardConfig
from hal.config import load
from hal.config.data_files import find_data
from hal.config.files import Problems, read_yaml
from hal.config.mapping import TeleopMapping
from hal.config.models import CameraModel, RobotModel
from hal.config.objects import ObjectConfig
from hal.config.rigfile import RigFile
from hal.errors import ConfigError, Problem

ROBOT = {"model": "panda"}
LOOK = {"target": [0, 0, 0], "distance": 1.0}
CAMERA = {"model": "realsense_d435", "look_at": LOOK}
SERIAL = CAMERA | {"real": {"serial": "012345678901"}}
UR = {"model": "ur5e", "real": {"host": "192.0.2.1"}, "gripper": {"enabled": False}}


def problems(config: Any, **arguments: Any) -> list[Problem]:
    """The problems of a rig, which has some."""
    with pytest.raises(ConfigError) as caught:
        load(config, **arguments)
    return list(caught.value.problems)


def only(config: Any, **arguments: Any) -> Problem:
    """The only problem of a rig."""
    found = problems(config, **arguments)
    assert len(found) == 1, "\n".join(map(str, found))
    return found[0]


def robot(**keys: Any) -> dict[str, Any]:
    return {"robots": {"arm": {**ROBOT, **keys}}}


def camera(**keys: Any) -> dict[str, Any]:
    return {"robots": {"arm": ROBOT}, "cameras": {"eye": {**CAMERA, **keys}}}


def held(**keys: Any) -> dict[str, Any]:
    return camera(look_at=None, attached={"robot": "arm", "link": "panda_hand", **keys})


def leader(**keys: Any) -> dict[str, Any]:
    return {"robots": {"arm": ROBOT}, "leaders": {"l": {"model": "so101_leader", "port": "/dev/a", **keys}}}


def thing(**keys: Any) -> dict[str, Any]:
    return {"objects": [{"name": "brick", "shape": "box", "half_extents": [1, 1, 1], **keys}]}


@pytest.mark.parametrize(
    ("config", "key", "code"),
    [
        # Unknown keys, with the nearest right one.
        ({"robtos": {}}, "robtos", "unknown_key"),
        (camera(streams={"colour": {}}), "cameras.eye.streams.colour", "invalid_choice"),
        (camera(streams={"color": {"fromat": "bgr8"}}), "cameras.eye.streams.color.fromat", "unknown_key"),
        # Unknown names, with the nearest right one.
        ({"objects": ["cub"]}, "objects.0", "unknown_object"),
        # A mode or a stream that the model lacks.
        (camera(depth={"min": 0.1, "max": 1.0}), "cameras.eye.depth", "not_adjustable"),
        (camera(streams=[]), "cameras.eye.streams", "missing_key"),
        # Wrong types and wrong counts.
        ({"sim": "yes"}, "sim", "wrong_type"),
        ({"robots": ["panda"]}, "robots", "wrong_type"),
        ({"robots": {"arm": "panda"}}, "robots.arm", "wrong_type"),
        ({"objects": {"cube": 1}}, "objects", "wrong_type"),
        ({"objects": [7]}, "objects.0", "wrong_type"),
        (robot(speed=1.5), "robots.arm.speed", "out_of_range"),
        (robot(at="arm-pc:99999"), "robots.arm.at", "out_of_range"),
        (robot(speed=True), "robots.arm.speed", "wrong_type"),
        (robot(model=5), "robots.arm.model", "wrong_type"),
        ({"robots": {"arm": {}}}, "robots.arm.model", "missing_key"),
        ({"robots": {"my arm": ROBOT}}, "robots.my arm", "bad_name"),
        (camera(output={"width": 256.5, "height": 256}), "cameras.eye.output.width", "wrong_type"),
        (camera(output={"width": "256", "height": 256}), "cameras.eye.output.width", "wrong_type"),
        (camera(output={"width": 0, "height": 256}), "cameras.eye.output.width", "out_of_range"),
        ({"simulation": {"physics_hz": float("nan")}}, "simulation.physics_hz", "wrong_type"),
        ({"simulation": {"gravity": -9.81}}, "simulation.gravity", "wrong_type"),
        ({"simulation": {"gravity": [0, 0, "down"]}}, "simulation.gravity", "wrong_type"),
        # Wrong units: a pose of 3 numbers where 7 are due, degrees, a quaternion that is none.
        (camera(look_at=None, pose=[0, 0, 1]), "cameras.eye.pose", "wrong_count"),
        (robot(base={"position": [0, 0]}), "robots.arm.base.position", "wrong_count"),
        (robot(base={"orientation": [0, 0, 90]}), "robots.arm.base.orientation", "wrong_count"),
        (robot(base={"orientation": [0, 0, 90, 1]}), "robots.arm.base.orientation", "bad_rotation"),
        (robot(initial=[0, 0, 0]), "robots.arm.initial", "wrong_count"),
        (
            held(rotation=[1, 2]),
            "cameras.eye.attached.rotation",
            "wrong_count",
        ),
        (
            held(target=[0, 0, 0]),
            "cameras.eye.attached.target",
            "out_of_range",
        ),
        # A simulated camera must stand somewhere, and in one place.
        (camera(pose={}), "cameras.eye", "conflict"),
        # Numbers that are out of every plausible range are mostly in another unit.
        (camera(look_at={**LOOK, "distance": 1200}), "cameras.eye.look_at.distance", "out_of_range"),
        (camera(look_at={**LOOK, "target": [0, 500, 0]}), "cameras.eye.look_at.target", "out_of_range"),
        (thing(half_extents=[1, 0, 1]), "objects.0.half_extents", "out_of_range"),
        (thing(mass=100), "objects.0.mass", "out_of_range"),
        (robot(base={"position": [-550, 0, 0]}), "robots.arm.base.position", "out_of_range"),
        (robot(limits={"velocity": 150}), "robots.arm.limits.velocity", "out_of_range"),
        (robot(limits={"upper": 170, "allow_looser_limits": True}), "robots.arm.limits.upper", "out_of_range"),
        (robot(workspace={"table_height": 200}), "robots.arm.workspace.table_height", "out_of_range"),
        ({"simulation": {"gravity": [0, 0, -981]}}, "simulation.gravity", "out_of_range"),
        # Limits.
        (robot(limits={"velocity": [1, 1]}), "robots.arm.limits.velocity", "wrong_count"),
        (robot(limits={"velocity": 3.0}), "robots.arm.limits.velocity", "looser_limit"),
        (robot(limits={"lower": -3.0}), "robots.arm.limits.lower", "looser_limit"),
        (robot(limits={"velocity": -1.0}), "robots.arm.limits.velocity", "out_of_range"),
        (robot(gripper={"speed": 0.9}), "robots.arm.gripper.speed", "looser_limit"),
        (robot(gripper={"force": 100}), "robots.arm.gripper.force", "looser_limit"),
        ({"robots": {"a": {"model": "iiwa", "gripper": {"speed": 0.1}}}}, "robots.a.gripper", "no_gripper"),
        # Objects.
        (thing(half_extents=None), "objects.0", "missing_key"),
        (thing(shape="cone"), "objects.0.shape", "invalid_choice"),
        (thing(mass=-1), "objects.0.mass", "out_of_range"),
        ({"objects": ["cube", "cube"]}, "name", "duplicate_name"),
        ({"robots": {"cube": ROBOT}, "objects": ["cube"]}, "name", "duplicate_name"),
        ({"objects": ["cubes/brick.yaml"]}, "objects.0", "missing_file"),
        (thing(random={"y": 0.3}), "objects.0.random.y", "wrong_type"),
        (thing(random={"z": [1, 2, 3]}), "objects.0.random.z", "wrong_count"),
        (thing(random={"x": [0, float("nan")]}), "objects.0.random.x", "wrong_type"),
        (thing(random={"x": [0, "far"]}), "objects.0.random.x", "wrong_type"),
        (thing(random={"yaw_deg": [-400, 0]}), "objects.0.random.yaw_deg", "out_of_range"),
        (thing(random={}), "objects.0.random", "missing_key"),
        (thing(random=[-1, 1]), "objects.0.random", "wrong_type"),
        ({"objects": [{"name": "f", "shape": "plane", "random": {"x": [0, 1]}}]}, "objects.0", "conflict"),
        (
            {"objects": [{"file": "cube", "attached": {"robot": "arm", "link": "hand"}, "random": {"x": [0, 1]}}]}
            | robot(),
            "objects.0",
            "conflict",
        ),
        # Pads.
        ({"gamepads": {"p": {"driver": "playback"}}}, "gamepads.p.file", "missing_key"),
        ({"gamepads": {"p": {"driver": "playback", "file": "no.jsonl"}}}, "gamepads.p.file", "missing_file"),
        ({"gamepads": {"p": {"file": "a.jsonl"}}}, "gamepads.p.file", "conflict"),
        ({"gamepads": {"p": {"sim": True, "driver": "evdev"}}}, "gamepads.p.sim", "conflict"),
        ({"gamepads": {"p": {"sim": False, "driver": "mock"}}}, "gamepads.p.sim", "conflict"),
        ({"gamepads": {"p": {"sim": False, "file": "a.jsonl"}}}, "gamepads.p.file", "conflict"),
        ({"gamepads": {"p": {"sim": True, "file": "no.jsonl"}}}, "gamepads.p.file", "missing_file"),
        ({"gamepads": {"p": {"sim": True, "options": {"loop": True}}}}, "gamepads.p.options", "conflict"),
        ({"gamepads": {"p": {"sim": "maybe"}}}, "gamepads.p.sim", "wrong_type"),
        # Leaders.
        (leader(model="so101_leadr"), "leaders.l.model", "unknown_model"),
        (leader(port=None), "leaders.l.port", "missing_key"),
        (leader(drives="b"), "leaders.l.drives", "unknown_robot"),
        (leader(deadman="pedal"), "leaders.l.deadman", "unknown_device"),
        (leader(signs=[1, 1, 1]), "leaders.l.signs", "wrong_count"),
        (leader(signs=[1, 1, 0.5, 1, 1]), "leaders.l.signs", "out_of_range"),
        (leader(options={"ids": [1, 2]}), "leaders.l.options.ids", "wrong_count"),
        (leader(engage="approach"), "leaders.l.engage", "conflict"),
        (leader(driver="ur"), "leaders.l.driver", "wrong_driver"),
        # Names and addresses of devices.
        ({"robots": {"a": ROBOT}, "cameras": {"a": CAMERA}}, "cameras.a", "duplicate_name"),
        ({"sim": False, "cameras": dict.fromkeys("ab", SERIAL)}, "cameras.b.real.serial", "duplicate_address"),
        ({"sim": False, "robots": dict.fromkeys("ab", UR)}, "robots.b.real.host", "duplicate_address"),
    ],
)
def test_one_mistake_is_one_problem_with_its_key(config: dict[str, Any], key: str, code: str) -> None:
    problem = only(config)
    assert (problem.key, problem.code) == (key, code)


@pytest.mark.parametrize(
    ("config", "key", "code", "words"),
    [
        (robot(sped=0.2), "sped", "unknown_key", "did you mean 'speed'"),
        (robot(model="pnada"), "model", "unknown_model", "did you mean 'panda'"),
        (robot(drivers={"sim": "pybulet"}), "", "unknown_driver", "did you mean 'pybullet'"),
        (robot(drivers={"sim": "evdev"}), "", "wrong_driver", "it has: gamepad"),
        (robot(tcp_speed=250), "tcp_speed", "out_of_range", "250 mm/s would be 0.25"),
        (robot(initial=[0, -45, 0, -135, 0, 90, 45]), "initial", "out_of_range", "'panda_joint2' is at -45"),
        (robot(base={"position": [0, 60, 0]}), "base.position", "out_of_range", "item 2 is 60; 60 mm would be 0.06"),
    ],
)
def test_messages_name_the_nearest_choice_the_unit_and_the_place(
    config: dict[str, Any], key: str, code: str, words: str
) -> None:
    problem = only(config)
    assert (problem.key, problem.code) == (f"robots.arm.{key}".rstrip("."), code)
    assert words in problem.message


@pytest.mark.parametrize(
    "model",
    [RigFile, RobotModel, CameraModel, ObjectConfig, TeleopMapping, BoardConfig],
    ids=lambda model: str(model.__name__),
)
def test_every_number_of_a_file_has_a_range(model: type[BaseModel]) -> None:
    def unlimited(schema: Any, place: str) -> Iterator[str]:
        if isinstance(schema, dict):
            most = {"maximum", "exclusiveMaximum"} & schema.keys()
            least = {"minimum", "exclusiveMinimum"} & schema.keys()
            if schema.get("type") in ("number", "integer") and not (most and least):
                yield place
        inner = schema.items() if isinstance(schema, dict) else enumerate(schema) if isinstance(schema, list) else ()
        for key, value in inner:
            yield from unlimited(value, f"{place}.{key}")

    assert list(unlimited(model.model_json_schema(), model.__name__)) == []


REAL = {"model": "panda", "sim": False, "drivers": {"real": "mock"}}


@pytest.mark.parametrize(
    ("keys", "place", "code"),
    [
        ({"tcp_speed": 3.0}, "robots.arm.tcp_speed", "out_of_range"),
        ({"limits": {"velocity": 20, "allow_looser_limits": True}}, "robots.arm.limits.velocity", "out_of_range"),
        ({"limits": {"jerk": 30000, "allow_looser_limits": True}}, "robots.arm.limits.jerk", "out_of_range"),
    ],
)
def test_what_a_simulation_may_do_a_real_arm_may_not(keys: dict[str, Any], place: str, code: str) -> None:
    config = {"robots": {"arm": {**REAL, **keys}}}
    load(config, sim=True)
    assert (place, code) in {(problem.key, problem.code) for problem in problems(config)}


# Files.


def test_missing_file_and_unknown_rig(tmp_path: Path) -> None:
    (tmp_path / "panda_bench.yaml").write_text("{}")
    problem = only(tmp_path / "panda_bnech.yaml")
    assert (problem.file, problem.code) == (str(tmp_path / "panda_bnech.yaml"), "missing_file")
    assert "'panda_bench.yaml'" in problem.message
    assert only("panda_tabel").code == "unknown_rig"


@pytest.mark.parametrize(
    ("text", "code"),
    [
        ("robots: {arm: [", "bad_yaml"),
        ("- a\n- b\n", "wrong_type"),
        ("", "wrong_type"),
        ("robots: !!python/object/apply:os.system ['true']", "bad_yaml"),
        ("a: 1\n---\nb: 2\n", "bad_yaml"),
        ("a: *nowhere", "bad_yaml"),
        ("robots: " + "[" * 2_000, "bad_yaml"),
        ("objects: &all [*all]", "bad_yaml"),
    ],
)
def test_files_that_are_no_rig(tmp_path: Path, text: str, code: str) -> None:
    (tmp_path / "rig.yaml").write_text(text)
    assert only(tmp_path / "rig.yaml").code == code


def test_what_a_caller_changes_in_read_data_is_not_read_again(tmp_path: Path) -> None:
    path, problems = tmp_path / "a.yaml", Problems()
    path.write_text("a: {b: [1]}")
    for _ in range(2):
        data = read_yaml(path, problems)
        assert data == {"a": {"b": [1]}}
        data["a"]["b"].append(2)


def test_keys_that_are_given_twice(tmp_path: Path) -> None:
    (tmp_path / "rig.yaml").write_text("robots:\n  arm: {model: panda}\n  arm: {model: fr3, speed: 0.1, speed: 0.2}\n")
    found = problems(tmp_path / "rig.yaml")
    assert {(problem.key, problem.code) for problem in found} == {
        ("robots.arm", "duplicate_key"),
        ("robots.arm.speed", "duplicate_key"),
    }
    assert "lines 2 and 3" in found[0].message


# Overrides and arguments.


@pytest.mark.parametrize(
    ("override", "key", "code"),
    [
        ("cameras.wrist.output.widht=320", "cameras.wrist.output.widht", "unknown_key"),
        ("cameras.wrsit.output.width=320", "cameras.wrsit.output.width", "unknown_device"),
        ("cameras.wrist.output.width=wide", "cameras.wrist.output.width", "wrong_type"),
        ("cameras.wrist.output.width=[", "cameras.wrist.output.width", "bad_yaml"),
        ("simulaton.physics_hz=1000", "simulaton", "unknown_key"),
        ("sim", "", "bad_override"),
        ("sim.deep=1", "sim.deep", "unknown_key"),
        ("objects.9=cube", "objects.9", "unknown_key"),
        ("robots..speed=1", "robots..speed", "bad_override"),
    ],
)
def test_overrides_are_to_blame_for_their_own_mistakes(override: str, key: str, code: str) -> None:
    problem = only("panda_table", overrides=[override])
    assert (problem.file, problem.key, problem.code) == ("--set", key, code)


def test_nonsense_anywhere_is_a_config_error_or_nothing_worse() -> None:
    """Nonsense in every place of a rig is a ConfigError, never another exception."""
    rig = yaml.safe_load(find_data("config", "panda_table.yaml").read_text())
    refused: list[Problem] = []
    for k, place in enumerate(places(rig)):
        broken = copy.deepcopy(rig)
        target = broken
        for part in place[:-1]:
            target = target[part]
        target[place[-1]] = NONSENSE[k % len(NONSENSE)]
        try:
            load(broken)
        except ConfigError as error:
            refused.extend(error.problems)
    assert len(refused) > 50
    assert all(problem.key and problem.message for problem in refused)


def test_arguments() -> None:
    found = problems("panda_table", clock="lockstep", driver="mok")
    assert {(problem.key, problem.code) for problem in found} == {
        ("clock", "invalid_choice"),
        ("driver", "wrong_driver"),
    }


def test_a_real_arm_without_a_driver_for_it() -> None:
    problem = only({"robots": {"arm": {"model": "iiwa"}}}, sim=False)
    assert (problem.key, problem.code) == ("robots.arm", "no_driver")
    assert "robots.arm.drivers.real" in problem.message


def test_an_object_whose_urdf_is_broken(tmp_path: Path) -> None:
    (tmp_path / "cup.urdf").write_text("<robot>")
    (tmp_path / "rig.yaml").write_text("objects: [{name: cup, urdf: cup.urdf}, {name: mug, urdf: mug.urdf}]")
    found = problems(tmp_path / "rig.yaml")
    assert [(Path(problem.file).name, problem.key) for problem in found] == [
        ("cup.urdf", ""),
        ("rig.yaml", "objects.1.urdf"),
    ]


def test_a_driver_whose_package_does_not_import() -> None:
    problem = only(robot(drivers={"sim": "no_such_lab.arm:DRIVER"}))
    assert (problem.key, problem.code) == ("robots.arm", "unknown_driver")


RANDOMIZED = {"robots": {"arm": ROBOT}, "cameras": {"eye": CAMERA}, "objects": ["table", "cube"]}
PICTURE = {"name": "ball", "shape": "sphere", "radius": 0.1}


@pytest.mark.parametrize(
    ("section", "key", "code", "says"),
    [
        ({"light": {"intensity": [2.0, 1.0]}}, "light.intensity", "empty_range", "2 is above 1"),
        ({"light": {"count": [1, 9]}}, "light.count", "out_of_range", "1 to 3"),
        ({"light": {"count": [1, 1.5]}}, "light.count", "wrong_type", "whole numbers"),
        ({"background": {"color": [[0, 0.9, 0], [1, 0.1, 1]]}}, "background.color", "empty_range", "green 0.9"),
        ({"objects": {"cubee": {}}}, "objects.cubee", "unknown_object", "did you mean 'cube'"),
        ({"objects": {"*": {"texture": ["wod"]}}}, "objects.*.texture.0", "unknown_texture", "did you mean 'wood'"),
        ({"objects": {"cube": {"texture": ["no.png"]}}}, "objects.cube.texture.0", "missing_file", "there is no file"),
        ({"objects": {"cube": {"texture": ["rig.txt"]}}}, "objects.cube.texture.0", "bad_texture", "PNG or JPEG"),
        ({"objects": {"cube": {"mass": [1, 2]}}}, "objects.cube.mass", "unknown_key", "mass_scale"),
        ({"robots": {"arm": {"links": {"hnd": {}}}}}, "robots.arm.links.hnd", "unknown_link", "did you mean 'hand'"),
        ({"cameras": {"ear": {}}}, "cameras.ear", "unknown_camera", "available: *, eye"),
        ({"cameras": {"*": {"latency_s": [0, 5]}}}, "cameras.*.latency_s", "out_of_range", "0 to 1 s"),
        ({"distractors": {"objects": [PICTURE], "count": [0, 2]}}, "distractors.count", "out_of_range", "2 of 1"),
        ({"distractors": {"objects": ["cube"], "count": [0, 1]}}, None, "duplicate_name", "cube"),
    ],
)
def test_ranges_of_a_randomization(
    section: dict[str, Any], key: str | None, code: str, says: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (tmp_path / "rig.txt").write_text("no picture")
    problem = only(RANDOMIZED | {"simulation": {"randomize": section}})
    assert problem.code == code
    assert says in problem.message
    if key is not None:
        assert (problem.file, problem.key) == ("<dict>", f"simulation.randomize.{key}")
